"""Things in the simulated world: primitives and URDFs, in files of their own or in the rig's."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, model_validator

from ..kinematics.urdf import UrdfModel, read_urdf
from ..specs import BodySpec, RangesSpec, Vector3
from .context import locate_urdf
from .data_files import data_folder, is_path, list_data, user_path
from .files import Problems, nearest, read_yaml, validate
from .models import UrdfSource
from .schema import (
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
    describe,
)

__all__ = [
    "ObjectConfig",
    "RandomPose",
    "load_objects",
]

# [random_poses.py] Where a thing starts in each episode: ranges, of which a pose is drawn with the episode's
# seed.

_ENDS = "the least and the greatest"


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    least, greatest = ends
    if least > greatest:
        raise ValueError(f"must be {_ENDS}; {least:g} is above {greatest:g}")
    return ends


_Two = tuple[float, float]
Range = Annotated[_Two, Several(Quantity("m", -50.0, 50.0), 2, _ENDS), AfterValidator(_ordered)]
Turn = Annotated[_Two, Several(Quantity("deg", -360.0, 360.0), 2, _ENDS), AfterValidator(_ordered)]


class RandomPose(Strict):
    """Ranges ``[least, greatest]``; what is left out stays as it is configured."""

    x: Range | None = None
    """m, in the world; likewise y and z."""
    y: Range | None = None
    z: Range | None = None
    roll_deg: Turn | None = None
    """Turned by so much about the world's x axis, then about y by pitch and about z by yaw, after its orientation."""
    pitch_deg: Turn | None = None
    yaw_deg: Turn | None = None

    @model_validator(mode="after")
    def _something(self) -> RandomPose:
        if all(getattr(self, key) is None for key in type(self).model_fields):
            raise ValueError(f"holds no range; keys: {', '.join(type(self).model_fields)}")
        return self

    def around(self, position: Vector3) -> RangesSpec:
        """The ranges of a thing that is configured at ``position``."""
        places = [given or (value, value) for given, value in zip((self.x, self.y, self.z), position, strict=True)]
        turns = [given or (0.0, 0.0) for given in (self.roll_deg, self.pitch_deg, self.yaw_deg)]
        ends = [*places, *((math.radians(least), math.radians(greatest)) for least, greatest in turns)]
        return RangesSpec(tuple(least for least, _ in ends), tuple(greatest for _, greatest in ends))


SIZES = {
    "box": ("half_extents",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "plane": (),
    "urdf": ("urdf",),
}
"""What each shape needs, and what no other shape may have."""
PLACES = frozenset({"position", "pose", "attached"})
"""Keys that say where a thing is. The random ranges of its file are for the place that the file gives it."""
_NONE: Mapping[str, Any] = MappingProxyType({})


class CarriedBy(Strict):
    """What an arm carries: it goes where the link goes, weighs nothing and touches nothing."""

    robot: str
    link: str
    """Of the URDF, or a name that the robot's model gives one."""
    pose: PoseConfig = PoseConfig()
    """In the link's frame."""


class ObjectConfig(Strict):
    """One thing. Lengths in m."""

    name: Name
    shape: Literal["box", "sphere", "cylinder", "capsule", "plane", "urdf"]
    """May be left out where ``urdf`` is given."""
    half_extents: Sizes | None = None
    """Of a box."""
    radius: Size | None = None
    """Of a sphere, a cylinder or a capsule."""
    length: Size | None = None
    """Of a cylinder, or of a capsule without its caps."""
    urdf: UrdfSource | None = None
    scale: Factor | None = None
    """Of a URDF."""
    mass: Mass | None = None
    """kg; 0, or left out, stands still. A URDF brings its own."""
    fixed: Flag = False
    position: Position = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)
    pose: PoseConfig | None = None
    """Both in one."""
    attached: CarriedBy | None = None
    """In the place of all three: in the hand of an arm."""
    random: RandomPose | None = None
    """Where it starts in each episode; at its pose without."""
    rgba: Rgba = (0.7, 0.7, 0.7, 1.0)
    collision: Flag = True
    visible: Flag = True

    @model_validator(mode="before")
    @classmethod
    def _shorthands(cls, data: Any) -> Any:
        return {"shape": "urdf", **data} if isinstance(data, dict) and "urdf" in data else data

    @model_validator(mode="after")
    def _sizes(self) -> ObjectConfig:
        needed = SIZES[self.shape]
        given = [key for key in ("half_extents", "radius", "length", "urdf") if getattr(self, key) is not None]
        missing, extra = [k for k in needed if k not in given], [k for k in given if k not in needed]
        if missing or extra:
            wants = ", ".join(needed) or "no size"
            wrong = [*(f"{key} is missing" for key in missing), *(f"{key} has no meaning" for key in extra)]
            raise ValueError(f"a {self.shape} has {wants}: {', '.join(wrong)}")
        if self.mass is not None and self.shape == "urdf":
            raise ValueError("a urdf brings its own mass")
        if self.scale is not None and self.shape != "urdf":
            raise ValueError(f"scale is for a urdf; a {self.shape} has its size in m")
        if self.attached is not None and self.shape == "plane":
            raise ValueError("a plane has no end; nobody can carry it")
        if self.random is not None and self.shape == "plane":
            raise ValueError("a plane has no end; it has no random place")
        if self.random is not None and self.attached is not None:
            raise ValueError("attached and random exclude each other: it is where the arm is")
        return self


def load_objects(
    entries: list[Any],
    source: str,
    base: Path,
    taken: dict[str, str],
    problems: Problems,
    warnings: list[str],
    urdfs: Mapping[str, UrdfModel] = _NONE,
    links: Mapping[str, Mapping[str, str]] = _NONE,
) -> tuple[BodySpec, ...]:
    """The bodies of a rig.

    ``taken`` are the names of its robots, with the key where each stands; ``urdfs`` and ``links`` their URDFs, and
    other names of their links, as far as they are known.
    """
    bodies = []
    robots = tuple(taken)
    for k, entry in enumerate(entries):
        key = f"objects.{k}"
        loaded = _load(entry, source, base, key, problems)
        if loaded is None:
            continue
        config, file, prefix = loaded
        with suppress(Unknown):
            if config.name in taken:
                text = f"{config.name!r} is also the name of {taken[config.name]}; names must differ"
                problems.add(file, f"{prefix}.name" if prefix else "name", text)
            taken.setdefault(config.name, f"{key} in {source}")
        folder = base if file == source else Path(file).parent
        urdf: Path | None = None
        with suppress(Unknown):
            urdf = _urdf(config, folder, file, f"{prefix}.urdf" if prefix else "urdf", problems, warnings)
        with suppress(Unknown):
            if config.attached is not None:
                where = f"{prefix}.attached" if prefix else "attached"
                _check_attached(config.attached, robots, urdfs, links, file, where, problems)
        if not problems.found:
            bodies.append(_body(config, urdf, links))
    return tuple(bodies)


def _load(entry: Any, source: str, base: Path, key: str, problems: Problems) -> tuple[ObjectConfig, str, str] | None:
    """The object, the file that it is in, and the key that it has there."""
    changes: dict[str, Any] = {}
    if isinstance(entry, dict) and "file" in entry:
        changes = {name: value for name, value in entry.items() if name != "file"}
        entry = entry["file"]
    if isinstance(entry, dict):
        return validate(ObjectConfig, entry, source, problems, key), source, key
    if not isinstance(entry, str):
        problems.add(source, key, f"must be a file, a name or keys and values, not {describe(entry)}")
        return None
    if is_path(entry):
        path = user_path(entry, base)
        if not os.path.isfile(path):
            there = [f"{path.parent.name}/{p.name}" for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
            problems.add(source, key, f"there is no file {path}{nearest(f'{path.parent.name}/{path.name}', there)}")
            return None
    else:
        there = list(list_data("config", "objects"))
        if entry not in there:
            problems.add(source, key, f"there is no object {entry!r}{nearest(entry, there)}, or a path to your own")
            return None
        path = data_folder("config") / "objects" / f"{entry}.yaml"
    data = read_yaml(path, problems)
    if data is None:
        return None
    config = validate(ObjectConfig, data, path, problems)
    if not changes:
        return config, str(path), ""
    gone = {"random"} if changes.keys() & PLACES else set()
    if "pose" in changes:
        gone |= {"position", "orientation"}
    data = {name: value for name, value in data.items() if name not in gone}
    # The file stood on its own first, so that a mistake is reported where it is, and here not again.
    in_order = all(problem.file != str(path) for problem in problems.found)
    noted = Problems()
    changed = validate(ObjectConfig, {**data, **changes}, source, noted, key)
    for problem in noted.found:
        if in_order or problem.key.removeprefix(f"{key}.").partition(".")[0] in changes:
            problems.add(source, problem.key, problem.message)
    return changed, str(path), ""


def _urdf(
    config: ObjectConfig, base: Path, file: str, key: str, problems: Problems, warnings: list[str]
) -> Path | None:
    """Path of the object's URDF, if it has one and that can be read."""
    path = locate_urdf(config.urdf, base, file, key, problems) if config.urdf is not None else None
    if path is None:
        return None
    try:
        model = read_urdf(path)
    except (ValueError, OSError) as error:
        problems.add(path, "", str(error))
        return None
    if model.without_mass():
        links = ", ".join(model.without_mass())
        warnings.append(f"{path}: no <inertial> in {links}; the simulator makes up a mass")
    return path


def _check_attached(
    carried: CarriedBy,
    robots: tuple[str, ...],
    urdfs: Mapping[str, UrdfModel],
    links: Mapping[str, Mapping[str, str]],
    file: str,
    key: str,
    problems: Problems,
) -> None:
    if carried.robot not in robots:
        text = f"this rig has no robot {carried.robot!r}{nearest(carried.robot, robots)}"
        problems.add(file, f"{key}.robot", text)
    urdf, others = urdfs.get(carried.robot), links.get(carried.robot, {})
    if urdf is not None and carried.link not in urdf.links and carried.link not in others:
        text = f"robot {carried.robot!r} has no link {carried.link!r}{nearest(carried.link, (*urdf.links, *others))}"
        problems.add(file, f"{key}.link", text)


def _body(config: ObjectConfig, urdf: Path | None, links: Mapping[str, Mapping[str, str]]) -> BodySpec:
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
        urdf=str(urdf) if urdf is not None else None,
        scale=config.scale or 1.0,
        mass=config.mass or 0.0,
        fixed=config.fixed,
        rgba=config.rgba,
        collision=config.collision,
        visible=config.visible,
        robot=carried.robot if carried is not None else None,
        link=links.get(carried.robot, {}).get(carried.link, carried.link) if carried is not None else None,
        random=config.random.around(position) if config.random is not None else None,
    )
