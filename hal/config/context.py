"""What resolving a rig needs besides the rig's own words, and what it finds out on the way."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from .. import registry
from ..errors import HalError
from ..kinematics.mesh_files import package_folder
from ..kinematics.urdf import UrdfModel
from ..specs import CameraSpec, RobotSpec
from .data_files import user_path
from .files import Problems, nearest, read_yaml, validate, with_holes
from .models import CameraModel, GripperModel, RobotModel, UrdfSource, find_model
from .rigfile import CameraConfig, Device, GripperConfig, RigFile, RobotConfig
from .schema import Unknown

__all__ = [
    "Context",
    "SHARED",
    "ask_camera_driver",
    "ask_driver",
    "is_emulated",
    "locate_urdf",
    "options_of",
]

# [sources.py] Where URDFs come from: a file of the user's, or one inside an installed Python package.

_HAS_WHEEL = sys.version_info < (3, 12) and (sys.platform, platform.machine()) == ("linux", "x86_64")
_NO_WHEEL = (
    f"PyBullet has no wheel for Python {platform.python_version()} on {platform.machine()}: use Python 3.11 on x86-64 "
    "Linux (uv venv --seed --python 3.11 .venv, then install again), or build it (C++ compiler): pip install pybullet"
)
INSTALL = {
    "pybullet_data": "pip install pybullet" if _HAS_WHEEL else _NO_WHEEL,
    "example_robot_data": "pip install example-robot-data",
    "airo_models": "pip install airo-models",
}
"""The command that brings a package, where it is not simply its name."""


def locate_urdf(source: UrdfSource, base: Path, file: Path | str, key: str, problems: Problems) -> Path | None:
    """Absolute path of a URDF; None, and a problem noted, where it is not there. Imports nothing."""
    if source.package is None:
        path = user_path(source.path, base)
    else:
        folder = package_folder(source.package)
        if folder is None:
            command = INSTALL.get(source.package, f"pip install {source.package.replace('_', '-')}")
            message = f"package {source.package!r} is not installed; {command}"
            if all(problem.message != message for problem in problems.found):  # robot and objects may share a package
                problems.add(file, f"{key}.package", message)
            return None
        path = user_path(source.path, folder)
    if not os.path.isfile(path):
        there = [p.name for p in path.parent.glob("*.urdf")] if path.parent.is_dir() else []
        problems.add(file, key, f"there is no file {path}{nearest(path.name, there) if there else ''}")
        return None
    return path


Model = TypeVar("Model", RobotModel, CameraModel)
HasDrivers = RobotModel | CameraModel | GripperModel


@dataclass
class Context:
    """What resolving needs besides the file's own words."""

    source: str
    """The rig's file, or ``<dict>``."""
    base: Path
    """What its paths are relative to."""
    rig: RigFile
    sim: bool | None
    driver: str | None
    clock: str | None
    problems: Problems
    warnings: list[str] = field(default_factory=list)
    urdfs: dict[str, UrdfModel] = field(default_factory=dict)
    """URDFs of the robots, by the robot's name; those that could be read."""
    links: dict[str, dict[str, str]] = field(default_factory=dict)
    """Other names of links, by the robot's name; those that are known."""
    emulated: set[str] = field(default_factory=set)
    """Keys in the rig of the arms that count as real, but have programs in the place of all that is."""
    drivers: dict[str, str] = field(default_factory=dict)
    """Drivers of the arms, grippers and cameras, by their keys in the rig; those that are known."""

    @property
    def rig_sim(self) -> bool:
        """The rig's flag, after the caller's word."""
        return self.rig.sim if self.sim is None else self.sim

    @property
    def time(self) -> str:
        """The clock, after the caller's word: ``real_time`` or ``lock_step``."""
        default = "lock_step" if self.driver is not None else self.rig.simulation.clock or "real_time"
        return self.clock or default

    def simulated(self, device: Device, parent: Device | None = None) -> bool:
        """Is this device simulated? ``parent`` is the arm of a gripper."""
        if self.sim is True or self.driver is not None:
            return True
        for owner in (device, parent):
            if owner is not None and owner.sim is not None:
                return owner.sim
        return self.rig_sim

    def read_model(
        self, kind: type[Model], key: str, config: RobotConfig | CameraConfig, folder: str, *parts: str
    ) -> tuple[Model, Path]:
        """A device's model and its file; a model of nothing but holes where there is none, which is then noted."""
        with suppress(Unknown):
            found = find_model(config.model, folder, parts, self.base)
            if isinstance(found, Path):
                data = read_yaml(found, self.problems)
                if data is not None:
                    return validate(kind, data, found, self.problems), found
            else:
                self.problem(f"{key}.model", found)
        return with_holes(kind, None, ()), self.base

    def choose_driver(
        self, kind: str, key: str, config: Device, model: HasDrivers, parent: Device | None = None
    ) -> str:
        """Name of the driver, which stands in ``drivers`` too; empty, and a problem noted, where there is none."""
        with suppress(Unknown):
            name = self.driver or self._named_driver(kind, key, config, model, parent)
            if name is not None and self.check_driver(name, kind, key):
                self.drivers[key] = name
                return name
        return ""

    def _named_driver(
        self, kind: str, key: str, config: Device, model: HasDrivers, parent: Device | None
    ) -> str | None:
        flag, state = ("sim", "simulated") if self.simulated(config, parent) else ("real", "real")
        own: str | None = getattr(config.drivers, flag) if config.drivers is not None else None
        chosen: str | None = own or getattr(model.drivers, flag)
        if chosen is None:
            self.problem(key, f"its model has no driver for a {state} {kind}; name one in {key}.drivers.{flag}")
        return chosen

    def check_driver(self, name: str, kind: str, key: str) -> bool:
        """Is there such a driver, and does it do this kind of device? If not, that is noted."""
        try:
            found = registry.driver(name)
        except HalError as error:
            self.problem(key, str(error))
            return False
        if getattr(found, kind) is None:
            self.problem(key, f"driver {name!r} has no {kind}; it has: {', '.join(found.kinds) or 'nothing'}")
            return False
        return True

    def problem(self, key: str, message: str) -> None:
        """Note a problem in the rig's file."""
        self.problems.add(self.source, key, message)


# [driver_options.py] What only one driver needs: its options in the rig and the model, and what that driver says
# of them.

Config = RobotConfig | GripperConfig | CameraConfig
DrivenModel = RobotModel | GripperModel | CameraModel

SHARED = ("host",)
"""Options of a real arm that its gripper has too, unless it has its own."""


def options_of(
    config: Config, model: DrivenModel, simulated: bool, driver: str, base: Path | None = None, file: Path | None = None
) -> dict[str, Any]:
    """The rig's options for this driver, on top of the model's. The latter are for the model's own driver only.

    Those that are paths become absolute: ``base`` is the folder of the rig's file, ``file`` that of the model.
    """
    own = model.drivers.sim if simulated else model.drivers.real
    of_model = (model.simulated if simulated else model.real) if driver == own else {}
    of_rig = config.simulated if simulated else config.real
    if base is not None and file is not None and driver:
        paths = registry.driver(driver).path_options
        of_model, of_rig = _absolute(of_model, paths, file.parent), _absolute(of_rig, paths, base)
    return {**of_model, **of_rig}


def _absolute(options: Mapping[str, Any], paths: Collection[str], folder: Path) -> dict[str, Any]:
    """What is no text is left as it is: the driver's own check says what is wrong with it."""
    return {
        name: str(user_path(value, folder)) if name in paths and isinstance(value, str) else value
        for name, value in options.items()
    }


def is_emulated(driver: str, options: Mapping[str, Any]) -> bool:
    """Does the driver say that a program stands in for the real device with these options?"""
    found = registry.function(driver, registry.driver(driver).emulated)
    return found is not None and bool(found(options))


def ask_driver(context: Context, key: str, spec: RobotSpec, config: RobotConfig, model: RobotModel, file: Path) -> None:
    """Note what the drivers of an arm and of its gripper find wrong in their records."""
    for relative, message in registry.checked(spec.driver, "robot", spec):
        _note(context, key, "", relative, message, config, model, file)
    gripper, kind = spec.gripper, model.gripper
    if gripper is None or kind is None:
        return
    arms = {f"real.{name}" for name in SHARED if name not in {**kind.real, **config.gripper.real}}
    for relative, message in registry.checked(gripper.driver, "gripper", gripper):
        if gripper.driver != spec.driver or relative not in arms:  # what is the arm's was told there
            _note(context, key, "gripper.", relative, message, config.gripper, kind, file)


def ask_camera_driver(
    context: Context, key: str, spec: CameraSpec, config: CameraConfig, model: CameraModel, file: Path
) -> None:
    """Note what the driver of a camera finds wrong in its record."""
    for relative, message in registry.checked(spec.driver, "camera", spec):
        _note(context, key, "", relative, message, config, model, file)


def _note(
    context: Context,
    key: str,
    part: str,
    relative: str,
    message: str,
    config: Config,
    model: DrivenModel,
    file: Path,
) -> None:
    """In the rig's file, unless what is wrong stands in the model's. ``relative`` is a key of the device's entry."""
    section, _, rest = relative.partition(".")
    name = rest.partition(".")[0]
    in_model = False
    if section in ("real", "simulated"):
        in_model = name in getattr(model, section) and name not in getattr(config, section)
    elif section == "limits" and isinstance(model, RobotModel) and isinstance(config, RobotConfig):
        given = config.limits.model_fields_set
        in_model = name not in given if name else not given
        if in_model and name in model.real_limits.model_fields_set and not context.simulated(config):
            relative = f"real_{relative}"
    elif section in ("capture", "depth", "field_of_view") and isinstance(config, CameraConfig):
        in_model = getattr(config, section) is None
    if in_model:
        context.problems.add(file, f"{part}{relative}", message)
    else:
        context.problem(f"{key}.{part}{relative}", message)
