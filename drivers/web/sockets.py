"""The WebSockets of pages, and the limits that protect them: how they open, what they may send, how they close."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from aiohttp import WSMsgType, web

from hal.auth import PROTOCOL, Authenticator

from .messages import MAX_BYTES

CloseReason = tuple[int, bytes]
"""Why a socket is closed: a code of RFC 6455's private range, and a text."""
Handle = Callable[[str | None], None]
"""Handles one message, None for one that is not text. Raises ValueError if it is malformed."""

_TOO_MANY_MALFORMED = (4400, b"too many messages that make no sense")
_WRONG_TOKEN = (4403, b"the token in the link is not that of this run")
_TOO_MANY_MESSAGES = (4408, b"too many messages")
_TOO_MANY_PAGES = (4409, b"too many pages are open")
_APP_CLOSES = (4410, b"the app has ended")

MAX_MESSAGES = 400
"""Messages that a page may send in one second. A page that drives sends 50, and one more for each change of the pad."""
MAX_MALFORMED = 100
"""Malformed messages that a page may send in all."""
MAX_PAGES = 16
_MAX_REFUSED = 16
"""Sockets with a wrong token that are open at the same time to report that. More of them are not opened."""
PING_AFTER = 10.0
"""Time without a message after which a page is sent a ping, in s."""
_CLOSE_TIME = 1.0
"""Time for answering a close, and for which a page that sent too much is still read, in s."""
_LAST_WORDS = 0.05
"""Time without a message after which such a page is no longer read, in s."""
_SEND_TIME = 10.0
"""Longest time that a page may take for one message, in s."""
_UNSENT_BYTES = 16384
"""Bytes that the kernel keeps for a page that does not read. More would only grow old there."""
_MAX_CONNECTIONS = 128
"""Connections that are not a page's socket. Sixteen pages that load at the same time have 96."""
_MAX_HANDSHAKES = 32
"""Handshakes of TLS at the same time; of more the oldest are given up."""
_MAX_REQUESTS = 100
"""Requests that one of them may send in one second. A page needs a dozen."""
_IDLE_TIME = 5.0
"""Time for which such a connection stays without a whole request, in s."""
_RETRY_AFTER = 0.1
"""Time until the next try if the machine has no descriptor or no memory for another connection, in s."""


class RateLimit:
    """Counts the messages of one socket, or the requests of one connection."""

    def __init__(self, most: int = MAX_MESSAGES) -> None:
        """Allow ``most`` messages in one second."""
        self._most = most
        self._second = 0.0
        self._messages = 0
        self._malformed = 0

    def allows_message(self, now: float) -> bool:
        """Count a message at ``now`` (s); False if there were too many within a second."""
        if not 0.0 <= now - self._second < 1.0:
            self._second, self._messages = now, 0
        self._messages += 1
        return self._messages <= self._most

    def allows_malformed(self) -> bool:
        """Count a malformed message; False if there were too many."""
        self._malformed += 1
        return self._malformed <= MAX_MALFORMED


class ConnectionLimit:
    """Accepts connections, and closes the oldest idle ones above a limit; the sockets of pages do not count.

    Anybody on this machine can connect, so a new connection is never refused because others are idle: it has sent its
    request before it becomes the oldest.
    """

    def __init__(self, most: int = _MAX_CONNECTIONS, idle_time: float = _IDLE_TIME) -> None:
        """``most`` connections at the same time, each for ``idle_time`` s without a request."""
        self._most = most
        self._idle_time = idle_time
        self._since: dict[asyncio.Transport, tuple[float, RateLimit]] = {}
        """Time of the connection or of its last request, s, monotonic, and its requests; the oldest first."""
        self._shaking: dict[asyncio.Future[None], None] = {}
        """Handshakes of TLS, the oldest first."""

    async def accept_all(
        self, sock: socket.socket, server: Callable[[], asyncio.Protocol], tls: ssl.SSLContext | None = None
    ) -> None:
        """Accept connections to ``sock``, with TLS or without, until cancelled.

        One at a time, in turn with everything else: the messages of pages are read in between.
        """
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(sock)
            except OSError:
                self._abort_oldest()
                await asyncio.sleep(_RETRY_AFTER)
                continue
            if tls is None:
                await self._start(server, connection)
                continue
            shaking = asyncio.ensure_future(self._start(server, connection, ssl=tls, ssl_handshake_timeout=_IDLE_TIME))
            self._shaking[shaking] = None
            shaking.add_done_callback(lambda done: self._shaking.pop(done, None))
            if len(self._shaking) > _MAX_HANDSHAKES:
                next(iter(self._shaking)).cancel()
            await asyncio.sleep(0)

    async def _start(self, server: Callable[[], asyncio.Protocol], connection: socket.socket, **tls: Any) -> None:
        try:
            transport, _ = await asyncio.get_running_loop().connect_accepted_socket(server, connection, **tls)
        except OSError:
            connection.close()  # it was closed meanwhile, or its handshake failed
        else:
            self._add(transport, time.monotonic())

    def _add(self, transport: asyncio.Transport, now: float) -> None:
        if len(self._since) >= self._most:
            for known in [known for known in self._since if _is_closed(known)]:
                del self._since[known]
        if len(self._since) >= self._most:
            self._abort_oldest()
        self._since[transport] = now, RateLimit(_MAX_REQUESTS)

    def note_request(self, transport: asyncio.BaseTransport | None, now: float) -> None:
        """Note that a connection has sent a request at ``now`` (s, monotonic), and abort it after too many."""
        if isinstance(transport, asyncio.Transport) and (known := self._since.pop(transport, None)) is not None:
            self._since[transport] = now, known[1]
            if not known[1].allows_message(now):
                transport.abort()

    @contextlib.contextmanager
    def exempt(self, transport: asyncio.Transport) -> Iterator[None]:
        """Do not count a connection within the block; afterwards it has as long as a new one."""
        self._since.pop(transport, None)
        try:
            yield
        finally:
            self._add(transport, time.monotonic())

    def close_idle(self, now: float) -> None:
        """Abort the connections that were idle for too long at ``now`` (s, monotonic); to be called regularly."""
        while self._since and now - next(iter(self._since.values()))[0] > self._idle_time:
            self._abort_oldest()

    def _abort_oldest(self) -> None:
        if self._since:
            oldest = next(iter(self._since))
            del self._since[oldest]
            oldest.abort()  # not close(), which waits until what was sent is read


def _is_closed(transport: asyncio.Transport) -> bool:
    # One that is closing keeps its descriptor while there is something left to send.
    return bool(transport.get_extra_info("socket").fileno() < 0)


CONNECTIONS = web.AppKey("connections", ConnectionLimit)
"""Key of the application's :class:`ConnectionLimit`."""


class PageSocket:
    """The open WebSocket of one page."""

    def __init__(self, ws: web.WebSocketResponse, transport: asyncio.Transport) -> None:
        self._ws = ws
        self._transport = transport
        self.sending_since: float | None = None
        """Since when the page has not read a message, s, monotonic; None while none is being sent."""
        self._receiving: asyncio.Future[CloseReason | None] | None = None
        self.app_ended = False
        """Whether :meth:`end` was called."""
        self.closed = asyncio.Event()
        """Set once it is not served any more."""
        self._minimise_buffers()

    def _minimise_buffers(self) -> None:
        """Let nothing wait in buffers: neither small messages for larger ones, nor old states for a slow page."""
        self._transport.set_write_buffer_limits(high=1)  # not 0, with which one of TLS never goes on
        sock = self._transport.get_extra_info("socket")
        with contextlib.suppress(OSError):  # it may be closed already
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)

    async def send(self, message: str | bytes) -> None:
        """Send a message; returns when the kernel has taken it. ConnectionError if the page is gone."""
        self.sending_since = time.monotonic()
        if isinstance(message, str):
            await self._ws.send_str(message)
        else:
            await self._ws.send_bytes(message)
        self.sending_since = None

    def abort(self) -> None:
        """Break the connection without a close."""
        self._transport.abort()

    async def receive_all(self, handle: Handle) -> CloseReason | None:
        """Handle every message until the page is gone or the app ends; returns a reason if it has sent too much."""
        self._receiving = asyncio.ensure_future(self._receive_all(handle))
        try:
            await asyncio.wait((self._receiving,))
        finally:
            self._receiving.cancel()
        return None if self._receiving.cancelled() else self._receiving.result()

    async def _receive_all(self, handle: Handle) -> CloseReason | None:
        limit = RateLimit()
        async for message in self._ws:
            if message.type is WSMsgType.ERROR:
                break
            try:
                handle(message.data if message.type is WSMsgType.TEXT else None)
            except ValueError:
                if not limit.allows_malformed():
                    return _TOO_MANY_MALFORMED
            if not limit.allows_message(time.monotonic()):
                return _TOO_MANY_MESSAGES
        return None

    async def drain(self, handle: Handle) -> None:
        """Handle what a page that is about to be closed has sent already, and sends within a moment."""
        end = time.monotonic() + _CLOSE_TIME
        with contextlib.suppress(asyncio.TimeoutError):
            while time.monotonic() < end:
                message = await self._ws.receive(timeout=_LAST_WORDS)
                if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                    return
                with contextlib.suppress(ValueError):
                    handle(message.data if message.type is WSMsgType.TEXT else None)

    async def close(self, reason: CloseReason) -> None:
        """Close with this code and text; returns when the page has answered, after a second at the latest."""
        await _close(self._ws, reason)

    async def end(self) -> None:
        """Let the task that serves the page close it because the app ends; returns when it has.

        If another task closes it, aiohttp cuts the connection without waiting for the page's answer. A page that sends
        at that moment takes that for a broken network, and tries to connect for ever.
        """
        self.app_ended = True
        if self._receiving is not None:
            self._receiving.cancel()
        await self.closed.wait()


class PageSockets(ABC):
    """The WebSockets of one kind, one for each page."""

    def __init__(self, auth: Authenticator) -> None:
        self._auth = auth
        self._sockets: set[PageSocket] = set()
        self._refused = 0

    @abstractmethod
    async def serve(self, sock: PageSocket) -> None:
        """Serve one page until it is gone."""

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Handle a page's request for a socket, from its opening to its end."""
        if not self._auth.is_valid_token(request.headers.get("Sec-WebSocket-Protocol")):
            return await self._refuse(request)
        ws = await open_socket(request, heartbeat=PING_AFTER)
        transport = request.transport
        if len(self._sockets) >= MAX_PAGES:
            await _close(ws, _TOO_MANY_PAGES)
        elif transport is not None:
            sock = PageSocket(ws, transport)
            self._sockets.add(sock)
            try:
                with request.app[CONNECTIONS].exempt(transport):
                    await self.serve(sock)
                if sock.app_ended:
                    await sock.close(_APP_CLOSES)
            finally:
                self._sockets.discard(sock)
                sock.closed.set()
        return ws

    async def _refuse(self, request: web.Request) -> web.WebSocketResponse:
        # A page learns the reason from a socket's close code only, not from the answer to its handshake.
        if self._refused >= _MAX_REFUSED:
            raise web.HTTPForbidden(text="too many come with a wrong token\n")
        self._refused += 1
        try:
            ws = await open_socket(request)
            await _close(ws, _WRONG_TOKEN)
        finally:
            self._refused -= 1
        return ws

    def abort_stuck(self, now: float) -> None:
        """Abort every page that does not read what it is sent; ``now`` in s, monotonic."""
        for sock in self._sockets:
            if sock.sending_since is not None and now - sock.sending_since > _SEND_TIME:
                sock.abort()

    async def close(self) -> None:
        """Close every page's socket because the app ends."""
        if self._sockets:
            closing = [asyncio.ensure_future(sock.end()) for sock in self._sockets]
            await asyncio.wait(closing, timeout=_CLOSE_TIME)


async def open_socket(
    request: web.Request,
    heartbeat: float | None = None,
    protocols: Sequence[str] = (PROTOCOL,),
    max_bytes: int = MAX_BYTES,
) -> web.WebSocketResponse:
    """Answer the handshake of a page's WebSocket; HTTPBadRequest if it is none."""
    ws = web.WebSocketResponse(
        protocols=protocols,
        heartbeat=heartbeat,
        timeout=_CLOSE_TIME,
        compress=False,
        max_msg_size=max_bytes + 1,  # it refuses this many
        writer_limit=1,  # every send waits until the kernel has taken it
    )
    try:
        await ws.prepare(request)
    except (ConnectionError, ValueError):  # the page is gone, or its key is not ASCII
        raise web.HTTPBadRequest(text="this is no handshake of a WebSocket\n") from None
    return ws


async def _close(ws: web.WebSocketResponse, reason: CloseReason) -> None:
    code, text = reason
    with contextlib.suppress(ConnectionError):
        await ws.close(code=code, message=text)
