"""Tells when input devices come, go or get other permissions, without looking for them: the kernel's inotify."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct

__all__ = ["Watch"]

# From the kernel's include/uapi/linux/inotify.h.
_ATTRIB, _MOVED_FROM, _MOVED_TO, _CREATE, _DELETE = 0x04, 0x40, 0x80, 0x100, 0x200
_DELETE_SELF, _MOVE_SELF, _IGNORED = 0x400, 0x800, 0x8000
_ONLYDIR = 0x01000000
_EVENT = struct.Struct("iIII")  # watch, mask, cookie, length of the name that follows


class Watch:
    """A folder that is watched, ``/dev/input``. :meth:`changed` raises OSError when that has come to its end.

    udev sets the permissions of a new device a moment after the kernel has made it, which is a change of its own.
    """

    def __init__(self, folder: str = "/dev/input") -> None:
        """Raises OSError: no such folder, or no watch to be had (the user's share of them is used up)."""
        libc = ctypes.CDLL(None, use_errno=True)
        try:
            begin, add = libc.inotify_init1, libc.inotify_add_watch
        except AttributeError:
            raise OSError("the C library has no inotify") from None
        self._fd = _checked(begin(os.O_NONBLOCK | os.O_CLOEXEC), folder)
        mask = _ATTRIB | _MOVED_FROM | _MOVED_TO | _CREATE | _DELETE | _DELETE_SELF | _MOVE_SELF | _ONLYDIR
        try:
            _checked(add(self._fd, os.fsencode(folder), mask), folder)
        except OSError:
            self.close()
            raise

    def fileno(self) -> int:
        """Readable when something changed."""
        return self._fd

    def changed(self) -> bool:
        """Did anything change since the last call? Never blocks. Raises OSError when the folder is gone."""
        found = False
        while True:
            try:
                data = os.read(self._fd, 65536)
            except BlockingIOError:
                return found
            found = True
            at = 0
            while at < len(data):
                _, mask, _, length = _EVENT.unpack_from(data, at)
                if mask & (_DELETE_SELF | _MOVE_SELF | _IGNORED):
                    raise OSError("the watched folder is gone")
                at += _EVENT.size + length

    def close(self) -> None:
        """Stop watching. Idempotent."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with contextlib.suppress(OSError):
                os.close(fd)


def _checked(result: int, folder: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), folder)
    return result
