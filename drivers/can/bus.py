"""One open CAN bus per interface and channel in a process, which all devices on it share.

A device subscribes the ids of its replies, sends frames, and calls :meth:`CanBus.poll` once per cycle, which hands
every frame that has come to its device. Nothing here waits.

Some interfaces return a bus's own frames (``udp_multicast``; vcan, where ``Message.is_rx`` does not tell them apart).
So a frame is a reply if a device subscribed its id, the bus's own if its id was sent, and unexpected otherwise.
"""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can

from hal.errors import (
    ConfigError,
    ConnectionLost,
    DeviceNotFound,
    DriverMissing,
    Fault,
    HalError,
    Problem,
    find_closest,
)

from .settings import BusSettings

FrameHandler = Callable[[bytearray], None]
"""Function that a frame's data is handed to."""

_RETRY_PERIOD = 0.2
"""Time between two attempts to open a lost bus again, s."""
_SHUTDOWN = 3.0
"""Longest time that the end waits for an attempt to open the bus, s."""
_LONGEST_POLL = 512
"""Largest number of frames that one poll handles, so that a flooded bus does not stop the cycle."""
_INSTANT = frozenset({"socketcan", "udp_multicast", "virtual"})
"""Interfaces that queue a frame at once or refuse it. Others write to a serial port, for example."""
_SEND_TIMEOUT = 0.002
"""Longest time to wait for another interface to take a frame, s."""
_BUS_OFF = 0x40
"""Bit in the id of an error frame: the controller has taken itself off the bus (CAN_ERR_BUSOFF)."""
_KEPT_IDS = 64
"""Largest number of unexpected ids that are remembered."""
_LIBRARIES = {"slcan": "pip install pyserial", "gs_usb": "pip install 'python-can[gs-usb]'"}
"""Interface -> command that installs its library."""
_NO_QUEUE = frozenset({errno.ENOBUFS, errno.EAGAIN})
"""Errors of a full transmit queue: nothing on the bus acknowledges frames, or there are too many."""


_FEWEST, _MANY_LOST = 200, 0.01
"""Frames from which on a share of lost ones is known, and the share from which it is a warning."""


class CanBus:
    """A python-can bus that the devices of one process share.

    Attributes:
        settings: Its settings.
        fault: Why it does not work; None while it does.
    """

    _open_buses: dict[tuple[str, str], CanBus] = {}  # noqa: RUF012  # shared on purpose
    _lock = threading.Lock()

    def __init__(self, settings: BusSettings) -> None:
        self.settings = settings
        self.fault: Fault | None = None
        self._users = 0
        self._bus: can.BusABC | None = None
        self._handlers: dict[int, FrameHandler | None] = {}
        """Id -> the device's function; None for an id that a device sends at."""
        self._senders: dict[int, int] = {}
        """Id -> number of devices that send at it."""
        self._messages: dict[int, can.Message] = {}
        self._timeout = 0.0 if settings.interface in _INSTANT else _SEND_TIMEOUT
        self._retry_at = 0.0
        self._opening: threading.Thread | None = None
        self._closed = False
        self.reopened = 0
        """How often the bus was opened again."""
        self.reset_statistics()

    # Sharing.

    @classmethod
    def acquire(cls, settings: BusSettings) -> CanBus:
        """Return the process's bus with this interface and channel, and open it if it is not open yet.

        Raises:
            ConfigError: Another device of this process opened it with other settings.
            DeviceNotFound: There is no such interface or channel; lists those that are there.
            ConnectionLost: The interface is down; the message has the command that fixes it.
            DriverMissing: A library that the interface needs is not installed.
        """
        with cls._lock:
            bus = cls._open_buses.get(settings.key)
            if bus is None:
                bus = cls(settings)
                bus._connect()
                cls._open_buses[settings.key] = bus
            elif bus.settings != settings:
                message = (
                    f"{settings.interface} {settings.channel} is already open with other settings of `fd` or `bus`"
                )
                raise ConfigError([Problem("<rig>", "real.bus", message, "conflict")])
            bus._users += 1
            return bus

    def release(self) -> None:
        """Give up one use of the bus; the last one closes it."""
        with self._lock:
            self._users -= 1
            if self._users > 0:
                return
            self._open_buses.pop(self.settings.key, None)
            self._closed = True
            if self._opening is not None:
                self._opening.join(_SHUTDOWN)
            self._disconnect()

    def subscribe(self, handlers: dict[int, FrameHandler], sent: Iterable[int]) -> None:
        """Hand frames with these ids to functions that must not raise; ``sent`` are the ids that the device sends.

        Raises ConfigError if another device of this process has one of the ids.
        """
        sent = tuple(sent)
        taken = sorted({id for id in handlers if id in self._handlers} | {id for id in sent if self._handlers.get(id)})
        if taken:  # also an id at which one device is commanded and another one answers: a reply would be a command
            text = ", ".join(f"{id:#x}" for id in taken)
            message = f"id {text} belongs to two devices on {self.settings.interface} {self.settings.channel}"
            raise ConfigError([Problem("<rig>", "real", message, "id_collision")])
        self._handlers.update(handlers)
        for id in sent:
            self._handlers.setdefault(id, None)  # a PiPER is asked for its firmware at the id that answers
            self._senders[id] = self._senders.get(id, 0) + 1

    def unsubscribe(self, ids: Iterable[int], sent: Iterable[int] = ()) -> None:
        """Stop to hand frames with these ids to a device that sends no more at those of ``sent``."""
        for id in ids:
            self._handlers.pop(id, None)
        for id in sent:
            self._senders[id] -= 1
            if not self._senders[id]:
                del self._senders[id]
                self._handlers.pop(id, None)

    # Opening.

    def _connect(self) -> None:
        try:
            self._bus = can.Bus(**self.settings.arguments())
        except Exception as error:  # interfaces raise errors of many kinds
            raise self._explain(error) from error
        self.fault = None

    def _disconnect(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(Exception):
                bus.shutdown()

    def try_reopen(self) -> bool:
        """Open a lost bus again if it is time for the next attempt; return whether the bus works.

        A thread opens it, because some adapters need seconds.
        """
        opening = self._opening
        if opening is None:
            if self.fault is None and self._bus is not None:
                return True
            if time.monotonic() >= self._retry_at:
                self._disconnect()
                self._opening = threading.Thread(target=self._reopen, name="can-reopen", daemon=True)
                self._opening.start()
            return False
        if opening.is_alive():
            return False
        self._opening = None
        self._retry_at = time.monotonic() + _RETRY_PERIOD
        return self.fault is None

    def _reopen(self) -> None:
        try:
            self._connect()
        except HalError as error:
            self.fault = getattr(error, "fault", None) or self.fault
        else:
            self.reopened += 1
            if self._closed:  # it took longer than the end waited
                self._disconnect()

    def _lose(self, error: Exception) -> None:
        if self.fault is None:
            self._retry_at = time.monotonic() + _RETRY_PERIOD
        problem = self._explain(error)
        self.fault = getattr(problem, "fault", None) or Fault("bus", str(problem), "check the adapter and its cable")

    def error(self, name: str) -> ConnectionLost:
        """Return the exception that a device raises while the bus does not work; ``name`` is the device's."""
        return ConnectionLost.of(name, self.fault or Fault("closed", "it is not open", "open the rig"))

    def _explain(self, error: Exception) -> HalError:
        """Return the error of this package that an interface's exception stands for."""
        s = self.settings
        where = f"{s.interface} {s.channel}"
        if s.interface not in can.VALID_INTERFACES:
            near = find_closest(s.interface, can.VALID_INTERFACES)
            hint = f"; did you mean {near!r}?" if near else ""
            message = f"there is no interface {s.interface!r} in python-can{hint}"
            return ConfigError([Problem("<rig>", "real.interface", message, "unknown_interface")])
        if isinstance(error, (ImportError, can.CanInterfaceNotImplementedError)):
            remedy = _LIBRARIES.get(s.interface, "install the library of this interface (see python-can's manual)")
            return DriverMissing(f"{where}: {error}; {remedy}")
        code = _errno_of(error)
        if code == errno.EAFNOSUPPORT:
            remedy = "sudo modprobe can_raw; a container or WSL needs a kernel with it"
            return _not_found(where, "this kernel has no SocketCAN", remedy, "no_socketcan")
        if code == errno.ENODEV:
            there = ", ".join(can_interfaces()) or "none"
            remedy = f"plug in the adapter, or correct `channel`; interfaces: {there}"
            if s.channel.startswith("vcan"):
                remedy = f"sudo ip link add {s.channel} type vcan; {bring_up(s)}"
            return _not_found(where, f"there is no interface {s.channel}", remedy, "no_interface")
        if code == errno.ENETDOWN:
            return _lost(where, f"the interface {s.channel} is down", bring_up(s), "interface_down")
        if code == errno.EINVAL and s.fd and s.interface == "socketcan":
            remedy = f"sudo ip link set {s.channel} down; {bring_up(s)}; or `fd: false` for an arm with classic CAN"
            return _lost(where, f"the interface {s.channel} takes no CAN-FD frames", remedy, "no_can_fd")
        if code == errno.EACCES:
            remedy = "sudo usermod -aG dialout $USER, then log in again"
            return _not_found(where, f"no permission to open {s.channel}", remedy, "no_permission")
        if isinstance(error, (ValueError, TypeError)):
            return ConfigError([Problem("<rig>", "real.bus", f"{where}: {error}", "bad_bus")])
        remedy = "check the adapter and its cable"
        if s.interface != "socketcan":
            remedy += ", and that the library of its vendor is installed; on Linux, most adapters are SocketCAN "
            remedy += "interfaces (hal check --can lists them)"
        return _lost(where, f"the bus does not work: {error}", remedy, "bus_lost")

    # Frames.

    def send(self, id: int, data: bytes) -> bool:
        """Queue a frame. A queue that is full drops it: that is counted, and False is returned.

        Raises:
            ConnectionLost: The bus does not work.
        """
        bus = self._bus
        if bus is None or self.fault is not None:
            raise self.error(f"{self.settings.interface} {self.settings.channel}")
        message = self._messages.get(id)
        if message is None:
            fd = self.settings.fd
            message = can.Message(arbitration_id=id, is_extended_id=False, is_fd=fd, bitrate_switch=fd, data=data)
            self._messages[id] = message
        message.data = bytearray(data)
        message.dlc = len(data)
        try:
            bus.send(message, self._timeout)
        except (can.CanError, OSError, ValueError) as error:
            if isinstance(error, can.CanTimeoutError) or _errno_of(error) in _NO_QUEUE or "buffer full" in str(error):
                self.unsent += 1
                return False
            self._lose(error)
            raise self.error(f"{self.settings.interface} {self.settings.channel}") from error
        self.sent += 1
        return True

    def poll(self) -> bool:
        """Hand every frame that has come to its device; return whether the bus works. Never waits."""
        bus = self._bus
        if bus is None or self.fault is not None:
            return False
        handlers, receive = self._handlers, bus.recv
        try:
            for _ in range(_LONGEST_POLL):
                message = receive(0.0)
                if message is None:
                    break
                if message.is_error_frame:
                    self._note_error_frame(message.arbitration_id)
                    continue
                id = message.arbitration_id
                self.received += 1
                if id not in handlers or message.is_extended_id or message.is_remote_frame:
                    self.unexpected += 1
                    if len(self.unexpected_ids) < _KEPT_IDS:
                        self.unexpected_ids.add(id)
                    continue
                handler = handlers[id]
                if handler is not None:
                    handler(message.data)
        except (can.CanError, OSError, ValueError) as error:
            self._lose(error)
        return self.fault is None

    def drain(self) -> None:
        """Discard every frame that has come, for example those from before the devices were opened."""
        bus = self._bus
        try:
            for _ in range(100 * _LONGEST_POLL):
                if bus is None or bus.recv(0.0) is None:
                    return
        except (can.CanError, OSError, ValueError) as error:  # reported once: an interface that is down, for example
            self._lose(error)

    def _note_error_frame(self, id: int) -> None:
        self.error_frames += 1
        if id & _BUS_OFF:
            s = self.settings
            cause = f"the controller of {s.channel} has taken itself off the bus: too many errors"
            remedy = f"check wiring, termination and bit rate, then: sudo ip link set {s.channel} down; {bring_up(s)}"
            self._retry_at = time.monotonic() + _RETRY_PERIOD
            self.fault = Fault("bus_off", cause, remedy)

    # Statistics.

    def reset_statistics(self) -> None:
        self.sent = self.unsent = self.received = self.unexpected = self.error_frames = 0
        self.unexpected_ids: set[int] = set()

    def statistics(self) -> dict[str, Any]:
        """Return the counters of the bus since the last reset."""
        return {
            "sent": self.sent,
            "unsent": self.unsent,
            "received": self.received,
            "unexpected": self.unexpected,
            "unexpected_ids": sorted(self.unexpected_ids),
            "error_frames": self.error_frames,
            "reopened": self.reopened,
        }


def describe_losses(name: str, channel: str, lost: int, expected: int) -> list[str]:
    """Return a warning if more than 1 % of the frames that were expected from a device did not come; else nothing."""
    if expected < _FEWEST or lost <= _MANY_LOST * expected:
        return []
    remedy = "check wiring, termination (120 ohm at both ends), bit rate and bus load: hal check --real"
    return [f"{name}: {100.0 * lost / expected:.1f} % of the frames on {channel} were lost; {remedy}"]


def can_interfaces() -> tuple[str, ...]:
    """Return the names of the CAN interfaces of this computer's kernel."""
    arphrd_can = "280"
    found = []
    for folder in Path("/sys/class/net").glob("*"):
        with contextlib.suppress(OSError):
            if (folder / "type").read_text().strip() == arphrd_can:
                found.append(folder.name)
    return tuple(sorted(found))


def bring_up(settings: BusSettings) -> str:
    """Return the command that brings a SocketCAN interface up at the bit rate of these settings."""
    if settings.channel.startswith("vcan"):
        return f"sudo ip link set {settings.channel} up{' mtu 72' if settings.fd else ''}"
    line = f"sudo ip link set {settings.channel} up type can bitrate {settings.bit_rate}"
    return f"{line} dbitrate {settings.data_bit_rate} fd on" if settings.fd else line


def _errno_of(error: BaseException) -> int | None:
    """Return the number of the operating system's error behind an exception of python-can; None if there is none."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno is not None:
            return cause.errno
        code = getattr(cause, "error_code", None)
        if isinstance(code, int):
            return code
        cause = cause.__cause__
    return None


def _lost(where: str, cause: str, remedy: str, code: str) -> ConnectionLost:
    return ConnectionLost.of(where, Fault(code, cause, remedy))


def _not_found(where: str, cause: str, remedy: str, code: str) -> DeviceNotFound:
    error = DeviceNotFound(f"{where}: {cause}; {remedy}", code=code)
    error.fault = Fault(code, cause, remedy)  # type: ignore[attr-defined]  # kept for a bus that was lost
    return error
