"""viser's server, restricted to the user of this machine. viser itself accepts every connection to its port.

The port is bound to loopback, which excludes other machines, but neither other users of this one nor other pages in the
user's browser. What is accepted is decided as for the console (:mod:`hal.auth`). Only the way of the token differs,
since viser's page cannot send it with its WebSocket: it is in the link, which is exchanged for a cookie.
"""

from __future__ import annotations

import hashlib
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

from hal.auth import Authenticator
from hal.errors import HalError

HOST = "127.0.0.1"
_REFUSED = "This page opens only by the link that the program printed.\n"

Handler = Callable[[ServerConnection, Request], Response | Awaitable[Response | None] | None]


class GuardedServer(viser.ViserServer):
    """A viser server that is reachable on this machine only."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: any page may request this tunnel, which would expose the arm to the internet."""


def start_server(port: int, label: str, secret: str) -> GuardedServer:
    """Start a server on the first free port from ``port`` on that accepts only requests with the secret.

    Args:
        port: The first port to try.
        label: Title of the page.
        secret: Value of ``token`` in the link.

    Raises:
        HalError: The installed viser cannot be restricted in this way (code ``viser_not_guarded``).
    """
    original = websockets.asyncio.server.serve

    @wraps(original)
    def guarded(*args: Any, process_request: Handler, **options: Any) -> Any:
        return original(*args, process_request=_guard(secret, process_request), **options)

    # viser has no setting for this. It finds the function in its module, and calls it in its constructor.
    websockets.asyncio.server.serve = guarded  # type: ignore[misc,assignment]
    try:
        server = GuardedServer(host=HOST, port=port, label=label, verbose=False)
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]
    if server.get_host() != HOST or _status(server.get_port(), "/") != http.HTTPStatus.FORBIDDEN:
        server.stop()
        raise HalError(
            f"viser {viser.__version__} does not keep other users out; install viser 1.1", code="viser_not_guarded"
        )
    return server


def _status(port: int, path: str) -> int:
    """Return the status of a request without the secret."""
    connection = http.client.HTTPConnection(HOST, port, timeout=5.0)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    finally:
        connection.close()


def _guard(secret: str, handler: Handler) -> Handler:
    """Return ``handler`` for requests with the secret, and a refusal for others."""
    auth = Authenticator(secret, HOST, ())
    # Cookies do not distinguish ports, so each server has its own name for its cookie.
    name = f"robot_hal_{hashlib.sha256(secret.encode()).hexdigest()[:8]}"

    def guarded(connection: ServerConnection, request: Request) -> Any:
        refused = connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSED)
        host, known = request.headers.get("Host"), auth.is_token(_cookie(request, name))
        if not auth.is_known_host(host):
            return refused
        if "Upgrade" in request.headers:
            own = auth.is_own_origin(request.headers.get("Origin"), host)
            return handler(connection, request) if own and known else refused
        token = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not known and not auth.is_token(token):
            return refused
        response = handler(connection, request)
        if isinstance(response, Response):
            response.headers["Set-Cookie"] = f"{name}={secret}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    return guarded


def _cookie(request: Request, name: str) -> str:
    with suppress(CookieError, KeyError):
        return SimpleCookie("; ".join(request.headers.get_all("Cookie")))[name].value
    return ""
