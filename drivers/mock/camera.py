"""A camera in memory whose pictures contain their own number and time."""

from __future__ import annotations

import math
import time
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.clock import Clock, RealClock
from hal.driver import CameraDriver, RawFrame
from hal.errors import CommandError, ConnectionLost
from hal.geometry import Pose
from hal.specs import CameraSpec

from .faults import MockCameraFaults, MockDevice

PLANE = 1.0
"""Distance of the background from the camera, m (or the camera's farthest depth, where that is nearer)."""
SQUARE = 16
"""Edge of the square that moves over the picture, pixels; it is 0.1 m nearer than the background."""
STEP = 4
"""Motion of the square from frame to frame, pixels."""
_HEAD = 12  # bytes of a picture that contain its number and its time


class PictureStamp(NamedTuple):
    """Number and time that are written into a mock picture."""

    seq: int
    t: float
    """s, to a microsecond."""


def read_picture(color: NDArray[np.uint8]) -> PictureStamp:
    """Return the number and the time that are written into the first four pixels of a :class:`MockCamera`'s picture.

    With it a test proves that a picture was neither changed nor confused with another one (without lossy compression).
    """
    head = np.ascontiguousarray(color).reshape(-1)[:_HEAD].tobytes()
    return PictureStamp(int.from_bytes(head[:4], "little"), int.from_bytes(head[4:], "little", signed=True) / 1e6)


class MockCamera(MockDevice[MockCameraFaults], CameraDriver):
    """A camera in memory that sees a plane, with a bright square in front of it that moves to the right.

    ``source`` is the rig's clock. In real time, frames come at the camera's rate, counted from ``open``. In lock-step
    each ``grab`` immediately returns a new frame of the present time; without a clock, one that is a period later than
    the last. The colour picture contains the frame's number and time, see :func:`read_picture`. In the segmentation
    the square is body 0. Faults: :class:`~hal.drivers.mock.faults.MockCameraFaults`.
    """

    kind: ClassVar[str] = "camera"
    simulated: ClassVar[bool] = True

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        if spec.width * spec.height * 3 < _HEAD:
            raise CommandError(f"camera {spec.name!r}: a mock picture needs 4 pixels, not {spec.width}x{spec.height}")
        self.faults = MockCameraFaults()
        self._clock = source if isinstance(source, Clock) else None
        self._waits = isinstance(source, RealClock)
        self._t_open = 0.0
        self._last = 0  # number of the newest delivered frame
        self._view = None
        if spec.view is not None and spec.view.robot is None:  # an attached camera moves with its arm
            self._view = Pose(spec.view.position, spec.view.orientation)

    def open(self) -> None:
        self._expect_connected()
        if self.is_open:
            return
        self.is_open = True
        self._last = 0
        self._t_open = self._clock.now() if self._clock else 0.0

    def grab(self, timeout: float) -> RawFrame | None:
        if not self.is_open:
            raise ConnectionLost(f"camera {self.spec.name!r} is not open")
        deadline = time.monotonic() + (timeout if self._waits else 0.0)
        while True:
            self._expect_connected()
            seq = self._newest()
            if seq > self._last:
                return self._capture(seq)
            rest = deadline - time.monotonic()
            if rest <= 0.0:
                return None
            time.sleep(min(rest, 0.25 / self.spec.rate_hz))

    def _newest(self) -> int:
        """Return the number of the newest frame that may be delivered; the first is 1."""
        if self.faults.freeze:
            return self._last
        if self._clock is None or not self._waits:
            seq = self._last + 1
            if self._lost(seq):
                seq += 1
        else:
            age = self._clock.now() - self._t_open - self.faults.delay_s
            seq = max(0, math.floor(age * self.spec.rate_hz + 1e-6) + 1)  # the 1e-6 absorbs the rounding of a period
        return self._last if self._lost(seq) else seq

    def _lost(self, seq: int) -> bool:
        return self.faults.drop > 0 and seq % self.faults.drop == 0

    def _capture(self, seq: int) -> RawFrame:
        t = self._t_open + (seq - 1) / self.spec.rate_hz
        if self._clock is not None and not self._waits:
            t = self._clock.now() - self.faults.delay_s
        self._last = seq
        images = self._draw(seq, t)
        if self.faults.garbage == "shape":
            images = {stream: image[:-1] for stream, image in images.items()}
        elif self.faults.garbage == "nan":
            images["depth"] = np.full_like(images["depth"], np.nan)
        wanted = self.spec.streams
        return RawFrame(
            t=t,
            t_device=t - self._t_open,
            seq=seq,
            T_world_camera=self._view,
            skew=0.0 if {"color", "depth"} <= set(wanted) else None,
            **{stream: images[stream] for stream in wanted},
        )

    def _draw(self, seq: int, t: float) -> dict[str, NDArray[Any]]:
        spec, width, height = self.spec, self.spec.width, self.spec.height
        plane = min(PLANE, spec.depth_max)
        near = max(plane - 0.1, spec.depth_min)
        color = np.empty((height, width, 3), np.uint8)
        color[..., 0] = np.linspace(0, 200, width, dtype=np.uint8)
        color[..., 1] = np.linspace(0, 200, height, dtype=np.uint8)[:, None]
        color[..., 2] = 40
        depth = np.full((height, width), plane, np.float32)
        segmentation = np.full((height, width), -1, np.int32)
        top, left = (height - min(SQUARE, height)) // 2, (seq * STEP) % width
        square = (slice(top, top + SQUARE), slice(left, left + SQUARE))
        color[square], depth[square], segmentation[square] = 255, near, 0
        infrared = color.mean(axis=2).astype(np.uint8)
        head = seq.to_bytes(4, "little") + round(t * 1e6).to_bytes(8, "little", signed=True)
        color.reshape(-1)[:_HEAD] = np.frombuffer(head, np.uint8)
        return {
            "color": color,
            "depth": depth,
            "infrared": infrared,
            "infrared_right": infrared.copy(),
            "segmentation": segmentation,
        }

    def close(self) -> None:
        self.is_open = False
