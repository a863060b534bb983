"""The server in the console's process: HTTP routes, the live socket, the channel to the app, and the one loop.

:class:`ConsoleServer` puts the parts together. :func:`make_app` has the routes and the headers of every answer,
:class:`LiveSockets` is ``/live`` (pad, requests and stops from the page; states, notes and beats to it), and
:class:`AppChannel` is the channel to the app inside the event loop.
"""

from __future__ import annotations

import asyncio
import errno
import json
import os
import socket
import ssl
import time
import traceback
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from aiohttp import web

from hal.auth import Authenticator
from hal.errors import ConnectionLost, NotSupported
from hal.host.process import Channel, SharedMemory
from hal.host.ring import frame_rings
from hal.keys import Credentials
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import CameraSpec, from_json
from hal.types import BUTTONS, ONE_SIDED, PAGE_AXES
from hal.views import ACTIONS

from .messages import MalformedMessage, StopRequest, encode, parse
from .pictures import DEPTH_COLORS, UNKNOWN_COLOR, PictureCache, PictureSockets
from .session import WebPage, WebSession, make_app_queue
from .sockets import CONNECTIONS, ConnectionLimit, PageSocket, PageSockets
from .stage import STAGE_POLICY, Stage
from .telemetry import Telemetry

_STATE_PERIOD = 0.05
"""Time between two states, in s."""
_KERNEL_BYTES = 4096
"""Bytes that the kernel may keep for the app: a few pad messages, so that one that was stopped soon gets the newest."""
_BACKLOG = 64
_MORE_PORTS = 20
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
    "connect-src 'self' ws://{host}; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

PageFile = tuple[bytes, str]
"""Content of a file of the page, and its content type."""
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ConsoleServer:
    """Serves pages until the app closes it, the app is gone, or an unexpected error occurs."""

    def __init__(self, channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
        """Listen and prepare; the arguments are those of :func:`~.process.main`."""
        self._channel = channel
        address, port = config["listen"]
        self._address = str(address)
        self._socket = open_listener(self._address, int(port), fixed=bool(config["port_fixed"]))
        cameras = [from_json(CameraSpec, camera) for camera in config["cameras"]]
        pictures, *hosts = [memory.buffer for memory in memories]
        auth = Authenticator(config["token"], self._address, config["names"], bool(config["tls"]))
        self._tls = Credentials("host").context if config["tls"] else None
        if self._tls is not None:
            self._tls.verify_mode = ssl.CERT_NONE  # browsers have no certificate: the token in the link says who may
        self._telemetry = Telemetry(config["hosts"], hosts)
        self._app_channel = AppChannel(channel, self._receive_from_app)
        self._session = WebSession(config["rig"], self._app_channel.queue, self._app_channel.flush)
        self._live = LiveSockets(auth, self._session)
        cache = PictureCache(cameras, frame_rings(pictures, cameras))
        self._pictures = PictureSockets(auth, cache, self._send_watched)
        self._connections = ConnectionLimit()
        files = read_page_files() | {"keys.js": keys_module(config["keyboard"])}
        stage = Stage(config["viewer"], config["rig"]["stage"])
        self._app = make_app(auth, self._connections, self._live, self._pictures, stage, files)
        self._parent = os.getppid()

    async def run(self) -> None:
        """Serve until the end."""
        runner = web.AppRunner(self._app, access_log=None, handle_signals=False)
        await runner.setup()
        assert runner.server is not None
        self._channel.send({"ready": {"address": self._address, "port": self._socket.getsockname()[1]}})
        self._app_channel.start()
        accepting = asyncio.ensure_future(self._connections.accept_all(self._socket, runner.server, self._tls))
        sending = asyncio.ensure_future(self._send_states())
        ended = asyncio.ensure_future(self._app_channel.ended.wait())
        done, _ = await asyncio.wait((accepting, sending, ended), return_when=asyncio.FIRST_COMPLETED)
        accepting.cancel()
        self._socket.close()
        await asyncio.gather(self._live.close(), self._pictures.close())
        for task in done:
            task.result()  # raises the error that ended it

    def _receive_from_app(self, message: dict[str, Any]) -> None:
        method = message["method"]
        if method == "frame":
            self._pictures.frame_arrived(message["camera"])
        elif method == "close":
            self._app_channel.ended.set()
        else:
            self._session.receive_from_app(message)

    def _send_watched(self, cameras: list[str]) -> None:
        self._app_channel.queue.put_newest("watched", {"watched": cameras})
        self._app_channel.flush()

    async def _send_states(self) -> None:
        """Send a state every period while the app's process lives; missed periods are left out."""
        due = time.monotonic()
        while os.getppid() == self._parent:
            now = time.monotonic()
            late = round(now - due, 3)
            self._session.check_pad(now)
            self._live.abort_stuck(now)
            self._pictures.abort_stuck(now)
            self._connections.close_idle(now)
            if self._session.pages:
                self._session.send_state({"t": now, "late": late, **self._telemetry.snapshot(now)})
            due = max(due + _STATE_PERIOD, now)
            await asyncio.sleep(due - now)


class AppChannel:
    """Both directions of the channel to the app; nothing here ever waits, whatever the app does.

    To send, put a message into :attr:`queue`, then call :meth:`flush`.
    """

    def __init__(self, channel: Channel, receive: Callable[[dict[str, Any]], None]) -> None:
        """``receive`` is called with every message of the app, in the loop's thread."""
        self.queue = make_app_queue()
        self.ended = asyncio.Event()
        """Set when the app is gone."""
        self._channel = channel
        self._receive = receive
        self._unsent = b""
        self._loop: asyncio.AbstractEventLoop | None = None

    def start(self) -> None:
        """Read and write the channel in the running loop from now on."""
        sock = self._channel.sock
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL_BYTES)
        sock.setblocking(False)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._read)
        self.flush()

    def _read(self) -> None:
        try:
            while (message := self._channel.poll()) is not None:
                self._receive_safely(message)
        except ConnectionLost:
            self._end()

    def _receive_safely(self, message: dict[str, Any]) -> None:
        try:
            self._receive(message)
        except Exception:  # a message that cannot be passed on must not block the next one, nor a stop
            traceback.print_exc()

    def flush(self) -> None:
        """Send what waits, as far as the app takes it; the rest follows when it does."""
        if self._loop is None or self.ended.is_set():
            return
        try:
            while self._fill():
                self._unsent = self._unsent[self._channel.sock.send(self._unsent) :]
            self._loop.remove_writer(self._channel.sock)
        except BlockingIOError:
            self._loop.add_writer(self._channel.sock, self.flush)
        except OSError:
            self._end()

    def _fill(self) -> bool:
        """Return whether there is something to send."""
        if not self._unsent and (message := self.queue.pop()) is not None:
            self._unsent = encode(message).encode() + b"\n"
        return bool(self._unsent)

    def _end(self) -> None:
        if self._loop is not None:
            self._loop.remove_reader(self._channel.sock)
            self._loop.remove_writer(self._channel.sock)
        self.ended.set()


class LiveSockets(PageSockets):
    """``/live``: connects the sockets of pages with the session."""

    def __init__(self, auth: Authenticator, session: WebSession) -> None:
        super().__init__(auth)
        self._session = session

    async def serve(self, sock: PageSocket) -> None:
        page = self._session.open_page(overflow=sock.abort)
        sending = asyncio.ensure_future(page.queue.pump(sock.send))
        try:
            reason = await sock.receive_all(lambda text: self._receive(page, text))
            if reason is not None:
                self._session.close_page(page)
                await sock.drain(lambda text: self._receive_stop(page, text))
                await sock.close(reason)
        finally:
            self._session.close_page(page)
            sending.cancel()

    def _receive(self, page: WebPage, text: str | None) -> None:
        if text is None:
            raise MalformedMessage("not text")
        self._session.receive(page, text)

    def _receive_stop(self, page: WebPage, text: str | None) -> None:
        """Handle stops only: a stop counts however much else the page has sent."""
        if text is not None and isinstance(parse(text), StopRequest):
            self._session.stop(page)


def read_page_files(folder: Path = _PAGE) -> dict[str, PageFile]:
    """Return the files of the page by name; no other file is ever served."""
    return {
        path.name: (path.read_bytes(), _TYPES[path.suffix])
        for path in sorted(folder.iterdir())
        if path.suffix in _TYPES and path.is_file()
    }


def keys_module(table: Mapping[str, Any]) -> PageFile:
    """Return ``keys.js``, the module of the page with constants of this project: keys, axes, buttons, limits, colours.

    Args:
        table: The keys, a ``hal.pads.keyboard.KeyboardTable``.
    """
    constants = {
        "KEYS": table,
        "AXES": PAGE_AXES,
        "ONE_SIDED": [axis for axis in PAGE_AXES if axis in ONE_SIDED],
        "BUTTONS": BUTTONS,
        "ACTIONS": ACTIONS,
        "PAD_SILENCE": PAD_SILENCE,
        "DEPTH_COLORS": DEPTH_COLORS,
        "UNKNOWN_COLOR": UNKNOWN_COLOR,
    }
    text = "".join(f"export const {name} = {json.dumps(value)};\n" for name, value in constants.items())
    return text.encode(), _TYPES[".js"]


def make_app(
    auth: Authenticator,
    connections: ConnectionLimit,
    live: LiveSockets,
    pictures: PictureSockets,
    stage: Stage,
    files: dict[str, PageFile],
) -> web.Application:
    """Return the application: its routes, the checks of every request, the headers of every answer."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        connections.note_request(request.transport, time.monotonic())
        host = request.headers.get("Host")
        if not auth.is_known_host(host):
            raise web.HTTPMisdirectedRequest(text="this server has another name; open the link that it printed\n")
        if "Upgrade" in request.headers and not auth.is_own_origin(request.headers.get("Origin"), host):
            raise web.HTTPForbidden(text="this page was not served by this server\n")
        return await handler(request)

    async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(_HEADERS)
        host = request.headers.get("Host")
        if auth.is_known_host(host):
            policy = STAGE_POLICY if request.path.startswith("/3d/") else _POLICY
            sockets = "wss://" if request.secure else "ws://"
            response.headers["Content-Security-Policy"] = policy.format(host=host).replace("ws://", sockets)

    async def serve_file(request: web.Request) -> web.StreamResponse:
        found = files.get(request.match_info.get("name", _INDEX))
        if found is None:
            raise web.HTTPNotFound(text="there is no such file\n")
        body, content_type = found
        return web.Response(body=body, headers={"Content-Type": content_type})

    app = web.Application(middlewares=[check])
    app[CONNECTIONS] = connections
    app.on_response_prepare.append(add_headers)
    app.router.add_get("/", serve_file)
    app.router.add_get("/page/{name}", serve_file)
    app.router.add_get("/live", live.handle, allow_head=False)
    app.router.add_get("/pictures", pictures.handle, allow_head=False)
    app.router.add_get("/3d/{path:.*}", stage.handle, allow_head=False)
    return app


def open_listener(address: str, port: int, *, fixed: bool) -> socket.socket:
    """Return a socket that listens at an address.

    Args:
        address: Address of an interface of this machine.
        port: Preferred port; if it is taken, the next free one of 20. 0 is any free one.
        fixed: Use no other port than ``port``.

    Raises:
        NotSupported: No port is free (``port_taken``), or the address is not one of this machine's (``bad_address``).
    """
    last = port if fixed or port == 0 else min(port + _MORE_PORTS, 65535)
    for number in range(port, last + 1):
        try:
            family = socket.getaddrinfo(address, number, type=socket.SOCK_STREAM)[0][0]
            dual = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
            sock = socket.create_server((address, number), family=family, backlog=_BACKLOG, dualstack_ipv6=dual)
            sock.setblocking(False)
            return sock
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE
            if taken and number < last:
                continue
            which = f"port {number}" if number == port else f"any of the ports {port} to {number}"
            reason = (error.strerror or str(error)).partition(" (while")[0]
            foreign = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
            if foreign:
                reason += f"; is {address} an address of this machine?"
            code = "port_taken" if taken else "bad_address" if foreign else "cannot_listen"
            raise NotSupported(f"the console cannot listen on {which} of {address}: {reason}", code=code) from None
    raise AssertionError("unreachable: the last port returns or raises")
