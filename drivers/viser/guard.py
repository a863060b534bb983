"""viser's server, for this machine's user only. By itself viser lets in whoever reaches its port.

The port is bound to loopback, which keeps other machines out, but neither other users of this one nor any page that
the user's browser happens to show. So a page must come by the link with the secret, which it trades for a cookie, and
only a page of this server's own may open the connection that carries poses and drags.
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import wraps
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from hal.errors import HalError

__all__ = ["HOST", "Server", "serve"]

HOST = "127.0.0.1"
_HOSTS = ("127.0.0.1", "localhost", "[::1]")
"""Names by which a browser may know this machine; a forwarded port keeps them, a hostile name server does not."""
_REFUSED = "This page opens only by the link that the program printed.\n"

Answer = Callable[[ServerConnection, Request], Response | Awaitable[Response | None] | None]


class Server(viser.ViserServer):
    """A viser server that stays on this machine."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Never: any page may ask for this tunnel, and it would put the arm on the internet."""


def serve(port: int, label: str, secret: str) -> Server:
    """A server on the first free port from ``port`` on, which lets in only who knows the secret.

    Raises HalError when the installed viser goes other ways than the ones that are guarded here.
    """
    original = websockets.asyncio.server.serve

    @wraps(original)
    def guarded(*args: Any, process_request: Answer, **options: Any) -> Any:
        return original(*args, process_request=_guard(secret, process_request), **options)

    # viser has no setting for this. It looks the function up in its module, and has called it when it is constructed.
    websockets.asyncio.server.serve = guarded  # type: ignore[misc,assignment]
    try:
        server = Server(host=HOST, port=port, label=label, verbose=False)
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]
    if server.get_host() != HOST or _status(server.get_port(), "/") != http.HTTPStatus.FORBIDDEN:
        server.stop()
        raise HalError(f"viser {viser.__version__} cannot be guarded; install a version that is known to work")
    return server


def _status(port: int, path: str) -> int:
    """What the server answers to somebody who does not know the secret."""
    connection = http.client.HTTPConnection(HOST, port, timeout=5.0)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    finally:
        connection.close()


def _guard(secret: str, answer: Answer) -> Answer:
    """The answer, for those who may have it."""
    # Cookies do not tell ports apart: each server has a name of its own for its one.
    name = f"robot_hal_{hashlib.sha256(secret.encode()).hexdigest()[:8]}"

    def guarded(connection: ServerConnection, request: Request) -> Any:
        refused = connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSED)
        if _port_free(request.headers.get("Host", "")) not in _HOSTS:
            return refused
        if request.headers.get("Upgrade", "").lower() == "websocket":
            origin = request.headers.get("Origin")
            same = origin is None or origin == f"http://{request.headers['Host']}"
            return answer(connection, request) if same and _same(_cookie(request, name), secret) else refused
        asked = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not _same(asked, secret) and not _same(_cookie(request, name), secret):
            return refused
        response = answer(connection, request)
        if isinstance(response, Response):
            response.headers["Set-Cookie"] = f"{name}={secret}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    return guarded


def _port_free(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdigit() else host


def _cookie(request: Request, name: str) -> str:
    with suppress(CookieError, KeyError):
        return SimpleCookie("; ".join(request.headers.get_all("Cookie")))[name].value
    return ""


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())
