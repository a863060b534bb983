"""Read a dataset: columns as arrays, pictures one by one."""

from __future__ import annotations

import threading
import weakref
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import accumulate, islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, DatasetError, DeviceNotFound
from ..types import STREAMS
from .about import read_about
from .codecs import DepthReader
from .foreign import is_foreign, read_foreign
from .index import read_index, repair_command
from .layout import (
    MORE_STREAMS,
    SUCCESS,
    TIMES,
    DatasetLayout,
    EpisodePlace,
    current_key,
    file_version,
    require_libraries,
    video_key,
)
from .validation import dataset_errors, wrong_file
from .videos import count_frames, read_picture, read_video

P = TypeVar("P", bound=NDArray[Any])


class _Columns(dict[str, NDArray[Any]]):
    """Columns by key; a key that the episode lacks raises DatasetError."""

    def __init__(self, file: str, episode: int) -> None:
        super().__init__()
        self._place = file, episode

    def __missing__(self, key: str) -> NDArray[Any]:
        file, episode = self._place
        raise DatasetError(f"has no column {key}", file=file, episode=episode)


class _ReadMemory:
    """Forgets what was read first of the episodes, when that of all needs more than ``limit`` bytes."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._used = 0
        self._read: deque[tuple[weakref.ref[Episode], str, int]] = deque()
        self._lock = threading.Lock()

    def add(self, episode: Episode, name: str, size: int) -> None:
        """Add what an episode has just read: an attribute that it reads again when it is needed, and its bytes."""
        with self._lock:
            self._used += size
            while self._used > self.limit and self._read:
                oldest, attribute, freed = self._read.popleft()
                self._used -= freed
                if (other := oldest()) is not None:
                    other.__dict__.pop(attribute, None)
            self._read.append((weakref.ref(episode), name, size))


def _bytes(arrays: Mapping[str, NDArray[Any]]) -> int:
    return sum(values.nbytes + 256 for values in arrays.values())  # an array takes some bytes of its own


_MEMORY = _ReadMemory(500_000_000)


@lru_cache(maxsize=32)
def _metadata(path: Path, version: tuple[int, int] | None) -> Any:
    """Return the metadata of a Parquet file; ``version`` is that of the file now."""
    import pyarrow.parquet as pq

    return pq.read_metadata(path)


@lru_cache(maxsize=1024)
def _group_ends(path: Path, version: tuple[int, int] | None) -> list[int]:
    """Return the number of rows up to the end of each row group of a file."""
    found = _metadata(path, version)
    return list(accumulate(found.row_group(k).num_rows for k in range(found.num_row_groups)))


@lru_cache(maxsize=16)
def _read_groups(path: Path, version: tuple[int, int] | None, groups: range) -> Any:
    """Return some row groups of a file, which short episodes share."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, metadata=_metadata(path, version), page_checksum_verification=True) as file:
        return file.read_row_groups(list(groups), use_threads=False)


class KeptRows(NamedTuple):
    """Rows of an episode, one after the other."""

    first: int
    end: int
    """Row after the last one."""


_MAY_CHANGE = dict.fromkeys(("common", "files", "success", "task"))
"""Metadata that an episode can get later."""


class Episode:
    """One finished episode. Files are read only when an attribute or method needs them.

    Everything that reads a file raises DatasetError if the file is missing, truncated or damaged, or lacks what
    ``meta/info.json`` and ``episodes/N.json`` list; the error names the file and the episode.
    """

    def __init__(
        self, layout: DatasetLayout, number: int, meta: dict[str, Any], about: dict[str, Any] | None = None
    ) -> None:
        self._layout = layout
        self._meta = meta
        self._about = about
        """What is known about an episode without metadata of its own (:mod:`~hal.recording.foreign`)."""
        self.rows: KeptRows | None = None
        """The rows that are left of an episode that is being trimmed; None for one as it is on the disk."""
        self.number = number
        self.fps: int = meta["fps"]
        self._version: tuple[int, int] | None = None
        """Of the episode's metadata file when it was read."""

    @cached_property
    def info(self) -> dict[str, Any]:
        """Metadata of the episode: seed, cameras, gaps, versions, the rig's whole configuration.

        Not to be changed: what is the same in many episodes is on the disk and in memory once.
        """
        if self._about is not None:
            return self._about
        self._version = file_version(self._about_file)
        return read_about(self._layout, self.number)

    @cached_property
    def _about_file(self) -> Path:
        return self._layout.about(self.number)

    def _is_current(self) -> bool:
        """Return whether the known place is that of the episode's files now."""
        return self._about is not None or self._version == file_version(self._about_file)

    def _follow(self) -> None:
        """Read the metadata again if the episode was marked, or its files joined with others, since it was read.

        Raises DatasetError (code ``dataset_changed``) if another episode has this number now.
        """
        known = self.info
        if self._is_current():
            return
        version, found = file_version(self._about_file), read_about(self._layout, self.number)
        if known | _MAY_CHANGE != found | _MAY_CHANGE:
            raise self._changed()
        self._version, self.info = version, found
        self.__dict__.pop("place", None)
        self.__dict__.pop("_files", None)

    def _changed(self) -> DatasetError:
        text = "another episode has this number since the dataset was opened: open it again"
        return wrong_file(self._layout, self._about_file, text, self.number, "dataset_changed")

    def _check_current(self) -> None:
        """Raise DatasetError if a file that was just read may be of another episode."""
        if not self._is_current():
            raise self._changed()

    @property
    def length(self) -> int:
        """Number of rows."""
        return int(self.info["length"])

    @property
    def task(self) -> str:
        """Description of the task."""
        return str(self.info["task"])

    @property
    def success(self) -> bool | None:
        """Whether the episode was marked a success; None if it was not marked."""
        mark = self.info["success"]
        if self._about is not None and mark is None and SUCCESS in self._meta["features"]:
            return bool(self.columns[SUCCESS].any()) or None
        return None if mark is None else bool(mark)

    @property
    def trouble(self) -> str:
        """Why its recording ended by itself, such as a lost camera; empty if it was saved."""
        return str(self.info.get("trouble") or ("recovered" if self.info.get("recovered") else ""))

    @property
    def data_file(self) -> str:
        """The file of the rows, relative to the dataset's folder."""
        return str(self._layout.data(self.place.data[0]).relative_to(self._layout.root))

    @cached_property
    def place(self) -> EpisodePlace:
        """The files that hold the episode, and where it begins in them."""
        return EpisodePlace.of(self.number, self.info)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Every column by its key: (rows, n), or (rows,) for a single number.

        They are read once, and once more if those of many other episodes were read meanwhile.
        """
        found = _Columns(self.data_file, self.number)
        path = self._layout.root / self.data_file
        features = {key: each for key, each in self._meta["features"].items() if each["dtype"] != "video"}
        table = self.read_table()
        odd = features.keys() - set(table.column_names)
        if self._about is None:
            odd |= set(table.column_names) - features.keys()
        if odd:
            raise self._wrong(path, f"does not have the columns of meta/info.json: {', '.join(sorted(odd)[:5])}")
        for key, feature in features.items():
            column = table[key].combine_chunks()
            shape = [] if feature["shape"] == [1] else feature["shape"]
            values = (column.flatten() if shape else column).to_numpy(zero_copy_only=False)
            if str(values.dtype) != feature["dtype"] or values.size != self.length * int(np.prod(shape)):
                raise self._wrong(path, f"{key} is not {feature['dtype']} {feature['shape']} in every row")
            own = np.array(values.reshape(-1, *shape))  # no view of rows that other episodes share
            own.flags.writeable = False
            found[current_key(key)] = own
        _MEMORY.add(self, "columns", _bytes(found))
        return found

    def read_table(self) -> Any:
        """Return the rows as an Arrow table, with the columns as they are stored."""
        self._follow()
        file_number, first = self.place.data
        path = self._layout.data(file_number)
        with dataset_errors(self._layout, path, self.number):
            version = file_version(path)
            ends = _group_ends(path, version)
            rows, end = ends[-1] if ends else 0, first + self.length
            if rows < end:
                raise self._wrong(path, f"has {rows} rows, and the episode ends with row {end}")
            groups = range(bisect_right(ends, first), bisect_left(ends, end) + 1)
            start = ends[groups[0] - 1] if groups[0] else 0
            table = _read_groups(path, version, groups).slice(first - start, self.length)
            if set(table["episode_index"].to_pylist()) != {self.number}:
                raise self._wrong(path, "has rows of another episode")
        self._check_current()
        return table

    def names(self, key: str) -> list[str]:
        """Return the names of a column's numbers. Raises DatasetError for a column that the dataset lacks."""
        for stored, feature in self._meta["features"].items():
            if current_key(stored) == key:
                return list(feature["names"] or [key])
        raise DatasetError(f"has no column {key}", file="meta/info.json")

    @cached_property
    def stamps(self) -> dict[str, NDArray[np.float64]]:
        """True times (rows,) on the rig's clock, s.

        ``grid`` is when each row was due; each source (``robot.panda``, ``camera.wrist``) has the times at which the
        row's values were measured, NaN if that is unknown. Without recorded times ``grid`` is LeRobot's nominal time.
        """
        start = float(self.info["t_start"])
        found = _Columns(self.data_file, self.number)
        for key, value in self.columns.items():
            if key.startswith(TIMES):
                found[key.removeprefix(TIMES)] = start + (value if value.ndim == 1 else value[:, 0])
        if self._about is not None:
            found.setdefault("grid", self.columns["timestamp"].astype(np.float64))
        _MEMORY.add(self, "stamps", _bytes(found))
        return found

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the recorded cameras."""
        return tuple(self.info["cameras"])

    def frames(self, camera: str) -> Iterator[NDArray[np.uint8]]:
        """Yield the colour picture (H, W, 3) RGB of every row. Raises DeviceNotFound if none was recorded."""
        return self.pictures(camera, "color")

    @cached_property
    def depth(self) -> EpisodeDepth:
        """Depth: ``depth[row]`` of the only camera that has some, ``depth["wrist"][row]``, ``depth("wrist")`` for all.

        A row is read alone, from its place in the file.
        """
        return EpisodeDepth(self)

    def pictures(self, camera: str, stream: str) -> Iterator[NDArray[Any]]:
        """Yield a stream's picture of every row, with the type and shape that it has in :class:`~hal.types.Frame`.

        Args:
            camera: Name of the camera.
            stream: A name of :data:`hal.types.STREAMS`. All but the exact ones are stored as video, so their values
                differ slightly from the camera's.

        Raises:
            DeviceNotFound: That stream was not recorded.
            DatasetError: The file is missing, or its first line is damaged. Further damage is raised by the iterator.
        """
        path = self._file_of(camera, stream)
        if path.suffix == ".mp4":
            height, width, _ = self._meta["features"][path.parent.parent.name]["shape"]
            pictures = read_video(path, self.first_picture(path), self.fps)
            if STREAMS[stream].shape:
                return self._yield_pictures(path, pictures, (height, width, 3))
            return self._yield_pictures(path, (picture[:, :, 0] for picture in pictures), (height, width))
        reader = self._depth_reader(path)
        if stream == "depth":
            return self._yield_pictures(path, iter(reader), reader.shape)
        dtype, lowest = STREAMS[stream].dtype, int(STREAMS[stream].lowest)
        return self._yield_pictures(
            path, ((units.astype(np.int32) + lowest).astype(dtype) for units in reader.units()), reader.shape
        )

    def frame(self, camera: str, row: int) -> NDArray[np.uint8]:
        """Return the colour picture (H, W, 3) RGB of one row; at most one other one is decoded.

        Raises DeviceNotFound if none was recorded, and IndexError if there is no such row.
        """
        path = self._file_of(camera, "color")
        own = range(self.length)[row]
        with dataset_errors(self._layout, path, self.number):
            found = read_picture(path, self.place.video(camera)[1] + own, self.fps)
        self._check_current()
        if found is None:
            raise self._wrong(path, f"has no picture of row {own}")
        return found

    def _file_of(self, camera: str, stream: str) -> Path:
        """Return the file of a stream. Raises DeviceNotFound if it was not recorded."""
        self._follow()
        files = self._files.get(camera, {})
        if stream not in files:
            there = ", ".join(self.cameras) or "none"
            kept = ", ".join(files) or "nothing"
            raise DeviceNotFound(
                f"episode {self.number} has no {stream} of a camera {camera!r}, but {kept}; cameras: {there}"
            )
        return files[stream]

    def _depth_reader(self, path: Path) -> DepthReader:
        with dataset_errors(self._layout, path, self.number):
            return DepthReader(path)

    def files(self, camera: str) -> dict[str, Path]:
        """Return the file of each stream of a camera; empty for a camera that was not recorded."""
        return dict(self._files.get(camera, {}))

    def picture_files(self, suffix: str = "") -> list[Path]:
        """Return the files of all streams of all cameras, or those with a suffix: ``.mp4`` or ``.depth``."""
        return [path for files in self._files.values() for path in files.values() if path.name.endswith(suffix)]

    @cached_property
    def _files(self) -> dict[str, dict[str, Path]]:
        return {camera: self._list_files(camera, known) for camera, known in self.info["cameras"].items()}

    def _list_files(self, camera: str, known: Mapping[str, Any]) -> dict[str, Path]:
        features = self._meta["features"]
        videos = {"color": camera} | {stream: f"{camera}_{stream}" for stream in MORE_STREAMS}
        found = {
            stream: self._layout.video(name, self.place.video(name)[0])
            for stream, name in videos.items()
            if video_key(name) in features
        }
        if known.get("depth_unit_m") is not None:
            found["depth"] = self._layout.depth(camera, self.number)
        for stream in known.get("streams", ()):
            if stream in MORE_STREAMS and STREAMS[stream].exact:
                found[stream] = self._layout.depth(f"{camera}_{stream}", self.number)
        return found

    def file_versions(self) -> tuple[tuple[int, int] | None, ...]:
        """Return numbers that change when a file of the episode is written anew."""
        self._follow()
        files = (self._about_file, self._layout.root / self.data_file, *self.picture_files())
        return tuple(map(file_version, files))

    def first_picture(self, video: Path) -> int:
        """Return the number of the episode's first picture in a video of :meth:`files`."""
        return self.place.video(video.parent.parent.name.removeprefix(video_key("")))[1]

    def check_pictures(self) -> None:
        """Raise DatasetError if a video or depth file is missing or does not have one picture per row.

        Pictures are counted, not decoded, which takes milliseconds.
        """
        self._follow()
        for path in self.picture_files():
            with dataset_errors(self._layout, path, self.number):
                if path.suffix == ".mp4":
                    self._check_count(path, count_frames(path, self.first_picture(path), self.length, self.fps))
                else:
                    self._check_count(path, len(DepthReader(path)))

    def _yield_pictures(self, path: Path, pictures: Iterator[P], shape: tuple[int, ...]) -> Iterator[P]:
        """Yield one picture per row, each of ``shape``; pictures of a next episode may follow in a video."""
        count = 0
        with dataset_errors(self._layout, path, self.number):
            for picture in islice(pictures, self.length + (path.suffix != ".mp4")):
                if count == 0:  # the file is open
                    self._check_current()
                if picture.shape != shape:
                    raise self._wrong(path, f"has a picture of {picture.shape}, not {shape}")
                count += 1
                if count > self.length:
                    break
                yield picture
            self._check_count(path, count)

    def _check_count(self, path: Path, count: int) -> None:
        if count != self.length:
            found = f"has {count} pictures" if count < self.length else "has more pictures than rows"
            raise self._wrong(path, f"{found}, for {self.length} rows")

    def _wrong(self, path: Path, what: str) -> DatasetError:
        return wrong_file(self._layout, path, what, self.number)

    def __len__(self) -> int:
        return self.length

    def __repr__(self) -> str:
        return f"<Episode {self.number}: {self.length} rows at {self.fps} Hz, {self.task!r}>"


class CameraDepth(Sequence[NDArray[np.float32]]):
    """Depth of one camera: the picture (H, W) of a row, m; 0 for what was not measured.

    A row is decoded when it is read, without the others. Raises IndexError for a row that the episode lacks, and
    DatasetError for a damaged one.
    """

    def __init__(self, episode: Episode, camera: str) -> None:
        self._episode = episode
        self._path = episode._file_of(camera, "depth")
        self._reader = episode._depth_reader(self._path)
        episode._check_count(self._path, len(self._reader))

    def __len__(self) -> int:
        return len(self._reader)

    @property
    def nbytes(self) -> int:
        """Size in memory, bytes: of the places of the rows in the file."""
        return self._reader.nbytes

    @overload
    def __getitem__(self, row: int) -> NDArray[np.float32]: ...
    @overload
    def __getitem__(self, row: slice) -> list[NDArray[np.float32]]: ...
    def __getitem__(self, row: int | slice) -> NDArray[np.float32] | list[NDArray[np.float32]]:
        if isinstance(row, slice):
            return [self[k] for k in range(*row.indices(len(self)))]
        own = range(len(self))[row]  # IndexError as it is: iteration ends with it
        with dataset_errors(self._episode._layout, self._path, self._episode.number):
            found = self._reader[own]
        self._episode._follow()
        return found


class EpisodeDepth:
    """Depth of an episode's cameras; see :attr:`Episode.depth`."""

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        self._cameras: dict[str, CameraDepth] = {}

    def __call__(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """Yield the depth picture (H, W) of every row of a camera, m; 0 for what was not measured.

        Raises DeviceNotFound if none was recorded.
        """
        return self._episode.pictures(camera, "depth")

    @overload
    def __getitem__(self, key: str) -> CameraDepth: ...
    @overload
    def __getitem__(self, key: int) -> NDArray[np.float32]: ...
    def __getitem__(self, key: str | int) -> CameraDepth | NDArray[np.float32]:
        """Return the depth of a camera, by its name, or that of a row of the only camera that has depth.

        Raises:
            DeviceNotFound: No depth of this camera was recorded, or that of several was, so a row is not enough.
            IndexError: There is no such row.
            DatasetError: The file is missing or damaged.
        """
        if not isinstance(key, str):
            having = [camera for camera in self._episode.cameras if "depth" in self._episode.files(camera)]
            if len(having) != 1:
                raise DeviceNotFound(
                    f"episode {self._episode.number} has depth of {', '.join(having) or 'no camera'}; select one: "
                    f"depth[{having[0] if having else 'name'!r}][{key}]"
                )
            return self[having[0]][key]
        if key not in self._cameras:
            self._cameras[key] = CameraDepth(self._episode, key)
            _MEMORY.add(self._episode, "depth", self._cameras[key].nbytes)
        return self._cameras[key]


class Dataset:
    """The finished episodes in a folder.

    Args:
        out: The folder.

    Raises:
        CommandError: There are no episodes in the folder (code ``no_episodes``).
        DatasetError: ``meta/info.json`` is damaged, or missing although there are episodes.
        DriverMissing: A library is not installed.
    """

    def __init__(self, out: str | Path) -> None:
        require_libraries()
        self._layout = layout = DatasetLayout(out)
        self._version = file_version(layout.info)
        foreign = read_foreign(layout) if is_foreign(layout) else None
        info = read_index(layout) if foreign is None else foreign.info
        if info is None or info["total_episodes"] == 0:
            missing = "" if layout.root.is_dir() else ", which does not exist"
            raise CommandError(f"there is no episode in {layout.root}{missing}{_hint(layout)}", code="no_episodes")
        self.root = layout.root
        self.info: dict[str, Any] = info
        """``meta/info.json``."""
        self.notes: tuple[str, ...] = () if foreign is None else foreign.notes
        """What is missing in a dataset that another program edited or recorded."""
        self.fps: int = info["fps"]
        abouts = [None] * info["total_episodes"] if foreign is None else foreign.episodes
        self.episodes = tuple(Episode(layout, number, info, about) for number, about in enumerate(abouts))

    def has_changed(self) -> bool:
        """Return whether episodes were added, removed or changed since the dataset was opened."""
        return self._version != file_version(self._layout.info)

    def __len__(self) -> int:
        return len(self.episodes)

    def __repr__(self) -> str:
        return f"<Dataset {self.root}: {len(self.episodes)} episodes, {self.info['total_frames']} rows>"


def _hint(layout: DatasetLayout) -> str:
    """Return the command that finishes unfinished episodes; an empty text if there are none."""
    left = len(layout.partials())
    if not left:
        return ""
    return f"; {left} {'was' if left == 1 else 'were'} not finished; finish with: {repair_command(layout)}"
