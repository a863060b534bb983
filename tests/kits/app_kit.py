"""Run an app in the process of the test, and write the recorded pads that apps are driven with.

Only one or two tests of each app start it as a program of its own, which has to import everything again.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np


class Done(NamedTuple):
    """How it ended, as subprocess.CompletedProcess says it."""

    returncode: int
    stdout: str
    stderr: str


def run_here(main: Callable[[list[str]], int], *arguments: object, answer: str = "") -> Done:
    """Call an app's ``main``; ``answer`` is what the person types. A traceback is an exception of the test's."""
    printed, errors = io.StringIO(), io.StringIO()

    def warn(message: object, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
        errors.write(f"{filename}:{lineno}: {category.__name__}: {message}\n")

    with (
        redirect_stdout(printed),
        redirect_stderr(errors),
        mock.patch("sys.stdin", io.StringIO(answer)),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("default")
        warnings.simplefilter("ignore", ResourceWarning)  # of what tests before have left to the garbage collector
        warnings.showwarning = warn
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as ended:  # argparse
            status = int(ended.code or 0)
    return Done(status, printed.getvalue(), errors.getvalue())


CROSS, CIRCLE, SQUARE, PS = "BTN_SOUTH", "BTN_EAST", "BTN_WEST", "BTN_MODE"

_TAP = 0.1  # s
_SQUEEZE = (("ABS_Z", 255), ("BTN_TL2", 1))
"""L2."""


def seed_of(number: int, draws: int = 0, seed: int = 0) -> int:
    """Return the seed that draws where an episode's objects start."""
    return int(np.random.SeedSequence([seed, number, draws]).generate_state(1)[0])


def write_pad(
    folder: Path,
    *presses: tuple[float, str] | tuple[float, str, float],
    until: float,
    held: tuple[float, float] | None = None,
) -> str:
    """Write a recorded DualShock 4 on which buttons are tapped, at s, or pressed for s; L2 is ``held`` from s to s.

    Return its path.
    """
    ranges = {axis: [0, 255, 15] for axis in ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY", "ABS_Z", "ABS_RZ")}
    header = {"format": "hal-pad-events", "version": 1, "model": "dualshock4", "ranges": ranges}
    events = [(0.0, axis, 0 if axis in ("ABS_Z", "ABS_RZ") else 128) for axis in ranges]
    events += [(t + up * (*how, _TAP)[0], button, 1 - up) for t, button, *how in presses for up in (0, 1)]
    if held is not None:
        events += [(t, code, value * down) for t, down in zip(held, (1, 0), strict=True) for code, value in _SQUEEZE]
    events.append((until, "ABS_X", 128))
    lines = [
        {"t": t, "type": "key" if code.startswith("BTN") else "abs", "code": code, "value": value}
        for t, code, value in sorted(events)
    ]
    file = folder / "pad.jsonl"
    file.write_text("\n".join(json.dumps(line) for line in [header, *lines]) + "\n", encoding="utf-8")
    return str(file)
