"""The things around the arms: drawn from their specs, put where a mirror of the simulated world says that they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from viser import SceneApi, SceneNodeHandle

from hal import registry
from hal.errors import HalError
from hal.geometry import Pose
from hal.host.memory import SeriesBox
from hal.specs import BodySpec, WorldSpec, from_json

from .drawing import draw, place, wxyz
from .urdf import UrdfTree, Visual, read_tree

__all__ = ["Bodies"]


class Bodies:
    """All bodies of a world on the page.

    A world whose driver has no mirrors is drawn as its specs say, without what can move.
    """

    def __init__(self, scene: SceneApi, spec: WorldSpec, snapshots: SeriesBox, notes: list[str]) -> None:
        self._scene = scene
        self._snapshots = snapshots
        self._notes = notes
        self._mirror = _mirror(spec, notes)
        self._specs: dict[str, BodySpec] = {}
        self._links: dict[str, dict[str | None, SceneNodeHandle]] = {}
        self._edits: dict[int, tuple[str, Mapping[str, Any]]] = {}
        self._number = 0
        for body in spec.bodies:
            self._draw(body)

    def edited(self, method: str, params: Mapping[str, Any], revision: int) -> None:
        """Note an edit of the world; it is done before the first snapshot of its revision is shown."""
        if self._mirror is not None:
            self._edits[revision] = (method, params)

    @property
    def behind(self) -> bool:
        """Are there edits to be done?"""
        return bool(self._edits)

    def show(self) -> None:
        """Bring the page up to date."""
        record = self._snapshots.read()
        if self._mirror is None or record is None or record[0] == self._number:
            return
        number, _, revision, values = record
        while self._mirror.revision < revision:
            edit = self._edits.pop(self._mirror.revision + 1, None)
            if edit is None:
                return  # snapshots come through memory and may overtake edits, which come through a socket
            self._mirror.request(*edit)
            self._edit(*edit)
        try:
            self._mirror.show(values)
        except ValueError:
            return  # of a world that was edited since
        self._number = number
        for name, links in self._links.items():
            for link, node in links.items():
                pose = self._mirror.request("pose", {"name": name, "link": link})
                place(node, pose["position"], pose["orientation"])

    def _edit(self, method: str, params: Mapping[str, Any]) -> None:
        if method == "add":
            self._draw(from_json(BodySpec, params["spec"]))
        elif method == "remove":
            self._erase(params["name"])
        elif method == "set_color" and params["name"] in self._specs:
            body = replace(self._specs[params["name"]], rgba=tuple(params["rgba"]))
            self._erase(body.name)
            self._draw(body, painted=True)

    def _erase(self, name: str) -> None:
        self._specs.pop(name, None)
        if self._links.pop(name, None) is not None:
            self._scene.remove_by_name(f"/bodies/{name}")

    def _draw(self, body: BodySpec, *, painted: bool = False) -> None:
        """``painted``: the spec's colour goes before those of a file."""
        self._specs[body.name] = body
        if not body.visible or (self._mirror is None and not body.fixed):
            return
        place_of = Pose(body.position, body.orientation)
        root = f"/bodies/{body.name}"
        if body.shape == "plane":
            self._scene.add_grid(
                root, 6.0, 6.0, cell_size=0.25, position=place_of.position, wxyz=wxyz(place_of.orientation)
            )
            return
        links = self._links[body.name] = {}
        self._scene.add_frame(root, show_axes=False)
        for number, (link, pose, visuals) in enumerate(self._parts(body, painted=painted)):
            where = place_of @ pose
            path = f"{root}/{number}"
            links[link] = self._scene.add_frame(
                path, show_axes=False, position=where.position, wxyz=wxyz(where.orientation)
            )
            draw(self._scene, path, visuals, self._notes)

    def _parts(self, body: BodySpec, *, painted: bool) -> list[tuple[str | None, Pose, list[Visual]]]:
        """Each link with its pose in the body's frame and what is drawn on it; the base link has no name."""
        if body.urdf is None:
            return [(None, Pose(), [_shape(body)])]
        try:
            tree = read_tree(body.urdf)
        except (OSError, ValueError) as error:
            self._notes.append(f"not drawn: {error}")
            return []
        rgba = body.rgba if painted else None
        return [
            (None if link == tree.root else link, _scaled(pose, body.scale), _visuals(tree, link, body.scale, rgba))
            for link, pose in tree.poses({}).items()
        ]


def _mirror(spec: WorldSpec, notes: list[str]) -> Any | None:
    """A copy of the world that is posed by its snapshots; None where its driver offers none."""
    try:
        made = registry.load(spec.driver, "world")
        if hasattr(made, "MIRRORED"):
            return made(spec, mirror=True, drawn=False)
        reason = "its driver has no mirrors"
    except HalError as error:
        reason = str(error)
    if any(not body.fixed for body in spec.bodies):
        notes.append(f"what can move in the simulated world is not drawn: {reason}")
    return None


def _shape(body: BodySpec) -> Visual:
    radius, length = body.radius or 0.0, body.length or 0.0
    size = {
        "box": tuple(2.0 * half for half in body.half_extents or ()),
        "sphere": (radius,),
    }.get(body.shape, (radius, length))
    return Visual(Pose(), body.shape, size, body.rgba)


def _visuals(tree: UrdfTree, link: str, scale: float, rgba: tuple[float, ...] | None) -> list[Visual]:
    return [
        replace(
            visual,
            pose=_scaled(visual.pose, scale),
            size=tuple(scale * part for part in visual.size),
            rgba=rgba or visual.rgba,
        )
        for visual in tree.visuals[link]
    ]


def _scaled(pose: Pose, scale: float) -> Pose:
    return Pose(scale * pose.position, pose.orientation)
