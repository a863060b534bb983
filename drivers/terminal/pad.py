"""The gamepad driver: the keys of a terminal, on this machine or over ssh."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Mapping

from hal.driver import GamepadDriver, PadReading
from hal.pads.keyboard import keyboard_table
from hal.pads.model import check_record
from hal.specs import PadSpec

from .controls import (
    HOLD_HELP,
    RELEASED,
    STEP_HELP,
    STOP_KEYS,
    HeldControls,
    PadControls,
    StepControls,
    TerminalOptions,
)
from .device import Terminal
from .keys import CTRL, PRESS, Key, KeyParser, TerminalReply, disable_key_reports, enable_key_reports

__all__ = ["TerminalPad"]

_SIGNALS = {"c": signal.SIGINT, "z": signal.SIGTSTP, "\\": signal.SIGQUIT}
"""Keys that send a signal with Ctrl. A terminal that reports all keys leaves these to the program, too."""


class TerminalPad(GamepadDriver):
    """Keys of a terminal as a gamepad. ``source``, if callable, stops every arm; Backspace and Esc call it.

    A plain terminal does not report when a key is released, so nothing can be held there: a key press is one bounded
    *step* (:class:`.controls.StepControls`). Where the terminal reports releases and the loss of focus, and answers
    fast enough (:mod:`.keys`), keys are *held* (:class:`.controls.HeldControls`).

    The silence of the terminal is noticed in both modes, so it may be the dead-man of a real arm. A step ends by this
    program's clock, needs nothing more from the terminal, and its proof of life is the key press alone: if this program
    hangs, the servo ends the step when the press is 0.12 s old. A held key counts only as long as the terminal answers
    (:class:`.keys.LinkCheck`), because the release can get lost with the link.

    In the background, and while the program is stopped by Ctrl-Z, the pad is not connected and the terminal is as it
    was before.
    """

    proves_liveness = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._options = check_record(TerminalOptions, spec.options, f"gamepads.{spec.name}")
        self._terminal: Terminal | None = None
        self._lock = threading.RLock()
        """Held while the terminal is taken over or given back."""
        self._parser = KeyParser()
        self._mode: StepControls | HeldControls = StepControls(self._options, spec.dead_zone)
        self._focus = True
        self._suspended = False
        self._last = PadReading(float("-inf"), float("-inf"), 0.0, 0, RELEASED.axes, frozenset(), connected=False)

    def open(self) -> None:
        """Take the terminal over; in the background, wait to be brought to the front.

        Raises:
            NotSupported: There is no terminal.
        """
        try:
            self._terminal = Terminal(self._options.tty)
            if _may_handle_signals() and signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:
                signal.signal(signal.SIGTSTP, self._on_ctrl_z)
            self._take_terminal()
        except BaseException:
            self.close()
            raise

    def _take_terminal(self) -> bool:
        """Take the terminal over, or give it back, by the rules of job control; True while it may be read.

        Raises OSError when the terminal is gone.
        """
        terminal = self._terminal
        if terminal is None or self._suspended:
            return False
        with self._lock:
            if not terminal.in_foreground():
                self._give_terminal_back()
            elif not terminal.entered and not self._suspended:
                terminal.enter()
                self._choose_mode(terminal)
            return terminal.entered

    def _choose_mode(self, terminal: Terminal) -> None:
        self._parser = KeyParser()
        self._focus = True
        reason: str | None = "options.mode of the rig is 'step'"
        if self._options.mode == "auto":
            if os.environ.get("TERM", "dumb") == "dumb":
                reason = "this terminal does not understand queries"
            else:
                reason = enable_key_reports(terminal, self._parser, self._send_signal)
        if reason is None:
            self._mode = HeldControls(self.spec.dead_zone)
            self.notes = ()
        else:
            self._mode = StepControls(self._options, self.spec.dead_zone)
            self.notes = (f"terminal keys make one step for each press: {reason}",)

    # Polling.

    def poll(self, now: float, timeout: float) -> PadReading:
        """See :meth:`GamepadDriver.poll`."""
        begun = time.monotonic()
        try:
            present = self._take_terminal()
            data = self._read_keys(now, timeout) if present else b""
        except OSError:  # closed: it does not come back
            present, data = False, b""
            self._close_terminal()
            self.notes = ("the terminal was closed",)
        if not present and timeout > 0.0:
            time.sleep(timeout)
        if timeout > 0.0:  # in lock-step nothing waits, and time stands still
            now += time.monotonic() - begun
        for event in self._parser.feed(data, time.monotonic()) if present else ():
            self._handle(event, now)
        if not present or not self._focus:
            self._mode.release()
            return self._report(now, self._last.t_alive, RELEASED, connected=False)
        controls = self._mode.controls(now)
        return self._report(now, self._mode.t_alive(now), controls, connected=True)

    def _read_keys(self, now: float, timeout: float) -> bytes:
        terminal, mode = self._terminal, self._mode
        assert terminal is not None
        with self._lock:  # no questions once Ctrl-Z has given the terminal back
            if terminal.entered and isinstance(mode, HeldControls):
                if mode.link.lost:  # the terminal was reset
                    self._choose_mode(terminal)
                    self._mode.stop(now)
                elif mode.link.time_to_next(now) <= 0.0:
                    terminal.write(mode.link.question(now))
        return terminal.read(min(timeout, self._mode.time_to_next(now)))

    def _handle(self, event: Key | TerminalReply, now: float) -> None:
        mode = self._mode
        if isinstance(event, TerminalReply):
            if isinstance(mode, HeldControls):
                if event.what in ("I", "O"):
                    self._focus = event.what == "I"
                    mode.release()
                else:
                    mode.link.handle_answer(event)
            return
        if event.event == PRESS:
            self._focus = True
            self._send_signal(event)
            if event.name in STOP_KEYS:
                mode.stop(now)
                if callable(self.source):
                    self.source()
                return
        mode.handle_key(event, now)

    def _report(self, now: float, t_alive: float, controls: PadControls, connected: bool) -> PadReading:
        last = self._last
        changed = (last.axes, last.buttons, last.connected) != (controls.axes, controls.buttons, connected)
        t = now if changed or last.seq == 0 else last.t
        seq = last.seq + int(changed or last.seq == 0)
        self._last = PadReading(t, t_alive, t, seq, controls.axes, controls.buttons, connected)
        return self._last

    # Ctrl-C, Ctrl-Z and fg.

    def _send_signal(self, key: Key) -> None:
        """Do for Ctrl-C and its like what the kernel does where they are not reported as keys."""
        number = _SIGNALS.get(key.name) if key.event == PRESS and key.modifiers & CTRL else None
        if number is None:
            return
        self._mode.release()
        if number is signal.SIGTSTP and signal.getsignal(number) != self._on_ctrl_z:
            with self._lock:
                self._give_terminal_back()
        os.killpg(os.getpgrp(), number)

    def _on_ctrl_z(self, number: int, frame: object) -> None:
        """Give the terminal back and stop this process; the next poll after ``fg`` takes the terminal over again."""
        with self._lock:
            self._suspended = True
            self._give_terminal_back()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._on_ctrl_z)
        self._suspended = False

    def _give_terminal_back(self) -> None:
        terminal = self._terminal
        if terminal is not None and terminal.entered:
            if isinstance(self._mode, HeldControls):
                disable_key_reports(terminal)
            terminal.leave()

    def _close_terminal(self) -> None:
        with self._lock:
            terminal, self._terminal = self._terminal, None
            if terminal is not None:
                terminal.close()

    # Description and end.

    @property
    def can_hold(self) -> bool:
        """Whether keys can be held; otherwise each press is one step."""
        return isinstance(self._mode, HeldControls)

    @property
    def control_names(self) -> Mapping[str, str]:
        """See :meth:`GamepadDriver.control_names`."""
        return keyboard_table("terminal").names

    def describe(self) -> str:
        """See :meth:`GamepadDriver.describe`."""
        if self._terminal is None:
            return "no terminal"
        if not self._terminal.entered:
            return "keys of this terminal, once the program is in the foreground: fg"
        return HOLD_HELP if isinstance(self._mode, HeldControls) else STEP_HELP

    def close(self) -> None:
        """Give the terminal back as it was. Idempotent."""
        with self._lock:
            self._give_terminal_back()
            self._close_terminal()
        if _may_handle_signals() and signal.getsignal(signal.SIGTSTP) == self._on_ctrl_z:
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        self._last = self._last._replace(axes=RELEASED.axes, buttons=frozenset(), connected=False)


def _may_handle_signals() -> bool:
    return threading.current_thread() is threading.main_thread()
