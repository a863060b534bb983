"""A serial line as a file descriptor, and what is wrong with it in words. Needs no library."""

from __future__ import annotations

import errno
import fcntl
import os
import termios
import tty
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EMULATED = ".emulated"
"""End of the name of an emulator's port: a pseudo terminal alone may also lead to a device, over a network."""
_ADVICE = {
    errno.ENOENT: "plug in its adapter; serial devices here: ",
    errno.EACCES: "sudo usermod -aG dialout $USER, then log out and in",
    errno.EBUSY: "end the other program that uses it",
}


def open_line(path: str, baud: int) -> int:
    """Open a serial line for this program alone: raw, 8 data bits, no parity, not blocking. Raises OSError.

    Args:
        path: Its device.
        baud: Bit/s, one of those that ``termios`` has.
    """
    if path.endswith(EMULATED) and os.stat(path).st_ctime > os.lstat(path).st_mtime:
        # A killed emulator has left its link, which now leads to a younger terminal, of someone else.
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
    line = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.ioctl(line, termios.TIOCEXCL)  # a second program would take half of the answers
        tty.setraw(line, termios.TCSANOW)
        set_baud(line, baud)
    except (OSError, termios.error) as error:
        os.close(line)
        raise OSError(errno.ENOTTY, f"is no serial line ({error})") from None
    return line


def set_baud(line: int, baud: int) -> None:
    """Set the bit rate of an open line. Raises OSError or termios.error."""
    mode = termios.tcgetattr(line)
    mode[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    mode[4] = mode[5] = getattr(termios, f"B{baud}")
    termios.tcsetattr(line, termios.TCSANOW, mode)


def read_line(line: int) -> bytes:
    """Return what has come. Raises OSError if the line is gone."""
    try:
        came = os.read(line, 4096)
    except BlockingIOError:
        return b""
    if not came:
        raise OSError(errno.EIO, "it was disconnected")
    return came


def explain(error: OSError, more: Mapping[int, str] | None = None) -> str:
    """Return why a line does not work, with what to do about it; ``more`` is further advice, by error number."""
    there = ", ".join(map(str, Path("/dev/serial/by-id").glob("*"))) or "none"
    if error.errno == errno.ENOENT and str(error.filename).endswith(EMULATED):
        return "its emulator does not run; start it in another terminal: hal emulate --config RIG"
    advice = {**_ADVICE, **(more or {})}.get(error.errno or 0, "check its cable and its power")
    return f"{error.strerror}; {advice}{there if error.errno == errno.ENOENT else ''}"


def is_emulated(options: Mapping[str, Any]) -> bool:
    """Return whether the ``port`` of these options is that of an emulator."""
    return str(options.get("port")).endswith(EMULATED)
