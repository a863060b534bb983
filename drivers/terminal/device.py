"""A terminal as a device: its settings changed and put back, bytes in and out, never in anybody's way."""

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
    """Keys one by one and without echo from :meth:`enter` to :meth:`leave`; Ctrl-C and Ctrl-Z stay what they are.

    It has a file description of its own, so that nothing here ever changes how the program's standard input and
    output behave, and never waits for a terminal that takes nothing. A process of its own (:mod:`.guardian`) puts the
    settings back should this one be killed.
    """

    def __init__(self, path: str | None = None) -> None:
        """The terminal at ``path``, or the program's own. Raises NotSupported where there is none."""
        self.fd = _open(path)
        self.entered = False
        """Are the settings ours?"""
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
        """May this program read? Who reads in the background is stopped by the kernel. OSError when it is gone."""
        try:
            return os.tcgetpgrp(self.fd) == os.getpgrp()
        except OSError as error:
            if error.errno == errno.ENOTTY:  # the terminal of another session: nobody's foreground
                return True
            raise

    def enter(self) -> None:
        """Take the terminal over. Raises OSError when it is gone. What was typed before is thrown away."""
        with _undisturbed():
            try:
                before = guardian.settings(self.fd)
                attributes = termios.tcgetattr(self.fd)
                attributes[3] &= ~(termios.ECHO | termios.ICANON)
                attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
                # The guardian must know before anything changes.
                self._keep({"before": before, "ours": [*attributes[:6], _as_json(attributes[6])], "write": ""})
                termios.tcsetattr(self.fd, termios.TCSANOW, attributes)
                termios.tcflush(self.fd, termios.TCIFLUSH)
                self._keep({"before": before, "ours": guardian.settings(self.fd), "write": ""})
            except termios.error as error:
                raise OSError(*error.args) from None
        self.entered = True

    def undo_with(self, text: str) -> None:
        """What must be written when the terminal is left, whoever leaves it."""
        if self._undo is not None:
            self._keep({**self._undo, "write": text})

    def leave(self) -> None:
        """Put everything back. Idempotent; never raises."""
        self.entered = False
        if self._undo is not None:
            with _undisturbed():
                guardian.restore(self.fd, self._undo)
            self._keep(None)

    def _keep(self, undo: dict[str, Any] | None) -> None:
        self._undo = undo
        pipe = self._guardian.stdin
        assert pipe is not None
        with contextlib.suppress(OSError, ValueError):  # it was killed, or let go of
            pipe.write(json.dumps(undo).encode() + b"\n")
            pipe.flush()

    def read(self, timeout: float) -> bytes:
        """What was typed; waits up to ``timeout`` s for it. OSError when the terminal is gone."""
        poller = select.poll()  # a new one each time: Ctrl-Z makes another thread read what is left
        poller.register(self.fd, select.POLLIN)
        if not poller.poll(1e3 * timeout):
            return b""
        with _undisturbed():
            try:
                data = os.read(self.fd, 65536)
            except BlockingIOError:  # somebody else was faster
                return b""
            except OSError:
                if self.in_foreground():
                    raise
                return b""  # sent to the background this moment
        if not data:
            raise OSError(errno.EIO, "the terminal was closed")
        return data

    def write(self, data: bytes) -> None:
        """Say something to the terminal, or lose it where the terminal takes nothing. OSError when it is gone."""
        with _undisturbed(), contextlib.suppress(BlockingIOError):
            os.write(self.fd, data)

    def close(self) -> None:
        """Leave, and let go of it. Idempotent."""
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
    why = "there is none"
    for name in names:
        try:
            fd = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            why = str(error)
            continue
        if os.isatty(fd):
            return fd
        os.close(fd)
        why = f"{name} is no terminal"
    raise NotSupported(f"no terminal to read keys from ({why}): start the program in one, over ssh with ssh -t")


def _as_json(characters: list[Any]) -> list[Any]:
    return [c if isinstance(c, int) else c.decode("latin-1") for c in characters]


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Job control must not stop this thread: should the program be in the background after all, reading fails."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _JOB_CONTROL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
