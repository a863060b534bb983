"""Child processes that start alike from a script, a notebook, standard input, the REPL and any thread.

A child is a fresh, isolated interpreter (``Popen``, never multiprocessing), in a session of its own so that Ctrl-C and
Ctrl-Z of the terminal do not reach it. What it shares with the app are memory that has no name and one socket, both
passed by descriptor: nothing can be left behind, whoever is killed.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

from .. import errors
from ..errors import ConnectionLost, HalError, Problem

__all__ = ["Channel", "ChannelClosed", "Child", "SharedMemory", "child_main", "fill_standard_descriptors"]

_BOOT = (
    "import sys, json; fds, path, target = json.loads(sys.argv[1]); "
    "sys.path.extend(p for p in path if p not in sys.path); "
    "from hal.host.process import child_main; child_main(target, fds)"
)
START_TIMEOUT = 60.0
"""Longest time that a child may take to get ready, s: reading a large mesh for the first time takes a while."""
REQUEST_TIMEOUT = 30.0
GOODBYE = 0.5
"""A child that does not take the word that it should end within so long, s, is stopped or hangs."""


class ChannelClosed(ConnectionLost):
    """The other process hung up: for a child, the end of its work."""


def fill_standard_descriptors() -> None:
    """Open descriptors 0 to 2 on the null device where a program was started without them.

    Memory and sockets would get these numbers, and every child that has its own standard streams would lose them.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


class SharedMemory:
    """Zeroed memory without a name, shared by passing its descriptor."""

    def __init__(self, size: int = 0, fd: int | None = None) -> None:
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
        """Close the descriptor. The map itself goes when the last view of it does."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


class Channel:
    """Messages (JSON, one a line) over a socket, both ways."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self._pending = b""
        self._sending = threading.Lock()

    def send(self, message: Any, timeout: float = REQUEST_TIMEOUT) -> None:
        """Send one message. ConnectionLost when the other side is gone, or does not take it within ``timeout`` s."""
        data = json.dumps(message).encode() + b"\n"
        try:
            with self._sending:
                self.sock.settimeout(timeout)
                self.sock.sendall(data)
        except OSError as error:
            raise ChannelClosed(f"the other process is gone: {error}") from None

    def poll(self) -> Any | None:
        """A message if one is there; never waits. ConnectionLost when the other side is gone."""
        return self._take(0.0)

    def receive(self, timeout: float) -> Any | None:
        """The next message; None when none came within ``timeout`` s."""
        deadline = time.monotonic() + timeout
        while True:
            message = self._take(max(0.0, deadline - time.monotonic()))
            if message is not None or time.monotonic() >= deadline:
                return message

    def _take(self, timeout: float) -> Any | None:
        if b"\n" not in self._pending:
            self.sock.settimeout(timeout)
            try:
                data = self.sock.recv(1 << 20)
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
        """Hang up. Idempotent."""
        self.sock.close()


def pack_error(error: BaseException) -> dict[str, Any]:
    """An error as JSON, so that the app can raise the same one."""
    known = type(error).__name__ if isinstance(error, HalError) else "HalError"
    text = str(error) if isinstance(error, HalError) else f"{type(error).__name__}: {error}"
    attributes = {key: value for key, value in vars(error).items() if isinstance(value, (str, int, float))}
    problems = [[p.file, p.key, p.message, p.code] for p in getattr(error, "problems", ())]
    return {"type": known, "text": text, "attributes": attributes, "problems": problems}


def unpack_error(data: dict[str, Any]) -> HalError:
    """The error that :func:`pack_error` packed."""
    cls = getattr(errors, data["type"], HalError)
    error: HalError = cls.__new__(cls)
    Exception.__init__(error, data["text"])
    vars(error).update(data["attributes"])
    if data["problems"]:
        vars(error)["problems"] = tuple(Problem(*problem) for problem in data["problems"])
    return error


class Child:
    """A process that serves requests and shares memory with this one.

    ``target`` names a function ``module:function`` that is called there with (channel, memories, configuration). It
    says ``{"ready": ...}`` when it is; the value is kept in :attr:`ready`.
    """

    def __init__(self, name: str, target: str, config: Any, memories: Sequence[SharedMemory] = ()) -> None:
        self.name = name
        self._asking = threading.Lock()
        self._number = 0
        fill_standard_descriptors()
        ours, theirs = socket.socketpair()
        self.channel = Channel(ours)
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # closed by close()
        fds = [theirs.fileno(), *(memory.fd for memory in memories)]
        path = [os.path.abspath(entry) for entry in sys.path]
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-u", "-c", _BOOT, json.dumps([fds, path, target])],
            pass_fds=fds,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            start_new_session=True,
        )
        theirs.close()
        self.ready: Any = None
        try:
            self.channel.send(config)
        except ConnectionLost:
            self.check()
            raise

    @property
    def busy(self) -> bool:
        """Is a request of this process on its way?"""
        return self._asking.locked()

    def wait_ready(self, timeout: float = START_TIMEOUT) -> Any:
        """Wait until the child is ready; raises the error that it met while it started."""
        self.ready = self._answer(timeout, "get ready")["ready"]
        return self.ready

    def check(self) -> None:
        """Raise ConnectionLost, with the last lines that it printed, when the child is not alive."""
        status = self.process.poll()
        if status is not None:
            raise ConnectionLost(f"the {self.name} process ended (status {status}){self._tail()}")

    def request(self, method: str, params: dict[str, Any] | None = None, timeout: float = REQUEST_TIMEOUT) -> Any:
        """Ask for something and wait for the answer; an error there is raised here."""
        with self._asking:
            self.check()
            self._number += 1
            self.channel.send({"id": self._number, "method": method, "params": params or {}})
            return self._answer(timeout, f"answer {method!r}", self._number)["result"]

    def _answer(self, timeout: float, what: str, number: int | None = None) -> dict[str, Any]:
        deadline = time.monotonic() + timeout
        while True:
            try:
                message = self.channel.receive(min(0.2, max(0.0, deadline - time.monotonic())))
            except ConnectionLost:
                self._wait_end(1.0)
                self.check()
                raise
            if message is not None and message.get("id", number) == number:
                if "error" in message:
                    raise unpack_error(message["error"])
                return dict(message)
            if message is None:
                self.check()
                if time.monotonic() >= deadline:
                    raise ConnectionLost(f"the {self.name} process did not {what} within {timeout:g} s{self._tail()}")

    def _wait_end(self, timeout: float) -> bool:
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def _tail(self) -> str:
        if self._log.closed:
            return ""
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - 2000))
        lines = self._log.read().decode(errors="replace").strip().splitlines()[-8:]
        return "; it said:\n    " + "\n    ".join(lines) if lines else ""

    def close(self, timeout: float = 5.0) -> None:
        """Ask the child to stop and end, and wait for it; end it by force when it does not. Idempotent."""
        try:
            if self.process.poll() is None:
                self.channel.send({"id": 0, "method": "close", "params": {}}, GOODBYE)
        except ConnectionLost:
            pass
        if not self._wait_end(timeout):
            self.process.kill()
            self._wait_end(timeout)
        self.channel.close()
        self._log.close()


def child_main(target: str, fds: Sequence[int]) -> None:
    """What runs in the child: call the target, report an error that it raises, end without interpreter tear-down."""
    channel = Channel(socket.socket(fileno=fds[0]))
    status = 0
    try:
        memories = [SharedMemory(fd=fd) for fd in fds[1:]]
        config = channel.receive(START_TIMEOUT)
        module, _, function = target.partition(":")
        main: Callable[..., None] = getattr(__import__(module, fromlist=[function]), function)
        main(channel, memories, config)
    except ChannelClosed:
        pass
    except BaseException as error:
        status = 1
        traceback.print_exc()
        with contextlib.suppress(ConnectionLost):
            channel.send({"error": pack_error(error)})
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # libraries that complain while the interpreter is torn down stay silent
