"""Keys that are held down: for terminals that say when a key is let go of, while they prove that they still can."""

from __future__ import annotations

import math

from hal.types import AXES

from .keys import ALT, CTRL, PRESS, RELEASE, Key
from .layout import AXIS_KEYS, BUTTON_KEYS, CLOSE, OPEN, SHOULDER_KEYS, Controls, raw
from .pings import Pings

__all__ = ["Holding"]

_SLOWER = 0.3
"""How far keys push while Shift is held."""
_GRIP_SPEED = 1.0
"""How fast r2 goes while its keys are held, full travels/s."""


class Holding:
    """The pad's controls, as keys are held; Space is l2.

    A key counts from its press to its release. A repeat is no press: of a key that went down while the terminal was
    away, or before a stop, nothing is known until it is pressed again.
    """

    def __init__(self, dead_zone: float) -> None:
        self.pings = Pings()
        self._zone = dead_zone
        self._held: set[str] = set()
        self._grip = 0.0
        self._t_grip = -math.inf

    def take(self, key: Key, now: float) -> None:
        """A key did something at ``now``, s."""
        if key.event == RELEASE:
            self._held.discard(key.name)
        elif key.event == PRESS and not key.modifiers & (ALT | CTRL):
            self._held.add(key.name)

    def stop(self, now: float) -> None:
        """Nothing counts as held any more."""
        self._held.clear()

    def release(self) -> None:
        """The terminal is away; r2 starts from 0 when it comes back, for a pad must come back with its hands off."""
        self._held.clear()
        self._grip = 0.0

    def controls(self, now: float) -> Controls:
        """Where the controls are at ``now``, s."""
        held = self._held
        dt = min(0.1, max(0.0, now - self._t_grip))
        self._t_grip = now
        self._grip = min(1.0, max(0.0, self._grip + _GRIP_SPEED * dt * ((CLOSE in held) - (OPEN in held))))
        reach = _SLOWER if "shift" in held else 1.0
        shares = dict.fromkeys(AXES, 0.0)
        for name, (axis, way) in AXIS_KEYS.items():
            if name in held:
                shares[axis] += reach * way
        axes = {axis: raw(axis, share, self._zone) for axis, share in shares.items()}
        axes["l2"] = float("space" in held)
        axes["r2"] = raw("r2", self._grip, self._zone)
        names = {**SHOULDER_KEYS, **BUTTON_KEYS, "space": "l2"}
        buttons = {button for name, button in names.items() if name in held}
        return Controls(axes, frozenset(buttons | {"r2"} if self._grip > 0.5 else buttons))

    def alive(self, now: float) -> float:
        """Last proof of life, s."""
        return self.pings.t_alive

    def wait(self, now: float) -> float:
        """How long until there is something to do, s."""
        return self.pings.wait(now)
