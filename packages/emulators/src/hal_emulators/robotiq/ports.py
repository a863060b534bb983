"""The other end of a gripper's line: a pseudo terminal with Modbus RTU, or the text port; with faults on the way."""

from __future__ import annotations

import math
import os
import re
import socket
import struct
from time import monotonic

from hal.drivers.robotiq.link import TEXT_PORT, Request, crc16
from hal_emulators.lines import Line
from hal_emulators.terminal import PseudoTerminal

from .gripper import EmulatedGripper

__all__ = ["Port", "SerialPort", "TextPort"]


class Port(Line):
    """What both kinds of line have in common."""

    def __init__(self, gripper: EmulatedGripper, seed: int = 0) -> None:
        super().__init__(seed)
        self.gripper = gripper
        self.t = self.asked = -math.inf
        """Time up to which its fingers have moved, and that of the newest request, s; for one in a simulated world."""
        self._came: dict[int, bytes] = {}

    def reset(self) -> None:
        super().reset()
        self.silent_until = 0.0

    def close(self) -> None:
        self._came = {}

    def execute(self, came: bytes) -> tuple[bytes, bytes]:
        """Return what is left of the bytes that have come, and the answer to the rest."""
        raise NotImplementedError

    def serve(self, descriptor: int) -> bool:
        """Take what has come; return whether there is still a client."""
        try:
            came = os.read(descriptor, 4096)
        except OSError:
            came = b""
        if not came:
            self._came.pop(descriptor, None)
            return False
        now = monotonic()
        if now < self.silent_until or not self.gripper.powered:
            return True
        before = self.gripper.request
        self._came[descriptor], answer = self.execute(self._came.get(descriptor, b"") + came)
        if self.gripper.request != before:
            self.asked = now
        if answer:
            self.answer(descriptor, answer)
        return True

    def send_due(self, now: float) -> None:
        """Let power come back as well."""
        if not self.gripper.powered and now >= self.gripper.on_at:
            self.gripper.powered = True
            self.gripper.switch_on()
        super().send_due(now)


class SerialPort(Port):
    def __init__(self, gripper: EmulatedGripper, seed: int = 0) -> None:
        super().__init__(gripper, seed)
        self._terminal = PseudoTerminal(str(gripper.settings.port))

    def open(self) -> None:
        self._terminal.open()

    def close(self) -> None:
        super().close()
        self._terminal.close()

    def descriptors(self) -> list[int]:
        return self._terminal.descriptors

    def serve(self, descriptor: int) -> bool:
        self._terminal.free()
        return super().serve(descriptor)

    def execute(self, came: bytes) -> tuple[bytes, bytes]:
        answers = b""
        while len(came) >= 8:
            size = 9 + came[6] if came[1] == 16 else 8
            if len(came) < size:
                break
            frame, came = came[:size], came[size:]
            if crc16(frame[:-2]) != frame[-2:]:
                return b"", answers  # the rest is no whole frame either
            if frame[0] == self.gripper.settings.slave:
                reply = frame[:1] + self._execute(frame[1], frame[2:-2])
                answers += reply + crc16(reply)
        return came, answers

    def _execute(self, function: int, data: bytes) -> bytes:
        """Return the answer to a function: without address and check."""
        start, count = struct.unpack_from(">HH", data)
        if function in (3, 4):
            act, gto, state, found, fault, echo, position = self.gripper.read()
            bits = act | gto << 3 | state << 4 | found << 6
            registers = bytes((bits, 0, fault, echo, position, round(self.gripper.force / 5.0)))
            first = 2 * (start - 0x07D0)
            values = registers[max(0, first) : first + 2 * count]
            if first >= 0 and len(values) == 2 * count:
                return bytes((function, len(values))) + values
        elif function == 16:
            values = data[5:]
            if start == 0x03E8 and len(values) == 6 and count == 3:
                self.gripper.take(Request(values[0] & 1, values[0] >> 3 & 1, *values[3:]))
                return bytes((function,)) + data[:4]
        else:
            return bytes((function | 0x80, 1))
        return bytes((function | 0x80, 2))


class TextPort(Port):
    _VARIABLES = ("ACT", "GTO", "STA", "OBJ", "FLT", "PRE", "POS")

    def __init__(self, gripper: EmulatedGripper, seed: int = 0) -> None:
        super().__init__(gripper, seed)
        self._door: socket.socket | None = None
        self._clients: dict[int, socket.socket] = {}

    def open(self) -> None:
        self._door = socket.create_server((str(self.gripper.settings.host), TEXT_PORT))

    def close(self) -> None:
        super().close()
        for one in (self._door, *self._clients.values()):
            if one is not None:
                one.close()
        self._door, self._clients = None, {}

    def descriptors(self) -> list[int]:
        return [] if self._door is None else [self._door.fileno(), *self._clients]

    def serve(self, descriptor: int) -> bool:
        assert self._door is not None
        if descriptor == self._door.fileno():
            client, _ = self._door.accept()
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client.fileno()] = client
        elif not super().serve(descriptor):
            self._clients.pop(descriptor).close()
        return True

    def execute(self, came: bytes) -> tuple[bytes, bytes]:
        *lines, left = came.split(b"\n")
        return left, b"".join(self._execute(line.decode(errors="replace").split()) for line in lines)

    def _execute(self, words: list[str]) -> bytes:
        if words[:1] == ["GET"] and words[1:2] and words[1] in self._VARIABLES:
            value = self.gripper.read()[self._VARIABLES.index(words[1])]
            return f"{words[1]} {value}".encode()
        pairs = dict(zip(words[1::2], words[2::2], strict=False))
        names = {"ACT": "act", "GTO": "gto", "POS": "pr", "SPE": "sp", "FOR": "fr"}
        if words[:1] != ["SET"] or not all(re.fullmatch(r"\d{1,3}", value) for value in pairs.values()):
            return b"?"
        request = {names[name]: min(255, int(value)) for name, value in pairs.items() if name in names}
        self.gripper.take(self.gripper.request._replace(**request))
        return b"ack"
