"""``/live``: the pad, wishes and stops from the page; states, news and beats to it."""

from __future__ import annotations

import asyncio

from .desk import Desk, Page
from .gatekeeper import Gatekeeper
from .messages import Malformed, Stop, parse
from .sockets import Sockets, Wire

__all__ = ["Live"]


class Live(Sockets):
    """Connects pages with the desk."""

    def __init__(self, gatekeeper: Gatekeeper, desk: Desk) -> None:
        super().__init__(gatekeeper)
        self._desk = desk

    async def serve(self, wire: Wire) -> None:
        page = self._desk.open(overflow=wire.cut)
        sending = asyncio.ensure_future(page.outbox.pump(wire.send))
        try:
            reason = await wire.listen(lambda text: self._hear(page, text))
            if reason is not None:
                self._desk.leave(page)
                await wire.drain(lambda text: self._hear_stop(page, text))
                await wire.close(reason)
        finally:
            self._desk.leave(page)
            sending.cancel()

    def _hear(self, page: Page, text: str | None) -> None:
        if text is None:
            raise Malformed("no text")
        self._desk.received(page, text)

    def _hear_stop(self, page: Page, text: str | None) -> None:
        """Whatever else a page says too often, a stop is a stop."""
        if text is not None and isinstance(parse(text), Stop):
            self._desk.stop(page)
