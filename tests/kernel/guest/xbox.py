"""Microsoft's pads by cable, as the kernel's xpad wants them.

Layout of the reports: what the kernel's ``drivers/input/joystick/xpad.c`` reads and writes.
"""

from __future__ import annotations

import struct

from gesture import Gesture, Make, Motors
from usbip import UsbDevice, UsbIdentity


class Xbox360(Make):
    """The pad of the Xbox 360."""

    def plug(self, number: int) -> UsbDevice:
        return UsbDevice(UsbIdentity(0x045E, 0x028E, 0x0114, (0xFF, 0x5D, 0x01), packet=32), number)

    def reports(self, gesture: Gesture, count: int) -> list[bytes]:
        first = _dpad(gesture) | gesture.bits("start", "select", "l3", "r3") << 4
        second = gesture.bits("l1", "r1", "home") | gesture.bits("south", "east", "west", "north") << 4
        triggers = (round(255 * gesture.axis(name)) for name in ("l2", "r2"))
        return [struct.pack("<BBBBBB4h6x", 0x00, 20, first, second, *triggers, *_sticks(gesture))]

    def motors(self, output: bytes) -> Motors | None:
        return Motors(strong=output[3], weak=output[4]) if output[:2] == b"\x00\x08" else None


class XboxOne(Make):
    """The pad of the Xbox One S. Its middle button has a report of its own."""

    def plug(self, number: int) -> UsbDevice:
        return UsbDevice(UsbIdentity(0x045E, 0x02EA, 0x0408, (0xFF, 0x47, 0xD0), packet=64), number)

    def reports(self, gesture: Gesture, count: int) -> list[bytes]:
        first = gesture.bits("start", "select") << 2 | gesture.bits("south", "east", "west", "north") << 4
        second = _dpad(gesture) | gesture.bits("l1", "r1", "l3", "r3") << 4
        triggers = (round(1023 * gesture.axis(name)) for name in ("l2", "r2"))
        number = count % 256
        state = struct.pack("<BBBBBBHH4h", 0x20, 0, number, 14, first, second, *triggers, *_sticks(gesture))
        return [state, struct.pack("<BBBBBB", 0x07, 0x20, number, 2, gesture.bits("home"), 0x5B)]

    def motors(self, output: bytes) -> Motors | None:
        return Motors(strong=output[8], weak=output[9]) if output[:2] == b"\x09\x00" else None


def _sticks(gesture: Gesture) -> list[int]:
    """Up is positive. No stick rests just in the middle."""
    values = (gesture.axis(name) for name in ("left_x", "left_y", "right_x", "right_y"))
    return [round(-0.5 + 32767.5 * value) if value else 500 for value in values]


def _dpad(gesture: Gesture) -> int:
    x, y = gesture.axis("dpad_x"), gesture.axis("dpad_y")
    return (y > 0.0) | (y < 0.0) << 1 | (x < 0.0) << 2 | (x > 0.0) << 3
