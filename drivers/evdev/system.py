"""Which input devices there are, from sysfs: that needs no permission and opens nothing."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple, Protocol

from hal.pads.codes import ABS, KEY
from hal.pads.model import Identity

from .node import EvdevNode, Node

__all__ = ["InputSystem", "LinuxInput", "NodeInfo", "permission_note"]

_WORD = 8 * struct.calcsize("l")  # sysfs prints bitmaps as words of this many bits, the highest first


class NodeInfo(NamedTuple):
    """One input device, not opened."""

    path: str
    identity: Identity
    uniq: str
    """The same for all devices of one pad, where the pad has a serial number or an address."""
    parent: str
    """The hardware behind it, which is the same for all devices of one pad."""
    is_pad: bool
    """Has it the buttons and sticks of a gamepad? A pad's motion sensor and touchpad are devices of their own."""

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
        """All that are there now, in the order of their numbers."""

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
            is_pad = _bit(device / "capabilities" / "key", KEY["BTN_SOUTH"]) and _bit(
                device / "capabilities" / "abs", ABS["ABS_X"]
            )
            found.append(NodeInfo(str(self._devices / name), identity, _text(device / "uniq"), parent, is_pad))
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


def _bit(path: Path, number: int) -> bool:
    words = _text(path).split()
    place, bit = divmod(number, _WORD)
    return place < len(words) and bool(int(words[-1 - place], 16) >> bit & 1)


def _driver(parent: str) -> str:
    try:
        return os.path.basename(os.readlink(os.path.join(parent, "driver")))
    except OSError:
        return ""
