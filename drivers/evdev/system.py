"""Which input devices there are, from sysfs: that needs no permission and opens nothing."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple, Protocol

from hal.pads.codes import ABS, KEY, REL
from hal.pads.model import Identity

from .node import EvdevNode, Node

__all__ = ["InputSystem", "LinuxInput", "NodeInfo", "permission_note"]

_WORD = 8 * struct.calcsize("l")  # sysfs prints bitmaps as words of this many bits, the highest first
_SIX = ("X", "Y", "Z", "RX", "RY", "RZ")


class NodeInfo(NamedTuple):
    """One input device, not opened."""

    path: str
    identity: Identity
    uniq: str
    """The same for all devices of one pad, where the pad has a serial number or an address."""
    parent: str
    """The hardware behind it, which is the same for all devices of one pad."""
    is_pad: bool
    """Has it the buttons and sticks of a gamepad, or the six axes and buttons of a SpaceMouse? A pad's motion sensor
    and touchpad are devices of their own."""
    is_joystick: bool = False
    """Has it the buttons of a joystick? Some gamepads look like one (Logitech's in D mode), and so do steering wheels:
    it is a pad only where a model knows it, or the rig names it."""

    def belongs_to(self, other: NodeInfo) -> bool:
        """Are the two parts of the same pad?"""
        if self.uniq and other.uniq:
            return self.uniq == other.uniq
        return bool(self.parent) and self.parent == other.parent

    def describe(self) -> str:
        """For people."""
        bus = {"usb": "USB", "bluetooth": "Bluetooth"}.get(self.identity.bus_name, f"bus {self.identity.bus}")
        return f"{self.identity.name} ({bus}, {self.path})"


class InputSystem(Protocol):
    """Where input devices come from."""

    def nodes(self) -> list[NodeInfo]:
        """All that are there now, in the order of their numbers. Takes some ms on a computer with many."""

    def fingerprint(self) -> object:
        """Differs when a device came or went, or its permissions changed. Cheap."""

    def open(self, path: str) -> Node:
        """Open one. Raises OSError."""


class LinuxInput:
    """The :class:`InputSystem` of this machine."""

    def __init__(self, sysfs: Path = Path("/sys/class/input"), devices: Path = Path("/dev/input")) -> None:
        self._sysfs = sysfs
        self._devices = devices

    def nodes(self) -> list[NodeInfo]:
        found = []
        for name in sorted(self._event_names(self._sysfs), key=lambda name: int(name[5:])):
            device = self._sysfs / name / "device"
            parent = os.path.realpath(device / "device")
            identity = Identity(
                name=_text(device / "name"),
                vendor=_hex(device / "id" / "vendor"),
                product=_hex(device / "id" / "product"),
                bus=_hex(device / "id" / "bustype"),
                driver=_driver(parent),
            )
            is_pad, is_joystick = _kind(device / "capabilities")
            uniq = _text(device / "uniq")
            found.append(NodeInfo(str(self._devices / name), identity, uniq, parent, is_pad, is_joystick))
        return found

    def fingerprint(self) -> object:
        marks = []
        for name in sorted(self._event_names(self._devices)):
            try:
                status = os.stat(self._devices / name)
            except OSError:
                continue
            marks.append((name, status.st_ino, status.st_ctime_ns))
        return tuple(marks)

    def open(self, path: str) -> Node:
        return EvdevNode(path)

    @staticmethod
    def _event_names(folder: Path) -> list[str]:
        try:
            return [name for name in os.listdir(folder) if name.startswith("event") and name[5:].isdigit()]
        except OSError:
            return []  # no input devices at all, as in a container


def permission_note(info: NodeInfo) -> str:
    """What to tell a person whose pad may not be read."""
    return (
        f"{info.describe()} is plugged in but may not be read; run: sudo usermod -aG input $USER, then log out and in"
    )


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _hex(path: Path) -> int:
    try:
        return int(_text(path), 16)
    except ValueError:
        return 0


def _kind(capabilities: Path) -> tuple[bool, bool]:
    """Is it a pad, and does it look like a joystick? From what it can send."""
    key, rel, axes = (_bits(capabilities / name) for name in ("key", "rel", "abs"))

    def has(bits: int, *codes: int) -> bool:
        return all(bits >> code & 1 for code in codes)

    sticks = has(axes, ABS["ABS_X"])
    if has(key, KEY["BTN_SOUTH"]):
        return sticks, False
    six = has(rel, *(REL[f"REL_{name}"] for name in _SIX)) or has(axes, *(ABS[f"ABS_{name}"] for name in _SIX))
    return six and has(key, KEY["BTN_0"]), sticks and has(key, KEY["BTN_TRIGGER"])


def _bits(path: Path) -> int:
    """A bitmap of sysfs as one number."""
    whole = 0
    for word in _text(path).split():
        whole = whole << _WORD | int(word, 16)
    return whole


def _driver(parent: str) -> str:
    try:
        return os.path.basename(os.readlink(os.path.join(parent, "driver")))
    except OSError:
        return ""
