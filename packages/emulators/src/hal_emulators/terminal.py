"""The far end of an emulated serial line: a pseudo terminal to which the name of a port leads."""

from __future__ import annotations

import fcntl
import os
import termios
import tty
from pathlib import Path

from hal.serial_line import EMULATED


class PseudoTerminal:
    """A pseudo terminal, and the link that leads to it. Its ``descriptors`` are none while it is away."""

    def __init__(self, port: str) -> None:
        """Choose the name. Raises ValueError if it is not that of an emulator, or is taken."""
        self._link = Path(port)
        self._ends: tuple[int, ...] = ()
        self.descriptors: list[int] = []
        if self._link.suffix != EMULATED or (self._link.exists() and not self._link.is_symlink()):
            raise ValueError(f"the port of an emulator is a free path that ends in {EMULATED}, not {self._link}")

    def open(self) -> None:
        """Offer it. Raises OSError."""
        self._ends = os.openpty()  # while its other end is open here too, it outlives its clients
        os.set_blocking(self._ends[0], False)
        self.descriptors = [self._ends[0]]
        tty.setraw(self._ends[1])
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(self._ends[1]))

    def close(self) -> None:
        """Take it away, as if it was unplugged."""
        for end in self._ends:
            os.close(end)
        self._ends, self.descriptors = (), []
        self._link.unlink(missing_ok=True)

    def free(self) -> None:
        """Let another client open it, as a client's close would, were the end not open here too."""
        fcntl.ioctl(self._ends[1], termios.TIOCNXCL)

    @property
    def baud(self) -> int:
        """Rate that the client has set, as a constant of ``termios``."""
        return int(termios.tcgetattr(self._ends[1])[5])
