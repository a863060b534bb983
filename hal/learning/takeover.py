"""Takeover: a person corrects a policy with a pad or a leader while it runs, and gives the arm back by letting go."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..commands import Command
    from ..gamepad import Gamepad
    from ..teleop import Teleop


class Takeover:
    """Decides in each turn who drives: a person, while any control that moves the arm or its gripper is held.

    A leader has a button for that (``take_over`` of its mapping).

    The arm goes back to the policy when all of them have been at rest for a while, in which it comes to rest. The
    gripper keeps what it holds: a trigger acts only after it has crossed the present grip.

    Args:
        teleop: Turns the pad's states into commands.
        pad: The pad; the dead-man is another of its controls.
        release: Time at rest after which the policy drives again, s.
    """

    def __init__(self, teleop: Teleop, pad: Gamepad, release: float = 0.3) -> None:
        self.teleop, self.pad, self.release = teleop, pad, release
        teleop.prepare_takeover()
        self.active = False
        """Whether the person drives."""
        self.intervals: list[tuple[float, float]] = []
        """Begin and end of each takeover, s on ``rig.clock``."""
        self._touched = 0.0

    def reset(self) -> None:
        """Begin an episode: the policy drives, and :attr:`intervals` is empty."""
        self.active, self.intervals = False, []

    def command(self, now: float, dt: float) -> tuple[Command, float | None] | None:
        """Return the person's command and grip at ``now``, ``dt`` s after the last turn; None if the policy drives."""
        state = self.pad.state()
        if self.teleop.is_touched(state):
            self._touched = now
            if not self.active:
                self.active = True
                self.teleop.reset()
                self.intervals.append((now, now))
        if not self.active:
            self.teleop.watch()
            return None
        self.intervals[-1] = (self.intervals[-1][0], now)
        if now - self._touched >= self.release:
            self.active = False
            return None
        return self.teleop.command(state, dt)
