"""The state of one resolving of a rig: the caller's choices, the problems so far, and what robots have in common.

Also the lookups that every kind of device needs: its model, its driver, the driver's options and checks, and URDFs.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from .. import registry
from ..errors import HalError, suggest
from ..geometry import Pose
from ..kinematics.composition import FLANGE, MountedTool, compose_urdf
from ..kinematics.hulls import FORMATS
from ..kinematics.mesh_files import check_mesh, package_folder
from ..kinematics.urdf import UrdfModel, read_urdf
from ..specs import CameraSpec, PadSpec, RobotSpec
from .data_files import user_path
from .files import Problems, find_file, leave_holes, read_yaml, validate
from .models import CameraModel, FileSource, GripperFile, GripperModel, RobotModel, TcpModel
from .rigfile import CameraConfig, Device, GripperConfig, LeaderConfig, PadConfig, RigFile, RobotConfig
from .schema import Unknown

Model = TypeVar("Model", RobotModel, CameraModel)
Spec = TypeVar("Spec", RobotSpec, CameraSpec, PadSpec)
Config = RobotConfig | GripperConfig | CameraConfig
ServedConfig = RobotConfig | CameraConfig | PadConfig | LeaderConfig
DrivenModel = RobotModel | GripperModel | CameraModel


@dataclass
class Context:
    """The state of resolving a rig: the caller's arguments, the problems so far, and what is shared between devices."""

    source: str
    """The rig's file, or ``<dict>``."""
    base: Path
    """Folder that the rig's paths are relative to."""
    rig: RigFile
    sim: bool | None
    driver: str | None
    clock: str | None
    problems: Problems
    engine: str | None = None
    """The caller's choice of the engine; None for the rig's."""
    warnings: list[str] = field(default_factory=list)
    urdfs: dict[str, UrdfModel] = field(default_factory=dict)
    """URDFs of the robots, by the robot's name; those that could be read."""
    links: dict[str, dict[str, str]] = field(default_factory=dict)
    """Other names of links, by the robot's name; those that are known."""
    emulated: set[str] = field(default_factory=set)
    """Keys in the rig of the arms that count as real, but whose real devices are all emulators."""
    real_time_only: set[str] = field(default_factory=set)
    """Those of :attr:`emulated` that no clock can step."""
    drivers: dict[str, str] = field(default_factory=dict)
    """Drivers of the arms, grippers and cameras, by their keys in the rig; those that are known."""
    gripper_files: dict[str, Path] = field(default_factory=dict)
    """Files of the grippers that are not part of their arm's model, by the keys of the arms in the rig."""
    served: dict[str, dict[str, RobotSpec | CameraSpec | PadSpec]] = field(default_factory=dict)
    """Devices at other computers, by their address and name; those that were asked."""

    @property
    def rig_sim(self) -> bool:
        """The rig's flag, or the caller's instead."""
        return self.rig.sim if self.sim is None else self.sim

    @property
    def time(self) -> str:
        """The clock: ``real_time`` or ``lock_step``."""
        default = "lock_step" if self.driver is not None else self.rig.simulation.clock or "real_time"
        return self.clock or default

    @property
    def engine_driver(self) -> str:
        """Name of the engine that simulates this rig."""
        return registry.choose_engine(self.engine or self.rig.simulation.engine)

    def report(self, key: str, message: str, code: str) -> None:
        """Add a problem in the rig's file; the arguments are those of :meth:`.files.Problems.add`."""
        self.problems.add(self.source, key, message, code)

    def check_link(self, file: str, key: str, robot: str, link: str) -> None:
        """Add a problem if there is no such robot, or it has no such link; ``key`` is that of both."""
        if robot not in self.rig.robots:
            message = f"this rig has no robot {robot!r}{suggest(robot, self.rig.robots)}"
            self.problems.add(file, f"{key}.robot", message, "unknown_device")
        urdf = self.urdfs.get(robot)  # None if the robot itself has problems
        others = self.links.get(robot, {})
        if urdf is not None and link not in urdf.links and link not in others:
            text = f"robot {robot!r} has no link {link!r}{suggest(link, (*urdf.links, *others))}"
            self.problems.add(file, f"{key}.link", text, "unknown_link")

    def is_simulated(self, device: Device, parent: Device | None = None) -> bool:
        """Return whether a device is simulated; ``parent`` is the arm of a gripper."""
        if self.sim is True or self.driver is not None:
            return True
        for owner in (device, parent):
            if owner is not None and owner.sim is not None:
                return owner.sim
        return self.rig_sim

    def is_served(self, config: ServedConfig) -> bool:
        """Return whether a device is at another computer, and is not simulated here in its place."""
        return config.at is not None and self.sim is not True and self.driver is None and config.sim is not True

    def find_served(self, kind: type[Spec], key: str, at: str) -> Spec | None:
        """Return the record of a device at another computer; None, with the problem added, if there is no such device.

        Raises:
            ConnectionLost: Nothing answers there.
            HalError: The other computer's refusal.
        """
        from ..remote.client import fetch_devices

        if at not in self.served:
            self.served[at] = fetch_devices(at)
        section, name = key.split(".", 1)
        what = section.removesuffix("s")
        there = {name: device for name, device in self.served[at].items() if isinstance(device, kind)}
        there = {name: device for name, device in there.items() if getattr(device, "kind", what) == what}
        if name not in there:
            has = ", ".join(there) or "none"
            self.report(key, f"the rig at {at} has no {what} {name!r}; it has: {has}", f"unknown_{what}")
        return there.get(name)

    def read_model(
        self, kind: type[Model], key: str, config: RobotConfig | CameraConfig, folder: str, *parts: str
    ) -> tuple[Model, Path]:
        """Return a device's model and its file; without one, a model of holes only, and the problem is added."""
        with suppress(Unknown):
            name = (folder, *parts)[-1].removesuffix("s")
            found = find_file(config.model, f"{name} model", self.base, folder, *parts)
            if not config.model and "model" not in config.model_fields_set:  # needed unless the arm is served
                self.report(f"{key}.model", "is missing", "missing_key")
            elif isinstance(found, Path):
                data = read_yaml(found, self.problems)
                if data is not None and isinstance(config, RobotConfig):
                    data = self._choose_arm(key, config, data)
                    if data is not None:
                        data = self._mount_gripper(key, config, data, found)
                if data is not None:
                    return validate(kind, data, found, self.problems), found
            else:
                self.report(f"{key}.model", found, "unknown_model")
        return leave_holes(kind, None, ()), self.base

    def _choose_arm(self, key: str, config: RobotConfig, data: dict[str, Any]) -> dict[str, Any] | None:
        """Return a model with the keys of one of its arms; None, and a problem, if the rig names none of them."""
        arms = data.get("arms")
        chosen = getattr(config, "arm", None)
        if not isinstance(arms, dict) or not arms:
            if chosen is not None:
                self.report(f"{key}.arm", f"model {config.model!r} has one arm only", "unknown_arm")
            return data
        own = arms.get(chosen) if chosen is not None else None
        if not isinstance(own, dict):
            message = f"must be one of {', '.join(map(str, arms))}: model {config.model!r} has several arms"
            self.report(f"{key}.arm", message, "unknown_arm")
            return None
        return {**{name: value for name, value in data.items() if name != "arms"}, **own}

    def _mount_gripper(self, key: str, config: RobotConfig, data: dict[str, Any], file: Path) -> dict[str, Any] | None:
        """Return an arm's model with the gripper that the rig or the model names; None, and a problem, if it has some.

        The gripper takes the place of what the arm's own URDF has on its flange.
        """
        chosen, mount, own = config.gripper.model, config.gripper.mount, data.get("gripper")
        if chosen is None and not isinstance(own, str):
            if mount is not None:
                self.report(f"{key}.gripper.mount", "needs a gripper that model names", "missing_key")
            return data
        base = self.base if chosen else file.parent
        found = find_file(chosen or str(own), "gripper model", base, "robots", "grippers")
        if isinstance(found, str):
            at = f"{key}.gripper.model" if chosen else "gripper"
            self.problems.add(self.source if chosen else file, at, found, "unknown_model")
            return None
        before = len(self.problems.found)
        given = read_yaml(found, self.problems)
        if mount is None and "flange" in data:
            mount = validate(TcpModel, data["flange"], file, self.problems, "flange")
        elif mount is None:
            message = f"is missing: model {config.model!r} has no flange; give a link, and the pose of a flange in it"
            self.report(f"{key}.gripper.mount", message, "missing_key")
        gripper = None if given is None else validate(GripperFile, given, found, self.problems)
        if gripper is None or mount is None or len(self.problems.found) > before:
            return None
        self.gripper_files[key] = found
        return data | gripper.mounted_on(mount, found.parent) | {"links": {**data.get("links", {}), "hand": FLANGE}}

    def choose_driver(
        self, kind: str, key: str, config: Device, model: DrivenModel, parent: Device | None = None
    ) -> str:
        """Return the name of a device's driver and keep it in :attr:`drivers`; "" and a problem if there is none."""
        with suppress(Unknown):
            name = self.driver or self._find_driver(kind, key, config, model, parent)
            if name is not None and self.check_driver(name, kind, key):
                self.drivers[key] = name
                return name
        return ""

    def _find_driver(
        self, kind: str, key: str, config: Device, model: DrivenModel, parent: Device | None
    ) -> str | None:
        flag, state = ("sim", "simulated") if self.is_simulated(config, parent) else ("real", "real")
        own: str | None = getattr(config.drivers, flag) if config.drivers is not None else None
        chosen: str | None = own or getattr(model.drivers, flag)
        if chosen is None:
            message = f"its model has no driver for a {state} {kind}; name one in {key}.drivers.{flag}"
            self.report(key, message, "no_driver")
        return self.engine_driver if flag == "sim" and registry.is_engine(chosen) else chosen

    def check_driver(self, name: str, kind: str, key: str) -> bool:
        """Return whether there is such a driver with this kind of device; if not, the problem is added."""
        try:
            found = registry.driver(name)
        except HalError as error:
            self.report(key, str(error), "unknown_driver")
            return False
        if getattr(found, kind) is None:
            message = f"driver {name!r} has no {kind}; it has: {', '.join(found.kinds) or 'nothing'}"
            self.report(key, message, "wrong_driver")
            return False
        return True


# URDFs: a file of the user's, or one inside an installed Python package.

_HAS_WHEEL = sys.version_info < (3, 12) and (sys.platform, platform.machine()) == ("linux", "x86_64")
_NO_WHEEL = (
    "it is a part of PyBullet, which has no wheel for "
    f"Python {platform.python_version()} on {sys.platform} {platform.machine()}. Use Python 3.11 on x86-64 Linux "
    "(uv venv --seed --python 3.11 .venv, then install again), or build it (C++ compiler): pip install pybullet. "
    "No built-in model or object needs it"
)
INSTALL = {
    "pybullet_data": "pip install pybullet" if _HAS_WHEEL else _NO_WHEEL,
    "example_robot_data": "pip install 'robot-hal[robots]'",
    "airo_models": "pip install 'robot-hal[robots]'",
    "franky_sim": "pip install 'robot-hal[robots]'",
    "rtbdata": "pip install 'robot-hal[robots]'",
}
"""The command that installs a package, where it is not ``pip install`` and the package's name."""


def load_arm(model: RobotModel, file: Path, problems: Problems, warnings: list[str]) -> UrdfModel | None:
    """Return the checked URDF of an arm with its tool; None, and the problems, if something in it is wrong."""
    freed = getattr(model, "freed", ())
    tool = model.tool
    if tool is None and not freed:
        return load_urdf(model.urdf, file.parent, file, "urdf", problems, warnings)
    arm = _locate(model.urdf, file.parent, file, "urdf", problems, (".urdf",))
    if arm is None:
        return None
    mounted: MountedTool | None = None
    if tool is not None:
        own = _locate(tool.urdf, file.parent, file, "tool.urdf", problems, (".urdf",))
        if own is None:
            return None
        flange = None if tool.flange is None else Pose(tool.flange.position, tool.flange.orientation)
        mounted = MountedTool(own, tool.link, Pose(tool.position, tool.orientation), flange)
    try:
        for path in (arm, *([mounted.urdf] if mounted is not None else [])):
            read_urdf(path)
        made = compose_urdf(arm, mounted, freed)
    except (ValueError, OSError) as error:
        problems.add(file, "tool" if mounted is not None else "freed", f"{arm.name}: {error}", "bad_urdf")
        return None
    return load_urdf(FileSource(path=str(made)), file.parent, file, "urdf", problems, warnings)


def load_urdf(
    source: FileSource, base: Path, file: Path | str, key: str, problems: Problems, warnings: list[str]
) -> UrdfModel | None:
    """Return a checked URDF; None, and a problem, if it is missing or wrong. Imports no package.

    A path is relative to ``base``; problems name ``file`` and ``key``. Links without mass are warnings.
    """
    path = _locate(source, base, file, key, problems, (".urdf",))
    if path is None:
        return None
    try:
        urdf = read_urdf(path)
    except (ValueError, OSError) as error:
        problems.add(path, "", str(error), "bad_urdf")
        return None
    if urdf.find_massless():
        links = ", ".join(urdf.find_massless())
        warnings.append(f"{path}: no <inertial> in {links}; the simulator makes up a mass")
    return urdf


def find_mesh(source: FileSource, base: Path, file: Path | str, key: str, problems: Problems) -> Path | None:
    """Return the path of a mesh file; None, and a problem, if it is missing or wrong. See :func:`load_urdf`."""
    path = _locate(source, base, file, key, problems, FORMATS)
    if path is None:
        return None
    if path.suffix.lower() not in FORMATS:
        text = f"{path.name} is none of the formats of meshes: {', '.join(FORMATS)}"
        problems.add(file, key, text, "bad_mesh")
        return None
    try:
        check_mesh(path)
    except (ValueError, OSError) as error:
        problems.add(path, "", str(error), "bad_mesh")
        return None
    return path


def _locate(
    source: FileSource, base: Path, file: Path | str, key: str, problems: Problems, ends: tuple[str, ...]
) -> Path | None:
    if source.package is None:
        path = user_path(source.path, base)
    else:
        folder = package_folder(source.package)
        if folder is None:
            command = INSTALL.get(source.package, f"pip install {source.package.replace('_', '-')}")
            message = f"package {source.package!r} is not installed; {command}"
            if all(problem.message != message for problem in problems.found):  # robot and objects may share a package
                problems.add(file, f"{key}.package", message, "missing_package")
            return None
        path = user_path(source.path, folder)
    if not os.path.isfile(path):
        beside = path.parent.iterdir() if path.parent.is_dir() else ()
        there = sorted(one.name for one in beside if one.suffix.lower() in ends)
        hint = suggest(path.name, there) if there else ""
        problems.add(file, key, f"there is no file {path}{hint}", "missing_file")
        return None
    return path


# What only one driver needs: its options, and its own check of a device's record.


def merge_options(
    config: Config, model: DrivenModel, simulated: bool, driver: str, base: Path | None = None, file: Path | None = None
) -> dict[str, Any]:
    """Return the rig's options for a driver, on top of the model's, which apply to the model's own driver only.

    Options that are paths become absolute: ``base`` is the folder of the rig's file, ``file`` the model's file.
    """
    own = model.drivers.sim if simulated else model.drivers.real
    same = driver == own or (simulated and registry.is_engine(driver) and registry.is_engine(own))
    of_model = (model.simulated if simulated else model.real) if same else {}
    of_rig = config.simulated if simulated else config.real
    if base is not None and file is not None and driver:
        paths = registry.driver(driver).path_options
        of_model, of_rig = _make_absolute(of_model, paths, file.parent), _make_absolute(of_rig, paths, base)
    return {**of_model, **of_rig}


def _make_absolute(options: Mapping[str, Any], paths: Collection[str], folder: Path) -> dict[str, Any]:
    """Make the options in ``paths`` absolute; values that are not text are left to the driver's check."""
    return {
        name: str(user_path(value, folder)) if name in paths and isinstance(value, str) else value
        for name, value in options.items()
    }


def is_emulated(driver: str, options: Mapping[str, Any]) -> bool:
    """Return whether the driver uses an emulator in place of the real device with these options."""
    found = registry.function(driver, registry.driver(driver).emulated)
    return found is not None and bool(found(options))


def check_robot_spec(
    context: Context, key: str, spec: RobotSpec, config: RobotConfig, model: RobotModel, file: Path
) -> None:
    """Add the problems that the drivers of an arm and of its gripper find in their records."""
    _add(context, key, "", registry.check_record(spec.driver, "robot", spec), config, model, file)
    gripper, kind = spec.gripper, model.gripper
    if gripper is None or kind is None:
        return
    found = registry.check_record(gripper.driver, "gripper", gripper)
    if gripper.driver == spec.driver:  # problems in the arm's own options were added above
        own = {**kind.real, **config.gripper.real}
        arms = {f"real.{name}" for name in registry.driver(spec.driver).shared_options if name not in own}
        found = [problem for problem in found if problem[0] not in arms]
    _add(context, key, "gripper.", found, config.gripper, kind, file)


def check_camera_spec(
    context: Context, key: str, spec: CameraSpec, config: CameraConfig, model: CameraModel, file: Path
) -> None:
    """Add the problems that the driver of a camera finds in its record; arguments as in :func:`check_robot_spec`."""
    _add(context, key, "", registry.check_record(spec.driver, "camera", spec), config, model, file)


def _add(
    context: Context,
    key: str,
    part: str,
    found: Iterable[tuple[str, str, str]],
    config: Config,
    model: DrivenModel,
    file: Path,
) -> None:
    """Add problems (key in the entry, message, code) to the rig's file, or to the model's if that has the key."""
    for relative, message, code in found:
        in_model = _find_model_key(relative, config, model, context)
        own = context.gripper_files.get(key) if part else None
        if in_model is not None:
            context.problems.add(own or file, in_model if own else f"{part}{in_model}", message, code)
        else:
            context.report(f"{key}.{part}{relative}", message, code)


def _find_model_key(relative: str, config: Config, model: DrivenModel, context: Context) -> str | None:
    """Return the key of the model that has the value of the key ``relative`` of an entry; None if the entry has it."""
    section, _, rest = relative.partition(".")
    name = rest.partition(".")[0]
    if section in ("real", "simulated"):
        return relative if name in getattr(model, section) and name not in getattr(config, section) else None
    if section == "limits" and isinstance(model, RobotModel) and isinstance(config, RobotConfig):
        given = config.limits.model_fields_set
        if name in given if name else given:
            return None
        tighter = name in model.real_limits.model_fields_set and not context.is_simulated(config)
        return f"real_{relative}" if tighter else relative
    if section in ("capture", "depth", "field_of_view") and isinstance(config, CameraConfig):
        return relative if getattr(config, section) is None else None
    return None
