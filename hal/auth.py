"""Who may connect to a page: pages that this server sent, addressed by a name of this machine, with the link's token.

The guard of the console. Also the console's address in the forms that people and browsers use: link,
ssh tunnel, names of this machine.
"""

from __future__ import annotations

import getpass
import hmac
import ipaddress
import re
import socket
from collections.abc import Collection

PROTOCOL = "hal.v1"
"""The WebSocket subprotocol; the token follows it in the list that a page offers."""
_HOST = re.compile(r"(?:\[(?P<v6>[0-9a-f:.]+)\]|(?P<name>[a-z0-9._-]+))(?::\d{1,5})?", re.ASCII | re.IGNORECASE)


class Authenticator:
    """Checks the headers of a request.

    A page of another site can make a browser send requests here. It cannot forge ``Origin``, it does not have the
    token, and a name of its own that it points to this machine (DNS rebinding) appears in ``Host``.
    """

    def __init__(self, token: str, address: str, names: Collection[str], tls: bool = False) -> None:
        """``address`` is the one that the server listens at, with TLS or without; ``names`` are this machine's."""
        self._scheme = "https" if tls else "http"
        self._token = token.encode()
        self._loopback = is_loopback(address)
        others = () if self._loopback else names
        self._names = frozenset(("localhost", *(name.lower() for name in others)))

    def is_known_host(self, host: str | None) -> bool:
        """Whether the Host header names this machine. The port is not checked: a tunnel may have another one."""
        found = _HOST.fullmatch(host or "")
        if found is None:
            return False
        name = found["v6"] or found["name"]
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return found["name"] is not None and name.lower() in self._names
        return address.is_loopback or not self._loopback

    def is_own_origin(self, origin: str | None, host: str | None) -> bool:
        """Whether the page that opens a WebSocket was served at the address that it connects to."""
        return origin is not None and host is not None and origin.lower() == f"{self._scheme}://{host.lower()}"

    def is_valid_token(self, offered: str | None) -> bool:
        """Whether the offered subprotocols contain the token."""
        protocols = [part.strip() for part in (offered or "").split(",")]
        if len(protocols) != 2 or protocols[0] != PROTOCOL:
            return False
        return self.is_token(protocols[1])

    def is_token(self, offered: str) -> bool:
        """Whether this is the token. Takes the same time for every wrong one."""
        return hmac.compare_digest(offered.encode(errors="surrogateescape"), self._token)


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach the address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def page_link(address: str, port: int, token: str, tls: bool = False) -> str:
    """Return the link of the page. The token is in the fragment, which browsers never send, log or pass on."""
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
    return f"http{'s' if tls else ''}://{host}:{port}/#{token}"


def ssh_tunnel(address: str, port: int) -> str:
    """Return the ssh command that makes the link work on the computer where it is typed."""
    there = f"[{address}]" if ":" in address else address
    return f"ssh -L {port}:{there}:{port} {_user()}@{socket.gethostname()}"


def host_names() -> list[str]:
    """Return the names of this machine that a browser may use, in lower case."""
    own = socket.gethostname()
    short = own.partition(".")[0]
    return list(dict.fromkeys(name.lower() for name in (own, short, f"{short}.local")))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in some containers
        return "USER"
