"""Child processes that start alike from a script, a notebook, standard input, the REPL and any thread.

A child is a fresh, isolated interpreter (``Popen``, never multiprocessing), in a session of its own so that Ctrl-C and
Ctrl-Z of the terminal do not reach it. It shares with the app memory that has no name and one socket, both passed by
descriptor: nothing can be left behind, whichever process is killed.

The app's side is :class:`Child`: it starts the process, sends requests and ends it. The child's side is a function that
reports when it is ready and then calls :func:`serve`.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from .. import errors
from ..errors import ConnectionLost, HalError, NotSupported, Problem
from ..lock import APP_MARK
from . import records

_BOOT = (
    "import sys, json, site; fds, path, target, library = json.loads(sys.argv[1]); "
    "sys.path += [p for p in path if p not in sys.path]; site.main(); "
    "from hal.host.process import child_main; child_main(target, fds, library)"
)
"""Program of a child: Python's own modules come first, then the app's path in its order, then what ``site`` adds."""
_OPTIONS = ("-I", "-S", "-u", "-c")
START_TIMEOUT = 60.0
"""Longest time that a child may take to get ready, s: reading a large mesh for the first time takes a while."""
REQUEST_TIMEOUT = 30.0
"""Longest time that an answer may take, s, unless a request names another."""
STOP_LIMIT = 5.0
"""Longest time for bringing the arms to rest before the devices are closed anyway, s."""
_GOODBYE = 0.5
"""A child that does not take the message that ends it within so long, s, is stopped or hangs."""
_SLICE = 0.2
"""s that a thread waits for an answer before it checks that the child is alive."""
_REAPED = 1.0
"""s after which a process that has closed its connection has ended, too."""
_SIGNALS: dict[int, str] = {
    signal.SIGKILL: "; if no one sent it, the memory may have run out: see dmesg",
    signal.SIGALRM: ": a library did not return",
}
"""What a signal that ends a process means."""
_IDLE = 0.5
"""s that :func:`serve` waits for a message before it checks that the app is alive."""


def _library() -> tuple[str, int]:
    """Return which copy of this library a process runs: its folder, and the layout of its shared memory."""
    return os.path.realpath(os.path.dirname(errors.__file__)), records.LAYOUT


def _describe_status(status: int) -> str:
    """Return an exit status as text; one below 0 is the number of the signal that ended the process."""
    names = {-number: number.name for number in signal.Signals}
    return names.get(status, f"status {status}") + _SIGNALS.get(-status, "")


def end_by_signal(number: int) -> None:
    """End this process by a signal that it has caught, so that its parent sees which one it was."""
    sys.stdout.flush()
    sys.stderr.flush()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


class ChannelClosed(ConnectionLost):
    """The other process closed the connection; a child then ends."""


def fill_standard_descriptors() -> None:
    """Open descriptors 0 to 2 on the null device where a program was started without them.

    Otherwise memory and sockets would get these numbers, and every child that has its own standard streams would lose
    them.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


class SharedMemory:
    """Zeroed memory without a name, shared by passing its descriptor."""

    def __init__(self, size: int = 0, fd: int | None = None) -> None:
        """Create ``size`` bytes, or map those behind the descriptor ``fd``."""
        self._owner = os.getpid() if fd is None else 0
        if fd is None:
            fill_standard_descriptors()
            fd = self._create()
            os.ftruncate(fd, max(size, 1))
        self.fd = fd
        self.size = os.fstat(fd).st_size
        self._map = mmap.mmap(fd, self.size)
        self.buffer = memoryview(self._map)

    @staticmethod
    def _create() -> int:
        if hasattr(os, "memfd_create"):
            return os.memfd_create("hal", os.MFD_CLOEXEC)
        with tempfile.TemporaryFile() as file:  # unlinked at once; lives as long as a descriptor
            return os.dup(file.fileno())

    def close(self) -> None:
        """Close the descriptor; the process that created the memory frees it, and every view then reads zeros."""
        if self.fd >= 0:
            if self._owner == os.getpid() and hasattr(mmap, "MADV_REMOVE"):  # the map itself ends with the last view
                self._map.madvise(mmap.MADV_REMOVE)
            os.close(self.fd)
            self.fd = -1


class Channel:
    """Messages (JSON, one per line) over a socket, both ways. One thread receives; any thread sends."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self._out = sock.dup()  # has a time limit of its own
        self._pending = b""
        self._sending = threading.Lock()

    def send(self, message: Any, timeout: float = REQUEST_TIMEOUT) -> None:
        """Send one message.

        Raises:
            ChannelClosed: If the other process is gone, or does not take the message within ``timeout`` s.
        """
        data = json.dumps(message).encode() + b"\n"
        try:
            with self._sending:
                self._out.settimeout(timeout)
                self._out.sendall(data)
        except OSError as error:
            raise ChannelClosed(f"the other process is gone: {error}") from None

    def send_if_free(self, message: Any) -> bool:
        """Send one short message unless the other process is behind; never waits. Returns whether it was sent.

        Raises:
            ChannelClosed: If the other process is gone.
        """
        data = json.dumps(message).encode() + b"\n"
        try:
            with self._sending:
                if self._out.gettimeout() != 0.0:
                    self._out.settimeout(0.0)
                sent = self._out.send(data)
                if sent < len(data):  # the other side must not see half a message
                    self._out.settimeout(REQUEST_TIMEOUT)
                    self._out.sendall(data[sent:])
        except BlockingIOError:
            return False
        except OSError as error:
            raise ChannelClosed(f"the other process is gone: {error}") from None
        return True

    def poll(self) -> Any | None:
        """Return a message if there is one; never waits. Raises ChannelClosed if the other process is gone."""
        return self._receive_line(0.0)

    def poll_all(self) -> list[Any]:
        """Return all messages that have come; never waits. Raises ChannelClosed like :meth:`poll`."""
        messages = [self._receive_line(0.0)]
        while b"\n" in self._pending:
            messages.append(self._receive_line(0.0))
        return messages

    def receive(self, timeout: float) -> Any | None:
        """Return the next message; None if none came within ``timeout`` s. Raises ChannelClosed like :meth:`poll`."""
        deadline = time.monotonic() + timeout
        while True:
            message = self._receive_line(max(0.0, deadline - time.monotonic()))
            if message is not None or time.monotonic() >= deadline:
                return message

    def _receive_line(self, timeout: float) -> Any | None:
        if b"\n" not in self._pending:
            try:
                if timeout != self.sock.gettimeout():  # which costs a call of the system
                    self.sock.settimeout(timeout)
                data = self.sock.recv(1 << 16)
            except (BlockingIOError, TimeoutError):
                return None
            except OSError as error:
                raise ChannelClosed(f"the other process is gone: {error}") from None
            if not data:
                raise ChannelClosed("the other process closed the connection")
            self._pending += data
            if b"\n" not in self._pending:
                return None
        line, self._pending = self._pending.split(b"\n", 1)
        return json.loads(line)

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self.sock.close()
        self._out.close()


def pack_error(error: BaseException) -> dict[str, Any]:
    """Return an error as plain data, from which :func:`unpack_error` makes the same error in the other process."""
    known = type(error).__name__ if isinstance(error, HalError) else "HalError"
    text = str(error) if isinstance(error, HalError) else f"{type(error).__name__}: {error}"
    attributes = {key: value for key, value in vars(error).items() if isinstance(value, (str, int, float))}
    problems = [[p.file, p.key, p.message, p.code] for p in getattr(error, "problems", ())]
    return {"type": known, "text": text, "attributes": attributes, "problems": problems}


def unpack_error(data: dict[str, Any]) -> HalError:
    """Return the error that :func:`pack_error` packed."""
    cls = getattr(errors, data["type"], HalError)
    error: HalError = cls.__new__(cls)
    Exception.__init__(error, data["text"])
    vars(error).update(data["attributes"])
    if data["problems"]:
        vars(error)["problems"] = tuple(Problem(*problem) for problem in data["problems"])
    return error


class Child:
    """A process that answers requests and shares memory with this one. Any thread may call any method."""

    def __init__(
        self,
        name: str,
        target: str,
        config: Any,
        memories: Sequence[SharedMemory] = (),
        on_message: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        """Start the process.

        Args:
            name: For error messages.
            target: ``module:function``, called in the child with (channel, memories, config). It sends
                ``{"ready": value}`` when it is; the value is kept in :attr:`ready`.
            config: Plain data (JSON).
            memories: Memory that both processes map.
            on_message: Called with every message that is no answer, from the thread that happens to receive it, which
                is one in :meth:`request` or :meth:`listen`. Without it such messages are dropped.
        """
        self.name = name
        self._on_message = on_message
        self._listening = threading.Lock()
        self._numbering = threading.Lock()
        self._number = 0
        self._answers: dict[int | None, dict[str, Any]] = {}
        """By the number of the request; ``ready`` and a failure of the process have none."""
        self._waiting: set[int | None] = set()
        fill_standard_descriptors()
        ours, theirs = socket.socketpair()
        self.channel = Channel(ours)
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # closed by close()
        fds = [theirs.fileno(), *(memory.fd for memory in memories)]
        path = [os.path.abspath(entry) for entry in sys.path]
        self.process = subprocess.Popen(
            [sys.executable, *_OPTIONS, _BOOT, json.dumps([fds, path, target, _library()]), f"{APP_MARK}{os.getpid()}"],
            pass_fds=fds,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            start_new_session=True,
        )
        theirs.close()
        self.ready: Any = None
        self._started = self._closing = False
        try:
            self.channel.send(config)
        except ConnectionLost:
            self._wait_end(_REAPED)
            self.check()
            raise

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    @property
    def busy(self) -> bool:
        """Whether a request of this process waits for its answer."""
        return bool(self._waiting)

    def wait_ready(self, timeout: float = START_TIMEOUT) -> Any:
        """Wait until the child is ready, and return what it reports. Raises the error that stopped its start."""
        self.ready = self._wait_answer(None, timeout, "get ready")["ready"]
        self._started = True
        return self.ready

    def check(self) -> None:
        """Raise ConnectionLost, with how the child ended and the last lines that it printed, if it has ended."""
        status = self.process.poll()
        if status is not None:
            when = "" if self._started else " while it started"
            text = f"the {self.name} process ended{when} ({_describe_status(status)}){self._tail()}"
            raise ConnectionLost(text, code="process_ended")

    def request(self, method: str, params: dict[str, Any] | None = None, timeout: float = REQUEST_TIMEOUT) -> Any:
        """Send a request and return its answer.

        Raises:
            ConnectionLost: With code ``process_ended`` if the child has ended, ``process_silent`` if no answer came
                within ``timeout`` s.
            HalError: Whatever the child's method raised.
        """
        return self.wait_result(self.send_request(method, params, timeout), method, timeout)

    def send_request(self, method: str, params: dict[str, Any] | None = None, timeout: float = REQUEST_TIMEOUT) -> int:
        """Send a request, and return its number for :meth:`wait_result`. Raises as :meth:`request`."""
        with self._numbering:
            self._number = number = self._number + 1
            self._waiting.add(number)
        try:
            self.check()
            self.channel.send({"id": number, "method": method, "params": params or {}}, timeout)
        except BaseException as error:
            self._waiting.discard(number)
            if isinstance(error, ConnectionLost):
                self.raise_last_error()
            raise
        return number

    def wait_result(self, number: int, method: str, timeout: float = REQUEST_TIMEOUT) -> Any:
        """Return the answer to a request that was sent. Raises as :meth:`request`."""
        try:
            return self._wait_answer(number, timeout, f"answer {method!r}")["result"]
        finally:
            self._waiting.discard(number)
            self._answers.pop(number, None)

    def notify(self, method: str, params: dict[str, Any] | None = None, timeout: float = REQUEST_TIMEOUT) -> None:
        """Send a message that has no answer. Raises ChannelClosed if the child does not take it in ``timeout`` s."""
        self.channel.send({"method": method, "params": params or {}}, timeout)

    def listen(self, timeout: float) -> bool:
        """Receive one message and pass it to ``on_message``, or to the request that waits for it.

        Returns:
            Whether one came within ``timeout`` s. False, too, if another thread receives all that time.

        Raises:
            ConnectionLost: If the child has ended.
        """
        return self._listen(timeout)

    def _listen(self, timeout: float, answered: Callable[[], object] | None = None) -> bool:
        """Receive one message, unless ``answered`` returns that another thread has received the answer."""
        if not self._listening.acquire(timeout=max(timeout, 1e-3)):
            return False
        try:
            if answered is not None and answered():
                return True
            message = self.channel.receive(timeout)
            if message is None:
                self.check()
                return False
            self._sort(message)
        except ChannelClosed:
            self._wait_end(_REAPED)
            self.check()
            raise
        finally:
            self._listening.release()
        return True

    def _sort(self, message: dict[str, Any]) -> None:
        """Keep an answer for its request; pass everything else on."""
        number = message.get("id")
        if number is not None:
            if number in self._waiting:
                self._answers[number] = message
        elif "ready" in message or "error" in message:
            self._answers[None] = message
        elif self._on_message is not None:
            self._on_message(message)

    def _answer(self, number: int | None) -> dict[str, Any] | None:
        """Return the answer to a request, or the error with which the process failed; None while there is neither."""
        outcome = self._answers.get(None, {})
        return self._answers.get(number) or (outcome if "error" in outcome else None)

    def _wait_answer(self, number: int | None, timeout: float, task: str) -> dict[str, Any]:
        deadline = time.monotonic() + timeout
        while True:
            answer = self._answer(number)
            if answer is not None:
                if "error" in answer:
                    raise unpack_error(answer["error"])
                return answer
            left = deadline - time.monotonic()
            if not self._listen(min(_SLICE, max(0.0, left)), partial(self._answer, number)) and left <= 0.0:
                raise ConnectionLost(
                    f"the {self.name} process did not {task} within {timeout:g} s{self._tail()}", code="process_silent"
                )

    def raise_last_error(self) -> None:
        """Raise the error that ended the process, if it sent one that was not read yet."""
        with contextlib.suppress(ConnectionLost):
            while self._listen(0.0):
                pass
        failure = self._answer(None)
        if failure is not None and "error" in failure:
            raise unpack_error(failure["error"])

    def _wait_end(self, timeout: float) -> bool:
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def _tail(self) -> str:
        """Return the last lines that the child printed, for an error message."""
        if self._log.closed:
            return ""
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - 2000))
        lines = self._log.read().decode(errors="replace").strip().splitlines()[-8:]
        return "; its last output:\n    " + "\n    ".join(lines) if lines else ""

    def request_close(self) -> None:
        """Make the child end, without waiting for it."""
        if not self._closing and self.is_alive:
            self._closing = True
            with contextlib.suppress(ConnectionLost):
                self.channel.send({"id": 0, "method": "close", "params": {}}, _GOODBYE)

    def close(self, timeout: float = 5.0) -> None:
        """Make the child end, and wait for it; kill it if it has not ended within ``timeout`` s. Idempotent."""
        self.request_close()
        if not self._wait_end(timeout):
            self.process.kill()
            self._wait_end(timeout)
        self.channel.close()
        self._log.close()


def serve(
    channel: Channel,
    methods: Mapping[str, Callable[..., Any]],
    between: Callable[[], float | None] | None = None,
    timeout: float = REQUEST_TIMEOUT,
) -> None:
    """Serve the app's requests, in a child, until the app closes this process or is gone.

    A message ``{"id": n, "method": name, "params": {...}}`` calls ``methods[name](**params)``; the result of that call,
    or its error, is sent back. A message without ``id`` has no answer; an error in it ends this function.

    Args:
        channel: The connection to the app.
        methods: By their names.
        between: Called when no message waits; returns the longest time to wait for the next one, s, or None to end.
        timeout: An app that does not take an answer for so long, s, counts as gone.
    """
    parent = os.getppid()
    try:
        while os.getppid() == parent:
            wait = _IDLE if between is None else between()
            if wait is None:
                return
            message = channel.receive(wait)
            while message is not None:
                if message["method"] == "close":
                    return
                _serve_message(channel, methods, message, timeout)
                message = channel.poll()
    except ChannelClosed:
        return


def _serve_message(
    channel: Channel, methods: Mapping[str, Callable[..., Any]], message: dict[str, Any], timeout: float
) -> None:
    name, number = message["method"], message.get("id")
    try:
        if name not in methods:
            raise NotSupported(f"no request {name!r}", code="no_such_request")
        answer = {"result": methods[name](**message["params"])}
    except Exception as error:
        if number is None:
            raise
        answer = {"error": pack_error(error)}
    if number is not None:
        channel.send({"id": number, **answer}, timeout)


def child_main(target: str, fds: Sequence[int], library: Sequence[Any]) -> None:
    """Run a child: call the target, report an error that it raises, end without interpreter tear-down."""
    channel = Channel(socket.socket(fileno=fds[0]))
    status = 0
    try:
        own = _library()
        if own != tuple(library):
            folders = f"the app runs {library[0]}, this process {own[0]}"
            changed = folders if own[0] != library[0] else f"{own[0]} has changed since the app started"
            raise NotSupported(f"app and servo must be one copy of hal: {changed}", code="version_mismatch")
        memories = [SharedMemory(fd=fd) for fd in fds[1:]]
        config = channel.receive(START_TIMEOUT)
        module, _, function = target.partition(":")
        main: Callable[..., None] = getattr(__import__(module, fromlist=[function]), function)
        main(channel, memories, config)
    except ChannelClosed:
        pass
    except KeyboardInterrupt:
        end_by_signal(signal.SIGINT)
    except BaseException as error:
        status = 1
        traceback.print_exc()
        with contextlib.suppress(ConnectionLost):
            channel.send({"error": pack_error(error)})
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # libraries that complain while the interpreter is torn down stay silent
