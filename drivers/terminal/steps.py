"""One key press, one bounded step: for terminals that never say when a key is let go of."""

from __future__ import annotations

from typing import NamedTuple

from hal.types import AXES

from .keys import ALT, CTRL, RELEASE, Key
from .layout import AXIS_KEYS, BUTTON_KEYS, CLOSE, OPEN, RELEASED, SHOULDER_KEYS, Controls, raw
from .options import Options

__all__ = ["Steps"]

_SETTLE = 0.06
"""Between two steps l2 is seen released for so long, s: the arm comes to rest, without which no press counts."""
_QUIET = 0.5
"""After a stop no key counts for so long, s: what was typed before it may still be on its way."""
_GRIP = 0.1
"""How far a key moves r2, share of its travel."""
_GRIP_S = 0.08
"""How long l2 is pressed for it, s. Half of that r2 stays where it was, so that the gripper is taken over there."""
_TAP_S = 0.1
"""How long the other buttons are pressed, s."""


class _Pulse(NamedTuple):
    """What is pressed from ``start`` to ``end``, s."""

    start: float
    end: float
    axes: dict[str, float]
    buttons: frozenset[str]
    grip: float | None = None
    """Where r2 goes in the middle of it."""


class Steps:
    """The pad's controls, pressed for a fixed time by each key press.

    A step ends by this clock and not by anything that the terminal sends. Keys that come during a step, or before the
    arm can be at rest after it, are dropped: a terminal's auto-repeat makes step after step, and a burst of keys that
    a network held back makes one.
    """

    def __init__(self, options: Options, dead_zone: float) -> None:
        self._options = options
        self._zone = dead_zone
        self._pulse: _Pulse | None = None
        self._ready = 0.0
        self._grip = 0.0

    def take(self, key: Key, now: float) -> None:
        """A key was pressed at ``now`` (s)."""
        if self._pulse is None and now >= self._ready and key.event != RELEASE and not key.modifiers & (ALT | CTRL):
            self._pulse = self._begin(key.name, now)

    def _begin(self, name: str, now: float) -> _Pulse | None:
        options = self._options
        if name in AXIS_KEYS:
            axis, way = AXIS_KEYS[name]
            share = way * (options.dpad_share if axis.startswith("dpad") else options.stick_share)
            return _Pulse(now, now + options.step_s, {"l2": 1.0, axis: raw(axis, share, self._zone)}, frozenset({"l2"}))
        if name in SHOULDER_KEYS:
            return _Pulse(now, now + options.button_s, {"l2": 1.0}, frozenset({"l2", SHOULDER_KEYS[name]}))
        if name in (CLOSE, OPEN):
            grip = round(min(1.0, max(0.0, self._grip + (_GRIP if name == CLOSE else -_GRIP))), 6)
            return _Pulse(now, now + _GRIP_S, {"l2": 1.0}, frozenset({"l2"}), grip)
        if name in BUTTON_KEYS:
            return _Pulse(now, now + _TAP_S, {}, frozenset({BUTTON_KEYS[name]}))
        return None

    def stop(self, now: float) -> None:
        """End the step at once."""
        self._pulse = None
        self._ready = now + _QUIET

    def release(self) -> None:
        """The terminal is away; r2 starts from 0 when it comes back, for a pad must come back with its hands off."""
        self._pulse = None
        self._grip = 0.0

    def controls(self, now: float) -> Controls:
        """Where the controls are at ``now``, s."""
        pulse = self._pulse
        if pulse is not None and pulse.grip is not None and now >= (pulse.start + pulse.end) / 2:
            self._grip = pulse.grip
        if pulse is not None and now >= pulse.end:
            # From the moment that the release is told, however late: two steps must never become one.
            self._ready = now + _SETTLE
            pulse = self._pulse = None
        axes, buttons = dict.fromkeys(AXES, 0.0), RELEASED.buttons
        if pulse is not None:
            axes.update(pulse.axes)
            buttons = pulse.buttons
        axes["r2"] = raw("r2", self._grip, self._zone)
        return Controls(axes, buttons | {"r2"} if self._grip > 0.5 else buttons)

    def alive(self, now: float) -> float:
        """Last proof of life, s. During a step it is the key press, and so gets too old for the servo by itself."""
        return self._pulse.start if self._pulse is not None else now

    def wait(self, now: float) -> float:
        """How long until the controls change by themselves, s."""
        pulse = self._pulse
        if pulse is None:
            return 1.0
        middle = (pulse.start + pulse.end) / 2
        return max(0.0, (middle if pulse.grip is not None and now < middle else pulse.end) - now)
