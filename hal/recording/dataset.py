"""Read a recording: columns as arrays, pictures one by one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, DatasetError, DeviceNotFound
from .codecs import DepthReader, count_frames, read_video
from .index import check_next, read_about, read_index, reading, repair_command
from .layout import MORE_STREAMS, SEGMENTATION, TIMES, VERSION, CameraSetup, Layout, require, video_key

__all__ = [
    "Dataset",
    "Episode",
    "check_compatible",
]

# [compatible.py] Does what is to be recorded fit a dataset that is there already?

_SAID_ELSEWHERE = ("video.fps", "video.width", "video.height")
"""Of a video: the dataset's own fps, and its shape, say it."""


def check_compatible(
    layout: Layout, features: Mapping[str, Any], fps: int, robot_type: str, cameras: Sequence[CameraSetup]
) -> None:
    """Raise CommandError, with everything that differs, where episodes of this kind cannot be added; DatasetError where
    the dataset is damaged."""
    root = layout.root
    if root.exists() and not root.is_dir():
        raise CommandError(f"{root} is a file; a recording needs a folder")
    if layout.info.exists() and not layout.numbers():
        raise CommandError(f"the dataset in {root} was not recorded by this program; choose a new folder")
    info = read_index(layout)
    if info is None:
        if root.is_dir() and not layout.episodes.is_dir() and any(root.iterdir()):
            raise CommandError(f"{root} holds other things than a recording; choose a new folder")
        return
    last = int(info["total_episodes"]) - 1
    if not layout.interrupted:
        check_next(layout, info)
    if info["codebase_version"] != VERSION:
        raise CommandError(f"the dataset in {root} was not recorded by this program; choose a new folder")
    found = [*_settings(info, fps, robot_type), *_features(info["features"], features)]
    if last >= 0:
        found += _depth(read_about(layout, last)["cameras"], cameras)
    if found:
        raise CommandError(f"the dataset in {root} is another kind: {'; '.join(found)}; choose a new folder")


def _settings(info: Mapping[str, Any], fps: int, robot_type: str) -> Iterator[str]:
    for name, new in (("fps", fps), ("robot_type", robot_type)):
        if info.get(name) != new:
            yield f"{name} is {info.get(name)} there, and {new} here"


def _features(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    if missing := [key for key in old if key not in new]:
        yield f"only there: {', '.join(missing)}"
    if added := [key for key in new if key not in old]:
        yield f"only here: {', '.join(added)}"
    for key in (key for key in old if key in new):
        there, here = old[key], new[key]
        for what in ("dtype", "shape"):
            if there.get(what) != here.get(what):
                yield f"{what} of {key} is {there.get(what)} there, and {here.get(what)} here"
        if there.get("names") != here.get("names"):
            yield _names(key, there.get("names") or [], here.get("names") or [])
        video, ours = there.get("info") or {}, here.get("info") or {}
        for what in dict.fromkeys([*video, *ours]):
            if what not in _SAID_ELSEWHERE and video.get(what) != ours.get(what):
                yield f"{what} of {key} is {video.get(what)} there, and {ours.get(what)} here"


def _names(key: str, old: Sequence[str], new: Sequence[str]) -> str:
    """In which numbers a column differs, at most three of each."""
    parts = []
    for where, names, others in (("there", old, new), ("here", new, old)):
        if own := [name for name in names if name not in others]:
            parts.append(f"only {where} it has {', '.join(own[:3])}{' and more' if len(own) > 3 else ''}")
    return f"the names of {key} differ: {'; '.join(parts) or 'their order is another'}"


def _depth(old: Mapping[str, Any], new: Sequence[CameraSetup]) -> Iterator[str]:
    """Cameras, in both, whose depth is not kept alike; no feature of the dataset says so."""
    for camera in new:
        if camera.name not in old:
            continue
        kept = SEGMENTATION in old[camera.name].get("streams", ()), SEGMENTATION in camera.more
        if kept[0] != kept[1]:
            yield f"segmentation of {camera.name} is kept {'there, and not here' if kept[0] else 'here, and not there'}"
        there, here = old[camera.name].get("depth_unit_m"), camera.depth_unit
        if there is None and here is not None:
            yield f"depth of {camera.name} is not kept there, and is here"
        elif there is not None and here is None:
            yield f"depth of {camera.name} is kept there, and not here"
        elif there is not None and here is not None and not math.isclose(there, here, rel_tol=1e-6):
            yield f"depth of {camera.name} is in units of {1e3 * there:g} mm there, and {1e3 * here:g} mm here"


P = TypeVar("P", bound=NDArray[Any])


class _Columns(dict[str, NDArray[Any]]):
    """Columns by their keys; a key that the episode lacks raises DatasetError."""

    def __init__(self, file: str, episode: int) -> None:
        super().__init__()
        self._place = file, episode

    def __missing__(self, key: str) -> NDArray[Any]:
        file, episode = self._place
        raise DatasetError(f"has no column {key}", file=file, episode=episode)


class Episode:
    """One episode. Nothing is read before it is asked for.

    Whatever reads a file raises DatasetError where that file is missing, truncated or damaged, or does not have what
    ``meta/info.json`` and ``episodes/N.json`` say; the error names the file and the episode.
    """

    def __init__(self, layout: Layout, number: int, meta: dict[str, Any]) -> None:
        self._layout = layout
        self._meta = meta
        self.number = number
        self.fps: int = meta["fps"]

    @cached_property
    def info(self) -> dict[str, Any]:
        """Seed, cameras, gaps, versions, the rig's whole configuration: the content of ``episodes/N.json``."""
        return read_about(self._layout, self.number)

    @property
    def length(self) -> int:
        """Number of rows."""
        return int(self.info["length"])

    @property
    def task(self) -> str:
        """What was to be done."""
        return str(self.info["task"])

    @property
    def success(self) -> bool | None:
        """Whether the episode was marked a success; None if it was not marked."""
        mark = self.info["success"]
        return None if mark is None else bool(mark)

    @property
    def data_file(self) -> str:
        """The file of the rows, relative to the dataset's folder."""
        return self._name(self._layout.data(self.number))

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Every column by its key: (rows, n), or (rows,) where it is one number."""
        import pyarrow.parquet as pq

        path = self._layout.data(self.number)
        found = _Columns(self.data_file, self.number)
        features = {key: each for key, each in self._meta["features"].items() if each["dtype"] != "video"}
        with (
            reading(self._layout.root, path, self.number),
            pq.ParquetFile(path, page_checksum_verification=True) as file,
        ):
            if file.metadata.num_rows != self.length:
                raise self._wrong(path, f"has {file.metadata.num_rows} rows, and the episode has {self.length}")
            if odd := sorted(set(file.schema_arrow.names) ^ features.keys()):
                raise self._wrong(path, f"does not have the columns of meta/info.json: {', '.join(odd[:5])}")
            table = file.read()
        for key, feature in features.items():
            column = table[key].combine_chunks()
            shape = [] if feature["shape"] == [1] else feature["shape"]
            values = (column.flatten() if shape else column).to_numpy(zero_copy_only=False)
            if str(values.dtype) != feature["dtype"] or values.size != self.length * int(np.prod(shape)):
                raise self._wrong(path, f"{key} is not {feature['dtype']} {feature['shape']} in every row")
            found[key] = values.reshape(-1, *shape)
        return found

    def names(self, key: str) -> list[str]:
        """Return what the numbers of a column are called. DatasetError for a column that the dataset lacks."""
        if key not in self._meta["features"]:
            raise DatasetError(f"has no column {key}", file="meta/info.json")
        return list(self._meta["features"][key]["names"] or [key])

    @cached_property
    def stamps(self) -> dict[str, NDArray[np.float64]]:
        """True times (rows,) on the rig's clock, s: ``grid``, when each row was due, and of each source
        (``robot.panda``, ``camera.wrist``) when it measured what stands in the row. NaN where it never did."""
        start = float(self.info["t_start"])
        found = _Columns(self.data_file, self.number)
        for key, value in self.columns.items():
            if key.startswith(TIMES):
                found[key.removeprefix(TIMES)] = start + (value if value.ndim == 1 else value[:, 0])
        return found

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose pictures were kept."""
        return tuple(self.info["cameras"])

    def frames(self, camera: str) -> Iterator[NDArray[np.uint8]]:
        """Return the colour picture (H, W, 3) RGB of every row. DeviceNotFound where none was kept."""
        return self.pictures(camera, "color")

    def depth(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """Return the depth picture (H, W) of every row, m; 0 for what was not measured. DeviceNotFound where none was
        kept."""
        return self.pictures(camera, "depth")

    def pictures(self, camera: str, stream: str) -> Iterator[NDArray[Any]]:
        """Return a stream's picture of every row, of the type and shape that it has in :class:`~hal.types.Frame`.

        Args:
            camera: Name of the camera.
            stream: ``color``, ``depth``, ``infrared``, ``infrared_right`` or ``segmentation``. Colour and infrared
                are kept as video, so their values are off by some units.

        Raises:
            DeviceNotFound: No such stream was kept.
            DatasetError: The file is missing, or its first line is damaged. Further damage is raised by the iterator.
        """
        path = self.files(camera).get(stream)
        if path is None:
            there = ", ".join(self.cameras) or "none"
            kept = ", ".join(self.files(camera)) or "nothing"
            raise DeviceNotFound(
                f"episode {self.number} has no {stream} of a camera {camera!r}, but {kept}; cameras: {there}"
            )
        if path.suffix == ".mp4":
            height, width, _ = self._meta["features"][path.parent.parent.name]["shape"]
            if stream == "color":
                return self._each(path, read_video(path), (height, width, 3))
            return self._each(path, (picture[:, :, 0] for picture in read_video(path)), (height, width))
        with reading(self._layout.root, path, self.number):
            reader = DepthReader(path)
        if stream == "depth":
            return self._each(path, iter(reader), reader.shape)
        return self._each(path, (units.astype(np.int32) - 1 for units in reader.units()), reader.shape)

    def files(self, camera: str) -> dict[str, Path]:
        """Return where the pictures of each stream of a camera are; empty for a camera that was not kept."""
        known, features = self.info["cameras"].get(camera), self._meta["features"]
        if known is None:
            return {}
        videos = {"color": camera} | {stream: f"{camera}_{stream}" for stream in MORE_STREAMS}
        found = {
            stream: self._layout.video(name, self.number)
            for stream, name in videos.items()
            if video_key(name) in features
        }
        if known.get("depth_unit_m") is not None:
            found["depth"] = self._layout.depth(camera, self.number)
        if SEGMENTATION in known.get("streams", ()):
            found[SEGMENTATION] = self._layout.depth(f"{camera}_{SEGMENTATION}", self.number)
        return found

    def check_pictures(self) -> None:
        """Raise DatasetError where a video or depth file is missing or does not have a picture per row.

        Pictures are counted and not decoded, which takes milliseconds.
        """
        for path in (path for camera in self.cameras for path in self.files(camera).values()):
            with reading(self._layout.root, path, self.number):
                self._check_count(path, count_frames(path) if path.suffix == ".mp4" else len(DepthReader(path)))

    def _each(self, path: Path, pictures: Iterator[P], shape: tuple[int, ...]) -> Iterator[P]:
        """Yield one picture per row, each of ``shape``."""
        count = 0
        with reading(self._layout.root, path, self.number):
            for picture in pictures:
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
        return DatasetError(what, file=self._name(path), episode=self.number)

    def _name(self, path: Path) -> str:
        return str(path.relative_to(self._layout.root))

    def __len__(self) -> int:
        return self.length

    def __repr__(self) -> str:
        return f"<Episode {self.number}: {self.length} rows at {self.fps} Hz, {self.task!r}>"


class Dataset:
    """The finished episodes in a folder.

    Raises:
        CommandError: There are no episodes in the folder.
        DatasetError: ``meta/info.json`` is damaged, or missing although there are episodes.
        DriverMissing: A library is not installed.
    """

    def __init__(self, out: str | Path) -> None:
        require()
        layout = Layout(out)
        info = read_index(layout)
        if info is None:
            raise CommandError(f"there is no episode in {layout.root}{_hint(layout)}")
        self.root = layout.root
        self.info: dict[str, Any] = info
        """``meta/info.json``."""
        self.fps: int = self.info["fps"]
        self.episodes = tuple(Episode(layout, number, self.info) for number in range(self.info["total_episodes"]))

    def __len__(self) -> int:
        return len(self.episodes)

    def __repr__(self) -> str:
        return f"<Dataset {self.root}: {len(self.episodes)} episodes, {self.info['total_frames']} rows>"


def _hint(layout: Layout) -> str:
    """Return the command that finishes what was not finished; an empty text where all was."""
    left = len(layout.partials())
    if not left:
        return ""
    return f"; {left} {'was' if left == 1 else 'were'} not finished; finish with: {repair_command(layout)}"
