"""Which key is which control of the pad."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

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

AXIS_KEYS: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "up": ("dpad_y", 1.0),
        "down": ("dpad_y", -1.0),
        "right": ("dpad_x", 1.0),
        "left": ("dpad_x", -1.0),
        "w": ("left_y", 1.0),
        "s": ("left_y", -1.0),
        "d": ("left_x", 1.0),
        "a": ("left_x", -1.0),
        "i": ("right_y", 1.0),
        "k": ("right_y", -1.0),
        "l": ("right_x", 1.0),
        "j": ("right_x", -1.0),
    }
)
"""Key -> the axis that it pushes, and which way."""
SHOULDER_KEYS: Mapping[str, str] = MappingProxyType({"pageup": "l1", "q": "l1", "pagedown": "r1", "e": "r1"})
"""Key -> the button that it is; these usually move something."""
BUTTON_KEYS: Mapping[str, str] = MappingProxyType(
    {"1": "south", "2": "east", "3": "west", "4": "north", "enter": "start", "tab": "select", "home": "home"}
)
"""Key -> the button that it is; these are what an app gives a meaning."""
CLOSE, OPEN = "g", "h"
"""They pull r2, and let it go."""
STOP_KEYS = ("backspace", "escape")
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
