"""The newest picture of every camera, as JPEG: each is compressed once, however many pages see it, or not at all."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from hal.camera import RawFrame
from hal.host.frames import FrameRing
from hal.specs import CameraSpec

from .telemetry import plain

__all__ = ["Gallery", "Picture", "compress", "smoothed"]

_QUALITY = 80
_SMALL = 100_000
"""Pixels up to which a picture is smoothed, as pages enlarge it. That takes 2 ms of 256 x 256."""
_LARGE = 50_000
"""Pixels from which a picture is smoothed and compressed beside the loop."""
_EDGE = 28
"""Neighbours that differ by more, of 255, are on an edge."""
_REACH = 8.0
"""Pixels along an edge of which the mean is taken, at most."""
_LONE = 0.6
"""A pixel that differs from the mean of its neighbours by this share of the local contrast becomes that mean."""
_AROUND = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]
_WINDOW = 2.0
"""s over which the rate of pictures is taken."""


class Picture(NamedTuple):
    """A compressed picture."""

    seq: int
    t: float
    """When it was taken, s."""
    jpeg: bytes


class Gallery:
    """Takes frames out of the ring while somebody watches their camera. One thread, that of the loop."""

    def __init__(self, cameras: Sequence[CameraSpec], ring: FrameRing) -> None:
        self._ring = ring
        self._shows = {spec.name: _Show(spec) for spec in cameras}
        self._beside = ThreadPoolExecutor(1, "hal-console-jpeg")

    @property
    def cameras(self) -> tuple[str, ...]:
        """All cameras, in their order on the pages."""
        return tuple(self._shows)

    def watch(self, cameras: Collection[str]) -> None:
        """These cameras are watched, and no others. What a ring holds from before is old; nobody is shown it."""
        for name, show in self._shows.items():
            show.watched = name in cameras
            if not show.watched:
                show.forget()

    def arrived(self, camera: str, now: float) -> bool:
        """A frame is said to be in the ring; is there one to be shown? ``now`` in s, monotonic."""
        show = self._shows.get(camera)
        if show is None or not show.watched:
            return False
        frame = self._ring.take(camera, show.seq, 0.0)
        if frame is not None:
            show.put(frame, now)
        return frame is not None

    def newest(self, camera: str) -> int:
        """Number of the camera's newest frame; 0 while there is none."""
        frame = self._shows[camera].frame
        return frame.seq if frame is not None else 0

    async def picture(self, camera: str) -> Picture | None:
        """The newest picture of a camera; None while there is none. A large one is waited for."""
        show = self._shows[camera]
        frame = show.frame
        if frame is not None and (show.picture is None or show.picture.seq < frame.seq):
            if show.is_large:
                if show.pending is None:
                    show.pending = asyncio.ensure_future(self._compress_beside(show, frame))
                await asyncio.shield(show.pending)
            else:
                show.picture = _picture(frame, show.spec)
        return show.picture if show.watched else None

    async def _compress_beside(self, show: _Show, frame: RawFrame) -> None:
        try:
            loop = asyncio.get_running_loop()
            show.picture = await loop.run_in_executor(self._beside, _picture, frame, show.spec)
        finally:
            show.pending = None

    def report(self, now: float) -> dict[str, dict[str, float | None]]:
        """Rate (1/s) and age (s) of every camera's pictures; None for what is not known, or not watched."""
        return {name: show.report(now) for name, show in self._shows.items()}


class _Show:
    """One camera."""

    def __init__(self, spec: CameraSpec) -> None:
        self.spec = spec
        self.is_large = spec.width * spec.height > _LARGE
        self.watched = False
        self.seq = 0
        self.frame: RawFrame | None = None
        self.picture: Picture | None = None
        self.pending: asyncio.Future[None] | None = None
        self._arrivals: deque[float] = deque(maxlen=256)

    def forget(self) -> None:
        self.frame = self.picture = None
        self._arrivals.clear()

    def put(self, frame: RawFrame, now: float) -> None:
        self.frame, self.seq = frame, frame.seq
        self._arrivals.append(now)

    def report(self, now: float) -> dict[str, float | None]:
        times = self._arrivals
        while times and now - times[0] > _WINDOW:
            times.popleft()
        span = times[-1] - times[0] if times else 0.0
        return {
            "fps": round((len(times) - 1) / span, 1) if span > 0.0 else None,
            "age": plain(now - self.frame.t) if self.frame is not None else None,
        }


def _picture(frame: RawFrame, spec: CameraSpec) -> Picture:
    return Picture(frame.seq, frame.t, compress(frame, spec))


def compress(frame: RawFrame, spec: CameraSpec) -> bytes:
    """The one stream of this frame as JPEG. Depth in metres becomes grey: near is bright, black was not measured."""
    if frame.color is not None:
        small = spec.width * spec.height <= _SMALL
        return _jpeg(smoothed(frame.color) if small else frame.color, "RGB", "420")
    if frame.infrared is not None:
        return _jpeg(frame.infrared[:, :, np.newaxis], "GRAY", "Gray")
    if frame.depth is None:
        raise ValueError(f"camera {spec.name} has no stream that can be shown")
    return _jpeg(_grey(frame.depth, spec.depth_min, spec.depth_max)[:, :, np.newaxis], "GRAY", "Gray")


def _jpeg(image: NDArray[np.uint8], colors: str, sampling: str) -> bytes:
    image = np.ascontiguousarray(image)
    data = simplejpeg.encode_jpeg(image, _QUALITY, colorspace=colors, colorsubsampling=sampling, fastdct=True)
    return bytes(data)


def smoothed(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an RGB picture (h, w, 3) without staircases and lone pixels, for people to look at.

    A renderer without a graphics card has no time for several samples a pixel. Every pixel on an edge becomes the mean
    of samples along that edge (T. Lottes, FXAA, 2009), and a lone one becomes as its neighbours.
    """
    height, width = picture.shape[:2]
    red, green, blue = (picture[:, :, part].astype(np.int16) for part in range(3))
    light = (5 * red + 9 * green + 2 * blue) >> 4
    centre = light[1:-1, 1:-1]
    around = (light[:-2, 1:-1], light[2:, 1:-1], light[1:-1, :-2], light[1:-1, 2:])
    least = np.minimum.reduce((centre, *around))
    most = np.maximum.reduce((centre, *around))
    row, column = np.nonzero(most - least > _EDGE)
    if not len(row):
        return picture
    low, high = least[row, column], most[row, column]
    upper_left, upper_right, lower_left, lower_right = (
        light[row + down, column + right].astype(np.float32) for down in (0, 2) for right in (0, 2)
    )
    across = lower_left + lower_right - upper_left - upper_right
    along = upper_left + lower_left - upper_right - lower_right
    corners = upper_left + upper_right + lower_left + lower_right
    scale = 1 / (np.minimum(abs(across), abs(along)) + np.maximum(corners / 32, 1))
    across, along = (np.clip(part * scale, -_REACH, _REACH) for part in (across, along))
    row, column = row + 1, column + 1
    flat = picture.reshape(-1, 3).astype(np.float32)
    place = row * width + column

    def sample(share: float) -> NDArray[np.float32]:
        x = np.clip(column + share * across, 0, width - 1.001)
        y = np.clip(row + share * along, 0, height - 1.001)
        left, top = x.astype(np.intp), y.astype(np.intp)
        right, down = ((x - left)[:, None].astype(np.float32), (y - top)[:, None].astype(np.float32))
        first = top * width + left
        upper = flat[first] * (1 - right) + flat[first + 1] * right
        lower = flat[first + width] * (1 - right) + flat[first + width + 1] * right
        mixed: NDArray[np.float32] = upper * (1 - down) + lower * down
        return mixed

    near = (sample(-1 / 6) + sample(1 / 6)) / 2
    far = near / 2 + (sample(-1 / 2) + sample(1 / 2)) / 4
    brightness = far @ np.array([0.299, 0.587, 0.114], np.float32)
    mixed = np.where(((brightness < low) | (brightness > high))[:, None], near, far)
    sides = sum(part[row - 1, column - 1] for part in around)
    lone = np.flatnonzero(abs(corners + sides - 8 * light[row, column]) > _LONE * 8 * (high - low))
    mixed[lone] = sum(flat[place[lone] + down * width + right] for down, right in _AROUND) / len(_AROUND)
    result: NDArray[np.uint8] = picture.copy()
    result.reshape(-1, 3)[place] = mixed
    return result


def _grey(depth: NDArray[np.float32], nearest: float, farthest: float) -> NDArray[np.uint8]:
    measured = depth > 0.0  # False for what is not a number, too
    share = np.clip((np.where(measured, depth, farthest) - nearest) / (farthest - nearest), 0.0, 1.0)
    grey: NDArray[np.uint8] = np.where(measured, 255.0 - 215.0 * share, 0.0).astype(np.uint8)
    return grey
