"""Which key is which control of the pad."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from hal.pads.keyboard import keyboard_table
from hal.types import AXES

__all__ = [
    "AXIS_KEYS",
    "BUTTON_KEYS",
    "CLOSE",
    "HOLD_HELP",
    "OPEN",
    "RELEASED",
    "SHOULDER_KEYS",
    "STEP_HELP",
    "STOP_KEYS",
    "Controls",
    "raw",
]

_TABLE = keyboard_table("terminal")
AXIS_KEYS = _TABLE.sticks
"""Key -> the axis that it pushes, and which way."""
BUTTON_KEYS = {key: button for key, button in _TABLE.buttons.items() if button not in ("l1", "r1")}
"""Key -> the button that it is; these are what an app gives a meaning."""
SHOULDER_KEYS = {key: button for key, button in _TABLE.buttons.items() if button in ("l1", "r1")}
"""Key -> the button that it is; these usually move something."""
CLOSE = next(key for key, direction in _TABLE.grip.items() if direction > 0.0)
OPEN = next(key for key, direction in _TABLE.grip.items() if direction < 0.0)
"""They pull r2, and let it go."""
STOP_KEYS = _TABLE.stop
"""They stop every arm, also while keys are held. A terminal sends Esc a moment late."""

_KEYS = (
    "    arrows: d-pad; Page Up/Down or Q/E: l1/r1; WASD, IJKL: left, right stick; G/H: r2, close/open\n"
    "    1 2 3 4: south east west north; Enter: start; Tab: select; Home: home; Ctrl-C ends"
)
STEP_HELP = (
    "keys of this terminal, one small step for each press (l2 is pressed with it)\n"
    "    Backspace or Esc: STOP; the next key continues. While the arm steps, other keys do not count\n"
    f"{_KEYS}\n"
    "    buttons are pressed without l2: what wants l2 held the whole way, like driving home, cannot be done here"
)
HOLD_HELP = (
    "keys of this terminal, held down\n"
    "    hold Space (l2) and other keys to move; release it to stop\n"
    f"    Backspace or Esc: STOP; hold Space again to continue\n{_KEYS}\n"
    "    Shift: slower. When the window loses the focus, or the link is slow, everything counts as released"
)


class Controls(NamedTuple):
    """Where the pad's controls are."""

    axes: Mapping[str, float]
    buttons: frozenset[str]


RELEASED = Controls(MappingProxyType(dict.fromkeys(AXES, 0.0)), frozenset())


def raw(axis: str, share: float, dead_zone: float) -> float:
    """What a pad must report on ``axis`` so that ``share`` (-1..1) of its travel comes out behind the dead zone."""
    if axis.startswith("dpad") or share == 0.0:
        return share
    return share * (1.0 - dead_zone) + (dead_zone if share > 0.0 else -dead_zone)
