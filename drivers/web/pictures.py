"""The pictures of the cameras on the pages: JPEG, compressed once per frame, at each page's own pace.

:class:`PictureCache` takes frames from the app and compresses the newest of each camera when a page needs it.
:class:`PictureSockets` is ``/pictures``: a page has at most one picture of each camera on its way, always the newest.
"""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from hal.auth import Authenticator
from hal.driver import RawFrame
from hal.host.ring import FrameRing
from hal.specs import CameraSpec
from hal.types import STREAMS

from .messages import MalformedMessage, PictureDrawn, WatchRequest, parse
from .sockets import PageSocket, PageSockets

_HEADER = struct.Struct("<BBHIdf")  # camera, 0, 0, seq, t, age
_SEQ_MASK = 0xFFFFFFFF
_QUALITY = 80
_SMALL = 100_000
"""Pixels up to which a picture is smoothed, because pages enlarge it."""
_LARGE = 50_000
"""Pixels from which a picture is smoothed and compressed in a thread of its own."""
_EDGE = 28
"""Neighbours that differ by more, of 255, are on an edge."""
_REACH = 8.0
"""Pixels along an edge of which the mean is taken, at most."""
_LONE = 0.6
"""A pixel that differs from the mean of its neighbours by this share of the local contrast becomes that mean."""
_AROUND = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]


class JpegPicture(NamedTuple):
    """A compressed picture."""

    seq: int
    t: float
    """Time at which it was taken, in s."""
    jpeg: bytes


class PictureCache:
    """The newest picture of every camera that a page watches. One thread, that of the event loop."""

    def __init__(self, cameras: Sequence[CameraSpec], rings: dict[str, FrameRing]) -> None:
        self._rings = rings
        self._feeds = {spec.name: _CameraFeed(spec) for spec in cameras}
        self._compressor = ThreadPoolExecutor(1, "hal-console-jpeg")

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of all cameras, in their order on the pages."""
        return tuple(self._feeds)

    def watch(self, cameras: Collection[str]) -> None:
        """Take frames of these cameras and of no others. Frames from before are old and never shown."""
        for name, feed in self._feeds.items():
            feed.watched = name in cameras
            if not feed.watched:
                feed.frame = feed.picture = None

    def take_frame(self, camera: str) -> bool:
        """Take a camera's newest frame out of the ring; return whether there is a new one that a page watches."""
        feed = self._feeds.get(camera)
        if feed is None or not feed.watched:
            return False
        frame = self._rings[camera].wait(feed.seq, 0.0)
        if frame is not None:
            feed.frame, feed.seq = frame, frame.seq
        return frame is not None

    def newest_seq(self, camera: str) -> int:
        """Return the number of the camera's newest frame; 0 while there is none."""
        frame = self._feeds[camera].frame
        return frame.seq if frame is not None else 0

    async def picture(self, camera: str) -> JpegPicture | None:
        """Return the newest picture of a camera, compressed; None while there is none."""
        feed = self._feeds[camera]
        frame = feed.frame
        if frame is not None and (feed.picture is None or feed.picture.seq < frame.seq):
            if feed.is_large:
                if feed.pending is None:
                    feed.pending = asyncio.ensure_future(self._compress_in_thread(feed, frame))
                await asyncio.shield(feed.pending)
            else:
                feed.picture = _picture(frame, feed.spec)
        return feed.picture if feed.watched else None

    async def _compress_in_thread(self, feed: _CameraFeed, frame: RawFrame) -> None:
        try:
            loop = asyncio.get_running_loop()
            feed.picture = await loop.run_in_executor(self._compressor, _picture, frame, feed.spec)
        finally:
            feed.pending = None


class _CameraFeed:
    """Newest frame and picture of one camera."""

    def __init__(self, spec: CameraSpec) -> None:
        self.spec = spec
        self.is_large = spec.width * spec.height > _LARGE
        self.watched = False
        self.seq = 0
        self.frame: RawFrame | None = None
        self.picture: JpegPicture | None = None
        self.pending: asyncio.Future[None] | None = None


# Sending them.


class PictureCredit:
    """Which pictures one page may be sent: the newest of each camera that it watches, once it has drawn the last."""

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        """Set when a picture may be due."""
        self._sent: dict[str, int] = {}
        self._free: set[str] = set()

    @property
    def cameras(self) -> frozenset[str]:
        """Names of the cameras that the page watches."""
        return frozenset(self._sent)

    def watch(self, cameras: tuple[str, ...]) -> None:
        """Watch these cameras from now on. The first picture of a camera needs no credit."""
        self._free = {name for name in cameras if name in self._free or name not in self._sent}
        self._sent = {name: self._sent.get(name, 0) for name in cameras}
        self.changed.set()

    def give_back(self, camera: str) -> None:
        """Allow the next picture of a camera: the page has drawn the last one."""
        if camera in self._sent:
            self._free.add(camera)
            self.changed.set()

    def due(self, newest: Callable[[str], int]) -> Iterator[str]:
        """Yield the cameras of which a new picture may be sent; ``newest`` returns a camera's newest number."""
        return (name for name in tuple(self._sent) if self.allows(name, newest(name)))

    def allows(self, camera: str, seq: int) -> bool:
        """Whether this picture may be sent."""
        return camera in self._free and seq > self._sent[camera]

    def spend(self, camera: str, seq: int) -> None:
        """Note that this picture is being sent."""
        self._free.discard(camera)
        self._sent[camera] = seq


class PictureSockets(PageSockets):
    """``/pictures``; ``watched`` is called with the cameras that any page watches, at every change."""

    def __init__(self, auth: Authenticator, cache: PictureCache, watched: Callable[[list[str]], None]) -> None:
        super().__init__(auth)
        self._cache = cache
        self._watched = watched
        self._watched_now: list[str] = []
        self._index = {name: k for k, name in enumerate(cache.cameras)}
        self._pages: set[PictureCredit] = set()

    async def serve(self, sock: PageSocket) -> None:
        credit = PictureCredit()
        self._pages.add(credit)
        sending = asyncio.ensure_future(self._send_pictures(sock, credit))
        try:
            reason = await sock.receive_all(lambda text: self._receive(credit, text))
            if reason is not None:
                await sock.close(reason)
        finally:
            sending.cancel()
            self._pages.discard(credit)
            self._update_watched()

    def _receive(self, credit: PictureCredit, text: str | None) -> None:
        message = parse(text or "", cameras=self._index)
        if isinstance(message, WatchRequest):
            credit.watch(message.cameras)
            self._update_watched()
        elif isinstance(message, PictureDrawn):
            credit.give_back(message.camera)
        else:
            raise MalformedMessage("not on this socket")

    def _update_watched(self) -> None:
        watched = sorted(frozenset().union(*(credit.cameras for credit in self._pages)), key=self._index.__getitem__)
        if watched != self._watched_now:
            self._watched_now = watched
            self._cache.watch(watched)
            self._watched(watched)

    def frame_arrived(self, camera: str) -> None:
        """Send a new frame of this camera to the pages that watch it."""
        if self._cache.take_frame(camera):
            for credit in self._pages:
                if camera in credit.cameras:
                    credit.changed.set()

    async def _send_pictures(self, sock: PageSocket, credit: PictureCredit) -> None:
        try:
            while True:
                await credit.changed.wait()
                credit.changed.clear()
                for camera in credit.due(self._cache.newest_seq):
                    picture = await self._cache.picture(camera)
                    if picture is None or not credit.allows(camera, picture.seq):
                        continue  # it stopped watching meanwhile
                    credit.spend(camera, picture.seq)
                    await sock.send(self._header(camera, picture) + picture.jpeg)
        except ConnectionError:
            pass  # the reader of the page's socket notices it too

    def _header(self, camera: str, picture: JpegPicture) -> bytes:
        age = time.monotonic() - picture.t
        return _HEADER.pack(self._index[camera], 0, 0, picture.seq & _SEQ_MASK, picture.t, age)


# Compressing them.


def _picture(frame: RawFrame, spec: CameraSpec) -> JpegPicture:
    return JpegPicture(frame.seq, frame.t, compress(frame, spec))


def compress(frame: RawFrame, spec: CameraSpec) -> bytes:
    """Return the one stream of a frame as JPEG.

    Depth in m becomes grey: bright is near (``spec.depth_min``), dark is far, black was not measured.
    """
    if frame.color is not None:
        small = spec.width * spec.height <= _SMALL
        return _jpeg(smooth_picture(frame.color) if small else frame.color, "RGB", "420")
    grey = next((getattr(frame, name) for name in spec.streams if not STREAMS[name].exact), None)
    if grey is not None:
        return _jpeg(grey[:, :, np.newaxis], "GRAY", "Gray")
    if frame.depth is None:
        raise ValueError(f"camera {spec.name} has no stream that can be shown")
    return _jpeg(_grey(frame.depth, spec.depth_min, spec.depth_max)[:, :, np.newaxis], "GRAY", "Gray")


def _jpeg(image: NDArray[np.uint8], colors: str, sampling: str) -> bytes:
    image = np.ascontiguousarray(image)
    data = simplejpeg.encode_jpeg(image, _QUALITY, colorspace=colors, colorsubsampling=sampling, fastdct=True)
    return bytes(data)


def smooth_picture(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a smoothed copy of an RGB picture (h, w, 3) for display: no staircases, no lone pixels.

    A renderer without a graphics card has no time for several samples per pixel. Every pixel on an edge becomes the
    mean of samples along that edge (T. Lottes, FXAA, 2009), and a lone one the mean of its neighbours.
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
    measured = depth > 0.0  # False for NaN, too
    share = np.clip((np.where(measured, depth, farthest) - nearest) / (farthest - nearest), 0.0, 1.0)
    grey: NDArray[np.uint8] = np.where(measured, 255.0 - 215.0 * share, 0.0).astype(np.uint8)
    return grey
