"""Where commands come in: lines on standard input, and a control port on a loopback address that speaks JSON lines."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import stat
import sys
from collections.abc import Callable
from typing import Any

from .link import listen

__all__ = ["CONTROL_PORT", "Console"]

CONTROL_PORT = 1339
_LONGEST = 4096
"""Bytes of a line."""

Execute = Callable[[list[str]], dict[str, Any]]


class Console:
    """Reads lines, has them executed, and answers. Everything happens in :meth:`serve`, in the caller's thread.

    A line on the control port is a JSON object ``{"command": ["reflex", "joint_reflex"]}`` or the words themselves;
    its answer is a JSON object with ``ok``, and ``error`` where that is false.
    """

    def __init__(self, host: str, poller: select.epoll, execute: Execute) -> None:
        """Raises OSError when the port is taken."""
        self._poller = poller
        self._execute = execute
        self._listener = listen(host, CONTROL_PORT)
        self._connections: dict[int, socket.socket] = {}
        self._unfinished: dict[int, bytes] = {}
        poller.register(self._listener, select.EPOLLIN)
        self._stdin = _readable_stdin()
        if self._stdin is not None:
            poller.register(self._stdin, select.EPOLLIN)

    def serve(self, descriptor: int) -> None:
        """Do what is to be done with a descriptor that is ready."""
        if descriptor == self._listener.fileno():
            with contextlib.suppress(OSError):
                connection, _ = self._listener.accept()
                connection.settimeout(1.0)
                self._connections[connection.fileno()] = connection
                self._poller.register(connection, select.EPOLLIN)
        elif descriptor == self._stdin:
            self._type(descriptor)
        elif descriptor in self._connections:
            self._converse(descriptor)

    def _converse(self, descriptor: int) -> None:
        connection = self._connections[descriptor]
        try:
            lines = self._lines(descriptor, connection.recv(_LONGEST))
            for line in lines:
                connection.sendall(json.dumps(self._answer(line)).encode() + b"\n")
        except (OSError, EOFError):
            self._poller.unregister(connection)
            del self._connections[descriptor]
            self._unfinished.pop(descriptor, None)
            connection.close()

    def _type(self, descriptor: int) -> None:
        try:
            if os.isatty(descriptor) and os.tcgetpgrp(descriptor) != os.getpgrp():
                raise EOFError  # in the background: what is typed is for the shell, and reading it would stop us
            lines = self._lines(descriptor, os.read(descriptor, _LONGEST))
        except (OSError, EOFError):
            self._poller.unregister(descriptor)
            self._stdin = None
            return
        for line in lines:
            answer = self._answer(line)
            text = answer.get("text") or json.dumps(answer, indent=2)
            with contextlib.suppress(OSError, ValueError):
                print(text, flush=True)

    def _lines(self, descriptor: int, data: bytes) -> list[str]:
        """Whole lines. Raises EOFError at the end and for a line that has none."""
        received = self._unfinished.get(descriptor, b"") + data
        *lines, rest = received.split(b"\n")
        if not data or len(rest) > _LONGEST:
            raise EOFError
        self._unfinished[descriptor] = rest
        return [line.decode(errors="replace").strip() for line in lines if line.strip()]

    def _answer(self, line: str) -> dict[str, Any]:
        try:
            return {"ok": True, **self._execute(_words(line))}
        except (ValueError, TypeError) as error:
            return {"ok": False, "error": str(error)}

    def close(self) -> None:
        """Let go of the port."""
        for connection in (self._listener, *self._connections.values()):
            connection.close()


def _words(line: str) -> list[str]:
    if not line.startswith("{"):
        return line.split()
    message = json.loads(line)
    words = message.get("command")
    if not isinstance(words, list) or not words:
        raise ValueError('expected {"command": ["word", ...]}')
    return [str(word) for word in words]


def _readable_stdin() -> int | None:
    """Its descriptor where somebody may type or write into it."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        descriptor = sys.stdin.fileno()
        kind = os.fstat(descriptor).st_mode
        if os.isatty(descriptor) or stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind):
            return descriptor
    return None
