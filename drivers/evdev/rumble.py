"""A pad's motors."""

from __future__ import annotations

import fcntl
import os
import struct
import threading
import time

from hal.gamepad import RUMBLE_SECONDS
from hal.pads.codes import EV_FF, FF_RUMBLE

__all__ = ["Rumble"]

# From the kernel's include/uapi/linux/input.h. The effect is a union whose largest member holds a pointer, so its size
# and where it begins depend on the machine.
_HEAD = "HhH HH HH"  # type, id, direction; trigger: button, interval; replay: length in ms, delay
_UNION = "HHhhH HHHH I P"  # ff_periodic_effect, the largest
_AT = struct.calcsize(f"@{_HEAD} 0P")
_SIZE = _AT + struct.calcsize(f"@{_UNION}")
_EVIOCSFF = 1 << 30 | _SIZE << 16 | ord("E") << 8 | 0x80  # _IOW('E', 0x80, struct ff_effect)
_EVENT = struct.Struct("@llHHi")
_FULL = 0xFFFF
_LONGEST = 10.0  # s


class Rumble:
    """The motors of one open device, which must be writable.

    The kernel must be told of an effect before it is played. That may take long: where the pad lives in another
    program, as long as that takes to answer. So it is done once, when the pad is plugged in, in a thread of its own;
    playing is then one write. Only a rumble of another strength or length than the last one is told anew. (An effect
    that is played several times would pause in between: the kernel stops the motors after each.)
    """

    def __init__(self, fd: int, strong: float, weak: float) -> None:
        """``fd`` stays the caller's. The shares (0..1) are those of the first effect, :data:`RUMBLE_SECONDS` long."""
        self._fd = fd
        self._effect = -1
        self._ready: tuple[float, float, float] | None = None
        self._busy = threading.Lock()
        self._closed = False
        self._prepare((strong, weak, RUMBLE_SECONDS), play=False)

    def play(self, strong: float, weak: float, seconds: float) -> bool:
        """Turn the motors, each at its share (0..1) of what it can. False where that cannot be done now.

        Raises OSError when the device is gone.
        """
        wanted = (strong, weak, min(seconds, _LONGEST))
        if self._closed or self._busy.locked():
            return False
        if self._ready == wanted:
            _play(self._fd, self._effect)
            return True
        return self._prepare(wanted, play=True)

    def _prepare(self, wanted: tuple[float, float, float], *, play: bool) -> bool:
        """Tell the kernel of the effect, in the background, and play it once."""
        if not self._busy.acquire(blocking=False):
            return False
        try:
            fd = os.dup(self._fd)  # the caller may close his in the meantime; effects belong to what both have open
        except OSError:
            self._busy.release()
            return False

        def work() -> None:
            try:
                self._effect = _upload(fd, self._effect, *wanted)
                self._ready = wanted
                if play:
                    _play(fd, self._effect)
            except OSError:  # the pad is gone, or has no room for an effect: then it does not rumble
                self._ready = None
            finally:
                os.close(fd)
                self._busy.release()

        threading.Thread(target=work, name="hal pad rumble", daemon=True).start()
        return True

    def wait(self, timeout: float) -> bool:
        """Until an effect is ready to be played, at most ``timeout`` s; for tests."""
        end = time.monotonic() + timeout
        while self._busy.locked() and time.monotonic() < end:
            time.sleep(0.005)
        return self._ready is not None

    def close(self) -> None:
        """No more. The kernel stops the motors when the device is closed. Idempotent."""
        self._closed = True


def _upload(fd: int, effect: int, strong: float, weak: float, seconds: float) -> int:
    """Make the effect, or change it; its number comes back. ``fcntl.ioctl`` lets other threads run meanwhile."""
    data = bytearray(_SIZE)
    struct.pack_into(f"@{_HEAD}", data, 0, FF_RUMBLE, effect, 0, 0, 0, max(1, round(seconds * 1000)), 0)
    struct.pack_into("@HH", data, _AT, round(strong * _FULL), round(weak * _FULL))
    fcntl.ioctl(fd, _EVIOCSFF, data)
    number: int = struct.unpack_from("@h", data, 2)[0]
    return number


def _play(fd: int, effect: int) -> None:
    os.write(fd, _EVENT.pack(0, 0, EV_FF, effect, 1))
