"""The input devices of this machine: what is plugged in, an opened device, and when to look again.

:class:`LinuxInput` lists devices from sysfs, which needs no permission and opens nothing. :class:`EvdevNode` is one
opened device on python-evdev. :class:`DeviceFinder` scans periodically.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hal.errors import DriverMissing
from hal.pads.codes import ABS, EV_ABS, EV_FF, EV_KEY, EV_REL, FF_RUMBLE, KEY, REL
from hal.pads.mapper import AxisRange
from hal.pads.model import Identity


class NodeInfo(NamedTuple):
    path: str
    identity: Identity
    uniq: str
    """Serial number or address of the pad, the same for all its devices; empty where it has none."""
    parent: str
    """The hardware behind the device, the same for all devices of one pad."""
    is_pad: bool
    """Whether it has the buttons and sticks of a gamepad, or the six axes and buttons of a SpaceMouse. A pad's motion
    sensor and touchpad are devices of their own."""
    is_joystick: bool = False
    """Whether it has the buttons of a joystick. Some gamepads have (Logitech's in D mode), and so have steering wheels:
    it is a pad only where a model matches it, or the rig names it."""
    is_keyboard: bool = False
    """Whether it has a keyboard's keys, as foot switches have: a pad only where the rig names its model."""

    def belongs_to(self, other: NodeInfo) -> bool:
        """Whether the two are parts of the same pad."""
        if self.uniq and other.uniq:
            return self.uniq == other.uniq
        return bool(self.parent) and self.parent == other.parent

    def describe(self) -> str:
        """Return the name, the bus and the path for the user."""
        bus = {"usb": "USB", "bluetooth": "Bluetooth"}.get(self.identity.bus_name, f"bus {self.identity.bus}")
        return f"{self.identity.name} ({bus}, {self.path})"


def permission_note(info: NodeInfo) -> str:
    """Return the note for a pad that may not be read, with the command that allows it."""
    return f"{info.describe()} may not be read; to allow it: sudo usermod -aG input $USER, then log out and in"


class Event(NamedTuple):
    kind: int
    code: int
    value: int
    t: float
    """When it happened, on the monotonic clock, s."""
    t_device: float
    """The kernel's stamp, s."""


# Devices through python-evdev and sysfs.

_EVIOCSCLOCKID = 0x400445A0  # _IOW('E', 0xa0, int), linux/input.h
_READS = 32  # most reads in one go; each brings up to 64 events
_WORD = 8 * struct.calcsize("l")  # sysfs prints bitmaps as words of this many bits, the highest first
_SIX_AXES = ("X", "Y", "Z", "RX", "RY", "RZ")


def evdev_module() -> Any:
    """Return python-evdev. Raises DriverMissing, with the command that installs it."""
    try:
        import evdev
    except ImportError as error:
        remedy = "install it with: pip install evdev-binary"
        raise DriverMissing(f"gamepads need python-evdev, which does not import ({error}); {remedy}") from error
    return evdev


class EvdevNode:
    """An opened input device, through python-evdev. Calls raise OSError when the device is gone.

    Attributes:
        axes: Event code -> range that the device reports.
        keys: Event codes of its buttons.
        rels: Event codes of its relative axes.
        can_rumble: Whether it has motors, and may be written to.
    """

    def __init__(self, path: str) -> None:
        """Open a device. Raises OSError if it is missing or may not be read, DriverMissing without python-evdev."""
        self.path = path
        self._device: Any = evdev_module().InputDevice(path)
        capabilities: dict[int, list[Any]] = self._device.capabilities()
        self.axes = {code: AxisRange(info.min, info.max, info.flat) for code, info in capabilities.get(EV_ABS, ())}
        self.keys = frozenset(capabilities.get(EV_KEY, ()))
        self.rels = frozenset(capabilities.get(EV_REL, ()))
        writable = fcntl.fcntl(self._device.fd, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDWR
        self.can_rumble = writable and FF_RUMBLE in capabilities.get(EV_FF, ())
        try:  # stamp events with the clock of everything else here
            fcntl.ioctl(self._device.fd, _EVIOCSCLOCKID, struct.pack("i", time.CLOCK_MONOTONIC))
            self._monotonic = True
        except OSError:
            self._monotonic = False

    def fileno(self) -> int:
        """Descriptor that is readable when there are events, and when the device is gone."""
        return int(self._device.fd)

    def read(self) -> Sequence[Event]:
        """Return every waiting event, oldest first; never blocks."""
        found: list[Any] = []
        for _ in range(_READS):
            try:
                batch = list(self._device.read())
            except BlockingIOError:
                break
            found += batch
        now = time.monotonic()
        return [
            Event(event.type, event.code, event.value, min(stamp, now) if self._monotonic else now, stamp)
            for event in found
            for stamp in (event.sec + event.usec * 1e-6,)
        ]

    def snapshot(self) -> tuple[dict[int, int], list[int]]:
        """Return the kernel's present state: axis code -> value, and the codes of the pressed buttons."""
        values = {code: int(self._device.absinfo(code).value) for code in self.axes}
        return values, [int(code) for code in self._device.active_keys()]

    def claim(self) -> bool:
        """Lock the device for one gamepad, across programs, until it is closed; False where it is locked already.

        Two gamepads on one device would be one thumb on two dead-man switches.
        """
        return lock_device(self._device.fd)

    def grab(self) -> None:
        """Keep the events of a keyboard from every other program, until it is closed."""
        self._device.grab()

    def close(self) -> None:
        self._device.close()


def lock_device(fd: int) -> bool:
    """Lock a device until ``fd`` is closed; False where another opening of it has the lock, in any program."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class LinuxInput:
    """The input devices of this machine."""

    def __init__(self, sysfs: Path = Path("/sys/class/input"), devices: Path = Path("/dev/input")) -> None:
        self._sysfs = sysfs
        self._devices = devices

    def nodes(self) -> list[NodeInfo]:
        """Return all present devices in the order of their numbers. Takes some ms on a computer with many."""
        found = []
        for name in sorted(self._event_names(self._sysfs), key=lambda name: int(name[5:])):
            device = self._sysfs / name / "device"
            parent = os.path.realpath(device / "device")
            identity = Identity(
                name=_text(device / "name"),
                vendor=_hex(device / "id" / "vendor"),
                product=_hex(device / "id" / "product"),
                bus=_hex(device / "id" / "bustype"),
                driver=_kernel_driver(parent),
            )
            kinds = _classify(device / "capabilities")
            uniq = _text(device / "uniq")
            found.append(NodeInfo(str(self._devices / name), identity, uniq, parent, *kinds))
        return found

    def fingerprint(self) -> object:
        """Return a value that differs after a device came or went, or its permissions changed. Cheap."""
        marks = []
        for name in sorted(self._event_names(self._devices)):
            try:
                status = os.stat(self._devices / name)
            except OSError:
                continue
            marks.append((name, status.st_ino, status.st_ctime_ns))
        return tuple(marks)

    def open(self, path: str) -> EvdevNode:
        """Open a device. Raises OSError."""
        return EvdevNode(path)

    @staticmethod
    def _event_names(folder: Path) -> list[str]:
        try:
            return [name for name in os.listdir(folder) if name.startswith("event") and name[5:].isdigit()]
        except OSError:
            return []  # no input devices at all, as in a container


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


def _classify(capabilities: Path) -> tuple[bool, bool, bool]:
    """Return whether a device is a pad, a joystick and a keyboard (:class:`NodeInfo`), from the events it can send."""
    key, rel, axes = (_bits(capabilities / name) for name in ("key", "rel", "abs"))

    def has(bits: int, *codes: int) -> bool:
        return all(bits >> code & 1 for code in codes)

    sticks = has(axes, ABS["ABS_X"])
    if has(key, KEY["BTN_SOUTH"]):
        return sticks, False, False
    six = has(rel, *(REL[f"REL_{n}"] for n in _SIX_AXES)) or has(axes, *(ABS[f"ABS_{n}"] for n in _SIX_AXES))
    is_pad, is_joystick = six and has(key, KEY["BTN_0"]), sticks and has(key, KEY["BTN_TRIGGER"])
    return is_pad, is_joystick, has(key, KEY["KEY_A"], KEY["KEY_B"], KEY["KEY_C"])


def _bits(path: Path) -> int:
    """Return a bitmap of sysfs as one number."""
    whole = 0
    for word in _text(path).split():
        whole = whole << _WORD | int(word, 16)
    return whole


def _kernel_driver(parent: str) -> str:
    try:
        return os.path.basename(os.readlink(os.path.join(parent, "driver")))
    except OSError:
        return ""


# When to look for devices.

_RESCAN = 0.2
"""Time between two scans, s."""


class DeviceFinder:
    """Lists the devices of a machine, no more often than needed."""

    def __init__(self, system: LinuxInput) -> None:
        self._system = system
        self._seen: object = None
        self._next = 0.0

    def scan(self) -> list[NodeInfo] | None:
        """Return the devices that are plugged in; None where nothing changed since the last scan."""
        self._next = time.monotonic() + _RESCAN
        mark = self._system.fingerprint()
        if mark == self._seen:
            return None
        self._seen = mark
        return self._system.nodes()

    def forget(self) -> None:
        self._seen = None

    def due(self) -> bool:
        return time.monotonic() >= self._next

    def open(self, info: NodeInfo) -> EvdevNode:
        """Open a device. Raises OSError."""
        return self._system.open(info.path)
