"""One open input device: ``/dev/input/event3``."""

from __future__ import annotations

import fcntl
import os
import struct
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from hal.errors import DriverMissing
from hal.pads.codes import EV_ABS, EV_FF, EV_KEY, EV_REL, FF_RUMBLE
from hal.pads.mapper import AxisRange

__all__ = ["Event", "EvdevNode", "Node", "evdev_module", "lock"]

_EVIOCSCLOCKID = 0x400445A0  # _IOW('E', 0xa0, int), linux/input.h
_READS = 32  # at most, in one go; each brings up to 64 events


class Event(NamedTuple):
    """One input event."""

    kind: int
    code: int
    value: int
    t: float
    """When it happened, on the monotonic clock, s."""
    t_device: float
    """The kernel's stamp, s."""


class Node(Protocol):
    """What the driver needs of an open input device. Calls raise OSError when the device is gone."""

    path: str
    axes: dict[int, AxisRange]
    """Event code -> what the device says about it."""
    keys: frozenset[int]
    """Event codes of the buttons that it has."""
    rels: frozenset[int]
    """Event codes of its axes that say how far, and not where."""
    can_rumble: bool
    """Has it motors, and may they be turned on?"""

    def fileno(self) -> int:
        """Readable when there is news, and when the device is gone."""

    def read(self) -> Sequence[Event]:
        """Every event that waits, oldest first; never blocks."""

    def snapshot(self) -> tuple[dict[int, int], list[int]]:
        """What the kernel says of now: axis code -> value, and the codes of the pressed buttons."""

    def claim(self) -> bool:
        """Take it for one gamepad, in every program of the hal, until it is closed; False where somebody has it.

        Two gamepads on one device would be one hand on two dead-men.
        """

    def close(self) -> None:
        """Let go of it. Idempotent."""


def evdev_module() -> Any:
    """python-evdev. Raises DriverMissing, with the command that installs it."""
    try:
        import evdev
    except ImportError as error:
        remedy = "install it with: pip install evdev-binary"
        raise DriverMissing(f"gamepads need python-evdev, which does not import ({error}); {remedy}") from error
    return evdev


def lock(fd: int) -> bool:
    """Lock a device for as long as this opening of it lasts; False where another opening has it, here or elsewhere."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class EvdevNode:
    """A :class:`Node` on python-evdev."""

    def __init__(self, path: str) -> None:
        """Raises OSError (no such device, or no permission) and DriverMissing."""
        self.path = path
        self._device: Any = evdev_module().InputDevice(path)
        capabilities: dict[int, list[Any]] = self._device.capabilities()
        self.axes = {code: AxisRange(info.min, info.max, info.flat) for code, info in capabilities.get(EV_ABS, ())}
        self.keys = frozenset(capabilities.get(EV_KEY, ()))
        self.rels = frozenset(capabilities.get(EV_REL, ()))
        writable = fcntl.fcntl(self._device.fd, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDWR
        self.can_rumble = writable and FF_RUMBLE in capabilities.get(EV_FF, ())
        self._monotonic = self._stamp_monotonic()

    def _stamp_monotonic(self) -> bool:
        """Have events stamped with the clock that everything else here uses."""
        try:
            fcntl.ioctl(self._device.fd, _EVIOCSCLOCKID, struct.pack("i", time.CLOCK_MONOTONIC))
        except OSError:
            return False
        return True

    def fileno(self) -> int:
        return int(self._device.fd)

    def read(self) -> Sequence[Event]:
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
        values = {code: int(self._device.absinfo(code).value) for code in self.axes}
        return values, [int(code) for code in self._device.active_keys()]

    def claim(self) -> bool:
        return lock(self._device.fd)

    def close(self) -> None:
        self._device.close()
