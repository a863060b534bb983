"""What resolving a rig needs besides the rig's own words, and what it finds out on the way."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from .. import registry
from ..errors import HalError
from .camera_models import CameraModel
from .files import Problems, read_yaml
from .models import GripperModel, RobotModel, find_model
from .rigfile import CameraConfig, Device, RigFile, RobotConfig
from .schema import Unknown
from .urdf import UrdfModel
from .validation import validate, with_holes

__all__ = ["Context"]

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
        default = "lock_step" if self.driver == "mock" else self.rig.simulation.clock or "real_time"
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
