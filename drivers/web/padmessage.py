"""A page's pad: is the message sound, and was the page alive when it says so?

A message may lie in buffers for long before it arrives, so its arrival proves nothing. The server sends the page its
own clock's time with every answer. The page repeats the newest one (``seen``), and says how long ago, on its own clock,
that came (``since``): at ``seen + since`` it was alive and said what the message says, however late that is read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from hal.servo.watchdog import PAD_SILENCE
from hal.types import BUTTONS, STICK_AXES

__all__ = ["ALARMS", "Malformed", "PadMessage", "PadWatch", "Verdict", "number", "pad_message"]

_ONE_SIDED = ("l2", "r2")
_RANGES = tuple((0.0 if axis in _ONE_SIDED else -1.0, 1.0) for axis in STICK_AXES)
_MASKS = 1 << len(BUTTONS)
_LONGEST = 1e9
"""ms, and s: more than any clock here shows."""

_AHEAD = "The page's clock runs ahead"
_LATE = "The page's messages came late"
_SILENT = "The page gave no sign of life"
ALARMS = frozenset((_AHEAD, _LATE, _SILENT))
"""Losses of the pad that nobody intended."""


class Malformed(ValueError):
    """A page said something that no page may say."""


class PadMessage(NamedTuple):
    """The whole pad."""

    seen: float
    """The newest stamp of ours that the page has, s."""
    since: float
    """How long it had it, s."""
    axes: tuple[float, ...]
    """In the order of ``hal.types.STICK_AXES``; -1..1, triggers 0..1. A page has no cap to push and turn."""
    buttons: int
    """Bit k: button k of ``hal.types.BUTTONS`` is down."""


def pad_message(data: Mapping[str, Any]) -> PadMessage:
    """The pad in a page's message. Raises Malformed."""
    axes, buttons = data["axes"], data["buttons"]
    if not isinstance(axes, list) or len(axes) != len(_RANGES):
        raise Malformed(f"not {len(_RANGES)} axes")
    if type(buttons) is not int or not 0 <= buttons < _MASKS:
        raise Malformed("no mask of buttons")
    return PadMessage(
        seen=number(data["seen"], 0.0, _LONGEST),
        since=number(data["since"], 0.0, _LONGEST) / 1000.0,
        axes=tuple(number(value, *limits) for value, limits in zip(axes, _RANGES, strict=True)),
        buttons=buttons,
    )


def number(value: object, low: float, high: float) -> float:
    """Return ``value`` as a float. Raises Malformed if it is not a number from ``low`` to ``high``."""
    # Not isinstance: True is an int. NaN and whole numbers too large for a float fail the comparison.
    if type(value) is not float and type(value) is not int:
        raise Malformed("not a number")
    if not low <= value <= high:
        raise Malformed("a number out of its range")
    return float(value)


class Verdict(NamedTuple):
    """What a message means for the pad."""

    gone: str | None = None
    """Why the pad was lost, before or with this message; None where it was not, or had been lost already."""
    t_alive: float | None = None
    """When the page provably said it, s; None where the message does not count."""
    dropped: str | None = None
    """Why it does not count, in words for the page's person; None where that is nothing to tell."""


class PadWatch:
    """Judges the pad of the page that drives, from the moment at which it was given the lease.

    Pure: times come from outside. The pad is *connected* from a message that counts until something makes it gone;
    whoever reads it must then see it released before it counts again.
    """

    def __init__(self, granted: float) -> None:
        """``granted`` is the stamp of the message that tells the page that it drives, s."""
        self._granted = granted
        self._stamp = granted
        self._alive = -math.inf
        self.connected = False

    def stamp(self, now: float) -> float:
        """A time is sent to the page; from now on it may be ``seen``."""
        self._stamp = now
        return now

    def take(self, message: PadMessage, now: float) -> Verdict:
        """Judge the next message of the page, which is looked at at ``now``.

        Raises Malformed where it claims to have seen a stamp that was not sent yet.
        """
        if message.seen > self._stamp:
            raise Malformed("a stamp that was never sent")
        if message.seen < self._granted:
            return Verdict()  # sent before it was given the lease this time
        claimed = message.seen + message.since
        if not claimed - now <= PAD_SILENCE:
            return Verdict(self.lose(_AHEAD), dropped=_AHEAD)
        # Messages arrive in the order in which they were sent: what proved it for one proves it for the next.
        alive = max(self._alive, min(now, claimed))
        gap, self._alive = alive - self._alive, alive
        if not now - alive <= PAD_SILENCE:
            return Verdict(self.lose(_LATE), dropped=_LATE)
        gone = self.lose(_SILENT) if gap > PAD_SILENCE else None
        self.connected = True
        return Verdict(gone, alive)

    def look(self, now: float) -> str | None:
        """Why the pad is gone by now without a message that says so; None where it is not, or was gone before."""
        return self.lose(_SILENT) if not now - self._alive <= PAD_SILENCE else None

    def lose(self, why: str) -> str | None:
        """The pad is gone; ``why`` comes back where it was there."""
        was, self.connected = self.connected, False
        return why if was else None
