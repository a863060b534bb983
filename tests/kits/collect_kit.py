"""Recorded pads that press what somebody who collects demonstrations would."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

__all__ = ["CIRCLE", "CROSS", "PS", "SQUARE", "seed_of", "write_pad"]

CROSS, CIRCLE, SQUARE, PS = "BTN_SOUTH", "BTN_EAST", "BTN_WEST", "BTN_MODE"

_TAP = 0.1  # s
_SQUEEZE = (("ABS_Z", 255), ("BTN_TL2", 1))
"""L2."""


def seed_of(number: int, draws: int = 0, seed: int = 0) -> int:
    """What an episode must be recorded with: the seed of where its things start."""
    return int(np.random.SeedSequence([seed, number, draws]).generate_state(1)[0])


def write_pad(folder: Path, *presses: tuple[float, str], until: float, held: tuple[float, float] | None = None) -> str:
    """A recorded DualShock 4 on which buttons are tapped, at s; L2 is ``held`` from s to s. Its path."""
    ranges = {axis: [0, 255, 15] for axis in ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY", "ABS_Z", "ABS_RZ")}
    header = {"format": "hal-pad-events", "version": 1, "model": "dualshock4", "ranges": ranges}
    events = [(0.0, axis, 0 if axis in ("ABS_Z", "ABS_RZ") else 128) for axis in ranges]
    events += [(t + up * _TAP, button, 1 - up) for t, button in presses for up in (0, 1)]
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
