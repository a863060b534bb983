"""The 3D view on the page: viser's page and its socket, passed on from a server that listens for this process only.

viser accepts every connection. So it listens at a path in a folder of this user, and what reaches it from here came
through the checks of every request, and knows the secret that only the console's own pages are told.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import time
from collections.abc import Callable, Coroutine
from typing import Any

from aiohttp import ClientError, ClientSession, UnixConnector, WSMsgType, web

from .sockets import CONNECTIONS, MAX_PAGES, PING_AFTER, RateLimit, open_socket

STAGE_POLICY = (
    "default-src 'self' blob: data: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' blob: data: ws://{host}; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Content security policy of viser's page: it is one file, which compiles what it brings, and loads nothing else."""
_SERVER = "http://viser/"
_MAX_BYTES = 1 << 20
"""Longest message of a page; a drag has 200 bytes."""


class Stage:
    """Requests for the 3D view."""

    def __init__(self, address: str, path: str) -> None:
        """``address`` is that of the socket of viser's server, ``path`` the view's on this server; empty: none.

        A page appends its number to the path: what it drags counts while it is in control.
        """
        self._address = address
        self._path = path.encode()
        self._open = 0

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Answer with viser's page, or pass the messages of its socket on until one side is gone."""
        path, _, page = request.path.rstrip("/").rpartition("/")
        known = hmac.compare_digest(path.encode(errors="surrogateescape"), self._path)
        if not self._path or not known or not page.isdecimal():
            raise web.HTTPNotFound(text="there is no such view\n")
        try:
            async with ClientSession(connector=UnixConnector(self._address)) as viewer:
                if "Upgrade" in request.headers:
                    return await self._connect(request, viewer, page)
                async with viewer.get(_SERVER) as answer:
                    body = await answer.read()
                    return web.Response(body=body, status=answer.status, headers={"Content-Type": answer.content_type})
        except (ClientError, OSError):
            raise web.HTTPBadGateway(text="the 3D view has ended\n") from None

    async def _connect(self, request: web.Request, viewer: ClientSession, page: str) -> web.WebSocketResponse:
        transport = request.transport
        if self._open >= MAX_PAGES or not isinstance(transport, asyncio.Transport):
            raise web.HTTPServiceUnavailable(text="too many pages are open\n")
        offered = [name.strip() for name in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
        self._open += 1
        try:
            async with viewer.ws_connect(_SERVER + page, protocols=offered, max_msg_size=0) as far:
                near = await open_socket(request, PING_AFTER, offered, _MAX_BYTES)
                with request.app[CONNECTIONS].exempt(transport):
                    limit = RateLimit()
                    await _first(
                        _copy(far, near.send_bytes, lambda: True),
                        _copy(near, far.send_bytes, lambda: limit.allows_message(time.monotonic())),
                    )
                    await near.close()
                return near
        finally:
            self._open -= 1


async def _copy(source: Any, send: Callable[[bytes], Coroutine[Any, Any, None]], allows: Callable[[], bool]) -> None:
    """Pass on the messages of a socket until it ends, or sends what is not allowed."""
    with contextlib.suppress(ConnectionError):
        async for message in source:
            if message.type is not WSMsgType.BINARY or not allows():
                return
            await send(message.data)


async def _first(*works: Coroutine[Any, Any, None]) -> None:
    """Wait until one of them is done; the others are cancelled."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
