"""What is drawn of a simulated world: the visual shapes of its bodies, and where a snapshot has them.

Everything comes from the rig's records, the URDF files that they name, and the world's snapshots: no physics engine, so
a picture of one state is the same picture whichever engine made it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import ConfigError, DeviceNotFound, Problem, suggest
from hal.geometry import Pose, matrix_to_quaternion
from hal.kinematics.urdf import TURNING, UrdfJoint, UrdfModel, UrdfVisual
from hal.randomization import COUNT
from hal.specs import BodySpec, RobotSpec, WorldSpec

from .disturbances import UNCHANGED, Randomized
from .lighting import BACKGROUND, Light, Look
from .shapes import Visual
from .urdf_files import absent_packages, checked_urdf, drawn_visuals, has_free_base, where_to_get
from .values import body_spec

Array = NDArray[np.float64]

PLANE = (5.0, 5.0)
"""Half extents of the part of an infinite plane that is drawn, m."""
_THIN = 0.005
"""Half the thickness of the box that is drawn for a plane, m."""


@dataclass(eq=False)
class DrawnBody:
    """A robot or an object: its links, what is drawn of each, and how its joints move them."""

    id: int
    """Its number, which no other body of this world gets."""
    spec: BodySpec | RobotSpec
    links: dict[str, int]
    """Numbers of the links by name; the base link is 0, and a parent comes before its children."""
    joints: tuple[UrdfJoint, ...]
    """All joints from the base outwards."""
    movable: tuple[str, ...]
    """Names of the joints that move, in the order of the URDF."""
    visuals: tuple[Visual, ...]
    roams: bool
    """Whether the snapshots have the pose of its base: see :meth:`hal.world.WorldDriver.snapshot`."""
    scale: float = 1.0
    index: int = -1
    """Its place among the world's bodies: its value in segmentation images."""

    @property
    def name(self) -> str:
        """Name of the body."""
        return self.spec.name


class DrawnWorld:
    """All bodies of a world, at the poses of the newest snapshot.

    Before the first snapshot, and after an edit, bodies are at their initial poses. Raises ConfigError with every
    problem.
    """

    def __init__(self, spec: WorldSpec) -> None:
        self.spec = spec
        self.bodies: dict[str, DrawnBody] = {}
        self.revision = 0
        """Number of edits so far, as of the world."""
        self.look = Look(shadows=spec.shadows)
        self.randomized = UNCHANGED
        """What ``rig.world.randomize`` applied last."""
        self._absent: dict[str, list[str]] = {}
        """Packages of meshes that are not installed -> the bodies that need them."""
        self._numbers = count()
        self._by_id: dict[int, DrawnBody] = {}
        self._frames: Array | None = None
        """Frames of all links, (N, 4, 4) in the world; None until they are needed."""
        problems: list[Problem] = []
        records: tuple[BodySpec | RobotSpec, ...] = (*spec.bodies, *spec.robots)
        for record in records:
            try:
                self._add(record)
            except ConfigError as error:
                problems.extend(error.problems)
        if problems:
            raise ConfigError(problems)
        self._arrange()

    # --- edits -------------------------------------------------------------------------------------------------------

    def request(self, method: str, params: Mapping[str, Any]) -> int:
        """Repeat an edit of the world, one of :attr:`hal.world.WorldDriver.MIRRORED`, and return the new revision."""
        if method == "add":
            self._add(body_spec(params["spec"]))
        elif method == "remove":
            del self._by_id[self.bodies.pop(params["name"]).id]
        elif method == "set_color":
            body, rgba = self.bodies[params["name"]], tuple(float(value) for value in params["rgba"])
            body.visuals = tuple(visual._replace(rgba=rgba) for visual in body.visuals)
        elif method == "randomize":
            self.randomized = Randomized.take(params["values"], params["seed"])
            self.look = _make_look(params["values"], self.spec.shadows)
        else:
            raise ValueError(f"{method} is no edit of what is drawn")
        if method in ("add", "remove"):
            self._arrange()
        self.revision += 1
        return self.revision

    def _add(self, spec: BodySpec | RobotSpec) -> None:
        urdf = None
        if isinstance(spec, RobotSpec):
            urdf = checked_urdf(spec.urdf, f"robots.{spec.name}.urdf")
        elif spec.urdf is not None:
            urdf = checked_urdf(spec.urdf, f"objects.{spec.name}.urdf")
        for package in absent_packages(str(urdf.path)) if urdf is not None else ():
            names = self._absent.setdefault(package, [])
            names += [spec.name] if spec.name not in names else []
        body = _body(next(self._numbers), spec, urdf)
        self.bodies[spec.name] = self._by_id[body.id] = body

    @property
    def notes(self) -> list[str]:
        """Messages for the user: what is not drawn as its file describes it."""
        return [
            f"{', '.join(names)}: drawn with plain shapes; the meshes are in {where_to_get(package)}"
            for package, names in self._absent.items()
        ]

    # --- snapshots ---------------------------------------------------------------------------------------------------

    def show(self, snapshot: Sequence[float]) -> None:
        """Place every body as in a snapshot of the same revision. Raises ValueError for one of other bodies."""
        values = np.asarray(snapshot, float)
        if len(values) != self._size:
            raise ValueError(f"a snapshot of {len(values)} numbers does not fit a world of {self._size}")
        self._values = values
        self._frames = None

    def snapshot(self) -> list[float]:
        """Return the present poses, as a world does."""
        values: list[float] = self._values.tolist()
        return values

    def _arrange(self) -> None:
        """Lay out links and snapshots, after bodies were added or removed, and place everything at its start."""
        bodies = list(self.bodies.values())
        for index, body in enumerate(bodies):
            body.index = index
        self._first: dict[int, int] = {}
        """Row of the base link in the list of all links, by the body's id."""
        total = 0
        for body in bodies:
            self._first[body.id] = total
            total += len(body.links)
        self._fill_links(bodies, total)
        self._fill_layout(bodies)
        self._values = np.zeros(self._size)
        self._frames = None
        self._start(bodies)

    def _fill_links(self, bodies: Sequence[DrawnBody], total: int) -> None:
        """Collect the joints of all bodies, so that all of them are computed at once."""
        self._joint_of: dict[tuple[int, str], int] = {}
        """Row of the link that a joint carries, by the body's id and the joint's name."""
        parent, depth = np.zeros(total, int), np.zeros(total, int)
        turned, across, around = (np.zeros((total, 3, 3)) for _ in range(3))
        self._offset, self._slide = np.zeros((total, 3)), np.zeros((total, 3))
        self._turns = np.zeros(total, bool)
        for body in bodies:
            first = self._first[body.id]
            for joint in body.joints:
                row = first + body.links[joint.child]
                self._joint_of[body.id, joint.name] = row
                parent[row] = first + body.links[joint.parent]
                depth[row] = depth[parent[row]] + 1
                origin, axis = joint.origin.matrix()[:3, :3], np.array(joint.axis)
                self._offset[row] = body.scale * joint.origin.position
                turned[row] = origin
                if joint.kind in TURNING:  # Rodrigues' formula: I + sin K + (1 - cos) K K, after the origin's rotation
                    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
                    across[row], around[row] = cross @ origin, cross @ cross @ origin
                    self._turns[row] = True
                elif joint.movable:
                    self._slide[row] = axis
        self._rotations = turned, across, around
        self._parents = parent
        self._levels = [np.flatnonzero(depth == level) for level in range(1, depth.max(initial=0) + 1)]
        self._bases = np.array([self._first[body.id] for body in bodies], int)

    def _fill_layout(self, bodies: Sequence[DrawnBody]) -> None:
        """Find each base pose and joint position in a snapshot."""
        place = 0
        base_at: dict[int, int] = {}
        rows, places = [], []
        for body in bodies:
            if not body.roams:
                base_at[body.id] = place
                place += 7
        for body in bodies:
            if body.roams:
                base_at[body.id] = place
                place += 7
            for name in body.movable:
                rows.append(self._joint_of[body.id, name])
                places.append(place)
                place += 1
        self._size = place
        self._base_at = np.array([base_at[body.id] for body in bodies], int)[:, None] + np.arange(7)
        self._joint_rows, self._joint_at = np.array(rows, int), np.array(places, int)

    def _start(self, bodies: Sequence[DrawnBody]) -> None:
        """Place every body at its initial pose."""
        at = dict(zip(self._joint_rows.tolist(), self._joint_at.tolist(), strict=True))
        for body, base in zip(bodies, self._base_at, strict=True):
            spec = body.spec
            self._values[base[3:]] = 0.0, 0.0, 0.0, 1.0
            if isinstance(spec, BodySpec):
                pose = Pose(spec.position, spec.orientation)
                self._values[base] = *pose.position, *pose.orientation
                continue
            for name, value in _initial_joints(spec, body.movable).items():
                self._values[at[self._joint_of[body.id, name]]] = value
        for body, base in zip(bodies, self._base_at, strict=True):
            spec = body.spec
            if isinstance(spec, RobotSpec):
                pose = Pose(spec.base_position, spec.base_orientation)
                if spec.kinematics.base_link is not None:  # it need not be the root
                    pose = pose @ Pose.from_matrix(self._link(body, spec.kinematics.base_link)).inverse()
                self._values[base] = *pose.position, *pose.orientation
        self._frames = None
        self._carry()

    def _carry(self) -> None:
        """Place what arms carry on their links."""
        for body, base in zip(self.bodies.values(), self._base_at, strict=True):
            spec = body.spec
            if isinstance(spec, BodySpec) and spec.robot in self.bodies:
                here = Pose.from_matrix(self._link(self.bodies[spec.robot], spec.link))
                pose = here @ Pose(spec.position, spec.orientation)
                self._values[base] = *pose.position, *pose.orientation
        self._frames = None

    def place(self, bodies: Mapping[str, Sequence[float]], arms: Mapping[str, Mapping[str, float]]) -> None:
        """Place bodies (7,) in the world, and the joints of arms, rad or m, with what they carry; the others stay."""
        joints = dict(zip(self._joint_rows.tolist(), self._joint_at.tolist(), strict=True))
        for body, base in zip(self.bodies.values(), self._base_at, strict=True):
            if body.name in bodies:
                self._values[base] = bodies[body.name]
            for name in arms.get(body.name, {}).keys() & set(body.movable):
                self._values[joints[self._joint_of[body.id, name]]] = arms[body.name][name]
        self._frames = None
        self._carry()

    def _compute(self) -> Array:
        """Return the frames (N, 4, 4) of all links in the world."""
        values, (turned, across, around) = self._values, self._rotations
        position = np.zeros(len(turned))
        position[self._joint_rows] = values[self._joint_at]
        angle = np.where(self._turns, position, 0.0)[:, None, None]
        frames = np.zeros((len(turned), 4, 4))
        frames[:, :3, :3] = turned + np.sin(angle) * across + (1.0 - np.cos(angle)) * around
        frames[:, :3, 3] = self._offset + position[:, None] * self._slide
        frames[:, 3, 3] = 1.0
        frames[self._bases] = _matrices(values[self._base_at])
        for rows in self._levels:
            frames[rows] = frames[self._parents[rows]] @ frames[rows]
        return frames

    # --- for the renderers and the cameras ---------------------------------------------------------------------------

    def visuals(self, body: int) -> tuple[Visual, ...]:
        """Return the visual shapes of the body with this id."""
        shown = self._by_id[body]
        section = f"{'robots' if isinstance(shown.spec, RobotSpec) else 'objects'}.{shown.name}"
        if not any(key.startswith(f"{section}.") for key in self.randomized.values):
            return shown.visuals
        names = {number: name for name, number in shown.links.items()}
        return tuple(
            _dress(visual, self.randomized.values, section, f"{section}.links.{names[visual.link]}")
            for visual in shown.visuals
        )

    def link_frames(self, links: Sequence[tuple[int, int]]) -> Array:
        """Return the poses (N, 4, 4) in the world of the frames of links, each given as (body id, link)."""
        if self._frames is None:
            self._frames = self._compute()
        return self._frames[[self._first[body] + link for body, link in links]]

    def pose(self, name: str, link: str | None = None) -> dict[str, list[float]]:
        """Return ``position`` (3,) m and ``orientation`` (4,) xyzw of a link, of the base for None.

        Raises DeviceNotFound, which lists the existing bodies or links.
        """
        if name not in self.bodies:
            raise DeviceNotFound(f"the world has no body {name!r}{suggest(name, self.bodies)}", code="unknown_body")
        body = self.bodies[name]
        if link is not None and link not in body.links:
            raise DeviceNotFound(f"{name!r} has no link {link!r}{suggest(link, body.links)}", code="unknown_link")
        frame = self._link(body, link)
        return {"position": frame[:3, 3].tolist(), "orientation": matrix_to_quaternion(frame[:3, :3]).tolist()}

    def _link(self, body: DrawnBody, link: str | None) -> Array:
        frames = self.link_frames([(body.id, 0 if link is None else body.links[link])])
        frame: Array = frames[0]
        return frame


def _matrices(poses: Array) -> Array:
    """Return poses (N, 7), position and quaternion, as matrices (N, 4, 4)."""
    x, y, z, w = poses[:, 3:].T
    rotations = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, :3, :3] = np.moveaxis(np.array(rotations), 2, 0)
    matrices[:, :3, 3] = poses[:, :3]
    matrices[:, 3, 3] = 1
    return matrices


# --- bodies ----------------------------------------------------------------------------------------------------------


def _body(number: int, spec: BodySpec | RobotSpec, urdf: UrdfModel | None) -> DrawnBody:
    roams = isinstance(spec, BodySpec) and (spec.robot is not None or has_free_base(spec, urdf))
    if urdf is None:
        assert isinstance(spec, BodySpec)
        return DrawnBody(number, spec, {"base": 0}, (), (), _primitive(spec) if spec.visible else (), roams)
    scale = 1.0 if isinstance(spec, RobotSpec) else spec.scale
    links = {link: k for k, link in enumerate((urdf.root, *(joint.child for joint in urdf.outwards)))}
    visuals = tuple(
        link_visual(shape, links[name], scale) for name, link in urdf.links.items() for shape in drawn_visuals(link)
    )
    movable = tuple(name for name, joint in urdf.joints.items() if joint.movable)
    return DrawnBody(number, spec, links, urdf.outwards, movable, visuals, roams, scale)


def link_visual(shape: UrdfVisual, link: int = 0, scale: float = 1.0) -> Visual:
    """Return a shape of a URDF as it is drawn, in the frame of its link."""
    size, position = tuple(scale * part for part in shape.size), tuple(scale * shape.pose.position)
    rgba = _single(shape.rgba or (1.0, 1.0, 1.0, 1.0))
    return Visual(link, shape.shape, size, shape.file, position, tuple(shape.pose.orientation), rgba)


def _primitive(spec: BodySpec) -> tuple[Visual, ...]:
    shape, at = spec.shape, (0.0, 0.0, 0.0)
    half = spec.half_extents or (0.0, 0.0, 0.0)
    size: tuple[float, ...] = (spec.radius or 0.0, spec.length or 0.0)
    if shape == "plane":  # the upper face of a thin box
        x, y = (spec.half_extents or (*PLANE, 0.0))[:2]
        shape, half, at = "box", (x, y, _THIN), (0.0, 0.0, -_THIN)
    if shape == "box":
        size = tuple(2.0 * side for side in half)
    elif shape == "sphere":
        size = size[:1]
    elif shape == "mesh":
        size = (spec.scale,) * 3
    return (Visual(0, shape, size, spec.mesh or "", at, (0.0, 0.0, 0.0, 1.0), _single(spec.rgba)),)


def _dress(visual: Visual, values: Mapping[str, Any], *sections: str) -> Visual:
    """Return a visual shape with the colour and the texture that are drawn; those of the last section win."""
    for section in sections:
        if (color := values.get(f"{section}.color")) is not None:
            visual = visual._replace(rgba=_single((*color, visual.rgba[3])))
        if (texture := values.get(f"{section}.texture")) is not None:
            visual = visual._replace(texture=texture)
    return visual


def _make_look(values: Mapping[str, Any], shadows: bool) -> Look:
    """Return light and background, which are the default ones where nothing was drawn."""
    count = values.get(COUNT, 1)
    share = values.get("light.intensity", 1.0) / count
    lights = tuple(_make_light(values, k, share) for k in range(count))
    exposure = {
        key.split(".")[1]: value
        for key, value in values.items()
        if key.startswith("cameras.") and key.endswith(".exposure")
    }
    background = tuple(values.get("background.color", BACKGROUND))
    ambient = values.get("light.ambient", 1.0)
    return Look(lights, ambient, background, values.get("background.texture", ""), shadows, exposure)


def _make_light(values: Mapping[str, Any], number: int, intensity: float) -> Light:
    x, y, z = Light().direction
    azimuth, elevation = math.atan2(y, x), math.atan2(z, math.hypot(x, y))
    if (given := values.get(f"light.{number}.azimuth_deg")) is not None:
        azimuth = math.radians(given)
    if (given := values.get(f"light.{number}.elevation_deg")) is not None:
        elevation = math.radians(given)
    flat = math.cos(elevation)
    red, green, blue = values.get(f"light.{number}.color", (1.0, 1.0, 1.0))
    direction = flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)
    return Light(direction, (intensity * red, intensity * green, intensity * blue))


def _single(rgba: Sequence[float]) -> tuple[float, ...]:
    """Return a colour in single precision, in which it was always drawn: 0.7 is then 178 of 255, not 179."""
    return tuple(np.asarray(rgba, np.float32).tolist())


def _initial_joints(spec: RobotSpec, movable: Sequence[str]) -> dict[str, float]:
    """Return the initial position of each movable joint of an arm: its gripper is open."""
    width = spec.gripper.width_max if spec.gripper is not None else None
    values = dict.fromkeys(movable, 0.0) | spec.joint_positions(spec.initial, width)
    return {name: value for name, value in values.items() if name in movable}
