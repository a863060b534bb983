"""What waits to be sent to one page: a bounded amount, whatever the page does with it."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

__all__ = ["Outbox"]

_NOTES = 256
"""Messages of which none may be left out that may wait for one page."""


class Outbox:
    """Messages for one page: the newest beat first, then notes in their order, then the newest of everything else.

    Nothing in here waits for the page except :meth:`pump`, so a page that is slow or frozen costs the others nothing.
    """

    def __init__(self, overflow: Callable[[], None]) -> None:
        """``overflow`` is called when a note is lost: the page must be cut off."""
        self._overflow = overflow
        self._beat: str | None = None
        self._notes: deque[str] = deque()
        self._newest: dict[str, str] = {}
        self._news = asyncio.Event()

    def beat(self, text: str) -> None:
        """The answer to a pad message; replaces the last one."""
        self._beat = text
        self._news.set()

    def note(self, text: str) -> None:
        """A message that matters, like all that came before it."""
        if len(self._notes) >= _NOTES:
            self._overflow()
            return
        self._notes.append(text)
        self._news.set()

    def newest(self, kind: str, text: str) -> None:
        """How something stands; replaces the last one of this kind."""
        self._newest[kind] = text
        self._news.set()

    def take(self) -> str | None:
        """What is to be sent next; None where there is nothing."""
        if self._beat is not None:
            text, self._beat = self._beat, None
            return text
        if self._notes:
            return self._notes.popleft()
        return self._newest.pop(next(iter(self._newest))) if self._newest else None

    async def pump(self, send: Callable[[str], Awaitable[None]]) -> None:
        """Send what comes, until the connection breaks or the task is cancelled. ``send`` waits for a slow page."""
        try:
            while True:
                await self._news.wait()
                self._news.clear()
                while (text := self.take()) is not None:
                    await send(text)
        except ConnectionError:
            pass  # whoever reads from the page notices, too
