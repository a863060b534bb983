"""Connections to a server before it trusts them: their handshake, their number, and what is reported of them."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections.abc import Callable
from functools import partial

from ..errors import ConnectionLost, HalError
from ..host.process import pack_error
from ..keys import HANDSHAKE_LIMIT, Credentials, hang_up, is_viewer, needs_keys
from .link import RigLink

MOST = 16
"""Connections that may be about to say who they are and what they want; of more the oldest are closed."""
_TLS = b"\x16"
"""First byte of a connection with TLS."""
_REPORT_PERIOD = 1.0
"""Time between two lines about strangers, s: they must not fill a log."""


class Entrance:
    """Admits connections; each has a thread of its own, which is none of a rig's.

    Those that only wait keep nobody out, and any number of them costs no more than :data:`MOST` threads.

    Args:
        address: Where the server listens: with certificates, unless only this computer reaches it.
        report: Called with each line that a user should see.

    Raises:
        NotSupported: There is no certificate here, see :func:`~hal.keys.find_key`.
    """

    def __init__(self, address: str, report: Callable[[str], object]) -> None:
        self.credentials = Credentials("host") if needs_keys(address) else None
        """What connections must show; None where only this computer can connect."""
        self._report = report
        self._waiting: dict[str, socket.socket] = {}
        self._lock = threading.Lock()
        self._t_report, self._unreported = -math.inf, 0

    def enter(self, peer: str, sock: socket.socket) -> None:
        """Count a connection as waiting until :meth:`leave`; ``sock`` may be its new object."""
        with self._lock:
            self._waiting[peer] = sock
            while len(self._waiting) > MOST:
                oldest = self._waiting.pop(next(iter(self._waiting)))
                with contextlib.suppress(OSError):
                    socket.socket.shutdown(oldest, socket.SHUT_RDWR)  # not that of TLS, which another thread uses

    def leave(self, peer: str) -> None:
        """Do not count a connection any more."""
        with self._lock:
            self._waiting.pop(peer, None)

    def admit(self, sock: socket.socket, peer: str, period: float) -> RigLink:
        """Return the link of a connection, whose :attr:`~.link.RigLink.at` has the person's name.

        Args:
            sock: The connection, which is closed if it is refused.
            peer: Its other end.
            period: That of the link.

        Raises:
            HalError: It is refused, and was told why.
        """
        if self.credentials is None:
            return RigLink(sock, peer, period)
        sock.settimeout(HANDSHAKE_LIMIT)
        try:
            if sock.recv(1, socket.MSG_PEEK) not in (_TLS, b""):
                text = (
                    "connections to this server are encrypted: name it by an address in its certificate, not 127.0.0.1"
                )
                plain = ConnectionLost(text, code="no_tls")
                _refuse(RigLink(sock, peer, period), sock, plain)
                raise plain
            secured = self.credentials.wrap(sock)
        except OSError as error:
            sock.close()
            raise error if isinstance(error, ConnectionLost) else self.credentials.explain(error, peer) from None
        self.enter(peer, secured)
        self.credentials.shake(secured, peer)
        link = RigLink(secured, peer, period)
        certificate = secured.getpeercert() or {}
        try:
            link.at += f" ({self.credentials.check(certificate, viewers=True)})"
            link.viewer = is_viewer(certificate)
        except HalError as error:
            _refuse(link, secured, error)
            raise
        link.check = partial(self.credentials.check, certificate, viewers=True)
        return link

    def report(self, peer: str, error: HalError) -> None:
        """Report why a connection ended that has taken nothing: at most one in :data:`_REPORT_PERIOD`."""
        now = time.monotonic()
        if now - self._t_report > _REPORT_PERIOD:
            more = f" (and {self._unreported} others)" if self._unreported else ""
            self._t_report, self._unreported = now, 0
            self._report(f"{peer} is refused: {error}{more}")
        else:
            self._unreported += 1


def _refuse(link: RigLink, sock: socket.socket, error: HalError) -> None:
    """Say why, and hang up: a mere close takes the reason back if the other end is about to say what it wants."""
    link.post({"error": pack_error(error)})
    link.send()
    hang_up(sock)
