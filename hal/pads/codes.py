"""Names and numbers of the input events that gamepads send.

Source: the Linux kernel's ``include/uapi/linux/input-event-codes.h``. python-evdev has them, too, but pad models and
recordings use them on machines without evdev.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

EV_SYN, EV_KEY, EV_REL, EV_ABS, EV_MSC, EV_FF = 0x00, 0x01, 0x02, 0x03, 0x04, 0x15
SYN_REPORT, SYN_DROPPED = 0, 3
FF_RUMBLE = 0x50
BUS_USB, BUS_BLUETOOTH = 0x03, 0x05


def _abs() -> dict[str, int]:
    names = ("X", "Y", "Z", "RX", "RY", "RZ", "THROTTLE", "RUDDER", "WHEEL", "GAS", "BRAKE")
    codes = {f"ABS_{name}": code for code, name in enumerate(names)}
    for hat in range(4):
        codes[f"ABS_HAT{hat}X"] = 0x10 + 2 * hat
        codes[f"ABS_HAT{hat}Y"] = 0x11 + 2 * hat
    return codes


def _key() -> dict[str, int]:
    codes = {f"BTN_{number}": 0x100 + number for number in range(10)}
    joystick = ("TRIGGER", "THUMB", "THUMB2", "TOP", "TOP2", "PINKIE", "BASE", "BASE2", "BASE3", "BASE4", "BASE5")
    codes.update({f"BTN_{name}": 0x120 + place for place, name in enumerate((*joystick, "BASE6"))})
    gamepad = ("SOUTH", "EAST", "C", "NORTH", "WEST", "Z", "TL", "TR", "TL2", "TR2", "SELECT", "START", "MODE")
    codes.update({f"BTN_{name}": 0x130 + place for place, name in enumerate((*gamepad, "THUMBL", "THUMBR"))})
    codes.update({f"BTN_DPAD_{name}": 0x220 + place for place, name in enumerate(("UP", "DOWN", "LEFT", "RIGHT"))})
    codes.update({f"BTN_TRIGGER_HAPPY{number}": 0x2C0 + number - 1 for number in range(1, 41)})
    codes |= {"KEY_A": 30, "KEY_B": 48, "KEY_C": 46}  # of foot switches
    codes |= {"BTN_LEFT": 0x110, "KEY_MENU": 139, "KEY_BACK": 158, "KEY_RECORD": 167, "KEY_HOMEPAGE": 172}
    return codes


ABS: Mapping[str, int] = MappingProxyType(_abs())
"""Axes: name -> code."""
REL: Mapping[str, int] = MappingProxyType(
    {f"REL_{name}": code for code, name in enumerate(("X", "Y", "Z", "RX", "RY", "RZ"))}
)
"""Axes that report a displacement, and nothing when they are released: name -> code."""
KEY: Mapping[str, int] = MappingProxyType(_key())
"""Buttons: name -> code."""
ABS_NAME: Mapping[int, str] = MappingProxyType({code: name for name, code in ABS.items()})
KEY_NAME: Mapping[int, str] = MappingProxyType({code: name for name, code in KEY.items()})
