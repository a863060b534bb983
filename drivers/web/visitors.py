"""Connections that are no page's socket: anybody on this machine can open them, so they are few, and short."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable, Iterator

__all__ = ["Visitors"]

_MOST = 128
"""At once. Sixteen pages that load at the same time have 96."""
_PATIENCE = 5.0
"""s for which one stays without asking for something, from the first byte of a request to its last included."""
_PAUSE = 0.1
"""s until the next try when the machine has no descriptor or no memory for one more."""


class Visitors:
    """Lets everybody in, and shows those out that have waited longest.

    A new one is never turned away for others that only sit there: it has sent its request by the time that it is the
    one that has waited longest. A page whose socket was opened is a visitor no more.
    """

    def __init__(self, most: int = _MOST, patience: float = _PATIENCE) -> None:
        """``most`` at once, each for ``patience`` s without a request."""
        self._most = most
        self._patience = patience
        self._since: dict[asyncio.Transport, float] = {}
        """When each one came or last asked for something, s, monotonic; who has waited longest stands first."""

    async def receive(self, sock: socket.socket, server: Callable[[], asyncio.Protocol]) -> None:
        """Accept whoever connects to ``sock``, until cancelled.

        One at a time, in turn with everything else: however many knock, the pages' messages are read in between.
        """
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(sock)
            except OSError:
                self._show_out_the_first()
                await asyncio.sleep(_PAUSE)
                continue
            try:
                transport, _ = await loop.connect_accepted_socket(server, connection)
            except OSError:
                connection.close()  # it is gone again
            else:
                self._came(transport, time.monotonic())

    def _came(self, transport: asyncio.Transport, now: float) -> None:
        if len(self._since) >= self._most:
            for known in [known for known in self._since if _is_gone(known)]:
                del self._since[known]
        if len(self._since) >= self._most:
            self._show_out_the_first()
        self._since[transport] = now

    def asked(self, transport: asyncio.BaseTransport | None, now: float) -> None:
        """It has sent a request, all its headers; ``now`` in s, monotonic."""
        if isinstance(transport, asyncio.Transport) and self._since.pop(transport, None) is not None:
            self._since[transport] = now

    @contextlib.contextmanager
    def staying(self, transport: asyncio.Transport) -> Iterator[None]:
        """Within, it is a page, and no visitor. Afterwards it has as long as any other to take what it was sent."""
        self._since.pop(transport, None)
        try:
            yield
        finally:
            self._since[transport] = time.monotonic()

    def show_out(self, now: float) -> None:
        """Now and then: break off with those that waited too long; ``now`` in s, monotonic."""
        while self._since and now - next(iter(self._since.values())) > self._patience:
            self._show_out_the_first()

    def _show_out_the_first(self) -> None:
        if self._since:
            first = next(iter(self._since))
            del self._since[first]
            first.abort()  # not close(), which waits for a reader of what was sent


def _is_gone(transport: asyncio.Transport) -> bool:
    """Is its descriptor free again? One that is closing keeps it while there is something left to send."""
    return bool(transport.get_extra_info("socket").fileno() < 0)
