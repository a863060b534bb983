"""What one control of a pad means: an axis without its dead zone, a button or trigger that is held."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ..deadman import Deadman, Threshold

if TYPE_CHECKING:
    from ..gamepad import PadReading

__all__ = ["HeldControl", "without_dead_zone"]


def without_dead_zone(value: float, zone: float) -> float:
    """``value`` (-1..1) with the part nearer to 0 than ``zone`` cut out, and the rest stretched to start from 0.

    What is not a number is 0.
    """
    if not abs(value) > zone or zone >= 1.0:
        return 0.0
    return math.copysign(min(1.0, (abs(value) - zone) / (1.0 - zone)), value)


class HeldControl:
    """Reads one button or trigger of a pad for its dead-man."""

    def __init__(self, control: str, deadman: Deadman) -> None:
        self.control = control
        self.deadman = deadman
        self._threshold = Threshold()

    def update(self, reading: PadReading, *, gate_open: bool) -> None:
        """Take a reading; before the pad's :class:`~hal.pads.neutral.NeutralGate` is open nothing counts."""
        if not gate_open:
            self._threshold.held = False
            pressed = True  # so this is no release, which would arm the switch
        elif self.control in ("l2", "r2") and self.control in reading.axes:
            pressed = self._threshold.update(reading.axes[self.control])
        else:
            pressed = self.control in reading.buttons
        self.deadman.update(pressed, reading.connected, reading.t_alive)
