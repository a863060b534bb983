"""The dead-man switch: a control that must be held for the arm to move."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from .commands import DeadmanRecord
from .errors import NotSupported
from .servo.watchdog import PAD_SILENCE, is_alive

Sink = Callable[[DeadmanRecord], None]


class Threshold:
    """Turns an analogue trigger into a button, with hysteresis so that a trembling finger does not release it.

    Args:
        press: Travel (0..1) from which it counts as pressed.
        release: Travel below which it counts as released.
    """

    def __init__(self, press: float = 0.5, release: float = 0.3) -> None:
        if not 0.0 < release <= press <= 1.0:
            raise ValueError(f"thresholds must satisfy 0 < release <= press <= 1, not press={press}, release={release}")
        self.press = press
        self.release = release
        self.held = False

    def update(self, value: float) -> bool:
        """Return whether the trigger is held at this travel (0..1); NaN counts as released."""
        self.held = value >= (self.release if self.held else self.press)
        return self.held


class Deadman:
    """A dead-man switch. Its owner (a gamepad, a web page) calls :meth:`update`; control sessions call :meth:`attach`.

    It counts as held only after it was seen released while its device was connected; a control that was held before
    that, or throughout an interruption, moves nothing. Every method may be called from any thread.

    Args:
        name: Name for messages, for example ``l2 of pad``.
        distrust: Returns why this switch must not guard a real arm at the moment, with the remedy; None if it may.
        alarm: Signals a stop to the hand that holds the switch (a pad rumbles); must return at once.
    """

    def __init__(
        self,
        name: str,
        distrust: Callable[[], str | None] | None = None,
        alarm: Callable[[], object] | None = None,
    ) -> None:
        self.name = name
        self._alarm = alarm
        self._distrust = distrust
        self._must_be_trusted = False
        self._armed = False
        self._record = DeadmanRecord(held=False, connected=False, presses=0, t_alive=-math.inf)
        self._sinks: dict[object, Sink] = {}
        self._lock = threading.RLock()
        self.error: Exception | None = None
        """Error for which a listener was dropped; None if there was none."""

    def alarm(self) -> None:
        """Signal to the hand that holds the switch that the arm was stopped, if the device can."""
        if self._alarm is not None:
            self._alarm()

    @property
    def record(self) -> DeadmanRecord:
        """Present state, as the servo gets it."""
        return self._record

    @property
    def held(self) -> bool:
        """Whether the switch is held, and counts."""
        return self._record.held

    def holds(self, now: float) -> bool:
        """Return whether the switch is held, and gave a sign of life lately, at ``now`` (s on the host's clock).

        For motions that no session watches. A session has its own, stricter watch in the servo.
        """
        return self._record.held and is_alive(now, self._record.t_alive, PAD_SILENCE)

    @property
    def connected(self) -> bool:
        """Whether the device of the switch is connected."""
        return self._record.connected

    def update(self, pressed: bool, connected: bool, t_alive: float) -> DeadmanRecord:
        """Take a state of the device and pass it on to all listeners.

        Args:
            pressed: Whether the control is pressed.
            connected: Whether the device is connected.
            t_alive: Time of the last proof of that on the host's clock, s.

        Returns:
            The new state of the switch.
        """
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
                self._pass_to(token)
            return self._record

    def disarm(self) -> None:
        """Count as released, now and until the control was released: a stop for which a new press is needed."""
        with self._lock:
            self._armed = False
            self._record = self._record._replace(held=False)
            for token in tuple(self._sinks):
                self._pass_to(token)

    def attach(self, sink: Sink) -> Callable[[], None]:
        """Call ``sink`` now and at every update, until the returned function is called.

        A sink that raises is dropped (see :attr:`error`): its receiver gets no further updates, which stops the arm.
        """
        token = object()
        with self._lock:
            self._sinks[token] = sink
            self._pass_to(token)

        def detach() -> None:
            with self._lock:
                self._sinks.pop(token, None)

        return detach

    def _pass_to(self, token: object) -> None:
        try:
            self._sinks[token](self._record)
        except Exception as error:
            self.error = error
            del self._sinks[token]

    def check_trust(self) -> None:
        """Require that this switch is safe enough for a real arm, now and from now on.

        From then on it counts as held only while that is so, because another device may replace the present one.

        Raises:
            NotSupported: It is not, because its silence would pass unnoticed; the message has the remedy (``code`` is
                ``deadman_not_trusted``).
        """
        reason = self._distrust() if self._distrust is not None else None
        if reason is not None:
            raise NotSupported(reason, code="deadman_not_trusted")
        with self._lock:
            self._must_be_trusted = True

    def __repr__(self) -> str:
        return f"<Deadman {self.name}: {'held' if self.held else 'released'}>"
