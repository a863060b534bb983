"""The parts of the console's process, put together, and its one clock."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Sequence
from typing import Any

from aiohttp import web

from hal.host.frames import FrameRing
from hal.host.process import Channel, SharedMemory
from hal.specs import CameraSpec, from_json

from .applink import AppLink
from .desk import Desk
from .gallery import Gallery
from .gatekeeper import Gatekeeper
from .live import Live
from .pictures import Pictures
from .server import listening, make_app, read_page
from .telemetry import Telemetry
from .visitors import Visitors

__all__ = ["Service"]

_PERIOD = 0.05
"""s between two states."""


class Service:
    """Serves until the app says so, is gone, or something fails that should not."""

    def __init__(self, channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
        self._channel = channel
        address, port = config["listen"]
        self._address = str(address)
        self._socket = listening(self._address, int(port), fixed=bool(config["port_fixed"]))
        cameras = [from_json(CameraSpec, camera) for camera in config["cameras"]]
        pictures, *hosts = [memory.buffer for memory in memories]
        gatekeeper = Gatekeeper(config["token"], self._address, config["names"])
        self._telemetry = Telemetry(config["hosts"], hosts)
        self._gallery = Gallery(cameras, FrameRing(pictures, cameras))
        self._link = AppLink(channel, self._heard)
        self._desk = Desk(config["rig"], self._link)
        self._live = Live(gatekeeper, self._desk)
        self._pictures = Pictures(gatekeeper, self._gallery, self._tell_watched)
        self._visitors = Visitors()
        self._app = make_app(gatekeeper, self._visitors, self._live, self._pictures, read_page())
        self._parent = os.getppid()

    async def run(self) -> None:
        """Serve until the end."""
        runner = web.AppRunner(self._app, access_log=None, handle_signals=False)
        await runner.setup()
        assert runner.server is not None
        self._channel.send({"ready": {"address": self._address, "port": self._socket.getsockname()[1]}})
        self._link.start()
        receiving = asyncio.ensure_future(self._visitors.receive(self._socket, runner.server))
        telling = asyncio.ensure_future(self._tell_states())
        ended = asyncio.ensure_future(self._link.ended.wait())
        done, _ = await asyncio.wait((receiving, telling, ended), return_when=asyncio.FIRST_COMPLETED)
        receiving.cancel()
        self._socket.close()
        await asyncio.gather(self._live.close(), self._pictures.close())
        for task in done:
            task.result()  # raises what made it end

    def _heard(self, message: dict[str, Any]) -> None:
        """The app said something."""
        method = message["method"]
        if method == "frame":
            self._pictures.arrived(message["camera"], time.monotonic())
        elif method == "close":
            self._link.ended.set()
        else:
            self._desk.heard(message)

    def _tell_watched(self, cameras: list[str]) -> None:
        self._link.waiting.watched(cameras)
        self._link.flush()

    async def _tell_states(self) -> None:
        """Turn as long as the app lives, a state in each turn; turns that are missed are left out."""
        due = time.monotonic()
        while os.getppid() == self._parent:
            now = time.monotonic()
            self._desk.look(now)
            self._live.drop_the_stuck(now)
            self._pictures.drop_the_stuck(now)
            self._visitors.show_out(now)
            if self._desk.pages:
                self._desk.show({"t": now, **self._telemetry.snapshot(now), "cameras": self._gallery.report(now)})
            due = max(due + _PERIOD, now)
            await asyncio.sleep(due - now)
