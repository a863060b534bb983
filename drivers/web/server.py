"""The HTTP side: which addresses there are, who may ask for them, and the headers of every answer."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

from aiohttp import web

from hal.errors import DriverMissing, NotSupported

from .gatekeeper import Gatekeeper
from .live import Live
from .pictures import Pictures
from .sockets import VISITORS
from .visitors import Visitors

__all__ = ["listening", "make_app", "read_page"]

_PAGE = Path(__file__).parent / "page"
_INDEX = "index.html"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Server": "hal",
}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_BACKLOG = 64
_MORE_PORTS = 20

File = tuple[bytes, str]
"""What a file of the page holds, and its content type."""
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def read_page(folder: Path = _PAGE) -> dict[str, File]:
    """The files of the page, by name: the only ones that are ever served. DriverMissing where they are not."""
    if not (folder / _INDEX).is_file():
        raise DriverMissing(f"the console's page is not there: no {folder / _INDEX}; install the project again")
    return {
        path.name: (path.read_bytes(), _TYPES[path.suffix])
        for path in sorted(folder.iterdir())
        if path.suffix in _TYPES and path.is_file()
    }


def make_app(
    gatekeeper: Gatekeeper, visitors: Visitors, live: Live, pictures: Pictures, files: dict[str, File]
) -> web.Application:
    """The server's application."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        visitors.asked(request.transport, time.monotonic())
        host = request.headers.get("Host")
        if not gatekeeper.knows_host(host):
            raise web.HTTPMisdirectedRequest(text="this server has another name; open the link that it printed\n")
        if "Upgrade" in request.headers and not gatekeeper.is_own_page(request.headers.get("Origin"), host):
            raise web.HTTPForbidden(text="this page was not served by this server\n")
        return await handler(request)

    async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(_HEADERS)
        host = request.headers.get("Host")
        if gatekeeper.knows_host(host):
            response.headers["Content-Security-Policy"] = _POLICY.format(host=host)

    async def serve_file(request: web.Request) -> web.StreamResponse:
        found = files.get(request.match_info.get("name", _INDEX))
        if found is None:
            raise web.HTTPNotFound(text="there is no such file\n")
        body, content_type = found
        return web.Response(body=body, headers={"Content-Type": content_type})

    app = web.Application(middlewares=[check])
    app[VISITORS] = visitors
    app.on_response_prepare.append(add_headers)
    app.router.add_get("/", serve_file)
    app.router.add_get("/page/{name}", serve_file)
    app.router.add_get("/live", live.handle, allow_head=False)
    app.router.add_get("/pictures", pictures.handle, allow_head=False)
    return app


def listening(address: str, port: int, *, fixed: bool) -> socket.socket:
    """A socket that listens on ``address``; on the next free one of 20 ports where this one is taken, unless ``fixed``.

    Port 0 is any free one. Raises NotSupported where there is none.
    """
    last = port if fixed or port == 0 else min(port + _MORE_PORTS, 65535)
    for number in range(port, last + 1):
        try:
            return _listen(address, number)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and number < last:
                continue
            which = f"port {number}" if number == port else f"any of the ports {port} to {number}"
            reason = error.strerror or str(error)
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                reason += f"; is {address} an address of this machine?"
            raise NotSupported(f"the console cannot listen on {which} of {address}: {reason}") from None
    raise AssertionError("unreachable: the last port returns or raises")


def _listen(address: str, port: int) -> socket.socket:
    family, kind, protocol, _, place = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
    sock = socket.socket(family, kind, protocol)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(place)
        sock.listen(_BACKLOG)
        sock.setblocking(False)
    except OSError:
        sock.close()
        raise
    return sock
