"""A USB device that a program plays, through USB/IP's virtual host controller: the kernel's own USB drivers bind to it.

Layout of the messages: the kernel's ``Documentation/usb/usbip_protocol.rst``; of descriptors: USB 2.0, chapter 9.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

from gesture import Output

_CONTROLLER = Path("/sys/devices/platform/vhci_hcd.0")
_PORTS, _FULL_SPEED = 8, 2

_SUBMIT, _UNLINK, _SUBMITTED, _UNLINKED = 1, 2, 3, 4
_HEADER = struct.Struct(">IIIII")  # command, number, device, direction, endpoint
_SUBMIT_REST = struct.Struct(">IiiIi8s")  # flags, length, start frame, packets, interval, setup
_STALL, _CANCELLED = -32, -104

_IN, _OUT = 0x81, 0x01
_GET_STATUS, _GET_DESCRIPTOR = 0, 6
_DEVICE, _CONFIGURATION, _STRING = 1, 2, 3


class UsbIdentity(NamedTuple):
    """What a USB device with one interface, and one interrupt endpoint each way, says of itself."""

    vendor: int
    product: int
    version: int
    interface: tuple[int, int, int]
    """Class, subclass and protocol."""
    packet: int
    """Most bytes at a time."""
    strings: tuple[str, ...] = ("Maker", "Pad")

    def descriptor(self, kind: int, index: int) -> bytes | None:
        """The descriptor of that kind, if there is one."""
        if kind == _DEVICE:
            ids = (self.vendor, self.product, self.version)
            return struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, 0x200, 0xFF, 0xFF, 0xFF, 64, *ids, 1, 2, 0, 1)
        if kind == _CONFIGURATION:
            body = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 2, *self.interface, 0)
            for endpoint in (_IN, _OUT):
                body += struct.pack("<BBBBHB", 7, 5, endpoint, 3, self.packet, 4)
            return struct.pack("<BBHBBBBB", 9, _CONFIGURATION, 9 + len(body), 1, 1, 0, 0xA0, 250) + body
        if kind == _STRING and index <= len(self.strings):
            text = self.strings[index - 1].encode("utf-16-le") if index else b"\x09\x04"  # index 0: it speaks English
            return bytes((2 + len(text), _STRING)) + text
        return None


class UsbDevice:
    """One device, plugged in from its creation to :meth:`unplug`."""

    listening = True

    def __init__(self, identity: UsbIdentity, number: int) -> None:
        """``number`` counts devices: a port is not free at once after its device was unplugged."""
        self.outputs: list[Output] = []
        self._identity = identity
        self._asked: deque[int] = deque()
        self._waiting: deque[bytes] = deque()
        self._port = number % _PORTS
        self._socket, kernels = socket.socketpair()
        self.t_plugged = time.monotonic()
        with kernels:  # the kernel keeps its end
            self._tell("attach", f"{self._port} {kernels.fileno()} {1 << 16 | number} {_FULL_SPEED}")

    @staticmethod
    def _tell(file: str, text: str) -> None:
        (_CONTROLLER / file).write_text(text)

    def fileno(self) -> int:
        """Readable when the kernel wants something."""
        return self._socket.fileno()

    def serve(self) -> None:
        """Do what the kernel asks for; to be called when there is something to read. EOFError once it is unplugged."""
        command, number, _, direction, endpoint = _HEADER.unpack(self._receive(_HEADER.size))
        rest = self._receive(_SUBMIT_REST.size)
        if command == _UNLINK:
            (other,) = struct.unpack_from(">I", rest)
            status = _CANCELLED if other in self._asked else 0
            self._asked = deque(asked for asked in self._asked if asked != other)
            self._socket.sendall(_HEADER.pack(_UNLINKED, number, 0, 0, 0) + struct.pack(">i24x", status))
            return
        length, setup = _SUBMIT_REST.unpack(rest)[1::4]
        data = self._receive(length) if direction == 0 else b""
        if endpoint == 0:
            answer = self._control(setup)
            if answer is None:
                self._answer(number, _STALL)
            else:
                self._answer(number, 0, answer)
        elif direction == 0:
            self.outputs.append(Output(time.monotonic(), data))
            self._answer(number, 0, length=length)
        else:
            self._asked.append(number)
            self._deliver()

    def _control(self, setup: bytes) -> bytes | None:
        """Answer a request to endpoint 0; None where the device knows no answer."""
        kind, request, value, _, length = struct.unpack("<BBHHH", setup)
        if kind == 0x80 and request == _GET_DESCRIPTOR:
            found = self._identity.descriptor(value >> 8, value & 0xFF)
            return None if found is None else found[:length]
        if kind == 0x80 and request == _GET_STATUS:
            return bytes(2)
        return b"" if kind & 0x80 == 0 else None

    def send(self, report: bytes) -> None:
        """An input report, as soon as the kernel asks for one."""
        self._waiting.append(report)
        self._deliver()

    def _deliver(self) -> None:
        while self._asked and self._waiting:
            self._answer(self._asked.popleft(), 0, self._waiting.popleft())

    def _answer(self, number: int, status: int, data: bytes = b"", length: int | None = None) -> None:
        result = struct.pack(">iiiii8x", status, len(data) if length is None else length, 0, 0, 0)
        self._socket.sendall(_HEADER.pack(_SUBMITTED, number, 0, 0, 0) + result + data)

    def _receive(self, size: int) -> bytes:
        data = self._socket.recv(size, socket.MSG_WAITALL) if size else b""
        if len(data) < size:
            raise EOFError("unplugged")
        return data

    def unplug(self) -> float:
        """Pull the cable; returns when, s on the monotonic clock."""
        t = time.monotonic()
        self._tell("detach", str(self._port))
        self._socket.close()
        return t
