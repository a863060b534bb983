"""From keys (``sensors/keyboard.yaml``) to the controls of a gamepad: one bounded step for each press."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from hal.pads.keyboard import keyboard_table
from hal.types import AXES

_TABLE = keyboard_table("terminal")
STOP_KEYS = _TABLE.stop
"""Keys that stop every arm. A terminal reports Esc alone with a short delay."""
_SHOULDERS = ("l1", "r1")
"""Buttons that usually move something, so a step presses the dead-man with them. Other buttons are left to the app."""

_STOP = " or ".join(key.capitalize() for key in STOP_KEYS)
_KEYS = textwrap.indent(textwrap.fill("; ".join(f"{keys}: {name}" for name, keys in _TABLE.names.items()), 108), "    ")
HELP = (
    "keys of this terminal, one small step for each press (l2 is pressed with it); Ctrl-C ends\n"
    f"    {_STOP}: STOP; the next key continues. While the arm steps, other keys are ignored\n"
    f"{_KEYS}\n"
    "    buttons are pressed without l2, so functions that need l2 held, such as homing, are not available"
)


class TerminalOptions(BaseModel):
    """Options of a terminal pad in a rig (``gamepads.<name>.options``).

    Unknown keys are ignored: the same pad of a rig may also be driven by evdev, which has options of its own. With the
    default mapping a step of an axis is 5 to 8 mm or about 2 degrees, one of a shoulder button 3 to 10 mm.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    tty: str | None = None
    """The terminal, for example ``/dev/pts/3``; None for the program's own."""
    step_s: float = Field(0.08, gt=0.0, le=0.08)
    """Duration of a step of an axis, s. The servo's watchdog ends a step after 0.12 s in any case; the difference is a
    margin for a loaded machine, which polls late."""
    dpad_share: float = Field(0.5, gt=0.0, le=1.0)
    """How far a step pushes the d-pad, share of its travel."""
    stick_share: float = Field(0.6, gt=0.0, le=1.0)
    """How far a step pushes a stick, share of its travel."""
    button_s: float = Field(0.05, gt=0.0, le=0.08)
    """Duration of a step of a shoulder button, which has no half-way, s."""


class PadControls(NamedTuple):
    """Positions of the pad's axes, and the buttons that are pressed."""

    axes: Mapping[str, float]
    buttons: frozenset[str]


RELEASED = PadControls(MappingProxyType(dict.fromkeys(AXES, 0.0)), frozenset())


def _raw_axis(axis: str, share: float, dead_zone: float) -> float:
    """Return the raw value of ``axis`` that comes out of the dead zone as ``share`` (-1..1) of its travel."""
    if axis.startswith("dpad") or share == 0.0:
        return share
    return share * (1.0 - dead_zone) + (dead_zone if share > 0.0 else -dead_zone)


_SETTLE = 0.06
"""Time between two steps in which l2 is reported as released, s: the arm must rest before the next press counts."""
_QUIET = 0.5
"""Time after a stop in which keys are ignored, s: those typed before the stop may arrive after it."""
_GRIP_STEP = 0.1
"""How far a key moves r2, share of its travel."""
_GRIP_S = 0.08
"""How long l2 is pressed for a step of r2, s. In its first half r2 keeps its value, so that the gripper is taken over
at its present width."""
_TAP_S = 0.1
"""How long the other buttons are pressed, s."""


class _Pulse(NamedTuple):
    """What is pressed from ``start`` to ``end``, s."""

    start: float
    end: float
    axes: dict[str, float]
    buttons: frozenset[str]
    grip: float | None = None
    """New value of r2 from the middle of the pulse on; None leaves r2 alone."""


class StepControls:
    """Controls that each key press pushes for a fixed time.

    A step ends by this program's clock and not by anything that the terminal sends. Keys that arrive during a step, or
    before the arm can be at rest after it, are dropped: the terminal's auto-repeat then makes step after step, and a
    burst of keys that a network delayed makes one.
    """

    def __init__(self, options: TerminalOptions, dead_zone: float) -> None:
        self._options = options
        self._zone = dead_zone
        self._pulse: _Pulse | None = None
        self._ready = 0.0
        self._grip = 0.0

    def handle_key(self, key: str, now: float) -> None:
        """Begin a step for a key that was pressed at ``now`` (s), unless one is under way."""
        if self._pulse is None and now >= self._ready:
            self._pulse = self._pulse_of(key, now)

    def _pulse_of(self, name: str, now: float) -> _Pulse | None:
        options, deadman = self._options, frozenset({"l2"})
        if name in _TABLE.sticks:
            axis, direction = _TABLE.sticks[name]
            share = direction * (options.dpad_share if axis.startswith("dpad") else options.stick_share)
            return _Pulse(now, now + options.step_s, {"l2": 1.0, axis: _raw_axis(axis, share, self._zone)}, deadman)
        if name in _TABLE.grip:
            grip = round(min(1.0, max(0.0, self._grip + _GRIP_STEP * _TABLE.grip[name])), 6)
            return _Pulse(now, now + _GRIP_S, {"l2": 1.0}, deadman, grip)
        button = _TABLE.buttons.get(name)
        if button in _SHOULDERS:
            return _Pulse(now, now + options.button_s, {"l2": 1.0}, deadman | {button})
        return _Pulse(now, now + _TAP_S, {}, frozenset({button})) if button is not None else None

    def stop(self, now: float) -> None:
        """End the step at once."""
        self._pulse = None
        self._ready = now + _QUIET

    def release(self) -> None:
        """End the step because the terminal is away. r2 starts from 0 when it is back, as on a pad left alone."""
        self._pulse = None
        self._grip = 0.0

    def controls(self, now: float) -> PadControls:
        """Return the controls at ``now``, s."""
        pulse = self._pulse
        if pulse is not None and pulse.grip is not None and now >= (pulse.start + pulse.end) / 2:
            self._grip = pulse.grip
        if pulse is not None and now >= pulse.end:
            # Counted from when the release is reported, however late: two steps must never become one.
            self._ready = now + _SETTLE
            pulse = self._pulse = None
        axes, buttons = dict.fromkeys(AXES, 0.0), RELEASED.buttons
        if pulse is not None:
            axes.update(pulse.axes)
            buttons = pulse.buttons
        axes["r2"] = _raw_axis("r2", self._grip, self._zone)
        return PadControls(axes, buttons | {"r2"} if self._grip > 0.5 else buttons)

    def t_alive(self, now: float) -> float:
        """Return the time of the last proof of life, s: the key press during a step, so that it becomes too old for the
        servo by itself."""
        return self._pulse.start if self._pulse is not None else now

    def time_to_next(self, now: float) -> float:
        """Return the time until the controls change by themselves, s."""
        pulse = self._pulse
        if pulse is None:
            return 1.0
        middle = (pulse.start + pulse.end) / 2
        return max(0.0, (middle if pulse.grip is not None and now < middle else pulse.end) - now)
