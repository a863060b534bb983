"""Who may come in: a page that this server sent, asked for by an address of this machine, with the printed token."""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Collection

from .addresses import is_loopback

__all__ = ["PROTOCOL", "Gatekeeper"]

PROTOCOL = "hal.v1"
"""The WebSocket subprotocol; the token follows it in the list that a page offers."""
_HOST = re.compile(r"(?:\[(?P<v6>[0-9a-f:.]+)\]|(?P<name>[a-z0-9._-]+))(?::\d{1,5})?", re.ASCII | re.IGNORECASE)


class Gatekeeper:
    """The rules for the headers of a request.

    A page of another site can make a browser send requests here. It cannot forge ``Origin``, it does not know the
    token, and a name of its own that it lets point to this machine (DNS rebinding) is in ``Host``.
    """

    def __init__(self, token: str, address: str, names: Collection[str]) -> None:
        """``address`` is what the server listens on; ``names`` are this machine's."""
        self._token = token.encode()
        self._loopback = is_loopback(address)
        others = () if self._loopback else names
        self._names = frozenset(("localhost", *(name.lower() for name in others)))

    def knows_host(self, host: str | None) -> bool:
        """May this stand in the Host header? The port does not matter: a tunnel may have another one."""
        found = _HOST.fullmatch(host or "")
        if found is None:
            return False
        name = found["v6"] or found["name"]
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return found["name"] is not None and name.lower() in self._names
        return address.is_loopback or not self._loopback

    def is_own_page(self, origin: str | None, host: str | None) -> bool:
        """Was the page that opens a WebSocket served under the address that it connects to?"""
        return origin is not None and host is not None and origin.lower() == f"http://{host.lower()}"

    def admits(self, offered: str | None) -> bool:
        """Is the token in this list of subprotocols the right one? Takes the same time for every wrong one."""
        protocols = [part.strip() for part in (offered or "").split(",")]
        if len(protocols) != 2 or protocols[0] != PROTOCOL:
            return False
        return hmac.compare_digest(protocols[1].encode(errors="surrogateescape"), self._token)
