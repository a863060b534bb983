"""What only one driver needs: its options in the rig and the model, and what that driver says of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from .. import registry
from ..specs import CameraSpec, RobotSpec
from .camera_models import CameraModel
from .context import Context
from .data_files import user_path
from .models import GripperModel, RobotModel
from .rigfile import CameraConfig, GripperConfig, RobotConfig

__all__ = ["SHARED", "ask_camera_driver", "ask_driver", "is_emulated", "options_of"]

Config = RobotConfig | GripperConfig | CameraConfig
Model = RobotModel | GripperModel | CameraModel

SHARED = ("host",)
"""Options of a real arm that its gripper has too, unless it has its own."""


def options_of(
    config: Config, model: Model, simulated: bool, driver: str, base: Path | None = None, file: Path | None = None
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
    model: Model,
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
