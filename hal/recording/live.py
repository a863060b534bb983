"""An episode while it is recorded: the queue of rows from the app to the writer's process, and the folder on disk.

Every row is written to the live folder as soon as it arrives, so that it can be read back after a crash::

    about.json          metadata at the start: features, cameras, encoder, the rig's configuration
    rows.arrow          an Arrow stream, one batch per row
    CAMERA.mp4          a fragmented video of the colour; CAMERA_infrared.mp4 of the infrared
    CAMERA.depth        depth, see codecs.py; CAMERA_segmentation.depth: numbers of bodies
    reserve             space for the last files, in case the disk is full at the end
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..host.memory import Mailbox
from ..host.ring import ArrayRing
from ..types import STREAMS
from .codecs import DepthFile, DepthReader, ids_to_units, truncate_records
from .layout import MORE_STREAMS, CameraSetup, read_json, sync_to_disk, write_json
from .validation import checked_name
from .videos import VideoEncoder, VideoFile, as_rgb, count_frames, truncate_to_last_fragment

# The queue.

_STATUS = "dH2000s"  # free space in bytes, length of the trouble's text, the text
_TEXT = 2000
VALUES = -1, ""
"""Key of a row's numbers in its slot; a picture's is the index of its camera, and its stream. A picture that is not new
keeps the slot's former content."""

_Key = tuple[int, str]
RowSlot = dict[_Key, NDArray[Any]]
"""One row in the queue."""


class RowQueue(ArrayRing[_Key]):
    """A queue of rows in shared memory, each with ``width`` numbers and the pictures of ``cameras``; read in place."""

    def __init__(self, buffer: memoryview, width: int, cameras: Sequence[CameraSetup], slots: int) -> None:
        """Lay the queue out in ``buffer``, which has :meth:`size` bytes and starts as zeros."""
        super().__init__(buffer[_status_size() :], _arrays(width, cameras), slots)
        self._status = Mailbox(buffer, _STATUS)
        self._reported: tuple[float, str] = (0.0, "")

    @staticmethod
    def size(width: int, cameras: Sequence[CameraSetup], slots: int) -> int:
        """Return the number of bytes that the queue needs."""
        return _status_size() + ArrayRing.count_bytes(_arrays(width, cameras), slots)

    # In the app.

    @property
    def is_half_full(self) -> bool:
        """Whether more than half of the slots are waiting."""
        return 2 * self.waiting > len(self.slots)

    @property
    def free_bytes(self) -> int:
        """Free space on the disk in the writer's last report, bytes; 0 before the first."""
        found = self._status.read()
        return int(found[1][0]) if found is not None else 0

    @property
    def trouble(self) -> str:
        """Why the writer has stopped writing; empty while it writes."""
        found = self._status.read()
        return found[1][2][: found[1][1]].decode(errors="replace") if found is not None else ""

    # In the writer's process.

    def report(self, free_bytes: int | None = None, trouble: str | None = None) -> None:
        """Report free space, trouble or both to the app; what is None keeps its value."""
        free, text = self._reported
        self._reported = free, text = (
            free if free_bytes is None else float(free_bytes),
            text if trouble is None else trouble,
        )
        data = text.encode()[:_TEXT]
        self._status.write(free, len(data), data)


def _status_size() -> int:
    return -(-Mailbox.size(_STATUS) // 64) * 64  # the arrays stay aligned


def _arrays(width: int, cameras: Sequence[CameraSetup]) -> dict[_Key, tuple[tuple[int, ...], DTypeLike]]:
    """Return shape and type of every array of a row."""
    arrays: dict[_Key, tuple[tuple[int, ...], DTypeLike]] = {VALUES: ((width,), np.float64)}
    for index, camera in enumerate(cameras):
        for stream in (*camera.videos.values(), *camera.depths.values()):
            kind = STREAMS[stream]
            arrays[index, stream] = (camera.height, camera.width, *kind.shape), kind.dtype
    return arrays


ABOUT, ROWS, RESERVE = "about.json", "rows.arrow", "reserve"
_RESERVED_BYTES = 65536


class LiveFolder:
    """Writes one episode to its live folder. Raises OSError if the disk refuses; what was written before stays."""

    def __init__(self, folder: Path, about: dict[str, Any], width: int) -> None:
        import pyarrow as pa

        self.folder = folder
        self.count = 0
        """Rows written."""
        self.cameras = [CameraSetup(*camera) for camera in about["cameras_kept"]]
        self._about = about
        folder.mkdir(parents=True)
        write_json(folder / ABOUT, about)
        (folder / RESERVE).write_bytes(bytes(_RESERVED_BYTES))
        self._files: dict[str, io.FileIO] = {}
        self._pa = pa
        self._schema = pa.schema([("row", pa.list_(pa.float64(), width))])
        self._rows = pa.ipc.new_stream(self._open(ROWS), self._schema)
        encoder, fps = VideoEncoder(*about["encoder"]), int(about["fps"])
        self._videos = {
            name: VideoFile(self._open(f"{name}.mp4"), encoder, camera.width, camera.height, fps)
            for camera in self.cameras
            for name in camera.videos
        }
        self._depths = {
            name: DepthFile(self._open(f"{name}.depth"), camera.width, camera.height, camera.depth_unit or 1.0)
            for camera in self.cameras
            for name in camera.depths
        }
        self._seen: dict[str, float] = {}
        """Sequence number of each camera's newest frame."""
        self._colors: dict[str, NDArray[np.uint8]] = {}
        self._closed = False
        sync_to_disk(folder)
        self._inode = os.stat(folder).st_ino

    def _open(self, name: str) -> io.FileIO:
        self._files[name] = io.FileIO(self.folder / name, "w+")
        return self._files[name]

    def add(self, slot: RowSlot) -> None:
        """Write one row, its numbers last, so that no row that can be read back lacks its pictures."""
        values = slot[VALUES]
        for k, camera in enumerate(self.cameras):
            new = self._seen.get(camera.name) != values[camera.seq]
            self._seen[camera.name] = float(values[camera.seq])
            for name, stream in camera.videos.items():
                if new:
                    self._colors[name] = as_rgb(slot[k, stream])
                self._videos[name].add(self._colors[name])
            for name, stream in camera.depths.items():
                if stream == "depth":
                    self._depths[name].add(slot[k, stream] if new else None)
                else:
                    units = ids_to_units(slot[k, stream], STREAMS[stream].lowest) if new else None
                    self._depths[name].add_units(units)
        row = self._pa.FixedSizeListArray.from_arrays(self._pa.array(values), len(values))
        self._rows.write_batch(self._pa.record_batch([row], schema=self._schema))
        self.count += 1

    @property
    def in_place(self) -> bool:
        """Whether the folder is still where it was created."""
        try:
            return os.stat(self.folder).st_ino == self._inode
        except OSError:
            return False

    def close(self) -> None:
        """Write what the encoders still hold, and close all files. Idempotent.

        Data that cannot be written is left out: reading back finds the last complete row.
        """
        if self._closed:
            return
        self._closed = True
        for video in self._videos.values():
            with contextlib.suppress(Exception):
                video.close()
        with contextlib.suppress(Exception):
            self._rows.close()
        for file in self._files.values():
            with contextlib.suppress(OSError):
                os.fsync(file.fileno())
            file.close()


class LiveContent:
    """Content of a live folder: the rows of which every part is there.

    Raises DatasetError-free built-in errors (ValueError, KeyError, OSError) for a damaged ``about.json``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.about: dict[str, Any] = read_json(folder / ABOUT)
        self.cameras = [CameraSetup(*camera) for camera in self.about["cameras_kept"]]
        for camera in self.cameras:
            checked_name(camera.name)
            if not set(camera.more) <= set(MORE_STREAMS):
                raise ValueError(f"{camera.name} has unknown streams: {camera.more}")
        rows = list(_rows(folder / ROWS))
        """(length, width) numbers."""
        lengths = [len(rows), *(self._count_pictures(camera) for camera in self.cameras)]
        self.length = min(lengths)
        self.rows = np.array(rows[: self.length])
        """(rows, numbers)"""
        for camera in self.cameras:
            for name in camera.depths if self.length else ():
                truncate_records(folder / f"{name}.depth", self.length)

    def _count_pictures(self, camera: CameraSetup) -> int:
        """Return for how many rows this camera's pictures are there."""
        found = []
        try:
            for name in camera.videos:
                video = self.folder / f"{name}.mp4"
                truncate_to_last_fragment(video)
                found.append(count_frames(video))
            for name in camera.depths:
                found.append(len(DepthReader(self.folder / f"{name}.depth")))
        except (FileNotFoundError, ValueError):  # killed before the file was complete enough to read
            return 0
        return min(found, default=1 << 62)


def read_live(folder: Path) -> LiveContent | None:
    """Return the content of a live folder; None if not even its metadata was written."""
    return LiveContent(folder) if (folder / ABOUT).exists() else None


def _rows(path: Path) -> Iterator[NDArray[np.float64]]:
    """Yield every complete row of a stream that may end anywhere."""
    import pyarrow as pa

    try:
        with path.open("rb") as file, pa.ipc.open_stream(file) as stream:
            for batch in stream:
                yield batch.column(0).values.to_numpy()
    except (pa.ArrowInvalid, OSError, EOFError):
        return
