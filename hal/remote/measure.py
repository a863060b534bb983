"""Measurement of a link: what it does to commands and to the dead-man, before anything is driven over it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from threading import Event
from typing import NamedTuple

from ..errors import ConnectionLost
from ..preflight import CheckResult
from ..servo.watchdog import SILENCE
from .client import connect
from .link import MOST_ROUND_TRIP, RigLink

RATE = 200.0
"""Round trips that are begun in a second."""
LATE = 0.1
"""A command that comes so much later than usual has passed the shortest deadline, s."""
LONGEST = 60.0
"""Longest measurement, s."""
_MOST_RATE = 1000.0
"""Greatest rate at which a link sends frames, Hz."""
_WAIT = 1.0
"""Longest wait for the last answers, s."""
_WIDTH = 50
"""Of the plot."""


class Measured(NamedTuple):
    """What was measured of a link."""

    at: str
    tls: str
    """Version of TLS; empty without."""
    round_trips: list[float]
    """Times from a message to its echo, in ascending order, s."""
    sent: int
    shortest: float
    """Shortest round trip without the time at the other end, s."""
    offset: float
    """This computer's clock minus that of the other end, s; known to within half of :attr:`shortest`."""


def measure_link(at: str, duration: float) -> Measured:
    """Send messages to a server for ``duration`` s, and take the times to their echoes. Raises as ``connect``."""
    link, _ = connect(at, {"want": "echo"})
    try:
        begun: list[float] = []
        taken: list[float] = []
        end = time.monotonic() + duration
        while (now := time.monotonic()) < end or (len(taken) < len(begun) and now < end + _WAIT):
            if now < end and (not begun or now - begun[-1] >= 1.0 / RATE):
                link.post(len(begun))
                begun.append(now)
            link.send()
            link.wait(max(0.0, begun[-1] + 1.0 / RATE - time.monotonic()) if now < end else 0.02)
            taken += [time.monotonic() - begun[number] for number in link.receive()]
        offset = link.offset
        return Measured(at, link.tls, sorted(taken), len(begun), offset.round_trip, offset.value)
    finally:
        link.close()


def echo(link: RigLink, over: Event) -> None:
    """Send every message back, until the other end closes the connection."""
    link.post({"echo": True})
    end = time.monotonic() + LONGEST + _WAIT
    with suppress(ConnectionLost):
        while time.monotonic() < end and not over.is_set():
            for message in link.receive():
                link.post(message)
                link.send()
            link.send()
            link.wait(0.02)


def judge_link(link: Measured) -> Iterator[CheckResult]:
    """Yield what a measurement means for a program that drives over this link."""
    times = link.round_trips
    if not times:
        yield CheckResult("round trip", "fail", f"no answer to {link.sent} messages", "try a cable; end busy programs")
        return
    p50, p99, longest = times[len(times) // 2], times[int(0.99 * (len(times) - 1))], times[-1]
    jitter = p99 - times[0]
    yield CheckResult("encryption", "ok", link.tls or "none: only this computer, or an ssh tunnel, reaches the server")
    found = f"p50 {1e3 * p50:.2f} ms, p99 {1e3 * p99:.2f} ms, longest {1e3 * longest:.2f} ms, of {len(times)}"
    yield CheckResult("round trip", "ok" if p50 <= MOST_ROUND_TRIP else "warn", found, "is it a VPN or a far network?")
    late = link.sent - sum(one <= times[0] + LATE for one in times)
    found = f"{late} of {link.sent} round trips took {1e3 * LATE:g} ms longer than the shortest, or had no end"
    yield CheckResult("late", "ok" if not late else "warn", found, "each stops a moving arm: use a cable, not Wi-Fi")
    rate = min(_MOST_RATE, 1.0 / max(jitter, 1e-6))
    found = f"{1e3 * jitter:.2f} ms (p99 - shortest): commands come one by one at up to {rate:.0f} Hz"
    yield CheckResult("jitter", "ok" if rate >= 50.0 else "warn", found, "at a greater rate some are skipped")
    side = "behind" if link.offset < 0.0 else "ahead"
    found = f"this one is {abs(link.offset):.6f} s {side}, known to within {500.0 * link.shortest:.3f} ms"
    yield CheckResult("clocks", "ok", found)
    if link.shortest > MOST_ROUND_TRIP:
        found = f"no control session: the shortest round trip is {1e3 * link.shortest:.0f} ms"
        yield CheckResult("dead-man", "fail", found, f"at most {1e3 * MOST_ROUND_TRIP:g} ms: states can be read")
    else:
        found = f"stops at the latest {1e3 * SILENCE:g} ms + {500.0 * link.shortest:.2f} ms after its last sign of life"
        yield CheckResult("dead-man", "ok", found)


def plot(times: list[float]) -> Iterator[str]:
    """Yield the lines of a histogram of round trips, s, whose bins double."""
    bins: dict[int, int] = {}
    for one in times:
        k = 0
        while 0.0625e-3 * 2**k < one:
            k += 1
        bins[k] = bins.get(k, 0) + 1
    for k in range(min(bins, default=0), max(bins, default=-1) + 1):
        count = bins.get(k, 0)
        yield f"to {0.0625 * 2**k:7.4g} ms {'#' * -(-_WIDTH * count // len(times)):{_WIDTH}s} {count}"
