"""``/pictures``: what the cameras see. A page has one picture of each camera on its way at most, always the newest."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable, Iterator

from .gallery import Gallery, Picture
from .gatekeeper import Gatekeeper
from .messages import Drawn, Malformed, Watch, parse
from .sockets import Sockets, Wire

__all__ = ["Credit", "Pictures"]

_HEADER = struct.Struct("<BBHIdf")  # camera, 0, 0, seq, t, age
_SEQ_MASK = 0xFFFFFFFF


class Credit:
    """What one page may be sent: of each camera that it watches the newest picture, once it has drawn the last."""

    def __init__(self) -> None:
        self.news = asyncio.Event()
        """Something may be due."""
        self._sent: dict[str, int] = {}
        self._free: set[str] = set()

    @property
    def cameras(self) -> frozenset[str]:
        """What it watches."""
        return frozenset(self._sent)

    def watch(self, cameras: tuple[str, ...]) -> None:
        """It watches these from now on. The first picture of a camera needs no credit."""
        self._free = {name for name in cameras if name in self._free or name not in self._sent}
        self._sent = {name: self._sent.get(name, 0) for name in cameras}
        self.news.set()

    def drawn(self, camera: str) -> None:
        """It has drawn this camera's picture."""
        if camera in self._sent:
            self._free.add(camera)
            self.news.set()

    def due(self, newest: Callable[[str], int]) -> Iterator[str]:
        """Cameras of which it may have a picture that it has not had; ``newest`` gives a camera's newest number."""
        return (name for name in tuple(self._sent) if self.may_have(name, newest(name)))

    def may_have(self, camera: str, seq: int) -> bool:
        """May it be sent this picture?"""
        return camera in self._free and seq > self._sent[camera]

    def spend(self, camera: str, seq: int) -> None:
        """It is being sent this picture."""
        self._free.discard(camera)
        self._sent[camera] = seq


class Pictures(Sockets):
    """Sends pictures to the pages; ``watched`` is told which cameras any of them watches, at every change."""

    def __init__(self, gatekeeper: Gatekeeper, gallery: Gallery, watched: Callable[[list[str]], None]) -> None:
        super().__init__(gatekeeper)
        self._gallery = gallery
        self._watched = watched
        self._watched_now: list[str] = []
        self._index = {name: k for k, name in enumerate(gallery.cameras)}
        self._pages: set[Credit] = set()

    async def serve(self, wire: Wire) -> None:
        credit = Credit()
        self._pages.add(credit)
        sending = asyncio.ensure_future(self._send(wire, credit))
        try:
            reason = await wire.listen(lambda text: self._hear(credit, text))
            if reason is not None:
                await wire.close(reason)
        finally:
            sending.cancel()
            self._pages.discard(credit)
            self._count()

    def _hear(self, credit: Credit, text: str | None) -> None:
        message = parse(text or "", cameras=self._index)
        if isinstance(message, Watch):
            credit.watch(message.cameras)
            self._count()
        elif isinstance(message, Drawn):
            credit.drawn(message.camera)
        else:
            raise Malformed("not on this socket")

    def _count(self) -> None:
        """Tell which cameras are watched."""
        watched = sorted(frozenset().union(*(credit.cameras for credit in self._pages)), key=self._index.__getitem__)
        if watched != self._watched_now:
            self._watched_now = watched
            self._gallery.watch(watched)
            self._watched(watched)

    def arrived(self, camera: str, now: float) -> None:
        """There is a new frame of this camera; ``now`` in s, monotonic."""
        if self._gallery.arrived(camera, now):
            for credit in self._pages:
                if camera in credit.cameras:
                    credit.news.set()

    async def _send(self, wire: Wire, credit: Credit) -> None:
        try:
            while True:
                await credit.news.wait()
                credit.news.clear()
                for camera in credit.due(self._gallery.newest):
                    picture = await self._gallery.picture(camera)
                    if picture is None or not credit.may_have(camera, picture.seq):
                        continue  # it stopped watching meanwhile
                    credit.spend(camera, picture.seq)
                    await wire.send(self._header(camera, picture) + picture.jpeg)
        except ConnectionError:
            pass  # whoever listens to the page notices, too

    def _header(self, camera: str, picture: Picture) -> bytes:
        age = time.monotonic() - picture.t
        return _HEADER.pack(self._index[camera], 0, 0, picture.seq & _SEQ_MASK, picture.t, age)
