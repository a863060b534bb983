"""Sony's pads, by cable and over Bluetooth, as their drivers in the kernel want them.

Layout of the reports: what the kernel's ``drivers/hid/hid-sony.c`` (6.1) and ``hid-playstation.c`` read and write.
"""

from __future__ import annotations

import struct
import zlib

import hid
from gesture import Gesture, Make, Motors
from uhid import BUS_BLUETOOTH, BUS_USB, HidDevice, HidIdentity

_VENDOR = 0x054C
_ADDRESS = bytes.fromhex("0123456789ab")
_HAT = {(0, 1): 0, (1, 1): 1, (1, 0): 2, (1, -1): 3, (0, -1): 4, (-1, -1): 5, (-1, 0): 6, (-1, 1): 7}
_FINGERS = bytes((0x80, 0, 0, 0)) * 2  # none on the touchpad
_INPUT, _FEATURE = 0xA1, 0xA3  # what a checksum begins with

_TURN = 8192  # what the gyroscope shows at the speed of the calibration,
_SPEED = 540  # in deg/s
_GRAVITY = 8192  # what the accelerometer shows of 1 g


class _Sony(Make):
    """They speak all the time: a motion sensor is never quite still."""

    name: str
    product: int

    def __init__(self, bluetooth: bool = False) -> None:
        self.bluetooth = bluetooth

    def period(self, gesture: Gesture) -> float:
        return 0.01  # 0.004 in truth

    def _plug(self, descriptor: bytes, features: list[bytes]) -> HidDevice:
        bus = BUS_BLUETOOTH if self.bluetooth else BUS_USB
        uniq = _ADDRESS.hex(":") if self.bluetooth else ""  # by cable the driver asks for it
        answers = {report[0]: report for report in features}
        return HidDevice(HidIdentity(self.name, bus, _VENDOR, self.product, descriptor, uniq, answers))

    def _checked(self, kind: int, report: bytes) -> bytes:
        """Over Bluetooth a checksum stands in the last four bytes."""
        if not self.bluetooth:
            return report
        return report[:-4] + struct.pack("<I", zlib.crc32(bytes((kind,)) + report[:-4]))


class DualShock4(_Sony):
    """The pad of the PlayStation 4."""

    name, product = "Wireless Controller", 0x09CC

    def plug(self, number: int) -> HidDevice:
        sticks = hid.data(hid.DESKTOP, (0x30, 0x31, 0x32, 0x35), 0, 255, 8)
        hat = hid.data(hid.DESKTOP, (0x39,), 0, 7, 4, hid.NULL_STATE)
        buttons = hid.data(hid.BUTTONS, tuple(range(1, 15)), 0, 1, 1)
        triggers = hid.data(hid.DESKTOP, (0x33, 0x34), 0, 255, 8)
        counter, rest = hid.vendor(hid.INPUT, 1, 6), hid.vendor(hid.INPUT, 54)
        controls = sticks + hat + buttons + counter + triggers
        by_cable = hid.report(1, controls, rest) + hid.report(5, hid.vendor(hid.OUTPUT, 31))
        by_radio = hid.report(1, controls) + hid.report(0x11, hid.vendor(hid.INPUT, 77), hid.vendor(hid.OUTPUT, 77))
        descriptor = hid.collection(0x05, by_radio if self.bluetooth else by_cable)
        address = (1, _ADDRESS[::-1])
        versions = _padded(0xA3, 49, (35, struct.pack("<H", 0x0100)), (41, struct.pack("<H", 0x0100)))
        addresses = [_padded(0x12, 16, address), _padded(0x81, 7, address)]  # two drivers ask in two ways
        return self._plug(descriptor, [self._calibration(), *addresses, versions])

    def _calibration(self) -> bytes:
        if self.bluetooth:
            turns = (_TURN, _TURN, _TURN, -_TURN, -_TURN, -_TURN)
            return self._checked(_FEATURE, _padded(0x05, 41, (7, _calibration(turns))))
        return _padded(0x02, 37, (7, _calibration((_TURN, -_TURN) * 3)))

    def reports(self, gesture: Gesture, count: int) -> list[bytes]:
        home = gesture.bits("home", "touchpad") | count % 64 << 2
        state = _sticks(gesture) + _buttons(gesture) + bytes((home,)) + _triggers(gesture)
        motion = struct.pack("<HB", count * 1875 % 65536, 0) + _motion(count)  # a unit is 5.33 us
        common = state + motion + bytes(5) + bytes((0x1B, 0, 0))  # cable, full
        touches = bytes((1, 0)) + _FINGERS
        if self.bluetooth:
            return [self._checked(_INPUT, (b"\x11\xc0\x00" + common + touches).ljust(78, b"\0"))]
        return [(b"\x01" + common + touches).ljust(64, b"\0")]

    def motors(self, output: bytes) -> Motors | None:
        at = {0x05: 1, 0x11: 3}.get(output[0])
        if at is None or not output[at] & 0x01:
            return None
        return Motors(strong=output[at + 4], weak=output[at + 3])


class DualSense(_Sony):
    """The pad of the PlayStation 5. Its driver reads the bytes itself, so its descriptor names their number only."""

    name, product = "DualSense Wireless Controller", 0x0CE6

    def plug(self, number: int) -> HidDevice:
        by_cable = hid.report(1, hid.vendor(hid.INPUT, 63)) + hid.report(2, hid.vendor(hid.OUTPUT, 62))
        by_radio = hid.report(0x31, hid.vendor(hid.INPUT, 77), hid.vendor(hid.OUTPUT, 77))
        descriptor = hid.collection(0x05, by_radio if self.bluetooth else by_cable)
        turns = (_TURN, -_TURN) * 3
        versions = ((24, struct.pack("<II", 0x0100, 0x0100)), (44, struct.pack("<H", 0x0224)))
        features = [
            _padded(0x05, 41, (7, _calibration(turns))),
            _padded(0x09, 20, (1, _ADDRESS[::-1])),
            _padded(0x20, 64, *versions),
        ]
        return self._plug(descriptor, [self._checked(_FEATURE, feature) for feature in features])

    def reports(self, gesture: Gesture, count: int) -> list[bytes]:
        state = _sticks(gesture) + _triggers(gesture) + bytes((count % 256,)) + _buttons(gesture)
        state += bytes((gesture.bits("home", "touchpad"), 0)) + bytes(4)
        motion = _motion(count) + struct.pack("<IB", count * 30000 % (1 << 32), 0)  # a unit is 1/3 us
        common = state + motion + _FINGERS + bytes(12) + bytes((0x2A,)) + bytes(10)  # full
        if self.bluetooth:
            return [self._checked(_INPUT, (b"\x31\x01" + common).ljust(78, b"\0"))]
        return [b"\x01" + common]

    def motors(self, output: bytes) -> Motors | None:
        at = {0x02: 1, 0x31: 3}.get(output[0])
        if at is None or not output[at] & 0x02:
            return None
        return Motors(strong=output[at + 3], weak=output[at + 2])


def _padded(number: int, size: int, *parts: tuple[int, bytes]) -> bytes:
    """A feature report of 0, but for its number and some (offset, contents)."""
    report = bytearray(size)
    report[0] = number
    for offset, contents in parts:
        report[offset : offset + len(contents)] = contents
    return bytes(report)


def _calibration(turns: tuple[int, ...]) -> bytes:
    return struct.pack("<14h", *turns, _SPEED, _SPEED, *(_GRAVITY, -_GRAVITY) * 3)


def _sticks(gesture: Gesture) -> bytes:
    """0 is left and up. No stick rests just in the middle."""
    values = (gesture.axis("left_x"), -gesture.axis("left_y"), gesture.axis("right_x"), -gesture.axis("right_y"))
    return bytes(round(127.5 + 127.5 * value) if value else 126 for value in values)


def _triggers(gesture: Gesture) -> bytes:
    return bytes(round(255 * gesture.axis(name)) for name in ("l2", "r2"))


def _buttons(gesture: Gesture) -> bytes:
    """Two bytes, the d-pad in the lowest bits. A trigger that is pulled is a pressed button, too."""
    pulled = frozenset(name for name in ("l2", "r2") if gesture.axis(name) > 0.0)
    gesture = gesture._replace(buttons=gesture.buttons | pulled)
    hat = _HAT.get((round(gesture.axis("dpad_x")), round(gesture.axis("dpad_y"))), 8)
    face = gesture.bits("west", "south", "east", "north")
    return bytes((hat | face << 4, gesture.bits("l1", "r1", "l2", "r2", "select", "start", "l3", "r3")))


def _motion(count: int) -> bytes:
    """Gyroscope and accelerometer of a pad that lies on a table and trembles."""
    return struct.pack("<6h", count % 64, 0, 0, 0, 0, _GRAVITY)
