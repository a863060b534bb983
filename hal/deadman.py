"""A dead-man switch: whatever a person holds so that the arm may move."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from .commands import DeadmanRecord
from .errors import NotSupported

__all__ = ["Deadman", "Threshold"]

Sink = Callable[[DeadmanRecord], None]


class Threshold:
    """Makes a button of an analogue trigger: pressed from ``press`` on, let go of below ``release`` (0..1).

    The gap between the two keeps a trembling finger from letting go and pressing again.
    """

    def __init__(self, press: float = 0.5, release: float = 0.3) -> None:
        if not 0.0 < release <= press <= 1.0:
            raise ValueError(f"thresholds must satisfy 0 < release <= press <= 1, not press={press}, release={release}")
        self.press = press
        self.release = release
        self.held = False

    def update(self, value: float) -> bool:
        """Is it held at this travel? A value that is not a number counts as released."""
        self.held = value >= (self.release if self.held else self.press)
        return self.held


class Deadman:
    """One dead-man switch. Its owner (a gamepad, a web page) calls :meth:`update`; control sessions :meth:`attach`.

    It counts as held only after it was seen released while its device was connected, so what was held before, or all
    through an interruption, moves nothing. Every method may be called from any thread.
    """

    def __init__(
        self,
        name: str,
        distrust: Callable[[], str | None] | None = None,
        alarm: Callable[[], object] | None = None,
    ) -> None:
        """``distrust`` says why this switch may not guard a real arm at the moment, or None where it may. ``alarm``
        tells the hand that holds it of a stop, and returns at once: a pad rumbles."""
        self.name = name
        self._alarm = alarm
        self._distrust = distrust
        self._must_be_trusted = False
        self._armed = False
        self._record = DeadmanRecord(held=False, connected=False, presses=0, t_alive=-math.inf)
        self._sinks: dict[object, Sink] = {}
        self._lock = threading.RLock()
        self.error: Exception | None = None
        """Why a listener was dropped."""

    def alarm(self) -> None:
        """Tell the hand that holds it that the arm was stopped, where it can be told."""
        if self._alarm is not None:
            self._alarm()

    @property
    def record(self) -> DeadmanRecord:
        """The present state, as the servo gets it."""
        return self._record

    @property
    def held(self) -> bool:
        """Is it held, and does that count?"""
        return self._record.held

    @property
    def connected(self) -> bool:
        """Is its device there?"""
        return self._record.connected

    def update(self, pressed: bool, connected: bool, t_alive: float) -> DeadmanRecord:
        """Take what the device says; ``t_alive`` (s, host's clock) is when it last gave proof that it is there."""
        with self._lock:
            trusted = not self._must_be_trusted or self._distrust is None or self._distrust() is None
            if not connected or not trusted:
                self._armed = False
            elif not pressed:
                self._armed = True
            held = pressed and connected and trusted and self._armed
            last = self._record
            presses = last.presses + int(held and not last.held)
            self._record = DeadmanRecord(held, connected, presses, t_alive)
            for token in tuple(self._sinks):
                self._hand_to(token)
            return self._record

    def attach(self, sink: Sink) -> Callable[[], None]:
        """Call ``sink`` now and at every update; the function that comes back ends that.

        A sink that raises is dropped (see ``error``): its receiver then hears nothing more, which stops the arm.
        """
        token = object()
        with self._lock:
            self._sinks[token] = sink
            self._hand_to(token)

        def detach() -> None:
            with self._lock:
                self._sinks.pop(token, None)

        return detach

    def _hand_to(self, token: object) -> None:
        try:
            self._sinks[token](self._record)
        except Exception as error:
            self.error = error
            del self._sinks[token]

    def check_trust(self) -> None:
        """Before it guards a real arm: raises NotSupported, with the remedy, where its silence would go unnoticed.

        From then on it counts as held only while that stays so, for another device may take the place of this one.
        """
        reason = self._distrust() if self._distrust is not None else None
        if reason is not None:
            raise NotSupported(reason)
        with self._lock:
            self._must_be_trusted = True

    def __repr__(self) -> str:
        return f"<Deadman {self.name}: {'held' if self.held else 'released'}>"
