"""The motors of a gamepad, through the kernel's force-feedback effects."""

from __future__ import annotations

import fcntl
import os
import struct
import threading

from hal.gamepad import RUMBLE_SECONDS
from hal.pads.codes import EV_FF, FF_RUMBLE

# From the kernel's include/uapi/linux/input.h. The effect is a union whose largest member holds a pointer, so its size
# and where it begins depend on the machine.
_HEAD = "HhH HH HH"  # type, id, direction; trigger: button, interval; replay: length in ms, delay
_UNION = "HHhhH HHHH I P"  # ff_periodic_effect, the largest
_AT = struct.calcsize(f"@{_HEAD} 0P")
_SIZE = _AT + struct.calcsize(f"@{_UNION}")
_EVIOCSFF = 1 << 30 | _SIZE << 16 | ord("E") << 8 | 0x80  # _IOW('E', 0x80, struct ff_effect)
_EVENT = struct.Struct("@llHHi")
_FULL = 0xFFFF
_LONGEST = 10.0
"""Longest rumble, s."""


class Rumble:
    """The motors of one open, writable device.

    An effect must be uploaded to the kernel before it is played. That may take long: where another program makes the
    pad, as long as that program takes to answer. So the default effect is uploaded once, in a thread of its own, when
    the pad is plugged in; playing it is one write. Only a rumble of another strength or length than the last one is
    uploaded again. (An effect with a repeat count would pause in between: the kernel stops the motors after each.)
    """

    def __init__(self, fd: int, strong: float, weak: float) -> None:
        """Upload the first effect, :data:`RUMBLE_SECONDS` long, in the background; strengths are 0..1."""
        self._fd = fd
        self._effect = -1
        self._ready: tuple[float, float, float] | None = None
        self._busy = threading.Lock()
        self._closed = False
        self._upload((strong, weak, RUMBLE_SECONDS), play=False)

    def play(self, strong: float, weak: float, seconds: float) -> bool:
        """Turn the motors, each at a share (0..1) of its strength; False where an upload is still under way.

        Raises OSError when the device is gone.
        """
        wanted = (strong, weak, min(seconds, _LONGEST))
        if self._closed or self._busy.locked():
            return False
        if self._ready == wanted:
            _play_effect(self._fd, self._effect)
            return True
        return self._upload(wanted, play=True)

    def _upload(self, wanted: tuple[float, float, float], *, play: bool) -> bool:
        """Upload an effect in the background, and play it once."""
        if not self._busy.acquire(blocking=False):
            return False
        try:
            fd = os.dup(self._fd)  # the caller may close its own meanwhile; effects belong to what both have open
        except OSError:
            self._busy.release()
            return False

        def work() -> None:
            try:
                self._effect = _upload_effect(fd, self._effect, *wanted)
                self._ready = wanted
                if play:
                    _play_effect(fd, self._effect)
            except OSError:  # the pad is gone, or has no room for an effect: it does not rumble
                self._ready = None
            finally:
                os.close(fd)
                self._busy.release()

        threading.Thread(target=work, name="hal pad rumble", daemon=True).start()
        return True

    def close(self) -> None:
        """Play nothing more. The kernel stops the motors when the device is closed. Idempotent."""
        self._closed = True


def _upload_effect(fd: int, effect: int, strong: float, weak: float, seconds: float) -> int:
    """Make or change an effect; return its number. Other threads run meanwhile: ``fcntl.ioctl`` releases the GIL."""
    data = bytearray(_SIZE)
    struct.pack_into(f"@{_HEAD}", data, 0, FF_RUMBLE, effect, 0, 0, 0, max(1, round(seconds * 1000)), 0)
    struct.pack_into("@HH", data, _AT, round(strong * _FULL), round(weak * _FULL))
    fcntl.ioctl(fd, _EVIOCSFF, data)
    number: int = struct.unpack_from("@h", data, 2)[0]
    return number


def _play_effect(fd: int, effect: int) -> None:
    os.write(fd, _EVENT.pack(0, 0, EV_FF, effect, 1))
