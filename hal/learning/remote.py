"""A policy on a server: the WebSocket protocol of openpi and RoboArena, as client and as server.

Messages are MessagePack maps in binary frames; arrays travel as raw bytes with a dtype and a shape. The server sends a
map of metadata first; then every request has one reply. A text frame is the server's error. RoboArena's servers
describe in their metadata what they need, and take a key ``endpoint`` in each request. Nothing is ever unpickled: what
comes over the wire becomes numbers, strings and arrays, or a :class:`~hal.errors.PolicyError`.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import ssl
import threading
import traceback
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

from ..errors import HalError, PolicyError, import_library
from ..keys import Credentials, find_credentials

T = TypeVar("T")
Message = dict[str, Any]

LARGEST = 64 << 20
"""Size of the largest message that is read, bytes."""
ALLOWED_KINDS = "fiub"
"""Kinds of NumPy types that are read from a message: floats, integers and booleans."""
CONNECT_TIMEOUT = 10.0
"""Longest wait for a connection, and then for the server's metadata, s."""


def pack(message: Mapping[str, Any]) -> bytes:
    """Return a message, a map of strings, numbers, lists, maps and arrays, as bytes."""
    packed: bytes = _msgpack().packb(message, default=_encode)
    return packed


def unpack(data: bytes) -> Any:
    """Return the content of a message. Its arrays are read-only.

    Raises:
        PolicyError: It is not MessagePack, or has an array of another type (code ``policy_protocol``).
    """
    try:
        return _msgpack().unpackb(data, object_hook=_decode, strict_map_key=False)
    except PolicyError:
        raise
    except Exception as error:  # the library raises a dozen kinds
        raise PolicyError(f"the server's message cannot be read: {error}", code="policy_protocol") from error


def _msgpack() -> Any:
    return import_library("msgpack", "a policy on a server", "robot-hal[policy]")


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _decode(value: dict[Any, Any]) -> Any:
    array, scalar = b"__ndarray__" in value, b"__npgeneric__" in value
    if not (array or scalar):
        return value
    kind = np.dtype(value[b"dtype"])
    if kind.kind not in ALLOWED_KINDS:
        raise PolicyError(f"the server sent an array of type {kind}, which is not read", code="policy_protocol")
    if scalar:
        return kind.type(value[b"data"])
    shape = tuple(int(size) for size in value[b"shape"])
    return np.frombuffer(value[b"data"], kind).reshape(shape)


class PolicyClient:
    """A connection to a policy's server; requests are sent and awaited in a thread of its own.

    A reply bears no number, so one request is under way at a time, and a connection whose reply did not come in time is
    closed instead of used again.
    """

    def __init__(self, url: str, *, api_key: str = "", timeout: float = 10.0) -> None:
        """Prepare a connection; :meth:`connect` opens it.

        Args:
            url: ``ws://host:port``, or ``wss://host:port`` with the certificate of ``hal keys``, if there is one here.
            api_key: Key that the server asks for; empty for none.
            timeout: Longest wait for a reply, s.

        Raises:
            DriverMissing: aiohttp or msgpack is not installed.
            NotSupported: The certificate here cannot be used, see :func:`~hal.keys.find_key`.
        """
        _msgpack(), _aiohttp()
        self.url = url
        self._credentials = find_credentials("person") if url.startswith("wss:") else None
        if self._credentials is not None:
            self._credentials.context.load_default_certs()  # servers with a certificate for the whole world
        self.timeout = timeout
        self.metadata: Message = {}
        """What the server sent on connecting."""
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else {}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="policy", daemon=True)
        self._thread.start()
        self._session: Any = None
        self._socket: Any = None
        self._next: asyncio.Future[Any] | None = None
        """The next message; awaited at all times, so that one that answers no request does not pass for a reply."""

    @property
    def connected(self) -> bool:
        """Whether the connection is open."""
        return self._socket is not None and not self._socket.closed

    def connect(self) -> Message:
        """Open the connection, unless it is open, and return the server's metadata.

        Raises:
            PolicyError: There is no server (code ``policy_unreachable``), or it speaks something else
                (``policy_protocol``).
        """
        if not self.connected:
            self._wait(self._connect(), 2.0 * CONNECT_TIMEOUT + 1.0)
        return self.metadata

    def request(self, message: Mapping[str, Any], timeout: float | None = None) -> Future[Any]:
        """Send a request, and return the future of its reply; ``timeout``, s, in place of the client's.

        A text is a reply, too: that to a reset, or an error (see :func:`check_actions`). The errors of the future are
        PolicyErrors: the server does not take the request and answer in time (code ``policy_timeout``), is gone
        (``policy_lost``), sends the traceback of an error (``policy_error``) or something else (``policy_protocol``).
        """
        return asyncio.run_coroutine_threadsafe(self._request(pack(message), timeout or self.timeout), self._loop)

    def close(self) -> None:
        """Close the connection and end the thread. Idempotent."""
        if not self._loop.is_closed():
            with contextlib.suppress(PolicyError):
                self._wait(self._disconnect(), 2.0)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(2.0)
            if not self._thread.is_alive():
                self._loop.close()

    def _wait(self, work: Coroutine[Any, Any, T], seconds: float) -> T:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(seconds)
        except FutureTimeoutError:
            future.cancel()
            raise PolicyError(f"{self.url} does not answer", code="policy_timeout") from None

    async def _connect(self) -> None:
        aiohttp = _aiohttp()
        await self._disconnect()
        self._session = aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_TIMEOUT))
        try:
            self._socket = await asyncio.wait_for(
                self._session.ws_connect(
                    self.url,
                    compress=0,
                    max_msg_size=LARGEST,
                    headers=self._headers,
                    ssl=True if self._credentials is None else self._credentials.context,
                ),
                CONNECT_TIMEOUT,
            )
        except (aiohttp.ClientError, OSError, ValueError, asyncio.TimeoutError) as error:
            await self._disconnect()
            if self._credentials is not None and (refusal := _find_tls_error(error)) is not None:
                lost = self._credentials.explain(refusal, self.url)
                raise PolicyError(str(lost), code=lost.code) from error
            cause = getattr(error, "os_error", None)  # of aiohttp, whose own text has its parameters
            reason = (cause and cause.strerror) or str(error) or "no answer"
            if self._credentials is not None and isinstance(error, (aiohttp.ServerDisconnectedError, ConnectionError)):
                reason += f" after the handshake. Has {self._credentials.file} expired, or another authority?"
            elif self._credentials is None and self.url.startswith("wss:"):
                reason += "; this user has no certificate of `hal keys`"
            raise PolicyError(f"no policy server at {self.url}: {reason}", code="policy_unreachable") from error
        self._listen()
        metadata = await self._receive(CONNECT_TIMEOUT)
        if not isinstance(metadata, dict):
            await self._disconnect()
            raise PolicyError(
                f"{self.url} begins with a {type(metadata).__name__} instead of its metadata", code="policy_protocol"
            )
        self.metadata = metadata

    async def _request(self, packed: bytes, timeout: float) -> Any:
        if not self.connected:
            raise PolicyError(f"the connection to {self.url} is closed", code="policy_lost")
        if self._next is not None and self._next.done():
            await self._receive(0.0)  # raises an error if the connection is lost
            await self._disconnect()
            raise PolicyError(f"{self.url} sent a message that answers no request", code="policy_protocol")
        end = self._loop.time() + timeout
        try:
            await asyncio.wait_for(self._socket.send_bytes(packed), timeout)
        except asyncio.TimeoutError:  # the buffers are full: a cable is pulled, or the server is frozen
            await self._disconnect()
            raise PolicyError(
                f"{self.url} did not take a request within {timeout:g} s", code="policy_timeout"
            ) from None
        except (OSError, RuntimeError) as error:
            await self._disconnect()
            raise PolicyError(f"the connection to {self.url} is lost: {error}", code="policy_lost") from error
        return await self._receive(end - self._loop.time())

    async def _receive(self, timeout: float) -> Any:
        aiohttp = _aiohttp()
        assert self._next is not None
        await asyncio.wait([self._next], timeout=timeout)
        if not self._next.done():
            await self._disconnect()
            raise PolicyError(f"{self.url} did not answer within {timeout:.1f} s", code="policy_timeout")
        message = self._next.result()
        if message.type is aiohttp.WSMsgType.BINARY:
            self._listen()
            try:
                return unpack(message.data)
            except PolicyError:
                await self._disconnect()
                raise
        if message.type is aiohttp.WSMsgType.TEXT:
            self._listen()
            # The server closes the connection after it; openpi's sends a traceback.
            if message.data.startswith(_ERROR) or "Traceback" in message.data:
                await self._disconnect()
                raise _server_error(message.data)
            return message.data
        await self._disconnect()
        raise PolicyError(f"the connection to {self.url} is lost", code="policy_lost")

    def _listen(self) -> None:
        self._next = asyncio.ensure_future(self._socket.receive())

    async def _disconnect(self) -> None:
        socket, session, listening = self._socket, self._session, self._next
        self._socket = self._session = self._next = None
        if listening is not None and not listening.done():
            listening.cancel()
            await asyncio.wait([listening], timeout=1.0)
        if socket is not None:
            with contextlib.suppress(Exception):
                await asyncio.wait_for(socket.close(), 1.0)
        if session is not None:
            with contextlib.suppress(Exception):
                await session.close()


_ERROR = "Error: "
"""Begin of the text in which a :class:`PolicyServer` reports an error, in one line."""


class PolicyServer:
    """Serves a function of a request, which is called once at a time; the other end of :class:`PolicyClient`.

    Example:
        Serve a policy of ten targets for each request, in a process of its own::

            with PolicyServer(lambda request: {"actions": np.tile(request["state"], (10, 1))}, port=8000) as server:
                server.wait()
    """

    def __init__(
        self,
        infer: Callable[[Message], Mapping[str, Any]],
        *,
        reset: Callable[[Message], None] | None = None,
        metadata: Mapping[str, Any] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        credentials: Credentials | None = None,
    ) -> None:
        """Prepare a server; :meth:`start`, or a ``with`` statement, starts it.

        Args:
            infer: Returns the reply to a request, a map with the key ``actions`` (steps, numbers).
            reset: Called for a request whose ``endpoint`` is ``reset``, which begins an episode; clients are told that
                they may ask for it (``resets`` in the metadata).
            metadata: What a client gets on connecting.
            host: Address to listen at.
            port: Port; 0 for a free one.
            credentials: ``Credentials("host")`` to encrypt, and answer only those who have a certificate.

        Raises:
            DriverMissing: aiohttp or msgpack is not installed.
        """
        _msgpack(), _aiohttp()
        self._credentials = credentials
        self._infer, self._reset = infer, reset
        self._metadata = dict(metadata or {}) | ({} if reset is None else {"resets": True})
        self._host, self.port = host, port
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="policy-server", daemon=True)
        self._runner: Any = None
        self._ended = threading.Event()
        self._computing = threading.Lock()
        """A client that connects again may ask while an answer for its last connection is computed."""

    @property
    def url(self) -> str:
        """Address for clients."""
        return f"ws{'s' if self._credentials else ''}://{self._host}:{self.port}"

    def start(self) -> PolicyServer:
        """Start to listen. Raises OSError if the port is taken."""
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(10.0)
        except BaseException:
            self.close()
            raise
        return self

    def wait(self) -> None:
        """Block until the server is closed."""
        self._ended.wait()

    def close(self) -> None:
        """Close every connection, and stop. Idempotent."""
        if not self._loop.is_closed():
            if self._thread.is_alive():
                if self._runner is not None:
                    with contextlib.suppress(Exception):
                        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result(5.0)
                self._loop.call_soon_threadsafe(self._loop.stop)
                self._thread.join(2.0)
            if not self._thread.is_alive():
                self._loop.close()
        self._ended.set()

    def __enter__(self) -> PolicyServer:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    async def _start(self) -> None:
        web = _aiohttp().web
        app = web.Application()
        app.router.add_get("/healthz", self._answer_health)
        app.router.add_get("/", self._serve)
        self._runner = web.AppRunner(app, shutdown_timeout=0.1)
        await self._runner.setup()
        context = None if self._credentials is None else self._credentials.context
        site = web.TCPSite(self._runner, self._host, self.port, ssl_context=context)
        await site.start()
        self.port = site._server.sockets[0].getsockname()[1]

    @staticmethod
    async def _answer_health(_: Any) -> Any:
        return _aiohttp().web.Response(text="OK")

    async def _serve(self, request: Any) -> Any:
        aiohttp = _aiohttp()
        if "Origin" in request.headers:  # a page in a browser, of this or of any other site: it cannot leave that out
            raise aiohttp.web.HTTPForbidden(text="a policy's server answers programs, not pages\n")
        socket = aiohttp.web.WebSocketResponse(compress=False, max_msg_size=LARGEST)
        await socket.prepare(request)
        if self._credentials is not None:
            try:
                self._credentials.check(request.transport.get_extra_info("peercert"))
            except HalError as error:
                await socket.send_str(f"{_ERROR}{error}")
                return socket
        await socket.send_bytes(pack(self._metadata))
        with contextlib.suppress(ConnectionResetError):  # the client left before its answer
            async for message in socket:
                if message.type is not aiohttp.WSMsgType.BINARY:
                    break
                try:
                    reply = await asyncio.get_running_loop().run_in_executor(None, self._reply, message.data)
                except Exception as error:
                    traceback.print_exc()  # for the one who runs the server; the client gets one line
                    await socket.send_str(_ERROR + f"{type(error).__name__}: {error}".splitlines()[0][:500])
                    await socket.close(code=aiohttp.WSCloseCode.INTERNAL_ERROR)
                    break
                await (socket.send_str(reply) if isinstance(reply, str) else socket.send_bytes(reply))
        return socket

    def _reply(self, data: bytes) -> bytes | str:
        request = unpack(data)
        if not isinstance(request, dict):
            raise PolicyError("a request is a map", code="policy_protocol")
        with self._computing:
            if request.pop("endpoint", "infer") == "reset":
                if self._reset is not None:
                    self._reset(request)
                return "reset successful"
            return pack(self._infer(request))


def _aiohttp() -> Any:
    found = import_library("aiohttp", "a policy on a server", "aiohttp")
    import_module("aiohttp.web")
    return found


def _find_tls_error(error: BaseException | None) -> ssl.SSLError | None:
    """Return the error of TLS that is behind one of aiohttp."""
    while error is not None:
        deeper = getattr(error, "certificate_error", None) or getattr(error, "os_error", None) or error.__cause__
        if isinstance(error, ssl.SSLError) and deeper is None:
            return error
        error = deeper
    return None


def _server_error(text: str) -> PolicyError:
    last = (text.strip().splitlines() or [""])[-1].removeprefix(_ERROR)
    return PolicyError(f"the policy's server reports: {last[:500]}", code="policy_error")


def check_actions(reply: Any, numbers: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the actions (steps, numbers) of a reply.

    Raises:
        PolicyError: The reply is the server's error (code ``policy_error``), or has no actions, of another shape or
            not finite (``policy_bad_actions``).
    """
    if isinstance(reply, str):
        raise _server_error(reply)
    found = reply.get("actions") if isinstance(reply, dict) else None
    if found is None:
        keys = ", ".join(map(str, reply)) if isinstance(reply, dict) else type(reply).__name__
        raise PolicyError(f"the policy's reply has no actions, only: {keys[:200]}", code="policy_bad_actions")
    try:
        actions = np.asarray(found, np.float64)
    except (TypeError, ValueError) as error:
        raise PolicyError(f"the policy's actions are no numbers: {error}", code="policy_bad_actions") from error
    if actions.ndim == 1:  # one action
        actions = actions[None]
    if actions.ndim == 3 and len(actions) == 1:  # a batch of one
        actions = actions[0]
    if actions.ndim != 2 or not len(actions) or actions.shape[1] != numbers:
        raise PolicyError(
            f"the policy answers with actions of the shape {actions.shape}; its configuration, with this "
            f"rig's arms, needs (steps, {numbers})",
            code="policy_bad_actions",
        )
    if not math.isfinite(float(actions.sum())):
        raise PolicyError("the policy's actions have a number that is not finite", code="policy_bad_actions")
    return actions
