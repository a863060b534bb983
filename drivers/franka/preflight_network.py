"""The way to a robot: its address, the network it is on, and whether anybody opens there. Every call is bounded."""

from __future__ import annotations

import ipaddress
import socket
import struct
import threading
from enum import Enum
from pathlib import Path
from typing import NamedTuple

__all__ = ["Answer", "Route", "knock", "resolve", "route_to"]


class Answer(Enum):
    """What came of a knock at a port."""

    OPEN = "open"
    REFUSED = "refused"
    """The computer is there, and nothing listens."""
    SILENT = "silent"
    """Nobody answered in time."""
    NO_WAY = "no way"
    """This computer has no network that leads there."""


class Route(NamedTuple):
    """How packets go from here to an address."""

    interface: str
    """``eth0``; ``lo`` where the address is this computer's own."""
    gateway: str | None
    """The router on the way; None where the robot is on a network that this computer is on."""
    wireless: bool


def resolve(host: str, timeout: float = 3.0) -> str | None:
    """The IPv4 address of a host, by name or number; None where there is none, or none came in ``timeout`` s."""
    found: list[str] = []

    def ask() -> None:
        try:
            found.append(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])  # type: ignore[arg-type]
        except (OSError, UnicodeError):  # the latter for names that no network knows
            return

    asking = threading.Thread(target=ask, name="hal-check-name", daemon=True)
    asking.start()
    asking.join(timeout)
    return found[0] if found else None


def knock(address: str, port: int, timeout: float = 1.0) -> Answer:
    """Does anybody listen at this port? Opens a connection and ends it at once."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as door:
        door.settimeout(timeout)
        try:
            door.connect((address, port))
        except ConnectionRefusedError:
            return Answer.REFUSED
        except TimeoutError:
            return Answer.SILENT
        except OSError:
            return Answer.NO_WAY
    return Answer.OPEN


def route_to(address: str, root: Path = Path("/")) -> Route | None:
    """How packets go there, by the kernel's own table; None where it does not say."""
    if _is_own(address):
        return Route("lo", None, False)
    try:
        lines = (root / "proc/net/route").read_text().splitlines()[1:]
    except OSError:
        return None
    target, best, narrowest = int(ipaddress.IPv4Address(address)), None, -1
    for line in lines:
        interface, destination, gateway, _, _, _, _, mask = line.split()[:8]
        if target & _number(mask) == _number(destination) and _number(mask) > narrowest:
            narrowest = _number(mask)
            router = None if _number(gateway) == 0 else str(ipaddress.IPv4Address(_number(gateway)))
            best = Route(interface, router, (root / "sys/class/net" / interface / "wireless").exists())
    return best


def _is_own(address: str) -> bool:
    """Is it an address of this computer? Asked without a packet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            asking.connect((address, 9))
        except OSError:
            return False
        return asking.getsockname()[0] == address or ipaddress.ip_address(address).is_loopback


def _number(text: str) -> int:
    """The kernel prints addresses as they lie in memory."""
    return int(struct.unpack("=I", struct.pack("!I", int(text, 16)))[0])
