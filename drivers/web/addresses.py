"""The console's address as people and browsers write it."""

from __future__ import annotations

import getpass
import ipaddress
import socket

__all__ = ["is_loopback", "link", "names", "tunnel"]


def is_loopback(address: str) -> bool:
    """Can only this machine reach it?"""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def link(address: str, port: int, token: str) -> str:
    """What a person opens. The token stands in the fragment, which no browser sends, logs or passes on."""
    host = address
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        pass
    else:
        if ip.is_unspecified:  # every interface: the machine's own name is as good as any of them
            host = socket.gethostname()
        elif ip.version == 6:
            host = f"[{address}]"
    return f"http://{host}:{port}/#{token}"


def tunnel(address: str, port: int) -> str:
    """The ssh command that makes the link work on the computer where it is typed."""
    there = f"[{address}]" if ":" in address else address
    return f"ssh -L {port}:{there}:{port} {_user()}@{socket.gethostname()}"


def names() -> list[str]:
    """Names of this machine, which a browser may have been told to go to."""
    own = socket.gethostname()
    short = own.partition(".")[0]
    return list(dict.fromkeys(name.lower() for name in (own, short, f"{short}.local")))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in some containers
        return "USER"
