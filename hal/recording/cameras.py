"""The pictures of one camera, kept until the rows that show them are made."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING

import numpy as np

from ..errors import ConnectionLost, StaleStateError
from .columns import MORE_STREAMS, CameraSetup
from .depth import unit_for

if TYPE_CHECKING:
    from ..camera import Camera
    from ..types import Frame
    from .ring import Images

__all__ = ["CameraTrack"]

_KEEP = 0.5
"""s of pictures that are kept for rows which are made late."""
_SILENT = 1.0
"""A camera that has sent nothing for so long is as good as lost, s."""


class CameraTrack:
    """Finds the picture of a row: the newest one that was taken at its time or before.

    In real time the camera's own thread brings every frame; in lock-step the present is drawn.
    """

    def __init__(self, camera: Camera, *, streams: Collection[str], lock_step: bool) -> None:
        self.camera = camera
        self._lost: tuple[float, ConnectionLost] | None = None
        self.repeated = 0
        """Rows that show the same picture as the one before."""
        self._lock_step = lock_step
        self._lock = threading.Lock()
        self._frames: deque[Frame] = deque(maxlen=max(4, round(_KEEP * camera.spec.rate_hz)))
        self._detach: list[Callable[[], None]] = []
        self._put = -1
        spec, scale = camera.spec, camera.info.depth_scale
        there = [stream for stream in spec.streams if stream in streams]
        keeps = "depth" in there
        self.setup = CameraSetup(
            camera.name,
            spec.width,
            spec.height,
            "color" in there,
            (scale or unit_for(spec.depth_max)) if keeps else None,
            scale is not None,
            -1,
            tuple(stream for stream in MORE_STREAMS if stream in there),
        )

    def begin(self) -> None:
        """A new episode. StaleStateError, ConnectionLost where the camera has no picture now."""
        self._lost, self.repeated, self._put = None, 0, -1
        with self._lock:
            self._frames.clear()
        if not self._lock_step:  # from here on nothing is missed, also not that it is lost
            self._detach = [self.camera.on_frame(self._keep), self.camera.on_connection(self._hear)]
        first = self.camera.latest(max_age=_SILENT)
        with self._lock:
            if not self._frames or first.stamp.seq < self._frames[0].stamp.seq:
                self._frames.appendleft(first)

    def end(self) -> None:
        """It is over. Idempotent."""
        for detach in self._detach:
            detach()
        self._detach = []

    def _keep(self, frame: Frame) -> None:
        with self._lock:
            self._frames.append(frame)

    def _hear(self, lost: ConnectionLost | None) -> None:
        if lost is not None and self._lost is None:
            self._lost = self.camera.clock.now(), lost

    def frame(self, t: float) -> Frame:
        """The picture of a row that was due at ``t``, s. ConnectionLost, StaleStateError where there is none."""
        if self._lock_step:
            return self.camera.latest()
        if self._lost is not None and t > self._lost[0]:
            raise self._lost[1]
        with self._lock:
            known = tuple(self._frames)
        found = next((frame for frame in reversed(known) if frame.stamp.t <= t), known[0])
        if t - found.stamp.t > _SILENT:
            raise StaleStateError(f"camera {self.camera.name} has sent no picture for {t - found.stamp.t:.1f} s")
        return found

    def fill(self, frame: Frame, images: Images) -> None:
        """Copy what is new into a slot. ValueError for a picture of another size."""
        if frame.stamp.seq == self._put:
            self.repeated += 1
            return
        for stream, place in images.items():
            image = getattr(frame, stream)
            if image is None or image.shape != place.shape:
                there = "none" if image is None else image.shape
                raise ValueError(f"camera {self.camera.name} sends pictures of {there}, not {place.shape}")
            np.copyto(place, image)
        self._put = frame.stamp.seq
