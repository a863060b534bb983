"""A gamepad of a rig into a :class:`~hal.specs.PadSpec`. Which pad ``auto`` is, is decided when the rig opens."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from .. import registry
from ..errors import ConfigError
from ..pads.model import pad_model
from ..specs import PadSpec
from .context import Context
from .data_files import user_path
from .files import read_yaml
from .models import find_model, load_pad_models
from .rigfile import PadConfig
from .schema import Unknown

__all__ = ["resolve_pad"]

CHOSEN_LATER = "auto"
"""Not the name of a driver: the pad is chosen when the rig opens."""

NO_WINDOW_KEYBOARD = "the keyboard of the viewer's window is no pad any more; use web (the console) or terminal"
"""Message for rigs and options that still name ``keyboard``."""


def resolve_pad(context: Context, name: str, config: PadConfig) -> PadSpec | None:
    """The pad, or None with the problems noted."""
    key = f"gamepads.{name}"
    model: dict[str, Any] | None = None
    with suppress(Unknown):
        model = _model(context, key, config)
    if context.driver is None:
        with suppress(Unknown):
            _check_recording(context, f"{key}.file", config)
        with suppress(Unknown):
            if config.driver == "keyboard":
                context.problem(f"{key}.driver", NO_WINDOW_KEYBOARD)
            elif config.driver != CHOSEN_LATER:
                context.check_driver(config.driver, "gamepad", f"{key}.driver")
    models = tuple(load_pad_models(context.problems).values())
    if context.problems.found:
        return None
    options = dict(config.options)
    if config.file is not None:
        options["file"] = str(_recording(context, config.file))
    spec = PadSpec(
        name=name,
        driver=context.driver or config.driver,
        model=model,
        models=models,
        dead_zone=config.dead_zone,
        options=options,
    )
    if spec.driver != CHOSEN_LATER:
        for relative, message in registry.checked(spec.driver, "gamepad", spec):
            context.problem(f"{key}.{relative}", message)
    return spec


def _model(context: Context, key: str, config: PadConfig) -> dict[str, Any] | None:
    if config.model == "auto":
        return None
    found = find_model(config.model, "sensors", ("gamepads",), context.base)
    if isinstance(found, str):
        context.problem(f"{key}.model", f"{found}, or auto")
        return None
    data = read_yaml(found, context.problems)
    if data is not None:
        try:
            pad_model(data, str(found))
        except ConfigError as error:
            for problem in error.problems:
                context.problems.add(problem.file, problem.key, problem.message)
    return data


def _recording(context: Context, file: str) -> Path:
    return user_path(file, context.base)


def _check_recording(context: Context, key: str, config: PadConfig) -> None:
    if config.driver != "playback":
        if config.file is not None:
            context.problem(key, f"is for the driver playback, not {config.driver!r}")
    elif config.file is None:
        context.problem(key, "is missing: the recording that is to be played")
    elif not os.path.isfile(_recording(context, config.file)):
        context.problem(key, f"there is no file {_recording(context, config.file)}")
