"""The channel to the app, inside of an event loop: nothing here ever waits, whatever the app does."""

from __future__ import annotations

import asyncio
import socket
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from hal.errors import ConnectionLost
from hal.host.process import Channel

from .messages import encode

__all__ = ["AppLink", "Waiting"]

_WISHES = 16
"""Requests of pages that may wait for the app."""
_KERNEL = 4096
"""Bytes that the kernel may keep for the app: a few pad messages, so that one that wakes up soon gets to the newest."""


class Waiting:
    """What waits for an app that does not read: at most the newest pad with the loss before it, stops, a few wishes."""

    def __init__(self) -> None:
        self._stop: dict[str, Any] | None = None
        self._gone: dict[str, Any] | None = None
        self._pad: dict[str, Any] | None = None
        self._driver: dict[str, Any] | None = None
        self._watched: dict[str, Any] | None = None
        self._wishes: deque[dict[str, Any]] = deque()

    def pad(self, t: float, t_alive: float, axes: tuple[float, ...], buttons: int, page: str) -> None:
        """The pad as it is; replaces the one before."""
        pad = {"connected": True, "t": t, "t_alive": t_alive, "axes": axes, "buttons": buttons, "from": page}
        self._pad = {"pad": pad}

    def gone(self, t: float, why: str) -> None:
        """The pad is gone. The app hears this before it hears of a pad again, however many of either it missed."""
        self._pad = None
        self._gone = {"pad": {"connected": False, "t": t, "why": why}}

    def stop(self, page: str) -> None:
        """``rig.stop()``; two that wait are one."""
        self._stop = {"stop": page}

    def driver(self, page: str | None) -> None:
        """Who drives."""
        self._driver = {"driver": page}

    def watched(self, cameras: list[str]) -> None:
        """Which cameras pages show."""
        self._watched = {"watched": cameras}

    def wish(self, message: dict[str, Any]) -> bool:
        """Something else that a page asks for. False where too much waits already; then it is forgotten."""
        if len(self._wishes) >= _WISHES:
            return False
        self._wishes.append(message)
        return True

    def take(self) -> dict[str, Any] | None:
        """What the app is to hear next; None where there is nothing."""
        for name in ("_stop", "_gone", "_driver", "_pad"):
            message: dict[str, Any] | None = getattr(self, name)
            if message is not None:
                setattr(self, name, None)
                return message
        if self._wishes:
            return self._wishes.popleft()
        message, self._watched = self._watched, None
        return message


class AppLink:
    """Both directions of the channel. Say something to :attr:`waiting`, then :meth:`flush`.

    ``heard`` is called with every message of the app, in the loop's thread.
    """

    def __init__(self, channel: Channel, heard: Callable[[dict[str, Any]], None]) -> None:
        self.waiting = Waiting()
        self.ended = asyncio.Event()
        """The app is gone."""
        self._channel = channel
        self._heard = heard
        self._unsent = b""
        self._writing = False
        self._loop: asyncio.AbstractEventLoop | None = None

    def start(self) -> None:
        """From now on the channel is read and written by the running loop."""
        sock = self._channel.sock
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL)
        sock.setblocking(False)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._read)
        self.flush()

    def _read(self) -> None:
        try:
            while (message := self._channel.poll()) is not None:
                self._hear(message)
        except ConnectionLost:
            self._end()

    def _hear(self, message: dict[str, Any]) -> None:
        try:
            self._heard(message)
        except Exception:  # a word that cannot be passed on must not keep the next one, nor a stop, from its way
            traceback.print_exc()

    def flush(self) -> None:
        """Send what waits, as far as the app takes it; the rest follows when it does."""
        if self._loop is None or self.ended.is_set():
            return
        try:
            while self._fill():
                self._unsent = self._unsent[self._channel.sock.send(self._unsent) :]
            self._write_later(False)
        except BlockingIOError:
            self._write_later(True)
        except OSError:
            self._end()

    def _fill(self) -> bool:
        """Is there something to send?"""
        if not self._unsent:
            message = self.waiting.take()
            if message is not None:
                self._unsent = encode(message).encode() + b"\n"
        return bool(self._unsent)

    def _write_later(self, later: bool) -> None:
        assert self._loop is not None
        if later != self._writing:
            self._writing = later
            if later:
                self._loop.add_writer(self._channel.sock, self.flush)
            else:
                self._loop.remove_writer(self._channel.sock)

    def _end(self) -> None:
        """The app hung up."""
        if self._loop is not None:
            self._loop.remove_reader(self._channel.sock)
            self._write_later(False)
        self.ended.set()
