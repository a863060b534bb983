"""What both WebSockets of a page have in common: how they open, what they may send, how they are closed."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable

from aiohttp import WSMsgType, web

from .allowance import Allowance
from .gatekeeper import PROTOCOL, Gatekeeper
from .messages import LONGEST
from .visitors import Visitors

__all__ = ["VISITORS", "Sockets", "Wire"]

VISITORS = web.AppKey("visitors", Visitors)
"""Where the application keeps those that are no pages."""

Reason = tuple[int, bytes]
"""Why a socket is closed: a code of RFC 6455's private range, and words."""
Hear = Callable[[str | None], None]
"""Takes one message; None for one that is no text. Raises ValueError where it is malformed."""

_TOO_MANY_MALFORMED = (4400, b"too many messages that make no sense")
_WRONG_TOKEN = (4403, b"the token in the link is not that of this run")
_TOO_MANY_MESSAGES = (4408, b"too many messages")
_TOO_MANY_PAGES = (4409, b"too many pages are open")
_APP_CLOSES = (4410, b"the app has ended")

_PAGES = 16
_REFUSED = 16
"""Sockets with a wrong token that are told so at the same time. More of them are not opened at all."""
_PING = 10.0
"""s of silence after which a page is asked whether it is still there."""
_GOODBYE = 1.0
"""s that a page may take to answer a close, and for which one that said too much is still listened to."""
_LAST_WORDS = 0.05
"""s after which such a page has said all that it had to say."""
_PATIENCE = 10.0
"""s that a page may take for one message."""
_UNSENT = 16384
"""Bytes that the kernel keeps for a page that does not take them. More would only grow old there."""


class Wire:
    """The open socket of one page."""

    def __init__(self, ws: web.WebSocketResponse, transport: asyncio.Transport) -> None:
        self._ws = ws
        self._transport = transport
        self._sending_since: float | None = None
        self._tune()

    def _tune(self) -> None:
        """Nothing is to wait in buffers: neither small messages for larger ones, nor old states for a slow page."""
        self._transport.set_write_buffer_limits(high=0)
        sock = self._transport.get_extra_info("socket")
        with contextlib.suppress(OSError):  # it may be gone again
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT)

    async def send(self, message: str | bytes) -> None:
        """Send a message; returns when the kernel has taken it. ConnectionError when the page is gone."""
        self._sending_since = time.monotonic()
        if isinstance(message, str):
            await self._ws.send_str(message)
        else:
            await self._ws.send_bytes(message)
        self._sending_since = None

    def is_stuck(self, now: float) -> bool:
        """Has the page taken nothing for too long? ``now`` in s, monotonic."""
        return self._sending_since is not None and now - self._sending_since > _PATIENCE

    def cut(self) -> None:
        """Break the connection."""
        self._transport.abort()

    async def listen(self, hear: Hear) -> Reason | None:
        """Hand over every message until the page is gone, or has said too much: then why it is to be closed."""
        allowance = Allowance()
        async for message in self._ws:
            if message.type is WSMsgType.ERROR:
                break
            try:
                hear(message.data if message.type is WSMsgType.TEXT else None)
            except ValueError:
                if not allowance.may_err():
                    return _TOO_MANY_MALFORMED
            if not allowance.may_go_on(time.monotonic()):
                return _TOO_MANY_MESSAGES
        return None

    async def drain(self, hear: Hear) -> None:
        """Hand over what a page that is about to be closed has sent already, and sends within a moment."""
        end = time.monotonic() + _GOODBYE
        with contextlib.suppress(asyncio.TimeoutError):
            while time.monotonic() < end:
                message = await self._ws.receive(timeout=_LAST_WORDS)
                if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                    return
                with contextlib.suppress(ValueError):
                    hear(message.data if message.type is WSMsgType.TEXT else None)

    async def close(self, reason: Reason) -> None:
        """Close with this code and these words."""
        await _close(self._ws, reason)


class Sockets(ABC):
    """The WebSockets of one kind, one for each page."""

    def __init__(self, gatekeeper: Gatekeeper) -> None:
        self._gatekeeper = gatekeeper
        self._wires: set[Wire] = set()
        self._refused = 0

    @abstractmethod
    async def serve(self, wire: Wire) -> None:
        """Serve one page until it is gone."""

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """A page's request for a socket, from its opening to its end."""
        if not self._gatekeeper.admits(request.headers.get("Sec-WebSocket-Protocol")):
            return await self._refuse(request)
        ws = await _open(request, heartbeat=_PING)
        transport = request.transport
        if len(self._wires) >= _PAGES:
            await _close(ws, _TOO_MANY_PAGES)
        elif transport is not None:
            wire = Wire(ws, transport)
            self._wires.add(wire)
            try:
                with request.app[VISITORS].staying(transport):
                    await self.serve(wire)
            finally:
                self._wires.discard(wire)
        return ws

    async def _refuse(self, request: web.Request) -> web.WebSocketResponse:
        """Say why: a page learns it from the code of a socket's end only, not from the answer to its handshake."""
        if self._refused >= _REFUSED:
            raise web.HTTPForbidden(text="too many come with a wrong token\n")
        self._refused += 1
        try:
            ws = await _open(request)
            await _close(ws, _WRONG_TOKEN)
        finally:
            self._refused -= 1
        return ws

    def drop_the_stuck(self, now: float) -> None:
        """Cut off every page that does not take what it is sent; ``now`` in s, monotonic."""
        for wire in self._wires:
            if wire.is_stuck(now):
                wire.cut()

    async def close(self) -> None:
        """The app ends: say so to every page."""
        if self._wires:
            goodbyes = [asyncio.ensure_future(wire.close(_APP_CLOSES)) for wire in self._wires]
            await asyncio.wait(goodbyes, timeout=_GOODBYE)


async def _open(request: web.Request, heartbeat: float | None = None) -> web.WebSocketResponse:
    ws = web.WebSocketResponse(
        protocols=(PROTOCOL,),
        heartbeat=heartbeat,
        timeout=_GOODBYE,
        compress=False,
        max_msg_size=LONGEST + 1,  # it refuses this many
        writer_limit=1,  # every send waits until the kernel has taken it
    )
    try:
        await ws.prepare(request)
    except (ConnectionError, ValueError):  # it is gone again, or its key is no ASCII
        raise web.HTTPBadRequest(text="this is no handshake of a WebSocket\n") from None
    return ws


async def _close(ws: web.WebSocketResponse, reason: Reason) -> None:
    code, text = reason
    with contextlib.suppress(ConnectionError):
        await ws.close(code=code, message=text)
