"""Network path to a robot: lock on this computer, address, route, ports and round-trip times. Every call is bounded.

Round trips are measured like the ping test of Franka's documentation (``ping -i 0.001 -s 1200``): packets of a
set-point's size, 1000 times a second. They are sent by this process, so that the times include the wake-up latency of
this computer.
"""

from __future__ import annotations

import json
import math
import os
import select
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from hal.lock import DeviceLock


def lock_arm(host: str) -> DeviceLock:
    """Reserve the arm at ``host`` for this process. Raises ControlTaken, with the other process's number.

    The arm's process of a program that has just ended brakes first, so this waits up to 1 s for it.
    """
    return DeviceLock(f"franka-{host}", f"the arm at {host}", patience=1.0)


class PortState(Enum):
    OPEN = "open"
    REFUSED = "refused"
    """The computer answers, but no program listens."""
    SILENT = "silent"
    """No answer in time."""
    NO_ROUTE = "no route"
    """No network of this computer leads there."""


class Route(NamedTuple):
    """Route of packets from this computer to an address."""

    interface: str
    """For example ``eth0``; ``lo`` for an address of this computer."""
    gateway: str | None
    """Router on the way; None for an address on a network of this computer."""
    wireless: bool


def resolve_host(host: str, timeout: float = 3.0) -> str | None:
    """Return the IPv4 address of a host name or address; None if it is unknown or takes longer than ``timeout`` s."""
    found: list[str] = []

    def look_up() -> None:
        try:
            found.append(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])  # type: ignore[arg-type]
        except (OSError, UnicodeError):  # the latter for impossible names
            return

    thread = threading.Thread(target=look_up, name="hal-check-name", daemon=True)
    thread.start()
    thread.join(timeout)
    return found[0] if found else None


def probe_port(address: str, port: int, timeout: float = 1.0) -> PortState:
    """Open a connection to a port, close it at once, and return what came of it."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.settimeout(timeout)
        try:
            probe.connect((address, port))
        except ConnectionRefusedError:
            return PortState.REFUSED
        except TimeoutError:
            return PortState.SILENT
        except OSError:
            return PortState.NO_ROUTE
    return PortState.OPEN


def route_to(address: str, interfaces: Path = Path("/sys/class/net")) -> Route | None:
    """Return the kernel's route to an IPv4 address; None if ``ip`` does not tell it."""
    try:
        done = subprocess.run(["ip", "-json", "route", "get", address], capture_output=True, timeout=3.0, check=True)
        found = json.loads(done.stdout)[0]
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return None
    return Route(found["dev"], found.get("gateway"), (interfaces / found["dev"] / "wireless").exists())


# Round trips.

_PAYLOAD = 1200
"""Bytes, as in Franka's test."""
_PERIOD = 1e-3
"""s"""
_GRACE = 0.1
"""s to wait for the last answers."""
_REQUEST, _REPLY = 8, 0
_HEADER = struct.Struct("!BBHHH")


class NotMeasured(Exception):
    """Round trips cannot be measured here; the message gives the reason."""


@dataclass(frozen=True)
class RoundTrips:
    sent: int
    times: Sequence[float]
    """Round-trip times of the packets that came back, in ascending order, s."""

    @property
    def lost(self) -> int:
        return self.sent - len(self.times)

    def quantile(self, share: float) -> float:
        """Return the time, s, within which this share (0 to 1) of the packets that came back had returned."""
        return self.times[min(len(self.times) - 1, math.ceil(share * len(self.times)) - 1)]

    def __str__(self) -> str:
        p50, p99, most = (1e3 * t for t in (self.quantile(0.5), self.quantile(0.99), self.times[-1]))
        return f"p50 {p50:.2f} ms, p99 {p99:.2f} ms, max {most:.2f} ms; {self.lost} of {self.sent} lost"


def measure_round_trips(address: str, duration: float) -> RoundTrips:
    """Ping an address 1000 times a second for ``duration`` s. Raises NotMeasured if this user may not."""
    try:
        with _icmp_socket() as sock:
            sock.setblocking(False)
            return _ping(sock, address, duration)
    except PermissionError:
        raise NotMeasured("this user may not ping") from None


def _icmp_socket() -> socket.socket:
    """Return a socket for pings. Raises PermissionError."""
    try:
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM, socket.IPPROTO_ICMP)
    except PermissionError:
        return socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)


def _ping(sock: socket.socket, address: str, duration: float) -> RoundTrips:
    raw, own = sock.type == socket.SOCK_RAW, os.getpid() & 0xFFFF
    pending: dict[int, float] = {}
    times: list[float] = []
    number, due = 0, time.perf_counter()
    end = due + duration
    while (now := time.perf_counter()) < end + _GRACE and (now < end or pending):
        if due <= now < end:
            number, due = number + 1, max(due + _PERIOD, now)  # missed periods are not made up for
            pending[number & 0xFFFF] = time.perf_counter()
            try:
                sock.sendto(_request(own, number & 0xFFFF), (address, 0))
            except OSError:
                continue  # it counts as lost
        wait = (due if due < end else end + _GRACE) - time.perf_counter()
        if select.select([sock], [], [], max(0.0, wait))[0]:
            sequence = _reply(sock, raw, own)
            sent_at = pending.pop(sequence, None) if sequence is not None else None
            if sent_at is not None:
                times.append(time.perf_counter() - sent_at)
    return RoundTrips(number, sorted(times))


def _request(own: int, number: int) -> bytes:
    """Return an echo request. Its payload is zeros, which do not change the checksum."""
    total = (_REQUEST << 8) + own + number
    checksum = ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
    return _HEADER.pack(_REQUEST, 0, checksum, own, number) + bytes(_PAYLOAD)


def _reply(sock: socket.socket, raw: bool, own: int) -> int | None:
    """Receive a packet, and return the number of the request that it answers; None for any other packet.

    A ``raw`` socket receives the answers to all programs, with IP headers; otherwise the kernel filters them.
    """
    try:
        packet = sock.recv(2 * _PAYLOAD)
    except OSError:  # nothing to read, or a report of an undelivered packet
        return None
    start = (packet[0] & 0xF) * 4 if raw and packet else 0
    if len(packet) < start + _HEADER.size:
        return None
    kind, _, _, owner, number = _HEADER.unpack_from(packet, start)
    return int(number) if kind == _REPLY and (owner == own or not raw) else None
