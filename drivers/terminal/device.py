"""A terminal as a device: its settings, changed and restored, and bytes in without blocking."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import signal
import termios
from collections.abc import Iterator
from typing import Any

from hal.errors import NotSupported

_JOB_CONTROL = (signal.SIGTTIN, signal.SIGTTOU)


class Terminal:
    """A terminal that gives keys one by one, without echo, from :meth:`take` to :meth:`close`.

    Ctrl-C and Ctrl-Z keep their meaning. The terminal is opened a second time, so that nothing here changes how the
    program's standard input and output behave.
    """

    def __init__(self, path: str | None = None) -> None:
        """Open the terminal at ``path``; None for the program's own.

        Raises:
            NotSupported: There is none (code ``no_terminal``).
        """
        self.fd = _open(path)
        self._before: list[Any] | None = None
        self._ours: list[Any] | None = None

    def in_foreground(self) -> bool:
        """Whether this program may read: the kernel stops a reader in the background. OSError when it is gone."""
        try:
            return os.tcgetpgrp(self.fd) == os.getpgrp()
        except OSError as error:
            if error.errno == errno.ENOTTY:  # the terminal of another session: it has no foreground here
                return True
            raise

    def is_taken(self) -> bool:
        """Whether the settings are those of :meth:`take`: a shell changes them while the program is stopped."""
        with _as_os_error():
            return self._ours is not None and termios.tcgetattr(self.fd) == self._ours

    def take(self) -> None:
        """Change the settings, and drop what was typed before. Raises OSError when the terminal is gone."""
        with _block_job_control(), _as_os_error():
            attributes = termios.tcgetattr(self.fd)
            if self._before is None:
                self._before = termios.tcgetattr(self.fd)
            attributes[3] &= ~(termios.ECHO | termios.ICANON)
            attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
            termios.tcsetattr(self.fd, termios.TCSANOW, attributes)
            termios.tcflush(self.fd, termios.TCIFLUSH)
            self._ours = termios.tcgetattr(self.fd)

    def read(self, timeout: float) -> bytes:
        """Return what was typed, after at most ``timeout`` s. Raises OSError when the terminal is gone."""
        poller = select.poll()
        poller.register(self.fd, select.POLLIN)
        if not poller.poll(1e3 * timeout):
            return b""
        with _block_job_control():
            try:
                data = os.read(self.fd, 65536)
            except BlockingIOError:  # another reader was faster
                return b""
            except OSError:
                if self.in_foreground():
                    raise
                return b""  # sent to the background this moment
        if not data:
            raise OSError(errno.EIO, "the terminal was closed")
        return data

    def close(self) -> None:
        """Restore the settings, unless another program has changed them since, and close the terminal. Idempotent.

        Unread input is dropped, because it was not meant for the shell.
        """
        if self.fd < 0:
            return
        with contextlib.suppress(OSError), _block_job_control():
            if self._before is not None and self.is_taken():
                with _as_os_error():
                    termios.tcsetattr(self.fd, termios.TCSANOW, self._before)
                    termios.tcflush(self.fd, termios.TCIFLUSH)
        os.close(self.fd)
        self.fd = -1


def _open(path: str | None) -> int:
    names = [path] if path is not None else ["/dev/tty"]
    if path is None:
        with contextlib.suppress(OSError):
            names.insert(0, os.ttyname(0))
    reason = "there is none"
    for name in names:
        try:
            fd = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            reason = str(error)
            continue
        if os.isatty(fd):
            return fd
        os.close(fd)
        reason = f"{name} is not a terminal"
    raise NotSupported(
        f"no terminal to read keys from ({reason}): start the program in one, over ssh with ssh -t", code="no_terminal"
    )


@contextlib.contextmanager
def _as_os_error() -> Iterator[None]:
    """Raise an error of termios as OSError."""
    try:
        yield
    except termios.error as error:
        raise OSError(*error.args) from None


@contextlib.contextmanager
def _block_job_control() -> Iterator[None]:
    """Block job-control signals: reading or writing in the background fails instead of suspending the program."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _JOB_CONTROL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
