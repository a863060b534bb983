"""Colour pictures as video: what encodes them, how a video that was cut off is mended, how it is read."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, NotSupported
from .stats import PictureStats

__all__ = [
    "Encoder",
    "VideoFile",
    "as_rgb",
    "choose_encoder",
    "count_frames",
    "mend",
    "picture_stats",
    "read_video",
    "remux",
]

Picture = NDArray[np.uint8]

_LIVE = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
"""In fragments, each written as soon as it is whole: a file that ends anywhere can be read up to its last fragment."""
_SAMPLES = 50
"""Pictures of a video that are looked at, at least."""
_BOX = struct.Struct(">I4s")


class Encoder(NamedTuple):
    """What compresses."""

    library: str
    """FFmpeg's name of it."""
    codec: str
    """As ``info.json`` names what comes out."""
    options: dict[str, str]

    @property
    def feature(self) -> dict[str, Any]:
        """For ``info`` of a video in ``info.json``."""
        return {"video.codec": self.codec, "video.pix_fmt": "yuv420p"}


# Every second picture stands for itself (g = 2), so any picture is found at once, as people train on them in random
# order. No picture refers to a later one (bf = 0, pred-struct = 1): it is on disk soon, and readers do not see the
# first one late.
_ENCODERS = (
    Encoder("libx264", "h264", {"preset": "veryfast", "crf": "23", "g": "2", "bf": "0"}),
    Encoder("libsvtav1", "av1", {"preset": "12", "crf": "30", "g": "2", "svtav1-params": "lp=1:pred-struct=1"}),
)


def choose_encoder(codec: str) -> Encoder:
    """``h264``, ``av1``, or ``auto`` for the first of them that is there.

    Raises CommandError for another word, NotSupported where this build of PyAV cannot encode it.
    """
    import av

    known = [encoder.codec for encoder in _ENCODERS]
    if codec not in ("auto", *known):
        raise CommandError(f"codec must be auto, {' or '.join(known)}, not {codec!r}")
    for encoder in _ENCODERS:
        if codec in ("auto", encoder.codec) and encoder.library in av.codecs_available:
            return encoder
    raise NotSupported(f"this build of PyAV cannot encode {codec}; install one of PyPI's: pip install av")


class VideoFile:
    """Appends pictures to an open, unbuffered file."""

    def __init__(self, file: io.RawIOBase, encoder: Encoder, width: int, height: int, fps: int) -> None:
        import av

        self._av = av
        self._container = av.open(file, "w", format="mp4", options=_LIVE)
        stream: Any = self._container.add_stream(encoder.library, rate=fps, options=encoder.options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.thread_count = 1  # more would hold pictures back
        self._stream = stream
        self._period = Fraction(1, fps)
        self._count = 0

    def add(self, picture: Picture) -> None:
        """One row's picture (H, W, 3) RGB."""
        frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = self._count, self._period
        self._count += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write what the encoder still holds."""
        self._container.mux(self._stream.encode())
        self._container.close()


def as_rgb(picture: Picture) -> Picture:
    """Return a copy (H, W, 3) of a picture, which may be a grey one (H, W)."""
    return picture.copy() if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)


def mend(path: Path) -> None:
    """Cut a live file off behind its last whole fragment."""
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


def count_frames(path: Path) -> int:
    """Return how many pictures a video holds, without decoding them."""
    import av

    if path.stat().st_size == 0:
        return 0
    with av.open(str(path)) as container:
        return sum(1 for packet in container.demux(video=0) if packet.size)


def remux(source: Path, target: Path, length: int) -> None:
    """Write the first ``length`` pictures of a live file as a plain one, without encoding them anew."""
    import av

    with av.open(str(source)) as live, av.open(str(target), "w", options={"movflags": "faststart"}) as plain:
        read = live.streams.video[0]
        write = plain.add_stream_from_template(read, opaque=True)  # what is read is written, whatever encoded it
        packets = (packet for packet in live.demux(read) if packet.size)
        for _, packet in zip(range(length), packets, strict=False):
            packet.stream = write
            plain.mux(packet)


def picture_stats(path: Path, length: int, fps: int) -> PictureStats:
    """Return statistics of a picture per second, or of more in a short video. Only key frames are decoded."""
    import av

    stats = PictureStats()
    every = max(1, min(fps, length // _SAMPLES))
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 1
        due = 0
        for count, packet in enumerate(packet for packet in container.demux(stream) if packet.size):
            if packet.is_keyframe and count >= due:
                due = count + every
                for frame in stream.codec_context.decode(packet):
                    stats.add(frame.to_ndarray(format="rgb24"))
        for frame in stream.codec_context.decode(None):
            stats.add(frame.to_ndarray(format="rgb24"))
    return stats


def read_video(path: Path) -> Iterator[Picture]:
    """Every picture (H, W, 3) RGB, in order."""
    import av

    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "AUTO"
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")
