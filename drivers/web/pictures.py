"""The pictures of the cameras on the pages: JPEG, once per frame and size, at each page's own pace and size.

Each stream of a camera is a camera of its own here, so that only what a page shows is copied and compressed.
:class:`PictureCache` takes frames from the app and compresses the newest of each camera when a page needs it.
:class:`PictureSockets` is ``/pictures``: a page has at most one picture of each camera on its way, always the newest.
"""

from __future__ import annotations

import asyncio
import math
import struct
import time
from collections.abc import Callable, Collection, Mapping, Sequence
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
DEPTH_COLORS = ((255, 241, 150), (250, 160, 60), (215, 65, 105), (120, 60, 170), (35, 75, 165))
"""Colours of depth, from near to far; each next one is darker, and is for a distance that is larger by one factor."""
UNKNOWN_COLOR = (128, 128, 128)
_DEPTH = np.array([np.interp(np.linspace(0, 4, 256), range(5), part) for part in zip(*DEPTH_COLORS, strict=True)])
_DEPTH_TABLE = np.vstack((_DEPTH.T, UNKNOWN_COLOR)).astype(np.uint8)
_SEGMENT_TABLE = np.vstack((np.arange(255)[:, None] * (67, 113, 151) % 190 + 60, (0, 0, 0))).astype(np.uint8)
"""Colours of bodies by their numbers, which come again after 255; the last one, black, is for none."""


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
        self.cameras = tuple(self._feeds)
        """Names of all cameras, in their order on the pages."""

    def watch(self, cameras: Collection[str]) -> None:
        """Take frames of these cameras and of no others. Frames from before are old and never shown."""
        for name, feed in self._feeds.items():
            feed.watched = name in cameras
            if not feed.watched:
                feed.frame = None
                feed.pictures.clear()

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

    async def picture(self, camera: str, width: float) -> JpegPicture | None:
        """Return the newest picture of a camera, compressed, at least ``width`` pixels wide; None while there is none.

        The size of a frame is divided by a whole number, so that few sizes are made.
        """
        feed = self._feeds[camera]
        frame, divisor = feed.frame, max(1, int(feed.spec.width / width))
        found = feed.pictures.get(divisor)
        if frame is not None and (found is None or found.seq < frame.seq):
            if divisor not in feed.pending:
                feed.pending[divisor] = asyncio.ensure_future(self._compress(feed, frame, divisor))
            await asyncio.shield(feed.pending[divisor])
        return feed.pictures.get(divisor)

    async def _compress(self, feed: _CameraFeed, frame: RawFrame, divisor: int) -> None:
        try:
            loop = asyncio.get_running_loop()
            jpeg = await loop.run_in_executor(self._compressor, compress, frame, feed.spec, divisor)
            if feed.watched:
                feed.pictures[divisor] = JpegPicture(frame.seq, frame.t, jpeg)
        finally:
            del feed.pending[divisor]


class _CameraFeed:
    """Newest frame of one camera, and its newest pictures by the divisors of their sizes."""

    def __init__(self, spec: CameraSpec) -> None:
        self.spec = spec
        self.watched = False
        self.seq = 0
        self.frame: RawFrame | None = None
        self.pictures: dict[int, JpegPicture] = {}
        self.pending: dict[int, asyncio.Future[None]] = {}


# Sending them.


class PictureCredit:
    """Which pictures one page may be sent: the newest of each camera that it watches, once it has drawn the last."""

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        """Set when a picture may be due."""
        self.widths: Mapping[str, float] = {}
        """Width at which the page shows each camera that it watches, pixels."""
        self._sent: dict[str, int] = {}
        self._free: set[str] = set()

    def watch(self, widths: Mapping[str, float]) -> None:
        """Watch these cameras from now on. The first picture of a camera needs no credit."""
        self.widths = widths
        self._free = {name for name in widths if name in self._free or name not in self._sent}
        self._sent = {name: self._sent.get(name, 0) for name in widths}
        self.changed.set()

    def give_back(self, camera: str) -> None:
        """Allow the next picture of a camera: the page has drawn the last one."""
        if camera in self._sent:
            self._free.add(camera)
            self.changed.set()

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
            credit.watch(message.widths)
            self._update_watched()
        elif isinstance(message, PictureDrawn):
            credit.give_back(message.camera)
        else:
            raise MalformedMessage("not on this socket")

    def _update_watched(self) -> None:
        watched = sorted(frozenset().union(*(credit.widths for credit in self._pages)), key=self._index.__getitem__)
        if watched != self._watched_now:
            self._watched_now = watched
            self._cache.watch(watched)
            self._watched(watched)

    def frame_arrived(self, camera: str) -> None:
        """Send a new frame of this camera to the pages that watch it."""
        if self._cache.take_frame(camera):
            for credit in self._pages:
                if camera in credit.widths:
                    credit.changed.set()

    async def _send_pictures(self, sock: PageSocket, credit: PictureCredit) -> None:
        try:
            while True:
                await credit.changed.wait()
                credit.changed.clear()
                for camera, width in tuple(credit.widths.items()):
                    if not credit.allows(camera, self._cache.newest_seq(camera)):
                        continue
                    picture = await self._cache.picture(camera, width)
                    if picture is not None and credit.allows(camera, picture.seq):  # else it stopped watching meanwhile
                        credit.spend(camera, picture.seq)
                        seq, age = picture.seq & _SEQ_MASK, time.monotonic() - picture.t
                        header = _HEADER.pack(self._index[camera], 0, 0, seq, picture.t, age)
                        await sock.send(header + picture.jpeg)
        except ConnectionError:
            pass  # the reader of the page's socket notices it too


# Compressing them.


def compress(frame: RawFrame, spec: CameraSpec, divisor: int = 1) -> bytes:
    """Return the one stream of a frame as JPEG, its size divided by a number.

    What is a measurement or a name, not a brightness, is never averaged. Depth gets one of :data:`DEPTH_COLORS`
    between ``spec.depth_min`` and ``spec.depth_max``, or :data:`UNKNOWN_COLOR`; segmentation a colour for each body.
    """
    (stream,) = spec.streams
    image = getattr(frame, stream)
    if stream == "depth":
        return _jpeg(_color_depth(image[::divisor, ::divisor], spec.depth_min, spec.depth_max))
    if STREAMS[stream].exact:
        numbers = image[::divisor, ::divisor]
        return _jpeg(_SEGMENT_TABLE[np.where(numbers < 0, 255, numbers % 255)])
    if divisor > 1:
        return _jpeg(_shrink(image, divisor))
    return _jpeg(smooth_picture(image) if stream == "color" and spec.width * spec.height <= _SMALL else image)


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    colors, sampling = ("RGB", "420") if image.ndim == 3 else ("GRAY", "Gray")
    image = np.ascontiguousarray(np.atleast_3d(image))
    data = simplejpeg.encode_jpeg(image, _QUALITY, colorspace=colors, colorsubsampling=sampling, fastdct=True)
    return bytes(data)


def _shrink(image: NDArray[np.uint8], divisor: int) -> NDArray[np.uint8]:
    """Return a smaller picture: of every n-th pixel the mean with the next one, down to the right.

    A mean of all pixels takes longer than the compression that it saves.
    """
    means = image[:-1:divisor, :-1] >> 1
    means += image[1::divisor, 1:] >> 1
    pixels = means.view(f"V{means[0, 0].nbytes}")[:, ::divisor]  # numpy copies whole pixels faster than their parts
    return np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1, *image.shape[2:])


def smooth_picture(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a copy of an RGB picture (h, w, 3) with less steep stairs, which a renderer without a GPU leaves.

    Every pixel is half its own colour, and an eighth of that of each neighbour.
    """
    sums = 8 * picture.astype(np.uint16)
    inner = sums[1:-1, 1:-1]
    inner >>= 1
    for side in (picture[:-2, 1:-1], picture[2:, 1:-1], picture[1:-1, :-2], picture[1:-1, 2:]):
        inner += side
    return (sums >> 3).astype(np.uint8)


def _color_depth(depth: NDArray[np.float32], nearest: float, farthest: float) -> NDArray[np.uint8]:
    measured = depth > 0.0  # False for NaN, too
    share = np.log(np.where(measured, depth, nearest) / nearest) / math.log(farthest / nearest)
    return _DEPTH_TABLE[np.where(measured, 255 * np.clip(share, 0.0, 1.0), 256).astype(np.intp)]
