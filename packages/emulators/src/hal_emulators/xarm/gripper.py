"""Emulated xArm Gripper: Modbus RTU at the arm's flange, to which the control box passes frames without their check.

Registers: xarm-python-sdk 1.18.4 (``XCONF.ServoConf``, uxbus_cmd.py). Chosen here: its speed, and that it stops where
an object is.
"""

from __future__ import annotations

import math
import struct

__all__ = ["Gripper"]

_ADDRESS = 8
_STATUS, _ERROR, _ENABLE, _MODE, _CLEAR, _SPEED = 0x0000, 0x000F, 0x0100, 0x0101, 0x0109, 0x0303
_TARGET, _POSITION, _VERSION = 0x0700, 0x0702, 0x0801
_OPEN, _LEAST = 850, -10
_RATE = 1000.0
"""Counts in a second at 5000 r/min."""


class Gripper:
    """The gripper, and at most one object between its fingers."""

    def __init__(self) -> None:
        self.connected, self.enabled, self.blocked = True, False, False
        self.error, self.speed = 0, 1500
        self.position = float(_OPEN)
        self.target = _OPEN
        self.object_width: float | None = None
        """m; None for no object."""
        self._moving = False

    @property
    def width(self) -> float:
        return width_at(self.position)

    @property
    def holds(self) -> bool:
        return self.object_width is not None and self.target < self.position and self.width <= self.object_width

    def step(self, dt: float) -> None:
        goal = min(max(self.target, 0), _OPEN)
        step = _RATE * self.speed / 5000 * dt
        before = self.position
        if self.enabled and not self.error and not self.blocked:
            way = max(-step, min(step, goal - self.position))
            if not (self.holds and way < 0.0):
                self.position += way
        self._moving = self.position != before
        if self.blocked and self.enabled and not self.error and abs(goal - self.position) > 1.0:
            self.fail(23)

    def fail(self, error: int) -> None:
        self.error, self.enabled = error, False

    def answer(self, frame: bytes) -> bytes | None:
        """Return the answer to a frame; None if there is none."""
        if not self.connected or len(frame) < 6 or frame[0] != _ADDRESS:
            return None
        function, address, count = struct.unpack_from(">xBHH", frame)
        if function == 0x10:
            values = frame[7 : 7 + 2 * count]
            self._write(address, int.from_bytes(values, "big", signed=True))
            return frame[:6]
        values = b"".join(self._read(address + k) for k in range(count))
        return frame[:2] + bytes([len(values)]) + values

    def _write(self, address: int, value: int) -> None:
        if address == _ENABLE:
            self.enabled = bool(value) and not self.error
        elif address == _CLEAR:
            self.error = 0
        elif address == _SPEED:
            self.speed = value
        elif address == _TARGET:
            if not _LEAST <= value <= _OPEN:
                self.fail(25)
            else:
                self.target = value

    def _read(self, address: int) -> bytes:
        position = struct.pack(">i", round(self.position))
        known = {
            _STATUS: 2 if self.holds else int(self._moving),
            _ERROR: self.error,
            _POSITION: int.from_bytes(position[:2], "big"),
            _POSITION + 1: int.from_bytes(position[2:], "big"),
            _VERSION: 3,
            _VERSION + 1: 4,
            _VERSION + 2: 3,
        }
        return struct.pack(">H", known.get(address, 0))


def width_at(position: float) -> float:
    """Return the distance between the fingers, m, from the lengths of their linkage in UFACTORY's URDF."""
    angle = 0.85 - position / 1000.0
    return 2.0 * (0.035 + 0.035465 * math.cos(angle) - 0.042039 * math.sin(angle) - 0.0260032)
