"""A gamepad of a rig into a :class:`~hal.specs.PadSpec`. Which pad ``auto`` is, is decided when the rig opens."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..specs import PadSpec
from .files import read_yaml
from .models import find_model, load_pad_models
from .rigfile import PadConfig

if TYPE_CHECKING:
    from .resolve import Context

__all__ = ["resolve_pad"]

CHOSEN_LATER = ("auto", "keyboard")
"""Not names of drivers: what they are depends on what is plugged in and on screen."""


def resolve_pad(context: Context, name: str, config: PadConfig) -> PadSpec | None:
    """The pad, or None with the problems noted."""
    key = f"gamepads.{name}"
    model: dict[str, Any] | None = None
    if config.model != "auto":
        found = find_model(config.model, "sensors", ("gamepads",), context.base)
        if isinstance(found, str):
            context.problem(f"{key}.model", f"{found}, or auto")
        else:
            model = read_yaml(found, context.problems)
    options = dict(config.options)
    driver = context.driver or config.driver
    if config.file is not None:
        options["file"] = str((context.base / Path(config.file).expanduser()).resolve())
    if context.driver is None:
        _check_recording(context, f"{key}.file", config, options.get("file"))
    if driver not in CHOSEN_LATER:
        context.check_driver(driver, "gamepad", f"{key}.driver")
    return PadSpec(
        name=name,
        driver=driver,
        model=model,
        models=tuple(load_pad_models(context.problems).values()),
        dead_zone=config.dead_zone,
        options=options,
    )


def _check_recording(context: Context, key: str, config: PadConfig, file: str | None) -> None:
    if config.driver != "playback":
        if file is not None:
            context.problem(key, f"is for the driver playback, not {config.driver!r}")
    elif file is None:
        context.problem(key, "is missing: the recording that is to be played")
    elif not Path(file).is_file():
        context.problem(key, f"there is no file {file}")
