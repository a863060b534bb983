"""A terminal as a device: its settings, changed and restored, and bytes in and out without blocking."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from typing import Any

from hal.errors import NotSupported

from . import guardian

__all__ = ["Terminal"]

_JOB_CONTROL = (signal.SIGTTIN, signal.SIGTTOU)
_GUARDIAN_ENDS = 2.0  # s


class Terminal:
    """A terminal that gives keys one by one, without echo, from :meth:`enter` to :meth:`leave`.

    Ctrl-C and Ctrl-Z keep their meaning. The terminal is opened a second time, so that nothing here changes how the
    program's standard input and output behave, and writing never waits for a terminal that takes nothing. A process of
    its own (:mod:`.guardian`) restores the settings if this one is killed.
    """

    def __init__(self, path: str | None = None) -> None:
        """Open the terminal at ``path``; None for the program's own.

        Raises:
            NotSupported: There is none (code ``no_terminal``).
        """
        self.fd = _open(path)
        self.entered = False
        """Whether the settings are changed at present."""
        self._undo: dict[str, Any] | None = None
        self._guardian = subprocess.Popen(
            [sys.executable, "-I", "-S", guardian.__file__, str(self.fd)],
            pass_fds=[self.fd],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            start_new_session=True,
        )

    def in_foreground(self) -> bool:
        """Whether this program may read: the kernel stops a reader in the background. OSError when it is gone."""
        try:
            return os.tcgetpgrp(self.fd) == os.getpgrp()
        except OSError as error:
            if error.errno == errno.ENOTTY:  # the terminal of another session: it has no foreground here
                return True
            raise

    def enter(self) -> None:
        """Take the terminal over, and drop what was typed before. Raises OSError when it is gone."""
        with _without_job_control():
            try:
                before = guardian.settings(self.fd)
                attributes = termios.tcgetattr(self.fd)
                attributes[3] &= ~(termios.ECHO | termios.ICANON)
                attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
                # The guardian gets this before anything changes.
                self._send_to_guardian(
                    {"before": before, "ours": [*attributes[:6], _as_json(attributes[6])], "write": ""}
                )
                termios.tcsetattr(self.fd, termios.TCSANOW, attributes)
                termios.tcflush(self.fd, termios.TCIFLUSH)
                self._send_to_guardian({"before": before, "ours": guardian.settings(self.fd), "write": ""})
            except termios.error as error:
                raise OSError(*error.args) from None
        self.entered = True

    def undo_with(self, text: str) -> None:
        """Set the text that is written when the terminal is left, here or by the guardian."""
        if self._undo is not None:
            self._send_to_guardian({**self._undo, "write": text})

    def leave(self) -> None:
        """Restore the settings. Idempotent; never raises."""
        self.entered = False
        if self._undo is not None:
            with _without_job_control():
                guardian.restore(self.fd, self._undo)
            self._send_to_guardian(None)

    def _send_to_guardian(self, undo: dict[str, Any] | None) -> None:
        self._undo = undo
        pipe = self._guardian.stdin
        assert pipe is not None
        with contextlib.suppress(OSError, ValueError):  # it was killed, or is closed
            pipe.write(json.dumps(undo).encode() + b"\n")
            pipe.flush()

    def read(self, timeout: float) -> bytes:
        """Return what was typed, after at most ``timeout`` s. Raises OSError when the terminal is gone."""
        poller = select.poll()  # a new one each time: after Ctrl-Z another thread reads the rest
        poller.register(self.fd, select.POLLIN)
        if not poller.poll(1e3 * timeout):
            return b""
        with _without_job_control():
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

    def write(self, data: bytes) -> None:
        """Write to the terminal; data that it does not take is lost. Raises OSError when it is gone."""
        with _without_job_control(), contextlib.suppress(BlockingIOError):
            os.write(self.fd, data)

    def close(self) -> None:
        """Restore the settings and close the terminal. Idempotent."""
        self.leave()
        pipe = self._guardian.stdin
        assert pipe is not None
        with contextlib.suppress(OSError):
            pipe.close()
        try:
            self._guardian.wait(_GUARDIAN_ENDS)
        except subprocess.TimeoutExpired:
            self._guardian.kill()
            self._guardian.wait()
        if self.fd >= 0:
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


def _as_json(characters: list[Any]) -> list[Any]:
    return [c if isinstance(c, int) else c.decode("latin-1") for c in characters]


@contextlib.contextmanager
def _without_job_control() -> Iterator[None]:
    """Block job-control signals: reading or writing in the background fails instead of suspending the program."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _JOB_CONTROL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
