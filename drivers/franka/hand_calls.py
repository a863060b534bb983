"""What goes to a Franka Hand and what comes back: a motion of its client library, its answer, a state."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from hal.types import Fault

__all__ = ["Answer", "Call", "Ended", "Seen", "grasp", "homing", "move"]

Answer: TypeAlias = "bool | Fault"
"""True and False are the hand's own; a fault is what an exception of the library meant."""

_SLACK = 3.0
"""s that a motion may take beyond what its distance and speed ask for: users report a second for every command."""
_HOMING = 30.0
"""s"""


class Seen(NamedTuple):
    """One state of the hand."""

    t: float
    """When it came, on the monotonic clock, s."""
    t_hand: float
    """The hand's own clock, s."""
    width: float
    """m"""
    max_width: float
    """m; makes sense only after homing."""
    is_grasped: bool
    temperature: int
    """Degrees Celsius."""


class Call(NamedTuple):
    """A motion, by the name that the library's method has. It blocks until the fingers rest."""

    method: str
    arguments: tuple[float, ...]
    bound: float
    """s after which its answer is overdue."""


class Ended(NamedTuple):
    """A motion that is over."""

    call: Call
    answer: Answer
    stopped: bool
    """Was the hand told to stop it?"""


def move(seen: Seen, width: float, speed: float) -> Call:
    """To ``width`` (m) at ``speed`` (m/s), with the hand's own force. One that meets something ends late, if ever."""
    return Call("move", (width, speed), 1.5 * abs(width - seen.width) / speed + _SLACK)


def grasp(seen: Seen, width: float, speed: float, force: float, inner: float, outer: float) -> Call:
    """Close at ``speed`` (m/s) until something is met, and hold that with ``force`` (N) where it is of this width."""
    way = max(seen.width, abs(width - seen.width))
    return Call("grasp", (width, speed, force, inner, outer), 1.5 * way / speed + _SLACK)


def homing() -> Call:
    """Close, and open all the way."""
    return Call("homing", (), _HOMING)
