"""Nothing that was held when a pad came (back) may move anything."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from ..types import AXES, BUTTONS

__all__ = ["NeutralGate"]


class NeutralGate:
    """Lets a pad's controls through once its hands are off it.

    It opens when every axis was near neutral at the same time, triggers let go of included, and shuts again when the
    pad disconnects. A button that was down at that moment counts only after it was seen up.
    """

    def __init__(self, near: float = 0.25) -> None:
        """``near``: share of an axis' travel that counts as neutral; more than a worn stick's drift."""
        self.near = near
        self.open = False
        self._seen_up: frozenset[str] = frozenset()
        self.waiting_for: tuple[str, ...] = ()
        """Controls that must be let go of (or, if the pad never spoke of them, moved once), for people."""

    def shut(self) -> None:
        """The pad is gone."""
        self.open = False
        self._seen_up = frozenset()
        self.waiting_for = ()

    def update(self, axes: Mapping[str, float], buttons: frozenset[str], unknown: Collection[str]) -> frozenset[str]:
        """Take a reading of a pad that is connected; the buttons that count come back."""
        if not self.open:
            away = tuple(name for name in AXES if name in unknown or not abs(axes.get(name, 0.0)) <= self.near)
            self.open = not away
            silent = bool(axes) and all(name in unknown for name in axes)
            self.waiting_for = ("any control: the pad has said nothing yet",) if silent else away
        if not self.open:
            return frozenset()
        self._seen_up |= frozenset(BUTTONS) - buttons
        self.waiting_for = tuple(name for name in BUTTONS if name not in self._seen_up)
        return buttons & self._seen_up
