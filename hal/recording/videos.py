"""Colour as video: encode, read pictures in any order, cut and join without encoding again."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import struct
import sys
import threading
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arguments import choice
from ..errors import NotSupported
from .codecs import PictureStats
from .layout import file_version

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame

Picture = NDArray[np.uint8]

_LIVE = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
"""Fragments, each written as soon as it is complete: a file cut off anywhere can be read up to its last fragment."""
_SAMPLES = 50
"""Pictures of a video that are decoded for statistics, at least."""
_BOX = struct.Struct(">I4s")


class VideoEncoder(NamedTuple):
    """A video encoder and its settings."""

    library: str
    """FFmpeg's name of the encoder."""
    codec: str
    """Name of the codec in ``info.json``."""
    options: dict[str, str]

    @property
    def feature(self) -> dict[str, Any]:
        """The encoder's entries in ``info`` of a video in ``info.json``."""
        return {"video.codec": self.codec, "video.pix_fmt": "yuv420p"}


# Every second picture is a key frame (g = 2), so that any picture is read quickly, as training reads them in random
# order. No picture refers to a later one (bf = 0, pred-struct = 1), so that it reaches the disk soon and the first one
# is shown on time.
_ENCODERS = (
    VideoEncoder("libx264", "h264", {"preset": "veryfast", "crf": "23", "g": "2", "bf": "0"}),
    VideoEncoder("libsvtav1", "av1", {"preset": "12", "crf": "30", "g": "2", "svtav1-params": "lp=1:pred-struct=1"}),
)


def choose_encoder(codec: str) -> VideoEncoder:
    """Return the encoder of ``h264``, ``av1`` or ``auto``, the first that is available.

    Raises:
        CommandError: Another codec.
        NotSupported: This build of PyAV cannot encode it.
    """
    import av

    choice("codec", codec, ("auto", *(encoder.codec for encoder in _ENCODERS)), "bad_codec")
    for encoder in _ENCODERS:
        if codec in ("auto", encoder.codec) and encoder.library in av.codecs_available:
            return encoder
    raise NotSupported(f"this build of PyAV cannot encode {codec}; install one of PyPI's: pip install av")


class VideoFile:
    """Appends pictures to an open, unbuffered file."""

    def __init__(self, file: io.RawIOBase, encoder: VideoEncoder, width: int, height: int, fps: int) -> None:
        import av

        self._av = av
        self._container = av.open(file, "w", format="mp4", options=_LIVE)
        stream: Any = self._container.add_stream(encoder.library, rate=fps, options=encoder.options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.thread_count = 1  # more threads would delay pictures
        self._stream = stream
        self._period = Fraction(1, fps)
        self._count = 0

    def add(self, picture: Picture) -> None:
        """Append one row's picture (H, W, 3) RGB."""
        frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = self._count, self._period
        self._count += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write what the encoder still holds."""
        self._container.mux(self._stream.encode())
        self._container.close()


def as_rgb(picture: Picture) -> Picture:
    """Return a copy (H, W, 3) of a colour picture (H, W, 3) or a grey one (H, W)."""
    return picture.copy() if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)


def truncate_to_last_fragment(path: Path) -> None:
    """Cut a live video after its last complete fragment."""
    size, place, whole = path.stat().st_size, 0, 0
    with path.open("rb") as file:
        while place + _BOX.size <= size:
            file.seek(place)
            length, kind = _BOX.unpack(file.read(_BOX.size))
            if length < _BOX.size or place + length > size:
                break
            place += length
            if kind in (b"moov", b"mdat"):
                whole = place
    os.truncate(path, whole)


def count_frames(path: Path, first: int = 0, most: int = sys.maxsize, fps: int = 1) -> int:
    """Return how many pictures a video holds from number ``first`` on, at most ``most``, without decoding them."""
    import av

    if path.stat().st_size == 0:
        return 0
    with av.open(str(path)) as container:
        return sum(1 for _ in itertools.islice(_packets(container, first, fps), most))


def _packets(container: InputContainer, first: int, fps: int) -> Iterator[Any]:
    """Yield the packets of a video from picture ``first`` on."""
    stream: Any = container.streams.video[0]
    _seek(container, first, fps)
    for packet in container.demux(stream):
        if packet.size and (not first or round(packet.pts * packet.time_base * fps) >= first):
            yield packet


def _seek(container: InputContainer, first: int, fps: int) -> None:
    """Go to the last key frame up to picture ``first``."""
    if first:
        stream: Any = container.streams.video[0]
        container.seek(round(first / (fps * stream.time_base)), stream=stream)


def key_frames(path: Path, first: int, count: int, fps: int) -> NDArray[np.bool_]:
    """Return which of ``count`` pictures of a video, from number ``first`` on, can be decoded without others."""
    import av

    with av.open(str(path)) as container:
        flags = [packet.is_keyframe for packet in itertools.islice(_packets(container, first, fps), count)]
    return np.array(flags + [False] * (count - len(flags)))


def remux(source: Path, target: Path, length: int) -> None:
    """Write the first ``length`` pictures of a live video as a plain one, without encoding them again."""
    import av

    with av.open(str(source)) as live, av.open(str(target), "w", options={"movflags": "faststart"}) as plain:
        read = live.streams.video[0]
        write = plain.add_stream_from_template(read, opaque=True)  # packets are copied, whatever encoded them
        packets = (packet for packet in live.demux(read) if packet.size)
        for _, packet in zip(range(length), packets, strict=False):
            packet.stream = write
            plain.mux(packet)


def can_be_joined(one: Path, other: Path) -> bool:
    """Return whether the pictures of two videos can follow each other in one file."""
    import av

    heads = []
    for path in (one, other):
        with av.open(str(path)) as container:
            codec = container.streams.video[0].codec_context
            heads.append((codec.name, codec.width, codec.height, bytes(codec.extradata or b"")))
    return heads[0] == heads[1]


class VideoPart(NamedTuple):
    """Pictures of a video, one after the other."""

    path: Path
    first: int
    """Number of the first one."""
    length: int


def join_videos(parts: Sequence[VideoPart], target: Path, fps: int) -> None:
    """Write pictures of several videos into one, without encoding them again; each part begins with a key frame.

    Raises ValueError if a part has fewer pictures.
    """
    import av

    written = 0
    with contextlib.ExitStack() as stack:
        joined = stack.enter_context(av.open(str(target), "w", format="mp4", options={"movflags": "faststart"}))
        write: Any = None
        for path, first, length in parts:
            with av.open(str(path)) as container:
                if write is None:
                    write = joined.add_stream_from_template(container.streams.video[0], opaque=True)
                found = 0
                for packet in itertools.islice(_packets(container, first, fps), length):
                    packet.time_base = Fraction(1, fps)
                    packet.pts = packet.dts = written + found
                    packet.duration = 1
                    packet.stream = write
                    joined.mux(packet)
                    found += 1
            if found != length:
                raise ValueError(f"{path.name} has {found} pictures from number {first} on, not {length}")
            written += length


def picture_stats(path: Path, length: int, fps: int, first: int = 0) -> PictureStats:
    """Return statistics of pictures from number ``first`` on: one per second, or more of a few.

    Only key frames are decoded.
    """
    import av

    stats, as_rgb24 = PictureStats(), _RgbConverter()
    every = max(1, min(fps, length // _SAMPLES))
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 1
        due = 0
        for count, packet in enumerate(itertools.islice(_packets(container, first, fps), length)):
            if packet.is_keyframe and count >= due:
                due = count + every
                for frame in stream.codec_context.decode(packet):
                    stats.add(as_rgb24(frame))
        for frame in stream.codec_context.decode(None):
            stats.add(as_rgb24(frame))
    return stats


def read_video(path: Path, first: int = 0, fps: int = 1) -> Iterator[Picture]:
    """Yield every picture (H, W, 3) RGB from number ``first`` on, in order; ``fps`` is needed only for ``first``."""
    import av

    as_rgb24 = _RgbConverter()
    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        stream.thread_type = "AUTO"
        _seek(container, first, fps)
        for frame in container.decode(stream):
            if not first or round(frame.pts * frame.time_base * fps) >= first:
                yield as_rgb24(frame)


class _RgbConverter:
    """Converts decoded pictures to RGB, in one thread: PyAV 17 uses all, and waking them takes longer than the work."""

    def __init__(self) -> None:
        import av

        self._reformatter = av.video.reformatter.VideoReformatter()
        self._threads = {"threads": 1} if int(av.__version__.split(".")[0]) >= 17 else {}

    def __call__(self, frame: VideoFrame) -> Picture:
        converted: Any = self._reformatter.reformat(frame, format="rgb24", **self._threads)
        return np.asarray(converted.to_ndarray(), np.uint8)


class _OpenVideo:
    """A video that stays open, for pictures in any order: opening it takes longer than decoding one.

    Its place in the file is its own: each thread of each process needs one.
    """

    def __init__(self, path: Path) -> None:
        import av

        self._container = av.open(str(path))
        stream: Any = self._container.streams.video[0]
        stream.thread_count = 1  # more threads would delay the first picture
        self._stream = stream
        self._ticks = float(1 / stream.time_base)
        """Steps of the video's time in a second."""
        self._as_rgb24 = _RgbConverter()

    def picture(self, number: int, fps: int) -> Picture | None:
        period = self._ticks / fps
        self._container.seek(round(number * period), stream=self._stream)
        wanted = round((number - 0.5) * period)
        for frame in self._container.decode(self._stream):
            if frame.pts >= wanted:
                return self._as_rgb24(frame)
        return None


@lru_cache(maxsize=32)
def _open_video(path: Path, version: tuple[int, int] | None, process: int, thread: int) -> _OpenVideo:
    return _OpenVideo(path)


def read_picture(path: Path, number: int, fps: int) -> Picture | None:
    """Return one picture (H, W, 3) RGB of a video; None if there are not so many. The file stays open for others."""
    return _open_video(path, file_version(path), os.getpid(), threading.get_ident()).picture(number, fps)
