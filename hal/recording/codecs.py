"""Coding of pictures: depth files without loss, colour as video, and statistics of both."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
import os
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, NotSupported

if TYPE_CHECKING:
    from av.container import InputContainer

__all__ = [
    "DepthFile",
    "DepthReader",
    "VideoEncoder",
    "PictureStats",
    "Stats",
    "VideoFile",
    "VideoPart",
    "as_rgb",
    "can_be_joined",
    "copy_records",
    "choose_encoder",
    "column_stats",
    "count_frames",
    "truncate_to_last_fragment",
    "merge_stats",
    "ids_to_units",
    "join_videos",
    "key_frames",
    "picture_stats",
    "stats_as_lists",
    "read_video",
    "remux",
    "to_units",
    "depth_unit_for",
]

# Depth files: zstd over the differences of neighbouring pixels, low and high bytes apart.
#
# A file is one line of JSON (size, unit), then a record per row of the episode: length, checksum, data. An empty record
# means that the row shows the same picture as the one before. Records are appended and flushed one by one, so a killed
# program leaves complete ones, and at most one that is cut off.

_RECORD = struct.Struct("<II")  # length, checksum
_LEVEL = 1
_MOST = 65535
_LINE, _SIDE = 4096, 16384
"""Bytes of the first line, and pixels of a side, at most: a damaged file must not ask for all memory."""
_UNITS = (0.0001, 0.00025, 0.0005, 0.001, 0.002, 0.005, 0.01)

Units = NDArray[np.uint16]


def depth_unit_for(depth_max: float) -> float:
    """Return the finest unit, m, in which 16 bits reach ``depth_max``, m, of a simulated camera."""
    return next((unit for unit in _UNITS if depth_max <= _MOST * unit), depth_max / _MOST)


def to_units(depth: NDArray[np.float32], unit: float) -> Units:
    """Return depth (H, W) in m as whole units, rounded to nearest; 0 for what was not measured or does not fit."""
    whole = np.rint(depth / np.float32(unit))
    whole[~((whole >= 0.0) & (whole <= _MOST))] = 0.0  # also true for NaN
    units: Units = whole.astype("<u2")
    return units


def ids_to_units(numbers: NDArray[np.int32]) -> Units:
    """Return numbers of bodies (H, W), -1 for none, as units. Raises ValueError for a number above 65534."""
    if numbers.size and not (numbers.min() >= -1 and numbers.max() < _MOST):
        raise ValueError("a number of a body does not fit into 16 bits")
    units: Units = (numbers + 1).astype("<u2")
    return units


class DepthFile:
    """Appends pictures to an open, unbuffered file."""

    def __init__(self, file: io.RawIOBase, width: int, height: int, unit: float) -> None:
        import zstandard

        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._file = file
        head = {"format": "delta, byte shuffle, zstd", "width": width, "height": height, "unit_m": unit}
        _write(file, json.dumps(head).encode() + b"\n")
        self._unit = unit

    def add(self, depth: NDArray[np.float32] | None) -> None:
        """Append one row's picture (H, W), m; None repeats the one before."""
        self.add_units(None if depth is None else to_units(depth, self._unit))

    def add_units(self, units: Units | None) -> None:
        """Append one row's picture (H, W), in the file's units; None repeats the one before."""
        payload = b"" if units is None else self._compressor.compress(_shuffled(units))
        _write(self._file, _RECORD.pack(len(payload), crc32(payload)) + payload)


class DepthReader:
    """Reads the complete records of a depth file. Raises ValueError or KeyError for a damaged first line."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with self.path.open("rb") as file:
            head: dict[str, Any] = json.loads(file.readline(_LINE))
            self.shape = (int(head["height"]), int(head["width"]))
            self.unit = float(head["unit_m"])
            if not (all(1 <= side <= _SIDE for side in self.shape) and 0.0 < self.unit < math.inf):
                raise ValueError(f"its first line is damaged: {head}")
            self._places = list(_records(file, self.path.stat().st_size))

    def __len__(self) -> int:
        return len(self._places)

    def end_of(self, count: int) -> int:
        """Return the position in the file at which the first ``count`` records end, bytes."""
        if count == 0:
            with self.path.open("rb") as file:
                return len(file.readline())
        start, length = self._places[count - 1]
        return start + length

    def units(self) -> Iterator[Units]:
        """Yield every row's picture (H, W), in units of :attr:`unit` m. Raises ValueError for a damaged one."""
        picture = np.zeros(self.shape, "<u2")
        with self.path.open("rb") as file:
            for k, (_, length) in enumerate(self._places):
                if length:
                    picture = self._decoded(file, k)
                yield picture

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        """Yield every row's picture (H, W), m; 0 for what was not measured."""
        unit = np.float32(self.unit)
        return (units.astype(np.float32) * unit for units in self.units())

    def __getitem__(self, k: int) -> NDArray[np.float32]:
        """Return the picture (H, W) of row ``k``, m; no other one is decoded.

        Raises IndexError if there is no such row, and ValueError if its picture is damaged.
        """
        own = self.stored_row(k)
        if not self._places[own][1]:
            return np.zeros(self.shape, np.float32)
        with self.path.open("rb") as file:
            depth: NDArray[np.float32] = self._decoded(file, own).astype(np.float32) * np.float32(self.unit)
            return depth

    def stored_row(self, k: int) -> int:
        """Return the row that holds the picture of row ``k``: an earlier one if it shows the same picture again."""
        own = range(len(self))[k]
        while own and not self._places[own][1]:
            own -= 1
        return own

    def _decoded(self, file: io.BufferedReader, k: int) -> Units:
        """Return the picture that is stored in record ``k``."""
        import zstandard

        start, length = self._places[k]
        file.seek(start - _RECORD.size)
        _, check = _RECORD.unpack(file.read(_RECORD.size))
        data = file.read(length)
        if crc32(data) != check or zstandard.frame_content_size(data) != 2 * math.prod(self.shape):
            raise ValueError(f"picture {k} is damaged")
        return _unshuffled(zstandard.ZstdDecompressor().decompress(data), self.shape)


def _records(file: io.BufferedReader, size: int) -> Iterator[tuple[int, int]]:
    """Yield start and length of each complete record, from the file's current position."""
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        length, check = _RECORD.unpack(head)
        start = file.tell()
        if start + length > size:
            return
        last = start + length == size
        if last and crc32(file.read(length)) != check:
            return
        file.seek(start + length)
        yield start, length


def _shuffled(units: Units) -> bytes:
    steps = units.copy()
    steps[:, 1:] -= units[:, :-1]
    return np.ascontiguousarray(steps.view(np.uint8).reshape(-1, 2).T).tobytes()


def _unshuffled(data: bytes, shape: tuple[int, int]) -> Units:
    steps = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(2, -1).T).view("<u2").reshape(shape)
    units: Units = np.cumsum(steps, axis=1, dtype=np.uint16)
    return units


def _write(file: io.RawIOBase, data: bytes) -> None:
    """Write all of ``data``: an unbuffered file may accept only a part at a time."""
    rest = memoryview(data)
    while rest:
        written = file.write(rest)
        rest = rest[written or 0 :]


def copy_records(source: Path, target: Path, first: int, end: int) -> None:
    """Write rows ``first`` to ``end - 1`` of a depth file into another one, as they are compressed."""
    reader = DepthReader(source)
    if not 0 <= first < end <= len(reader):
        raise ValueError(f"it has {len(reader)} pictures, and not {first} to {end - 1}")
    begin = reader.stored_row(first)
    target.parent.mkdir(parents=True, exist_ok=True)
    with source.open("rb") as read, target.open("wb") as write:
        write.write(read.readline())
        for start, stop in ((begin, begin + 1), (first + 1, end)):
            read.seek(reader.end_of(start))
            write.write(read.read(reader.end_of(stop) - reader.end_of(start)))


def truncate_records(path: Path, count: int) -> None:
    """Cut a depth file after its first ``count`` records."""
    os.truncate(path, DepthReader(path).end_of(count))


# Statistics of columns and pictures, as a LeRobotDataset keeps them to normalise by.

Stats = dict[str, NDArray[Any]]
"""``min``, ``max``, ``mean``, ``std``, ``q01`` ... ``q99``, each of the column's shape, and ``count`` (1,)."""

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_LEVELS = 256
_FINE = 120
"""Rows of pixels that are counted per picture, at least; as accurate as all of them, and far quicker."""


def column_stats(values: NDArray[Any]) -> Stats:
    """Return the statistics of a column (rows, n), without unknown values (NaN); NaN if there are only those."""
    table = np.asarray(values, np.float64)
    known = np.isfinite(table)
    found: Stats = {key: np.full(table.shape[1], np.nan) for key in ("min", "max", "mean", "std", *_QUANTILES)}
    for k in range(table.shape[1]):
        numbers = table[known[:, k], k]
        if numbers.size:
            found["min"][k], found["max"][k] = numbers.min(), numbers.max()
            found["mean"][k], found["std"][k] = numbers.mean(), numbers.std()
            for key, value in zip(_QUANTILES, np.quantile(numbers, list(_QUANTILES.values())), strict=True):
                found[key][k] = value
    return found | {"count": np.array([len(table)], np.int64)}


class PictureStats:
    """Statistics of pictures, by a histogram of each colour."""

    def __init__(self) -> None:
        self._seen = np.zeros((3, _LEVELS), np.int64)
        self._pictures = 0

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add one picture (H, W, 3) RGB."""
        step = max(1, min(picture.shape[:2]) // _FINE)
        for k in range(3):
            self._seen[k] += np.bincount(picture[::step, ::step, k].ravel(), minlength=_LEVELS)
        self._pictures += 1

    def stats(self) -> Stats:
        """Return the statistics of the colours.

        Each is of shape (3, 1, 1), scaled to 0..1; ``count`` is the number of pictures.
        """
        levels = np.arange(_LEVELS) / (_LEVELS - 1)
        total = np.maximum(1, self._seen.sum(axis=1))
        mean = self._seen @ levels / total
        std = np.sqrt(np.maximum(0.0, self._seen @ levels**2 / total - mean**2))
        there = self._seen > 0
        share = np.cumsum(self._seen, axis=1) / total[:, None]
        found = {
            "min": levels[there.argmax(axis=1)],
            "max": levels[_LEVELS - 1 - there[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": std,
            **{key: levels[(share >= level).argmax(axis=1)] for key, level in _QUANTILES.items()},
        }
        return {key: value.reshape(3, 1, 1) for key, value in found.items()} | {"count": np.array([self._pictures])}


def merge_stats(parts: Sequence[Mapping[str, Any]]) -> Stats:
    """Return the statistics of several parts together: exact but for the quantiles, which are averaged by row count.

    A number that a part does not know (NaN) does not count.
    """
    if len(parts) == 1:
        return {key: np.asarray(value) for key, value in parts[0].items()}
    stacked = {key: np.array([part[key] for part in parts], np.float64) for key in parts[0]}
    rows = stacked["count"].reshape(-1, *(1,) * (stacked["mean"].ndim - 1))

    def average(values: NDArray[Any]) -> NDArray[Any]:
        weights = rows * ~np.isnan(values)
        with np.errstate(invalid="ignore"):
            found: NDArray[Any] = (weights * np.nan_to_num(values)).sum(axis=0) / weights.sum(axis=0)
        return found

    mean = average(stacked["mean"])
    return {
        "min": np.fmin.reduce(stacked["min"]),
        "max": np.fmax.reduce(stacked["max"]),
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, average(stacked["std"] ** 2 + stacked["mean"] ** 2) - mean**2)),
        **{key: average(stacked[key]) for key in _QUANTILES},
        "count": stacked["count"].sum(axis=0).astype(np.int64),
    }


def stats_as_lists(stats: Mapping[str, Stats]) -> dict[str, dict[str, list[Any]]]:
    """Return the statistics of each column as lists, ready for JSON.

    A column in which a number was never known is left out: JSON has no NaN, and an invented number would mislead.
    """
    complete = {key: found for key, found in stats.items() if all(np.isfinite(each).all() for each in found.values())}
    return {key: {name: each.tolist() for name, each in found.items()} for key, found in complete.items()}


# Videos.

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
    """Return the encoder of a codec.

    Args:
        codec: ``h264``, ``av1``, or ``auto`` for the first that is available.

    Raises:
        CommandError: Another codec.
        NotSupported: This build of PyAV cannot encode it.
    """
    import av

    known = [encoder.codec for encoder in _ENCODERS]
    if codec not in ("auto", *known):
        raise CommandError(f"codec must be auto, {' or '.join(known)}, not {codec!r}", code="bad_codec")
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

    stats = PictureStats()
    every = max(1, min(fps, length // _SAMPLES))
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 1
        due = 0
        for count, packet in enumerate(itertools.islice(_packets(container, first, fps), length)):
            if packet.is_keyframe and count >= due:
                due = count + every
                for frame in stream.codec_context.decode(packet):
                    stats.add(frame.to_ndarray(format="rgb24"))
        for frame in stream.codec_context.decode(None):
            stats.add(frame.to_ndarray(format="rgb24"))
    return stats


def read_video(path: Path, first: int = 0, fps: int = 1) -> Iterator[Picture]:
    """Yield every picture (H, W, 3) RGB from number ``first`` on, in order; ``fps`` is needed only for ``first``."""
    import av

    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        stream.thread_type = "AUTO"
        _seek(container, first, fps)
        for frame in container.decode(stream):
            if not first or round(frame.pts * frame.time_base * fps) >= first:
                yield frame.to_ndarray(format="rgb24")
