"""Objects of the simulated world: primitives and URDFs, in files of their own or in the rig's file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, model_validator

from ..errors import suggest
from ..kinematics.urdf import UrdfModel
from ..specs import PRIMITIVES, BodySpec, RangesSpec, Vector3
from .context import Context, find_mesh, load_urdf
from .files import Problems, find_file, read_yaml, validate
from .models import FileSource
from .schema import (
    ENDS,
    Factor,
    Flag,
    Mass,
    Name,
    PoseConfig,
    Position,
    Quantity,
    QuaternionConfig,
    Rgba,
    Several,
    Size,
    Sizes,
    Strict,
    Unknown,
    ValueProblem,
    check_order,
    describe,
)

_Two = tuple[float, float]
Range = Annotated[_Two, Several(Quantity("m", -50.0, 50.0), 2, ENDS), AfterValidator(check_order)]
Turn = Annotated[_Two, Several(Quantity("deg", -360.0, 360.0), 2, ENDS), AfterValidator(check_order)]


class RandomPose(Strict):
    """Ranges ``[least, greatest]`` that the start pose of each episode is drawn from; others stay as configured."""

    x: Range | None = None
    """m, in the world; likewise y and z."""
    y: Range | None = None
    z: Range | None = None
    roll_deg: Turn | None = None
    """A turn about the world's x axis, then about y by pitch and about z by yaw, on top of the orientation."""
    pitch_deg: Turn | None = None
    yaw_deg: Turn | None = None

    @model_validator(mode="after")
    def _check_ranges(self) -> RandomPose:
        if all(getattr(self, key) is None for key in type(self).model_fields):
            raise ValueProblem(f"has no range; keys: {', '.join(type(self).model_fields)}", "missing_key")
        return self

    def place_around(self, position: Vector3) -> RangesSpec:
        """Return the ranges of an object whose configured position is ``position`` (3,), m."""
        places = [given or (value, value) for given, value in zip((self.x, self.y, self.z), position, strict=True)]
        turns = [given or (0.0, 0.0) for given in (self.roll_deg, self.pitch_deg, self.yaw_deg)]
        ends = [*places, *((math.radians(least), math.radians(greatest)) for least, greatest in turns)]
        return RangesSpec(tuple(least for least, _ in ends), tuple(greatest for _, greatest in ends))


SIZES = {**PRIMITIVES, "mesh": ("mesh",), "urdf": ("urdf",)}
"""The keys that each shape needs, and that no other shape may have."""
PLACES = frozenset({"position", "pose", "attached"})
"""Keys that place an object. The random ranges of its file are for the place that the file gives it."""


class CarriedBy(Strict):
    """An object on a link of an arm: it moves with the link, has no weight and touches nothing."""

    robot: str
    link: str
    """A link of the URDF, or the name that the robot's model gives one."""
    pose: PoseConfig = PoseConfig()
    """Pose in the link's frame."""


class ObjectConfig(Strict):
    """One object. Lengths in m."""

    name: Name
    shape: Literal["box", "sphere", "cylinder", "capsule", "plane", "mesh", "urdf"]
    """May be left out if ``urdf`` or ``mesh`` is given."""
    half_extents: Sizes | None = None
    """Of a box."""
    radius: Size | None = None
    """Of a sphere, a cylinder or a capsule."""
    length: Size | None = None
    """Of a cylinder, or of a capsule without its caps."""
    mesh: FileSource | None = None
    """An OBJ, STL or Collada file. Its convex hull collides, and gives the inertia."""
    parts: Flag = False
    """Whether each part of a mesh has a hull of its own: objects and groups of an OBJ, connected pieces of others."""
    urdf: FileSource | None = None
    scale: Factor | None = None
    """Scale of a URDF or a mesh."""
    mass: Mass | None = None
    """kg; an object of mass 0, the default, does not move. A URDF has its own masses."""
    fixed: Flag = False
    position: Position = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)
    pose: PoseConfig | None = None
    """Position and orientation in one."""
    attached: CarriedBy | None = None
    """Instead of a pose in the world: on a link of an arm."""
    random: RandomPose | None = None
    """Start poses of the episodes; without it the object starts at its pose."""
    rgba: Rgba = (0.7, 0.7, 0.7, 1.0)
    collision: Flag = True
    visible: Flag = True

    @model_validator(mode="before")
    @classmethod
    def _expand_shorthand(cls, data: Any) -> Any:
        shape = next((key for key in ("urdf", "mesh") if isinstance(data, dict) and key in data), None)
        return data if shape is None else {"shape": shape, **data}

    @model_validator(mode="after")
    def _check_sizes(self) -> ObjectConfig:
        needed = SIZES[self.shape]
        wrong = [f"{key} is missing" for key in needed if getattr(self, key) is None]
        code = "missing_key" if wrong else "conflict"
        others = [key for key in ("half_extents", "radius", "length", "mesh", "urdf") if key not in needed]
        wrong += [f"{key} does not apply" for key in others if getattr(self, key) is not None]
        if wrong:
            raise ValueProblem(f"a {self.shape} has {', '.join(needed) or 'no size'}: {', '.join(wrong)}", code)
        moves = self.attached is not None, self.random is not None
        conflicts = {
            "mass does not apply to a urdf, which has its own": self.mass is not None and self.shape == "urdf",
            f"scale applies to a urdf or a mesh; a {self.shape} has its size in m": self.scale is not None
            and self.shape not in ("urdf", "mesh"),
            f"parts applies to a mesh only, not to a {self.shape}": self.parts and self.shape != "mesh",
            "a plane is infinite; it cannot have attached or random": self.shape == "plane" and any(moves),
            "attached and random exclude each other: the object is where the arm is": all(moves),
        }
        if text := next((text for text, there in conflicts.items() if there), None):
            raise ValueProblem(text, "conflict")
        return self


def load_objects(context: Context, entries: Sequence[Any], section: str, taken: dict[str, str]) -> tuple[BodySpec, ...]:
    """Return objects of a rig. Problems are added to ``context``; then the objects may be incomplete.

    The robots of the rig have been resolved before, so that their URDFs and other names of links are known. ``taken``
    has the names of robots and other objects, each with its place in words; the new ones are added.
    """
    bodies = []
    problems, source = context.problems, context.source
    for k, entry in enumerate(entries):
        key = f"{section}.{k}"
        loaded = _load(entry, source, context.base, key, problems)
        if loaded is None:
            continue
        config, file, prefix = loaded
        prefix = f"{prefix}." if prefix else ""
        with suppress(Unknown):
            if config.name in taken:
                text = f"{config.name!r} is also the name of {taken[config.name]}; names must be unique"
                problems.add(file, f"{prefix}name", text, "duplicate_name")
            taken.setdefault(config.name, f"{key} in {source}")
        folder = context.base if file == source else Path(file).parent
        urdf: UrdfModel | None = None
        with suppress(Unknown):
            if config.urdf is not None:
                urdf = load_urdf(config.urdf, folder, file, f"{prefix}urdf", problems, context.warnings)
        mesh: Path | None = None
        with suppress(Unknown):
            if config.mesh is not None:
                mesh = find_mesh(config.mesh, folder, file, f"{prefix}mesh", problems)
        with suppress(Unknown):
            if config.attached is not None:
                context.check_link(file, f"{prefix}attached", config.attached.robot, config.attached.link)
        if not problems.found:
            bodies.append(_make_body(config, urdf, mesh, context.links))
    return tuple(bodies)


def _load(entry: Any, source: str, base: Path, key: str, problems: Problems) -> tuple[ObjectConfig, str, str] | None:
    """Return an object, the file that it is in, and its key in that file."""
    changes: dict[str, Any] = {}
    if isinstance(entry, dict) and "file" in entry:
        changes = {name: value for name, value in entry.items() if name != "file"}
        entry = entry["file"]
    if isinstance(entry, dict):
        return validate(ObjectConfig, entry, source, problems, key), source, key
    path = _find_file(entry, source, base, key, problems)
    data = read_yaml(path, problems) if path is not None else None
    if path is None or data is None:
        return None
    config = validate(ObjectConfig, data, path, problems)
    if not changes:
        return config, str(path), ""
    gone = {"random"} if changes.keys() & PLACES else set()
    if "pose" in changes:
        gone |= {"position", "orientation"}
    data = {name: value for name, value in data.items() if name not in gone}
    # The file was checked alone first, so that a mistake in it is reported there, and not here again.
    in_order = all(problem.file != str(path) for problem in problems.found)
    of_changed = Problems()
    changed = validate(ObjectConfig, {**data, **changes}, source, of_changed, key)
    for problem in of_changed.found:
        if in_order or problem.key.removeprefix(f"{key}.").partition(".")[0] in changes:
            problems.add(source, problem.key, problem.message, problem.code)
    return changed, str(path), ""


def _find_file(entry: object, source: str, base: Path, key: str, problems: Problems) -> Path | None:
    if not isinstance(entry, str):
        message, code = f"must be a file, a name or keys and values, not {describe(entry)}", "wrong_type"
    elif isinstance(path := find_file(entry, "object", base, "config", "objects"), str):
        message, code = path, "unknown_object"
    elif os.path.isfile(path):  # unlike Path.is_file, it has no error for names that are too long
        return path
    else:
        there = [f"{path.parent.name}/{found.name}" for found in path.parent.glob("*.yaml")]
        hint = suggest(f"{path.parent.name}/{path.name}", there)
        message, code = f"there is no file {path}{hint}", "missing_file"
    problems.add(source, key, message, code)
    return None


def _make_body(
    config: ObjectConfig, urdf: UrdfModel | None, mesh: Path | None, links: Mapping[str, Mapping[str, str]]
) -> BodySpec:
    carried = config.attached
    if carried is not None:
        pose, given = carried.pose, set[str]()
    else:
        pose, given = config.pose or PoseConfig(), config.model_fields_set
    position = config.position if "position" in given else pose.position
    return BodySpec(
        name=config.name,
        position=position,
        orientation=config.orientation if "orientation" in given else pose.orientation,
        shape=config.shape,
        half_extents=config.half_extents,
        radius=config.radius,
        length=config.length,
        urdf=str(urdf.path) if urdf is not None else None,
        mesh=str(mesh) if mesh is not None else None,
        parts=config.parts,
        scale=config.scale or 1.0,
        mass=config.mass or 0.0,
        fixed=config.fixed,
        rgba=config.rgba if mesh is None or "rgba" in config.model_fields_set else (1.0, 1.0, 1.0, 1.0),
        collision=config.collision,
        visible=config.visible,
        robot=carried.robot if carried is not None else None,
        link=links.get(carried.robot, {}).get(carried.link, carried.link) if carried is not None else None,
        random=config.random.place_around(position) if config.random is not None else None,
    )
