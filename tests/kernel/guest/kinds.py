"""Pads that a model of ours names, and what must become of each."""

from __future__ import annotations

import os
import re
from typing import NamedTuple

from hal.types import BUTTONS, STICK_AXES

_KERNEL = tuple(int(number) for number in re.findall(r"\d+", os.uname().release)[:2])
_DUALSHOCK4 = "playstation" if _KERNEL >= (6, 2) else "sony"


class Kind(NamedTuple):
    """One kind of pad on one bus."""

    make: str
    """What ``serve.py`` calls it."""
    description: str
    """How the driver's own description of it begins."""
    driver: str
    """The kernel's."""
    sony: bool = False
    """Has it a motion sensor that speaks all the time, and a touchpad?"""

    def __str__(self) -> str:
        return f"{self.make}, {self.driver}"

    def gestures(self) -> list[tuple[dict[str, float], tuple[str, ...]]]:
        """Each of its controls alone: axes and buttons."""
        found: list[tuple[dict[str, float], tuple[str, ...]]] = []
        for name in STICK_AXES:
            found += [({name: value}, ()) for value in ((1.0,) if name in ("l2", "r2") else (1.0, -1.0))]
        absent = ("l2", "r2") if self.sony else ("l2", "r2", "touchpad")
        return found + [({}, (name,)) for name in BUTTONS if name not in absent]


KINDS = (
    Kind("dualshock4", "DualShock 4 (USB, ", _DUALSHOCK4, sony=True),
    Kind("dualshock4_bluetooth", "DualShock 4 (Bluetooth, ", _DUALSHOCK4, sony=True),
    Kind("dualsense", "DualSense (USB, ", "playstation", sony=True),
    Kind("dualsense_bluetooth", "DualSense (Bluetooth, ", "playstation", sony=True),
    Kind("xbox360", "Xbox 360 pad (USB, ", "xpad"),
    Kind("xbox_one", "Xbox One pad (USB, ", "xpad"),
)
