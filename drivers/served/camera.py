"""A camera of another computer."""

from __future__ import annotations

import time
from typing import Any

from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConnectionLost
from hal.host.process import unpack_error
from hal.remote.client import connect
from hal.remote.frames import LARGEST, ReceivedFrames, check_camera, unpack_info
from hal.remote.link import RigLink
from hal.specs import CameraSpec

_BEAT = 0.02
"""Longest wait before the other computer gets a sign of life, s."""


class ServedCamera(CameraDriver):
    """A camera that another computer serves. Times are translated into this computer's clock.

    They are wrong by half of the shortest round trip lately at most, which :meth:`statistics` has.
    """

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._link: RigLink | None = None
        self._frames = ReceivedFrames(spec)
        self._info = self.nominal_info()

    @property
    def info(self) -> CameraInfo:
        return self._info

    def open(self) -> None:
        if self._link is not None:
            return
        link, answer = connect(str(self.spec.at), {"want": "frames", "camera": self.spec.name})
        try:
            check_camera(self.spec, answer["camera"])
        except ConnectionLost:
            link.close()
            raise
        link.largest = LARGEST
        self._info = unpack_info(answer["info"])
        self._frames = ReceivedFrames(self.spec)
        link.incoming = [self._frames]
        self._link = link

    def grab(self, timeout: float) -> RawFrame | None:
        link, frames = self._link, self._frames
        if link is None:
            raise ConnectionLost(f"camera {self.spec.name!r} is not open")
        deadline = time.monotonic() + timeout
        while True:
            link.send()
            for message in link.receive():
                raise unpack_error(message["error"])
            if frames.frame is not None:
                frame, frames.frame = frames.frame, None
                return frame
            rest = deadline - time.monotonic()
            if rest <= 0.0:
                return None
            link.wait(min(rest, _BEAT))

    def statistics(self) -> dict[str, Any]:
        link = self._link
        return {} if link is None else link.statistics()

    def close(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()
