"""A HID device that a program plays, through /dev/uhid: the kernel's own HID drivers bind to it.

Layout of the messages: the kernel's ``include/uapi/linux/uhid.h``.
"""

from __future__ import annotations

import errno
import os
import struct
import time
from typing import NamedTuple

from gesture import Output

BUS_USB, BUS_BLUETOOTH = 0x03, 0x05

_DESTROY, _OPEN, _CLOSE, _OUTPUT, _GET_REPORT, _GET_REPORT_REPLY = 1, 4, 5, 6, 9, 10
_CREATE2, _INPUT2, _SET_REPORT, _SET_REPORT_REPLY = 11, 12, 13, 14
_CREATE_REQUEST = struct.Struct("<I128s64s64sHHIIII4096s")
_EVENT_SIZE = 4380


class HidIdentity(NamedTuple):
    """What a HID device says of itself when it is plugged in."""

    name: str
    bus: int
    vendor: int
    product: int
    descriptor: bytes
    """Its report descriptor."""
    uniq: str = ""
    features: dict[int, bytes] = {}  # noqa: RUF012  (never changed)
    """Feature reports that it answers, by number; each begins with its number."""


class HidDevice:
    """One device, plugged in from its creation to :meth:`unplug`."""

    def __init__(self, identity: HidIdentity) -> None:
        self.outputs: list[Output] = []
        self._features = identity.features
        self._fd = os.open("/dev/uhid", os.O_RDWR)
        descriptor = identity.descriptor
        texts = (identity.name.encode(), b"", identity.uniq.encode())
        numbers = (len(descriptor), identity.bus, identity.vendor, identity.product, 0x100, 0)
        self.t_plugged = time.monotonic()
        os.write(self._fd, _CREATE_REQUEST.pack(_CREATE2, *texts, *numbers, descriptor))
        self.listening = False
        """Does the kernel want input? A real device is silent where nobody listens."""

    def fileno(self) -> int:
        """Readable when the kernel wants something."""
        return self._fd

    def serve(self) -> None:
        """Do what the kernel asks for; to be called when there is something to read."""
        event = os.read(self._fd, _EVENT_SIZE)
        (kind,) = struct.unpack_from("<I", event)
        if kind in (_OPEN, _CLOSE):
            self.listening = kind == _OPEN
        elif kind == _OUTPUT:
            (size,) = struct.unpack_from("<H", event, 4 + 4096)
            self.outputs.append(Output(time.monotonic(), event[4 : 4 + size]))
        elif kind == _GET_REPORT:
            request, number = struct.unpack_from("<IB", event, 4)
            data = self._features.get(number, b"")
            status = 0 if data else errno.EIO
            os.write(self._fd, struct.pack("<IIHH4096s", _GET_REPORT_REPLY, request, status, len(data), data))
        elif kind == _SET_REPORT:
            (request,) = struct.unpack_from("<I", event, 4)
            os.write(self._fd, struct.pack("<IIH", _SET_REPORT_REPLY, request, 0))

    def send(self, report: bytes) -> None:
        """An input report."""
        os.write(self._fd, struct.pack("<IH4096s", _INPUT2, len(report), report))

    def unplug(self) -> float:
        """Pull the cable; returns when, s on the monotonic clock."""
        t = time.monotonic()
        os.write(self._fd, struct.pack("<I", _DESTROY))
        os.close(self._fd)
        return t
