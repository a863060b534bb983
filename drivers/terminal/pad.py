"""The keys of a terminal as a gamepad, on this machine or over ssh."""

from __future__ import annotations

import os
import signal
import threading
import time

from hal.driver import GamepadDriver, PadReading
from hal.pads.model import validated
from hal.specs import PadSpec

from .device import Terminal
from .holding import Holding
from .keys import CTRL, PRESS, Answer, Key, KeyParser
from .layout import HOLD_HELP, RELEASED, STEP_HELP, STOP_KEYS, Controls
from .negotiation import leave, why_not_hold
from .options import Options
from .steps import Steps

__all__ = ["TerminalPad"]

_SIGNALS = {"c": signal.SIGINT, "z": signal.SIGTSTP, "\\": signal.SIGQUIT}
"""With Ctrl. A terminal that reports all keys as such leaves these to us, too."""


class TerminalPad(GamepadDriver):
    """Keys of a terminal. ``source``, if it can be called, stops every arm: Backspace and Esc call it.

    A plain terminal never says when a key is let go of, so nothing can be held there: a key press is one bounded
    *step* (:class:`.steps.Steps`). Where the terminal reports releases and the loss of focus, and answers fast enough
    (:mod:`.negotiation`), keys are *held* (:class:`.holding.Holding`).

    Either way its silence is noticed, and so it may be the dead-man of a real arm. A step ends by this program's
    clock, needs nothing more from the terminal, and its proof of life is the key press alone: if this program should
    hang, the servo ends the step when the press is 0.12 s old. A key that is held counts only as long as the terminal
    answers (:class:`.pings.Pings`), because the release can get lost with the link.

    In the background, and while it is stopped by Ctrl-Z, the pad is not connected and the terminal is as it was.
    """

    proves_liveness = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._options = validated(Options, spec.options, f"gamepads.{spec.name}")
        self._terminal: Terminal | None = None
        self._lock = threading.RLock()
        """Whoever takes the terminal over or puts it back holds it."""
        self._parser = KeyParser()
        self._hand: Steps | Holding = Steps(self._options, spec.dead_zone)
        self._focus = True
        self._suspended = False
        self._last = PadReading(float("-inf"), float("-inf"), 0.0, 0, RELEASED.axes, frozenset(), connected=False)

    def open(self) -> None:
        """Raises NotSupported where there is no terminal. In the background it waits to be brought to the front."""
        try:
            self._terminal = Terminal(self._options.tty)
            if _may_handle_signals() and signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:
                signal.signal(signal.SIGTSTP, self._on_stop)
            self._present()
        except BaseException:
            self.close()
            raise

    def _present(self) -> bool:
        """Is the terminal ours to read? Takes it over when it has become so. OSError when it is gone."""
        terminal = self._terminal
        if terminal is None or self._suspended:
            return False
        with self._lock:
            if not terminal.in_foreground():
                self._leave()
            elif not terminal.entered and not self._suspended:
                terminal.enter()
                self._agree(terminal)
            return terminal.entered

    def _agree(self, terminal: Terminal) -> None:
        """Find out whether keys can be held."""
        self._parser = KeyParser()
        self._focus = True
        why: str | None = "the rig asks for it"
        if self._options.mode == "auto":
            asks = os.environ.get("TERM", "dumb") != "dumb"
            why = why_not_hold(terminal, self._parser, self._obey) if asks else "this terminal understands no questions"
        if why is None:
            self._hand = Holding(self.spec.dead_zone)
            self.notes = ()
        else:
            self._hand = Steps(self._options, self.spec.dead_zone)
            self.notes = (f"keys of the terminal make a step for each press: {why}",)

    # Being polled.

    def poll(self, now: float, timeout: float) -> PadReading:
        begun = time.monotonic()
        try:
            present = self._present()
            data = self._listen(now, timeout) if present else b""
        except OSError:  # closed: it does not come back
            present, data = False, b""
            self._drop()
            self.notes = ("the terminal was closed",)
        if not present and timeout > 0.0:
            time.sleep(timeout)
        if timeout > 0.0:  # in lock-step nothing waits, and time stands still
            now += time.monotonic() - begun
        for event in self._parser.feed(data, time.monotonic()) if present else ():
            self._take(event, now)
        if not present or not self._focus:
            self._hand.release()
            return self._report(now, self._last.t_alive, RELEASED, connected=False)
        controls = self._hand.controls(now)
        return self._report(now, self._hand.alive(now), controls, connected=True)

    def _listen(self, now: float, timeout: float) -> bytes:
        terminal, hand = self._terminal, self._hand
        assert terminal is not None
        with self._lock:  # nothing may be asked any more once Ctrl-Z has given the terminal back
            if terminal.entered and isinstance(hand, Holding):
                if hand.pings.lost:  # somebody reset the terminal
                    self._agree(terminal)
                    self._hand.stop(now)
                elif hand.pings.wait(now) <= 0.0:
                    terminal.write(hand.pings.ask(now))
        return terminal.read(min(timeout, self._hand.wait(now)))

    def _report(self, now: float, alive: float, controls: Controls, connected: bool) -> PadReading:
        last = self._last
        changed = (last.axes, last.buttons, last.connected) != (controls.axes, controls.buttons, connected)
        t = now if changed or last.seq == 0 else last.t
        seq = last.seq + int(changed or last.seq == 0)
        self._last = PadReading(t, alive, t, seq, controls.axes, controls.buttons, connected)
        return self._last

    def _take(self, event: Key | Answer, now: float) -> None:
        hand = self._hand
        if isinstance(event, Answer):
            if isinstance(hand, Holding):
                self._hear(event, hand)
            return
        if event.event == PRESS:
            self._focus = True
            self._obey(event)
            if event.name in STOP_KEYS:
                hand.stop(now)
                if callable(self.source):
                    self.source()
                return
        hand.take(event, now)

    def _hear(self, answer: Answer, hand: Holding) -> None:
        if answer.what in ("I", "O"):
            self._focus = answer.what == "I"
            hand.release()
        else:
            hand.pings.hear(answer)

    # Ctrl-C, Ctrl-Z and fg.

    def _obey(self, key: Key) -> None:
        """Ctrl-C and its like: do what the kernel does where they are not reported as keys."""
        number = _SIGNALS.get(key.name) if key.event == PRESS and key.modifiers & CTRL else None
        if number is None:
            return
        self._hand.release()
        if number is signal.SIGTSTP and signal.getsignal(number) != self._on_stop:
            with self._lock:
                self._leave()
        os.killpg(os.getpgrp(), number)

    def _on_stop(self, number: int, frame: object) -> None:
        """Ctrl-Z: give the terminal back, stand still, and be taken over again by the next poll after ``fg``."""
        with self._lock:
            self._suspended = True
            self._leave()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._on_stop)
        self._suspended = False

    def _leave(self) -> None:
        """Give the terminal back."""
        terminal = self._terminal
        if terminal is not None and terminal.entered:
            if isinstance(self._hand, Holding):
                leave(terminal)
            terminal.leave()

    def _drop(self) -> None:
        with self._lock:
            terminal, self._terminal = self._terminal, None
            if terminal is not None:
                terminal.close()

    # The rest.

    @property
    def can_hold(self) -> bool:
        return isinstance(self._hand, Holding)

    def describe(self) -> str:
        if self._terminal is None:
            return "no terminal"
        if not self._terminal.entered:
            return "keys of this terminal, once the program is in the foreground: fg"
        return HOLD_HELP if isinstance(self._hand, Holding) else STEP_HELP

    def close(self) -> None:
        with self._lock:
            self._leave()
            self._drop()
        if _may_handle_signals() and signal.getsignal(signal.SIGTSTP) == self._on_stop:
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        self._last = self._last._replace(axes=RELEASED.axes, buttons=frozenset(), connected=False)


def _may_handle_signals() -> bool:
    return threading.current_thread() is threading.main_thread()
