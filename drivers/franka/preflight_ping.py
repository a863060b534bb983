"""How long a packet of a set-point's size takes to the robot and back, a thousand times a second.

This is the ping test of Franka's documentation (``ping -i 0.001 -s 1200``), in this process and as an ordinary user
where the kernel allows it, so that the time includes how late this computer wakes up.
"""

from __future__ import annotations

import math
import os
import re
import select
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass

from hal.preflight import CheckResult

__all__ = ["ALLOW", "NotMeasured", "RoundTrips", "judge", "measure"]

PAYLOAD = 1200
"""Bytes, as in Franka's test."""
PERIOD = 1e-3
"""s"""
GRACE = 0.1
"""s that the last answers may take."""
GOOD, BUDGET = 0.3e-3, 1e-3
"""s there and back. A whole cycle, our work and the robot's included, has to fit into 1 ms, says Franka's
documentation; that 0.3 ms of it may go to the network is our choice."""
ALLOW = "sudo sysctl -w net.ipv4.ping_group_range='0 2147483647'"
"""Allows everybody to ping without the program."""

_STRAIGHT = "connect the cable straight to Control's LAN port, end busy programs, and use a real-time kernel"
_REQUEST, _REPLY = 8, 0
_HEADER = struct.Struct("!BBHHH")


class NotMeasured(Exception):
    """Nobody may ping here; the message says why."""


@dataclass(frozen=True)
class RoundTrips:
    """What a measurement found."""

    sent: int
    times: Sequence[float]
    """Of those that came back, s, the shortest first."""

    @property
    def lost(self) -> int:
        """How many never came back."""
        return self.sent - len(self.times)

    def quantile(self, share: float) -> float:
        """The time within which this share of those that came back did, s."""
        return self.times[min(len(self.times) - 1, math.ceil(share * len(self.times)) - 1)]

    def __str__(self) -> str:
        p50, p99, most = (1e3 * t for t in (self.quantile(0.5), self.quantile(0.99), self.times[-1]))
        return f"p50 {p50:.2f} ms, p99 {p99:.2f} ms, max {most:.2f} ms; {self.lost} of {self.sent} lost"


def measure(address: str, duration: float) -> RoundTrips:
    """Ping for ``duration`` s. Raises NotMeasured where that is not allowed."""
    try:
        with _icmp() as sock:
            sock.setblocking(False)
            return _by_socket(sock, address, duration)
    except PermissionError:
        return _by_program(address, duration)


def judge(trips: RoundTrips) -> CheckResult:
    """Is that good enough for set-points?"""
    if not trips.times:
        return CheckResult("network", "unknown", f"not measured: of {trips.sent} pings none came back")
    found = f"there and back {trips}"
    if trips.quantile(0.5) >= BUDGET:
        return CheckResult("network", "fail", f"{found}: most set-points would be late", _STRAIGHT)
    if trips.lost or trips.quantile(0.99) > GOOD or trips.times[-1] >= BUDGET:
        found = f"{found}; wanted: p99 below {1e3 * GOOD:.1f} ms, each below {1e3 * BUDGET:.0f} ms, none lost"
        return CheckResult("network", "warn", found, _STRAIGHT)
    return CheckResult("network", "ok", found)


def _icmp() -> socket.socket:
    """A socket that may ping. Raises PermissionError."""
    try:
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM, socket.IPPROTO_ICMP)
    except PermissionError:
        return socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)


def _by_socket(sock: socket.socket, address: str, duration: float) -> RoundTrips:
    raw, own = sock.type == socket.SOCK_RAW, os.getpid() & 0xFFFF
    on_the_way: dict[int, float] = {}
    times: list[float] = []
    number, due = 0, time.perf_counter()
    end = due + duration
    while (now := time.perf_counter()) < end + GRACE and (now < end or on_the_way):
        if due <= now < end:
            number, due = number + 1, max(due + PERIOD, now)  # what could not be sent in time is not caught up
            on_the_way[number & 0xFFFF] = time.perf_counter()
            try:
                sock.sendto(_request(own, number & 0xFFFF), (address, 0))
            except OSError:
                continue  # it counts as lost
        wait = (due if due < end else end + GRACE) - time.perf_counter()
        if select.select([sock], [], [], max(0.0, wait))[0]:
            sequence = _reply(sock, raw, own)
            sent_at = on_the_way.pop(sequence, None) if sequence is not None else None
            if sent_at is not None:
                times.append(time.perf_counter() - sent_at)
    return RoundTrips(number, sorted(times))


def _request(own: int, number: int) -> bytes:
    """An echo request. Its payload is zeros, which the checksum does not see."""
    total = (_REQUEST << 8) + own + number
    checksum = ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
    return _HEADER.pack(_REQUEST, 0, checksum, own, number) + bytes(PAYLOAD)


def _reply(sock: socket.socket, raw: bool, own: int) -> int | None:
    """Number of the request that the next packet answers; None where it is something else.

    The kernel sorts them, except for a ``raw`` socket, which gets everybody's, with the headers of IP.
    """
    try:
        packet = sock.recv(2 * PAYLOAD)
    except OSError:  # nothing in it, or news of a packet that did not get there
        return None
    start = (packet[0] & 0xF) * 4 if raw and packet else 0
    if len(packet) < start + _HEADER.size:
        return None
    kind, _, _, owner, number = _HEADER.unpack_from(packet, start)
    return int(number) if kind == _REPLY and (owner == own or not raw) else None


def _by_program(address: str, duration: float) -> RoundTrips:
    """By ``ping``, as often as it lets an ordinary user."""
    program = shutil.which("ping")
    if program is None:
        raise NotMeasured("this user may not ping, and there is no program 'ping'")
    said = ""
    for interval in ("0.002", "0.2"):  # new versions of ping, and old ones
        options = ["-n", "-i", interval, "-s", str(PAYLOAD), "-w", str(math.ceil(duration))]
        try:
            done = subprocess.run(
                [program, *options, address],
                env={**os.environ, "LC_ALL": "C"},
                capture_output=True,
                text=True,
                timeout=duration + 5.0,
            )
        except subprocess.TimeoutExpired:
            raise NotMeasured("ping does not end") from None
        sent = re.search(r"(\d+) packets transmitted", done.stdout)
        if sent is not None:
            times = sorted(1e-3 * float(ms) for ms in re.findall(r"time=([\d.]+) ms", done.stdout))
            return RoundTrips(int(sent[1]), times)
        said = " ".join(done.stderr.split())
    raise NotMeasured(f"ping says: {said}")
