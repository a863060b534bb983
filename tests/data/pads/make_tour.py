"""Writes tour.jsonl: a drive with a DualShock 4, made event by event, not recorded from a hand.

    python tests/data/pads/make_tour.py

What a person would do with the default mapping: squeeze L2 (the dead-man), drive forwards, down, aside, back and up,
turn the wrist, close the hand and open it, let go of L2 in mid-motion, press it again and drive on, and let go of
everything. Values are those that hid-sony gives: 0..255, Y downwards, 128 or 127 at rest, reports every 4 ms. Fingers
move with ramps and tremble a little; the seed is fixed, so the file is the same every time.
"""

from __future__ import annotations

import json
import math
import random
from pathlib import Path

REPORT = 0.004  # s between two reports of the pad by cable
DURATION = 12.6  # s
STICK_REST = {"ABS_X": 128, "ABS_Y": 128, "ABS_RX": 128, "ABS_RY": 127}
TRIGGER_BUTTON = {"ABS_Z": "BTN_TL2", "ABS_RZ": "BTN_TR2"}
TRIGGER_BUTTON_FROM = 10  # of 255; where the pad itself starts to call a trigger pressed, a guess

# control, from s, to s, share of the travel (up and right positive; triggers 0..1)
SQUEEZES = [
    ("ABS_Z", 0.40, 7.10, 1.0),  # the dead-man ...
    ("ABS_Z", 7.90, 12.20, 1.0),  # ... again, after it was let go of in mid-motion
    ("ABS_RX", 3.20, 4.40, 0.85),  # turns the wrist
    ("ABS_RY", 4.50, 5.40, -0.7),
    ("ABS_X", 8.30, 9.60, 0.9),
    ("ABS_RZ", 9.00, 10.90, 1.0),  # closes the hand, opens it again
]
DPAD = [
    ("ABS_HAT0Y", 0.80, 2.20, 1),  # forwards
    ("ABS_HAT0X", 2.30, 3.40, 1),  # to the right
    ("ABS_HAT0Y", 6.30, 7.50, -1),  # backwards; the dead-man goes at 7.1 s, in mid-motion
    ("ABS_HAT0X", 8.20, 9.60, -1),  # to the left
    ("ABS_HAT0Y", 11.00, 12.00, 1),
]
PRESSES = [
    ("BTN_TR", 3.50, 4.60),  # down
    ("BTN_TL", 4.80, 6.20),  # up
    ("BTN_TL", 9.80, 10.80),
]
RISE = 0.12  # s that a finger needs from rest to where it wants to be


def share(t: float, start: float, end: float) -> float:
    """0 to 1 along a smooth ramp, hold, and back to 0 at ``end``."""
    rise = min(1.0, max(0.0, (t - start) / RISE))
    fall = min(1.0, max(0.0, (end - t) / RISE))
    return 0.5 - 0.5 * math.cos(math.pi * min(rise, fall))


def values_at(t: float, hand: random.Random) -> dict[str, int]:
    """What the pad reports at ``t``."""
    values: dict[str, int] = {}
    for axis, rest in STICK_REST.items():
        push = sum(reach * share(t, start, end) for name, start, end, reach in SQUEEZES if name == axis)
        upwards = -1.0 if axis in ("ABS_Y", "ABS_RY") else 1.0
        # At rest a potentiometer flickers by one step now and then; a pushed thumb trembles.
        tremble = hand.gauss(0.0, 1.2) if push else int(hand.random() < 0.02)
        values[axis] = min(255, max(0, round(rest + 127.0 * upwards * push + tremble)))
    for axis, button in TRIGGER_BUTTON.items():
        pull = sum(reach * share(t, start, end) for name, start, end, reach in SQUEEZES if name == axis)
        tremble = hand.gauss(0.0, 1.0) if 0.0 < pull < 1.0 else 0.0
        values[axis] = min(255, max(0, round(255.0 * pull + tremble)))
        values[button] = int(values[axis] >= TRIGGER_BUTTON_FROM)
    for axis in ("ABS_HAT0X", "ABS_HAT0Y"):
        pressed = sum(step for name, start, end, step in DPAD if name == axis and start <= t < end)
        values[axis] = -pressed if axis == "ABS_HAT0Y" else pressed
    for button in ("BTN_TL", "BTN_TR"):
        values[button] = int(any(name == button and start <= t < end for name, start, end in PRESSES))
    return values


def lines() -> list[str]:
    """The file, line by line. Like the kernel, only what changed is an event."""
    hand = random.Random(4)
    ranges = {axis: [0, 255, 15] for axis in (*STICK_REST, *TRIGGER_BUTTON)}
    ranges |= {axis: [-1, 1, 0] for axis in ("ABS_HAT0X", "ABS_HAT0Y")}
    about = "Synthesised event by event by make_tour.py after what hid-sony reports; no hand moved a pad for it."
    header = {"format": "hal-pad-events", "version": 1, "model": "dualshock4", "ranges": ranges, "about": about}
    text = [json.dumps(header)]
    last = dict.fromkeys((*TRIGGER_BUTTON, "ABS_HAT0X", "ABS_HAT0Y"), 0)
    for report in range(round(DURATION / REPORT) + 1):
        t = report * REPORT
        for code, value in values_at(t, hand).items():
            if value != last.get(code, 0 if code.startswith("BTN") else None):
                kind = "abs" if code.startswith("ABS") else "key"
                text.append(json.dumps({"t": round(t, 3), "type": kind, "code": code, "value": value}))
                last[code] = value
    return text


if __name__ == "__main__":
    (Path(__file__).parent / "tour.jsonl").write_text("\n".join(lines()) + "\n", encoding="utf-8")
