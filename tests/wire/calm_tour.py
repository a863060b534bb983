"""A recorded drive that stays inside the limits of every Franka, at a share of the speeds: half a metre and some turns.

Written as what the kernel reports of a DualShock 4; no hand moved a pad for it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

SECONDS = 11.0
_STICKS = {name: [0, 255, 15] for name in ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY", "ABS_Z", "ABS_RZ")}
_HEAD = {
    "format": "hal-pad-events",
    "version": 1,
    "model": "dualshock4",
    "ranges": {**_STICKS, "ABS_HAT0X": [-1, 1, 0], "ABS_HAT0Y": [-1, 1, 0]},
    "about": "written by the tests in tests/wire; no hand moved a pad for it",
}
Held = tuple[float, float, str, int, int]
DEADMAN = ("ABS_Z", 255, 0), ("BTN_TL2", 1, 0)
"""L2."""
_HELD: tuple[Held, ...] = (
    # from s, to s, control, value, at rest
    (0.6, 2.6, "ABS_HAT0Y", -1, 0),  # forwards
    (1.6, 3.6, "ABS_HAT0X", -1, 0),  # to the left
    (3.0, 4.5, "BTN_TR", 1, 0),  # down
    (4.6, 6.6, "ABS_HAT0X", 1, 0),
    (5.0, 6.0, "ABS_RY", 200, 128),  # turning about each axis
    (6.2, 7.4, "ABS_X", 60, 128),
    (6.8, 8.8, "ABS_HAT0Y", -1, 0),
    (7.5, 8.7, "ABS_RX", 190, 128),
    (8.9, 9.9, "BTN_TL", 1, 0),  # up
    (0.3, 10.5, "ABS_Z", 255, 0),  # L2, the dead-man
    (0.3, 10.5, "BTN_TL2", 1, 0),
)


def write_tour(path: Path) -> Path:
    """Write it; returns the path."""
    return write_pad(path, _HELD, SECONDS)


def write_pad(path: Path, held: Iterable[Held], seconds: float) -> Path:
    """Write what a pad reports on which controls are held: from s, to s, control, value, value at rest."""
    events = [(0.0, name, 128) for name in ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY")]
    for start, end, name, value, rest in held:
        events += [(start, name, value), (end, name, rest)]
    # A pad that is held is never quite still; a silent one counts as lost.
    events += [(0.1 * k, "ABS_Y", 128 + k % 2) for k in range(1, round(10 * seconds))]
    lines = [json.dumps(_HEAD)]
    for t, name, value in sorted(events):
        kind = "key" if name.startswith("BTN") else "abs"
        lines.append(json.dumps({"t": round(t, 3), "type": kind, "code": name, "value": value}))
    path.write_text("\n".join(lines) + "\n")
    return path
