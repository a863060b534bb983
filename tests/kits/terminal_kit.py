"""The far end of a pseudo-terminal: its screen and the keys of its user."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Callable
from fcntl import ioctl
from pathlib import Path
from types import TracebackType
from typing import Any


def wait_for(condition: Callable[[], bool], what: str, timeout: float = 20.0, every: float = 0.002) -> None:
    """Wait until ``condition`` holds; AssertionError after ``timeout`` s."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen within {timeout:g} s"
        time.sleep(every)


class FarEnd:
    """A terminal: a thread of its own reads what is written to it."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        self.path = os.ttyname(self.slave)
        self.screen = b""
        """Everything that was written to it."""
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def type(self, text: str | bytes) -> None:
        """Press keys."""
        os.write(self.master, text.encode() if isinstance(text, str) else text)

    def put(self, text: str | bytes) -> None:
        """Press keys, and wait until they have reached the near end; nothing may read meanwhile."""
        before = self.unread()
        self.type(text)
        wait_for(lambda: self.unread() > before, "typing")

    def unread(self) -> int:
        """Return how many bytes are unread."""
        return int(struct.unpack("i", ioctl(self.slave, termios.FIONREAD, b"\0" * 4))[0])

    @property
    def settings(self) -> list[Any]:
        return termios.tcgetattr(self.slave)

    @settings.setter
    def settings(self, attributes: list[Any]) -> None:
        termios.tcsetattr(self.slave, termios.TCSANOW, attributes)

    @property
    def raw(self) -> bool:
        """Whether keys are given one by one, without echo."""
        return not termios.tcgetattr(self.slave)[3] & (termios.ICANON | termios.ECHO)

    def _run(self) -> None:
        while not self._ending.is_set():
            if not select.select((self.master,), (), (), 0.05)[0]:
                continue
            try:
                self.screen += os.read(self.master, 65536)
            except OSError:
                return

    def hang_up(self) -> None:
        """Close the terminal's window."""
        self._ending.set()
        self._thread.join(2.0)
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        self._ending.set()
        self._thread.join(2.0)
        for fd in (self.master, self.slave):
            if fd >= 0:
                os.close(fd)
        self.master = self.slave = -1

    def __enter__(self) -> FarEnd:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()


class InTerminal:
    """A program in the foreground of a terminal that it controls, as a shell starts it."""

    def __init__(self, far: FarEnd, command: list[str]) -> None:
        self.far = far
        self.before = far.settings

        def take_control() -> None:
            ioctl(far.slave, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            command,
            stdin=far.slave,
            stdout=far.slave,
            stderr=far.slave,
            start_new_session=True,
            preexec_fn=take_control,
            env={**os.environ, "TERM": "xterm-256color", "PS1": "$ "},
        )

    def shows(self, text: str, timeout: float = 30.0) -> None:
        """Wait until the screen shows ``text``."""

        try:
            wait_for(lambda: text.encode() in self.far.screen, f"{text!r} on the screen", timeout)
        except AssertionError as error:
            raise AssertionError(f"{error}; it shows {self.far.screen[-2000:]!r}") from None

    def tells(self, pattern: str, timeout: float = 30.0) -> str:
        """Return the group of ``pattern`` as soon as the screen shows it."""
        wait_for(
            lambda: re.search(pattern, self.far.screen.decode()) is not None, f"{pattern!r} on the screen", timeout
        )
        found = re.search(pattern, self.far.screen.decode())
        return found[1]

    def holders(self) -> list[str]:
        """Return the command lines of the processes that have this terminal open, without the test's own."""
        found = []
        for process in Path("/proc").iterdir():
            if process.name.isdigit() and int(process.name) != os.getpid():
                with contextlib.suppress(OSError):
                    if any(os.readlink(link) == self.far.path for link in (process / "fd").iterdir()):
                        found.append((process / "cmdline").read_text().replace("\0", " "))
        return found

    def is_released(self) -> None:
        """Wait until no process has the terminal open."""
        wait_for(lambda: not self.holders(), "closing of the terminal", every=0.05)

    def is_put_back(self) -> None:
        """Wait until no process has the terminal open and its settings are as before."""
        self.is_released()
        assert self.far.settings == self.before
        assert self.far.unread() == 0, "no input is left for the shell"

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(10)

    def __enter__(self) -> InTerminal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()
