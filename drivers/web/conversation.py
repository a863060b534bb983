"""Both directions of the channel to the console's process, for an app that must never wait for it."""

from __future__ import annotations

import contextlib
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from hal.errors import ConnectionLost
from hal.host.process import Channel, Child

__all__ = ["Conversation"]

_LOOK = 0.5
"""s between two looks whether this is over."""
_DEAF = 10.0
"""A process that takes nothing for so long is as good as gone, s."""
_WORDS = 256
"""Messages that may wait for it; of more the oldest are forgotten."""
_GOODBYE = 2.0
"""s that it has for ending by itself; it gives its pages one of them."""


class Conversation:
    """One thread hears, and calls ``hear`` with every message; one tells.

    Should either direction break, the process is ended, and ``lost`` is called once: a page must never look alive to a
    person while nobody hears its stop.
    """

    def __init__(self, child: Child, hear: Callable[[dict[str, Any]], None], lost: Callable[[], None]) -> None:
        self._child = child
        self._take = hear
        self._lost = lost
        self._news = threading.Condition()
        self._words: deque[dict[str, Any]] = deque(maxlen=_WORDS)
        self._newest: dict[str, dict[str, Any]] = {}
        self._frames: dict[str, None] = {}
        self._over = False
        self._threads = [
            threading.Thread(target=self._hear, name="hal-console-hear", daemon=True),
            threading.Thread(target=self._tell, name="hal-console-tell", daemon=True),
        ]

    def start(self) -> None:
        """From now on the two threads have the channel."""
        for thread in self._threads:
            thread.start()

    def tell(self, method: str, **more: Any) -> None:
        """Say something to the process, some time; never waits."""
        with self._news:
            self._words.append({"method": method, **more})
            self._news.notify()

    def tell_newest(self, method: str, **more: Any) -> None:
        """The same for what is said often: it replaces the last one of this method that still waits."""
        with self._news:
            self._newest[method] = {"method": method, **more}
            self._news.notify()

    def show(self, camera: str) -> None:
        """There is a new picture of this camera. Two that wait are one, and words come first."""
        with self._news:
            self._frames[camera] = None
            self._news.notify()

    def _next(self) -> dict[str, Any] | None:
        with self._news:
            self._news.wait_for(lambda: self._words or self._newest or self._frames or self._over)
            if self._over:
                return None
            if self._words:
                return self._words.popleft()
            if self._newest:
                return self._newest.pop(next(iter(self._newest)))
            camera = next(iter(self._frames))
            del self._frames[camera]
            return {"method": "frame", "camera": camera}

    def _tell(self) -> None:
        channel = Channel(self._child.channel.sock.dup())  # a limit of its own on how long a message may take
        try:
            while (message := self._next()) is not None:
                channel.send(message, _DEAF)
        except ConnectionLost:
            self._break()
        finally:
            channel.close()

    def _hear(self) -> None:
        try:
            while not self._over:
                message = self._child.channel.receive(_LOOK)
                if message is not None:
                    self._safely(message)
        except (ConnectionLost, OSError, ValueError):
            pass
        finally:
            self._break()

    def _safely(self, message: dict[str, Any]) -> None:
        """A mistake in what one message leads to must not cost the next one, which may be a stop."""
        try:
            self._take(message)
        except Exception:
            traceback.print_exc(file=sys.stderr)

    def _break(self) -> None:
        with self._news:
            if self._over:
                return
            self._over = True
            self._news.notify_all()
        self._child.process.kill()
        self._lost()

    def close(self) -> None:
        """End the process, within a few seconds whatever it does. Idempotent."""
        with self._news:
            self._over = True
            self._news.notify_all()
        self._child.close(_GOODBYE)
        for thread in self._threads:
            with contextlib.suppress(RuntimeError):  # it was never started
                thread.join(timeout=1.0)
