"""Import paths and names of version 0.1.0 that moved: they work for one release, with a DeprecationWarning.

:data:`MODULES` maps a module that is gone to the one that holds its names now; :data:`NAMES` lists names that left
their module or have a new name; :class:`RenamedAttribute` is the old name of a method or field.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.abc import Loader, MetaPathFinder
else:
    Loader = MetaPathFinder = object  # to import these would take longer than the rest of ``import hal``

__all__ = ["MODULES", "NAMES", "RenamedAttribute", "install", "names_of"]

MODULES: Mapping[str, str] = MappingProxyType(
    {
        "hal.calibration.recording": "hal.calibration.collecting",
        "hal.calibration.setting": "hal.calibration.setup",
        "hal.camera_driver": "hal.driver",
        "hal.camera_info": "hal.driver",
        "hal.config.urdf": "hal.kinematics.urdf",
        "hal.console": "hal.views",
        "hal.course": "hal.learning.replay",
        "hal.cropping": "hal.images",
        **{
            f"hal.drivers.pybullet.{old}": f"hal.drivers.scene.{new}"
            for old, new in {
                "camera": "camera",
                "exposure": "exposure",
                "meshes": "meshes",
                "mirror": "mirror",
                "renderer": "renderer",
                "scene": "shapes",
            }.items()
        },
        "hal.gripper_motion": "hal.gripper",
        "hal.ik": "hal.kinematics.ik",
        "hal.placement": "hal.learning.episode",
        "hal.policy": "hal.learning.policy",
        "hal.pose": "hal.geometry",
        "hal.quaternion": "hal.geometry",
        "hal.replaying": "hal.learning.replay",
        "hal.resetting": "hal.learning.episode",
        "hal.testing.specs": "hal.testing",
    }
)
"""Module of 0.1.0 -> the module that has its public names now."""

NAMES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "hal.ark": {"Options": "hal.ark.ArkOptions"},
        "hal.calibration": {"Sighting": "hal.calibration.BoardDetection"},
        "hal.calibration.recording": {
            "drive": "hal.calibration.collecting.collect_views",
            "take_and_tell": "hal.calibration.collecting.add_view",
        },
        "hal.calibration.setting": {
            "Setting": "hal.calibration.setup.CalibrationSetup",
            "guess_of": "hal.calibration.setup.initial_guess",
            "setting_of": "hal.calibration.setup.find_setup",
        },
        "hal.camera": {name: f"hal.driver.{name}" for name in ("CameraDriver", "CameraTally", "RawFrame")},
        "hal.course": {
            "Course": "hal.learning.replay.RecordedTrajectory",
            "arms_of": "hal.learning.replay.recorded_arms",
            "moved_besides": "hal.learning.replay.other_moving_arms",
        },
        "hal.drivers.pybullet.camera": {
            "PyBulletCamera": "hal.drivers.scene.camera.SimulatedCamera",
            "PyBulletPictures": "hal.drivers.scene.camera.SimulatedPictures",
            "TinyRenderer": "hal.drivers.pybullet.tiny.TinyRenderer",
        },
        "hal.gamepad": {name: f"hal.driver.{name}" for name in ("GamepadDriver", "Plugged")},
        "hal.gripper": {name: f"hal.driver.{name}" for name in ("GripperDriver", "GripperReading")},
        "hal.gym": {"Action": "hal.learning.gym.ActionKind", "Spaces": "hal.learning.gym.ObservationDict"},
        "hal.kinematics": {"Pose7": "hal.kinematics.arm.Pose7"},
        "hal.placement": {"draw_poses": "hal.learning.episode.sample_poses"},
        "hal.policy": {
            "Answer": "hal.learning.policy.PolicyAnswer",
            "Outcome": "hal.learning.policy.PolicyOutcome",
            "found": "hal.learning.policy.load_object",
        },
        "hal.preflight": {"Verdict": "hal.preflight.CheckResult"},
        "hal.recording.exporters": {
            "Exported": "hal.recording.exporters.ExportResult",
            "Kind": "hal.recording.exporters.ExportFormat",
            "Progress": "hal.recording.exporters.ExportProgress",
        },
        "hal.replaying": {"Player": "hal.learning.replay.TrajectoryPlayer"},
        "hal.resetting": {"put_back": "hal.learning.episode.reset_scene"},
        "hal.robot": {name: f"hal.driver.{name}" for name in ("Reading", "RobotDriver", "Setpoint")},
    }
)
"""Module of 0.1.0 -> names that it had -> their module and name now."""


def _warn(old: str, new: str) -> None:
    """Warn at the line outside of this package that uses the old path."""
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_globals["__name__"].partition(".")[0] in ("hal", "importlib"):
        frame = frame.f_back
    warnings.warn_explicit(
        f"{old} moved to {new}; the old path goes with the next release",
        DeprecationWarning,
        frame.f_code.co_filename,
        frame.f_lineno,
        frame.f_globals["__name__"],
        frame.f_globals.setdefault("__warningregistry__", {}),
    )


def _find(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


class _Alias(Loader):
    """Loads an old module as a view of the new one, so that its classes are the same objects."""

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        old = module.__name__
        target = import_module(MODULES[old])
        module.__doc__ = target.__doc__
        names = NAMES.get(old, {})
        module.__getattr__ = lambda name: _find(names.get(name, f"{MODULES[old]}.{name}"))  # type: ignore[method-assign]


class _Finder(MetaPathFinder):
    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in MODULES:
            return None
        _warn(name, MODULES[name])
        return ModuleSpec(name, _Alias())


def install() -> None:
    """Let the old modules be imported. They are looked up only after every other place."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())


def names_of(module: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a module or package, which finds the names and modules that left it."""

    def find(name: str) -> Any:
        if (old := f"{module}.{name}") in MODULES:
            return import_module(old)
        new = NAMES.get(module, {}).get(name)
        if new is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(old, new)
        return _find(new)

    return find


class RenamedAttribute:
    """The old name of a method or field, to assign to it in its class.

    Args:
        new: The name that it has now.
    """

    def __init__(self, new: str) -> None:
        self._new = new

    def __set_name__(self, owner: type, name: str) -> None:
        self._old = name

    def __get__(self, instance: object, owner: type) -> Any:
        _warn(f"{owner.__name__}.{self._old}", self._new)
        return getattr(owner if instance is None else instance, self._new)
