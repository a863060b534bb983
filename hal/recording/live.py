"""The live folder of an episode: every row is on its way to the disk as soon as it is there, and can be read back.

about.json          what is known when it begins: features, cameras, encoder, the rig's configuration
rows.arrow          an Arrow stream, a batch per row
CAMERA.mp4          a fragmented video of the colour; CAMERA_infrared.mp4 of the infrared
CAMERA.depth        depth, see :mod:`.depth`; CAMERA_segmentation.depth, numbers of bodies
reserve             room for the last word, should the disk be full by then
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .codecs import DepthFile, DepthReader, Encoder, VideoFile, as_rgb, count_frames, cut, mend, numbers_to_units
from .index import plain_name
from .layout import MORE_STREAMS, SEGMENTATION, CameraSetup, read_json, sync, write_json
from .ring import Slot

__all__ = ["ABOUT", "RESERVE", "ROWS", "LiveFolder", "Rest", "read_rest"]

ABOUT, ROWS, RESERVE = "about.json", "rows.arrow", "reserve"
_ROOM = 65536


class LiveFolder:
    """Writes one episode. OSError when the disk does not take it; what was written before stays."""

    def __init__(self, folder: Path, about: dict[str, Any], width: int) -> None:
        import pyarrow as pa

        self.folder = folder
        self.count = 0
        """Rows so far."""
        self.cameras = [CameraSetup(*camera) for camera in about["cameras_kept"]]
        self._about = about
        folder.mkdir(parents=True)
        write_json(folder / ABOUT, about)
        (folder / RESERVE).write_bytes(bytes(_ROOM))
        self._files: dict[str, io.FileIO] = {}
        self._pa = pa
        self._schema = pa.schema([("row", pa.list_(pa.float64(), width))])
        self._rows = pa.ipc.new_stream(self._open(ROWS), self._schema)
        encoder, fps = Encoder(*about["encoder"]), int(about["fps"])
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
        """Each camera's newest frame."""
        self._colors: dict[str, NDArray[np.uint8]] = {}
        self._closed = False
        sync(folder)
        self._inode = os.stat(folder).st_ino

    def _open(self, name: str) -> io.FileIO:
        self._files[name] = io.FileIO(self.folder / name, "w+")
        return self._files[name]

    def add(self, slot: Slot) -> None:
        """One row. Its numbers come last, so that no row lacks its pictures."""
        for camera, images in zip(self.cameras, slot.images, strict=True):
            new = self._seen.get(camera.name) != slot.values[camera.seq]
            self._seen[camera.name] = float(slot.values[camera.seq])
            for name, stream in camera.videos.items():
                if new:
                    self._colors[name] = as_rgb(images[stream])
                self._videos[name].add(self._colors[name])
            for name, stream in camera.depths.items():
                if stream == SEGMENTATION:
                    self._depths[name].add_units(numbers_to_units(images[stream]) if new else None)
                else:
                    self._depths[name].add(images[stream] if new else None)
        row = self._pa.FixedSizeListArray.from_arrays(self._pa.array(slot.values), len(slot.values))
        self._rows.write_batch(self._pa.record_batch([row], schema=self._schema))
        self.count += 1

    @property
    def in_place(self) -> bool:
        """Is the folder still where it was?"""
        try:
            return os.stat(self.folder).st_ino == self._inode
        except OSError:
            return False

    def rescue(self) -> bool:
        """Write files that somebody has deleted once more, from what is still open. False where they were moved."""
        if any(os.fstat(file.fileno()).st_nlink for file in self._files.values()):
            return False
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / ABOUT, self._about)
        for name, file in self._files.items():
            with (self.folder / name).open("wb") as copy:
                for place in range(0, os.fstat(file.fileno()).st_size, 1 << 20):
                    copy.write(os.pread(file.fileno(), 1 << 20, place))
        return True

    def close(self) -> None:
        """Write what the encoders hold. What cannot be written is left out: reading back finds the last whole row.

        Idempotent.
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


class Rest:
    """What a live folder holds: rows of which every part is there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.about: dict[str, Any] = read_json(folder / ABOUT)
        self.cameras = [CameraSetup(*camera) for camera in self.about["cameras_kept"]]
        for camera in self.cameras:
            plain_name(camera.name)
            if not set(camera.more) <= set(MORE_STREAMS):
                raise ValueError(f"{camera.name} has unknown streams: {camera.more}")
        rows = list(_rows(folder / ROWS))
        lengths = [len(rows), *(self._pictures(camera) for camera in self.cameras)]
        self.length = min(lengths)
        self.rows = np.array(rows[: self.length])
        """(rows, numbers)"""
        for camera in self.cameras:
            for name in camera.depths if self.length else ():
                cut(folder / f"{name}.depth", self.length)

    def _pictures(self, camera: CameraSetup) -> int:
        """Of how many rows this camera's pictures are there."""
        found = []
        try:
            for name in camera.videos:
                video = self.folder / f"{name}.mp4"
                mend(video)
                found.append(count_frames(video))
            for name in camera.depths:
                found.append(len(DepthReader(self.folder / f"{name}.depth")))
        except (FileNotFoundError, ValueError):  # it was killed before there was any
            return 0
        return min(found, default=1 << 62)


def read_rest(folder: Path) -> Rest | None:
    """Return what can be read back; None for a folder that was not even begun."""
    return Rest(folder) if (folder / ABOUT).exists() else None


def _rows(path: Path) -> Iterator[NDArray[np.float64]]:
    """Every whole row of a stream that may end anywhere."""
    import pyarrow as pa

    try:
        with path.open("rb") as file, pa.ipc.open_stream(file) as stream:
            for batch in stream:
                yield batch.column(0).values.to_numpy()
    except (pa.ArrowInvalid, OSError, EOFError):
        return
