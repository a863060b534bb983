"""A cap that moves in six ways, and a pad that no model knows."""

from __future__ import annotations

import struct
import time
from typing import Any

import evdev
import hid
from evdev import ecodes
from gesture import Gesture, Make, Output
from uhid import BUS_USB, HidDevice, HidIdentity

_REACH = 350


class SpaceMouse(Make):
    """3Dconnexion's SpaceMouse Compact, whose descriptor says "relative" or "absolute", depending on its firmware.

    It repeats itself while it is pushed, and falls silent in the middle. Its own axes point to the right, towards the
    user and down.
    """

    def __init__(self, relative: bool) -> None:
        self._kind = hid.RELATIVE if relative else hid.ABSOLUTE

    def plug(self, number: int) -> HidDevice:
        parts = [
            hid.report(1, hid.data(hid.DESKTOP, (0x30, 0x31, 0x32), -_REACH, _REACH, 16, self._kind)),
            hid.report(2, hid.data(hid.DESKTOP, (0x33, 0x34, 0x35), -_REACH, _REACH, 16, self._kind)),
            hid.report(3, hid.data(hid.BUTTONS, (1, 2), 0, 1, 1), hid.vendor(hid.INPUT, 14, 1)),
        ]
        descriptor = hid.collection(0x08, *parts)
        return HidDevice(HidIdentity("3Dconnexion SpaceMouse Compact", BUS_USB, 0x256F, 0xC635, descriptor))

    def reports(self, gesture: Gesture, count: int) -> list[bytes]:
        push, turn = (
            [round(-_REACH * gesture.axis(f"{what}_{axis}")) for axis in ("y", "x", "z")] for what in ("push", "turn")
        )
        buttons = struct.pack("<BBB", 3, gesture.bits("l1", "r1"), 0)
        return [struct.pack("<B3h", 1, *push), struct.pack("<B3h", 2, *turn), buttons]

    def period(self, gesture: Gesture) -> float | None:
        return 0.016 if any(gesture.axes.values()) else None


class _InputDevice:
    """A device that has no hardware at all: through the kernel's uinput."""

    listening = True

    def __init__(self, name: str, capabilities: dict[int, Any], vendor: int, product: int) -> None:
        self.outputs: list[Output] = []
        self.t_plugged = time.monotonic()
        self._device = evdev.UInput(capabilities, name, vendor, product, bustype=BUS_USB)

    def fileno(self) -> int:
        return int(self._device.fd)

    def serve(self) -> None:
        """It has no motors, so the kernel wants nothing."""

    def send(self, report: list[tuple[int, int, int]]) -> None:
        """Events, as one report."""
        for event in report:
            self._device.write(*event)
        self._device.syn()

    def unplug(self) -> float:
        t = time.monotonic()
        self._device.close()
        return t


class UnknownPad(Make):
    """Laid out like an 8BitDo: the right stick is Z and RZ, and the triggers are GAS and BRAKE."""

    _AXES = {"left_x": "X", "-left_y": "Y", "right_x": "Z", "-right_y": "RZ", "r2": "GAS", "l2": "BRAKE"}  # noqa: RUF012
    _BUTTONS = ("south", "east", "north", "west", "select", "start")

    def plug(self, number: int) -> _InputDevice:
        sticks = evdev.AbsInfo(value=128, min=0, max=255, fuzz=0, flat=0, resolution=0)
        triggers = sticks._replace(value=0)
        axes = [(self._code(name), triggers if name in ("l2", "r2") else sticks) for name in self._AXES]
        keys = [ecodes.ecodes[f"BTN_{name.upper()}"] for name in self._BUTTONS]
        capabilities: dict[int, Any] = {ecodes.EV_KEY: keys, ecodes.EV_ABS: axes}
        return _InputDevice("Nobody's Pad", capabilities, 0x1234, 0x5678)

    def _code(self, name: str) -> int:
        return int(ecodes.ecodes[f"ABS_{self._AXES[name]}"])

    def reports(self, gesture: Gesture, count: int) -> list[list[tuple[int, int, int]]]:
        events = []
        for name in self._AXES:
            value = gesture.axis(name.removeprefix("-")) * (-1.0 if name[0] == "-" else 1.0)
            stick = round(127.5 + 127.5 * value) if value else 126
            raw = round(255 * value) if name in ("l2", "r2") else stick
            events.append((ecodes.EV_ABS, self._code(name), raw))
        for name in self._BUTTONS:
            events.append((ecodes.EV_KEY, ecodes.ecodes[f"BTN_{name.upper()}"], int(name in gesture.buttons)))
        return [events]
