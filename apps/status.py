"""The live line of an app: what the arm does, in one line that is drawn again and again."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from typing import TextIO

__all__ = ["StatusLine"]


class StatusLine:
    """One line at the bottom of a terminal; where there is none, only :meth:`event` prints."""

    def __init__(self, stream: TextIO | None = None, period: float = 0.1) -> None:
        self._stream = sys.stdout if stream is None else stream
        self._live = self._stream.isatty()
        self._period = period
        self._next = 0.0
        self._drawn = False

    def update(self, text: Callable[[], str]) -> None:
        """Draw the line anew, if its period is over; ``text`` is called only then."""
        now = time.monotonic()
        if not self._live or now < self._next:
            return
        self._next = now + self._period
        width = shutil.get_terminal_size().columns - 1
        self._write("\r\x1b[K" + text()[:width])
        self._drawn = True

    def event(self, text: str) -> None:
        """Print a line that stays."""
        self.clear()
        self._write(text + "\n")

    def clear(self) -> None:
        """Take the live line away."""
        if self._drawn:
            self._write("\r\x1b[K")
            self._drawn = False

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # the terminal was closed: the arm must still be brought to rest
            self._live = False
