"""The gamepad driver: the keys of a terminal, on this machine or over ssh."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress

from hal.config.files import check_record
from hal.driver import GamepadDriver, PadReading
from hal.pads.keyboard import keyboard_table
from hal.specs import PadSpec

from .controls import HELP, RELEASED, STOP_KEYS, PadControls, StepControls, TerminalOptions
from .device import Terminal
from .keys import KeyParser


class TerminalPad(GamepadDriver):
    """Keys of a terminal as a gamepad. ``source``, if callable, stops every arm; Backspace and Esc call it.

    A terminal does not report when a key is released, so nothing can be held: a key press is one bounded *step*
    (:class:`.controls.StepControls`). A step ends by this program's clock and needs nothing more from the terminal, and
    its proof of life is the key press alone: if this program hangs, the servo ends the step when the press is 0.12 s
    old. So the pad may be the dead-man of a real arm.

    In the background, also after Ctrl-Z, the pad is not connected. The shell then has the terminal, with the shell's
    own settings; after ``fg`` the next poll takes it over again.
    """

    proves_liveness = True
    can_hold = False

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._options = check_record(TerminalOptions, spec.options, f"gamepads.{spec.name}")
        self._terminal: Terminal | None = None
        self._parser = KeyParser()
        self._controls = StepControls(self._options, spec.dead_zone)
        self._last = PadReading(float("-inf"), float("-inf"), 0.0, 0, RELEASED.axes, frozenset(), connected=False)

    def open(self) -> None:
        """Take the terminal over; in the background, the first poll in the foreground does.

        Raises:
            NotSupported: There is no terminal.
        """
        self._terminal = Terminal(self._options.tty)
        with suppress(OSError):  # it is gone: so says the next poll
            self._take(self._terminal)

    def _take(self, terminal: Terminal) -> bool:
        """Take the terminal over, unless it is; return whether it may be read. Raises OSError when it is gone."""
        if not terminal.in_foreground():
            return False
        if not terminal.is_taken():
            terminal.take()
            self._parser = KeyParser()
            self._controls.release()
        return True

    def poll(self, now: float, timeout: float) -> PadReading:
        """See :meth:`GamepadDriver.poll`."""
        begun = time.monotonic()
        terminal, controls = self._terminal, self._controls
        try:
            present = terminal is not None and self._take(terminal)
            wait = min(timeout, controls.time_to_next(now))
            data = terminal.read(wait) if terminal is not None and present else b""
        except OSError:  # closed: it does not come back
            present, data = False, b""
            self.close()
            self.notes = ("the terminal was closed",)
        if not present and timeout > 0.0:
            time.sleep(timeout)
        if timeout > 0.0:  # in lock-step nothing waits, and time stands still
            now += time.monotonic() - begun
        if not present:
            controls.release()
            return self._report(now, self._last.t_alive, RELEASED, connected=False)
        for key in self._parser.feed(data, time.monotonic()):
            if key not in STOP_KEYS:
                controls.handle_key(key, now)
                continue
            controls.stop(now)
            if callable(self.source):
                self.source()
        pressed = controls.controls(now)
        return self._report(now, controls.t_alive(now), pressed, connected=True)

    def _report(self, now: float, t_alive: float, controls: PadControls, connected: bool) -> PadReading:
        last = self._last
        changed = (last.axes, last.buttons, last.connected) != (controls.axes, controls.buttons, connected)
        t = now if changed or last.seq == 0 else last.t
        seq = last.seq + int(changed or last.seq == 0)
        self._last = PadReading(t, t_alive, t, seq, controls.axes, controls.buttons, connected)
        return self._last

    @property
    def control_names(self) -> Mapping[str, str]:
        """See :meth:`GamepadDriver.control_names`."""
        return keyboard_table("terminal").names

    def describe(self) -> str:
        """See :meth:`GamepadDriver.describe`."""
        if self._terminal is None:
            return "no terminal"
        if not self._last.connected:
            return "keys of this terminal, once the program is in the foreground: fg"
        return HELP

    def close(self) -> None:
        """Give the terminal back as it was. Idempotent."""
        terminal, self._terminal = self._terminal, None
        if terminal is not None:
            terminal.close()
        self._last = self._last._replace(axes=RELEASED.axes, buttons=frozenset(), connected=False)
