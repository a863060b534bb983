"""Import paths of version 0.1.0 that moved: they work for one release, with a DeprecationWarning.

:data:`MODULES` maps a module that is gone to the one that holds its names now; :data:`NAMES` lists names that left a
module that still exists.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import MappingProxyType, ModuleType
from typing import Any

__all__ = ["MODULES", "NAMES", "RENAMED", "install", "names_of"]

MODULES: Mapping[str, str] = MappingProxyType(
    {
        "hal.calibration.recording": "hal.calibration.collecting",
        "hal.calibration.setting": "hal.calibration.setup",
        "hal.camera_driver": "hal.driver",
        "hal.camera_info": "hal.driver",
        "hal.config.urdf": "hal.kinematics.urdf",
        "hal.console": "hal.views",
        "hal.cropping": "hal.images",
        "hal.gripper_motion": "hal.gripper",
        "hal.gym": "hal.learning.gym",
        "hal.ik": "hal.kinematics.ik",
        "hal.policy": "hal.learning.policy",
        "hal.pose": "hal.geometry",
        "hal.replaying": "hal.learning.replay",
        "hal.resetting": "hal.learning.episode",
    }
)
"""Module of 0.1.0 -> the module that has its public names now."""

NAMES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "hal.camera": {"CameraDriver": "hal.driver", "RawFrame": "hal.driver"},
        "hal.gamepad": {"GamepadDriver": "hal.driver", "PadReading": "hal.driver"},
        "hal.gripper": {"GripperDriver": "hal.driver", "GripperReading": "hal.driver"},
        "hal.robot": {"Reading": "hal.driver", "RobotDriver": "hal.driver", "Setpoint": "hal.driver"},
    }
)
"""Module -> names that it had in 0.1.0 -> the module that has them now."""

RENAMED: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "hal.calibration.collecting": {"drive": "collect_views", "take_and_tell": "add_view"},
        "hal.calibration.setup": {"guess_of": "initial_guess", "setting_of": "find_setup"},
        "hal.learning.episode": {"draw_poses": "sample_poses", "put_back": "reset_scene"},
        "hal.learning.gym": {"Action": "ActionKind", "Spaces": "ObservationDict"},
        "hal.learning.policy": {"Answer": "PolicyAnswer", "Outcome": "PolicyOutcome", "found": "load_object"},
        "hal.learning.replay": {"Player": "TrajectoryPlayer"},
    }
)
"""Module -> names of 0.1.0 -> their new names."""


def _warn(old: str, new: str, level: int) -> None:
    warnings.warn(f"{old} moved to {new}; the old path goes with the next release", DeprecationWarning, level)


class _Alias(Loader):
    """Loads an old module as a view of the new one, so that its classes are the same objects."""

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        target = import_module(MODULES[module.__name__])
        module.__doc__ = target.__doc__
        renamed = RENAMED.get(target.__name__, {})
        module.__getattr__ = lambda name: getattr(target, renamed.get(name, name))  # type: ignore[method-assign]


class _Finder(MetaPathFinder):
    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in MODULES:
            return None
        _warn(name, MODULES[name], 3)
        return ModuleSpec(name, _Alias())


def install() -> None:
    """Let the old modules be imported. They are looked up only after every other place."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())


def names_of(module: str) -> Callable[[str], Any]:
    """Return a module's ``__getattr__``, which finds the names of :data:`NAMES` that left it."""

    def find(name: str) -> Any:
        home = NAMES[module].get(name)
        if home is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(f"{module}.{name}", f"{home}.{name}", 3)
        return getattr(import_module(home), name)

    return find
