"""The format of a dataset: its columns, the place of every file, and how to write files that survive a crash."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import importlib.util
import json
import math
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import CommandError, DriverMissing
from ..types import STREAMS

VERSION = "v3.0"
"""Version of LeRobot's format."""
STATE = "observation.state"
ACTION = "action"
SETPOINT = "rig.setpoint"
"""LeRobot treats columns whose names begin with ``observation`` or ``action`` as inputs and outputs of a policy. What a
policy must not learn from, because it contains the answer or is unknown on a robot, begins with ``rig``."""
GRIP_FORCE = "rig.setpoint_force"
"""Force that was asked of each gripper, N."""
TAU_EXT, WRENCH_EXT = "rig.tau_ext", "rig.wrench_ext"
"""External torques, Nm, and the external wrench at the tcp, N and Nm, as the arm estimates them."""
ENVIRONMENT = "observation.environment_state"
"""LeRobot's key for what a policy sees of the world beside the robot: here the poses of objects."""
PAD = "rig.pad"
SUCCESS = "next.success"
SOURCE = "source"
SOURCES = ("", "person", "policy", "program")
"""Who drives, by the number in :data:`SOURCE`; empty if it is unknown."""
AFTERWARDS: dict[str, str] = {"intervention": "bool", "next.success": "bool", "next.done": "bool"}
"""Columns that are known when an episode ends, with their types."""
TIMES = "rig.time."
"""Prefix of the columns whose first number is a time, s: on the rig's clock while it is recorded, in the dataset since
the episode's first row."""
GRID = f"{TIMES}grid"

MORE_STREAMS = tuple(stream for stream in STREAMS if stream not in ("color", "depth"))
"""Streams of a camera that are recorded only on request."""
OBJECTS = "objects"
"""Requested beside streams, it records the poses of the simulation's objects as an observation."""
BOOKKEEPING: dict[str, str] = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that every LeRobotDataset has, with their types."""


class Column(NamedTuple):
    """One column of the dataset: ``len(names)`` numbers in every row."""

    key: str
    dtype: str
    """``float32``, ``float64``, ``int64`` or ``bool`` on disk; in the queue every number is a double."""
    names: tuple[str, ...]

    @property
    def feature(self) -> dict[str, Any]:
        """The column's entry in ``features`` of ``meta/info.json``."""
        return {"dtype": self.dtype, "shape": [len(self.names)], "names": list(self.names)}


class CameraSetup(NamedTuple):
    """Which pictures of one camera are recorded, and how."""

    name: str
    width: int
    height: int
    color: bool
    depth_unit: float | None
    """Metres per unit of the stored depth; None if no depth is recorded."""
    depth_lossless: bool
    """Whether the camera itself measures in that unit."""
    seq: int
    """Index of the number in a row that counts this camera's frames."""
    more: Sequence[str] = ()
    """Streams that are recorded besides colour and depth: some of :data:`MORE_STREAMS`."""

    @property
    def videos(self) -> dict[str, str]:
        """Names of the videos, each with its stream: ``wrist`` has the colour, ``wrist_infrared`` the infrared."""
        color = {self.name: "color"} if self.color else {}
        return color | {f"{self.name}_{stream}": stream for stream in self.more if not STREAMS[stream].exact}

    @property
    def depths(self) -> dict[str, str]:
        """Names of the files of lossless pictures, each with its stream: depth, and others that are exact."""
        depth = {self.name: "depth"} if self.depth_unit is not None else {}
        return depth | {f"{self.name}_{stream}": stream for stream in self.more if STREAMS[stream].exact}


_RENAMED = re.compile(
    r"observation\.(?=(setpoint|setpoint_velocity|tcp_set|status|pad|(camera_pose|object|time)\..*)$)"
)


def current_key(key: str) -> str:
    """Return the present name of a column: in older datasets ``observation`` begins every name."""
    return _RENAMED.sub("rig.", key)


def video_key(video: str) -> str:
    """Return the dataset's key of a video: of a camera's colour, or of ``<camera>_infrared``."""
    return f"observation.images.{video}"


def features_of(
    columns: Sequence[Column], cameras: Sequence[CameraSetup], fps: int, video: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return ``features`` of ``meta/info.json``."""
    found = {column.key: column.feature for column in columns}
    features = {STATE: found.pop(STATE), ACTION: {**found[SETPOINT]}, **found}
    features |= {key: {"dtype": dtype, "shape": [1], "names": None} for key, dtype in AFTERWARDS.items()}
    for camera in cameras:
        for name in camera.videos:
            features[video_key(name)] = {
                "dtype": "video",
                "shape": [camera.height, camera.width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": camera.height,
                    "video.width": camera.width,
                    **video,
                    "video.is_depth_map": False,
                    "video.fps": fps,
                    "video.channels": 3,
                    "has_audio": False,
                },
            }
    features |= {key: {"dtype": dtype, "shape": [1], "names": None} for key, dtype in BOOKKEEPING.items()}
    return features


_LIBRARIES = ("pyarrow", "av", "zstandard")


def video_names(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the names of the videos among ``features`` of ``meta/info.json``."""
    return [key.removeprefix(video_key("")) for key, each in features.items() if each["dtype"] == "video"]


def require_libraries() -> None:
    """Raise DriverMissing, with the command that installs them, if a library is missing. Imports none of them."""
    missing = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise DriverMissing(
            f"recordings need {', '.join(missing)}; install with: pip install 'robot-hal[record]'", name=missing[0]
        )


CHUNK = 1000
"""Files in a folder."""
GROUP = 100
"""Episodes whose rows share a file, at most."""
VIDEO_MB = 200
"""Size up to which videos are joined, MB."""
MOVES = "list.json"
"""Name of the file in a partial folder that lists where its files go. Once it exists, the episode counts as saved."""
_DIGITS = "[0-9]" * 3
_ABOUT_FILES = f"{_DIGITS}{_DIGITS}.json"
_CHUNK_FILES = f"chunk-{_DIGITS}/file-{_DIGITS}"
_PATIENCE = 5.0
"""Time to wait for another process to release a dataset, s: the writer of a program that was killed is about to end."""


class EpisodePlace(NamedTuple):
    """Which files hold an episode, by their numbers, and where it begins in those that several episodes may share."""

    entry: int
    """File of its row in LeRobot's index."""
    data: tuple[int, int]
    """File of its rows, and the number of its first row there."""
    videos: Mapping[str, tuple[int, int]]
    """File of each video, and the number of the episode's first picture there."""

    @classmethod
    def of(cls, number: int, about: Mapping[str, Any]) -> EpisodePlace:
        """Return the place of an episode from its metadata; older ones have files of the episode's number."""
        files = about.get("files")
        if files is None:
            return cls(number, (number, 0), {})
        return cls(files["index"], (*files["data"],), {name: (*at,) for name, at in files["videos"].items()})

    def video(self, name: str) -> tuple[int, int]:
        """Return the file of a video, and the number of the episode's first picture there."""
        return self.videos.get(name, (self.entry, 0))

    def after(self, videos: Iterable[str]) -> EpisodePlace:
        """Return the place of a next episode, in files of its own."""
        return EpisodePlace(
            self.entry + 1, (self.data[0] + 1, 0), {name: (self.video(name)[0] + 1, 0) for name in videos}
        )

    def as_json(self) -> dict[str, Any]:
        """Return the entry of an episode's metadata."""
        videos = {name: list(at) for name, at in self.videos.items()}
        return {"files": {"index": self.entry, "data": list(self.data), "videos": videos}}


class DatasetLayout:
    """Paths of the files of one dataset.

    An episode is recorded into files of its own, so that no episode can damage another. Later several episodes may
    share a file of rows, of videos or of the index (:func:`~hal.recording.merging.merge`); :class:`EpisodePlace` says
    where they are. Depth and metadata always have a file per episode.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser().absolute()
        self.info = self.root / "meta" / "info.json"
        self.stats = self.root / "meta" / "stats.json"
        self.tasks = self.root / "meta" / "tasks.parquet"
        self.episodes = self.root / "episodes"
        """This project's own folder: a JSON file per episode, and the episode that is being recorded."""

    @staticmethod
    def _file(number: int) -> str:
        return f"chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}"

    def data(self, file: int) -> Path:
        """Return the path of a file of rows, by its number."""
        return self.root / "data" / f"{self._file(file)}.parquet"

    def entry(self, file: int) -> Path:
        """Return the path of a file of LeRobot's index of episodes, by its number."""
        return self.root / "meta" / "episodes" / f"{self._file(file)}.parquet"

    def video(self, name: str, file: int) -> Path:
        """Return the path of a file of a video, by its number; ``name`` is one of :attr:`CameraSetup.videos`."""
        return self.root / "videos" / video_key(name) / f"{self._file(file)}.mp4"

    def depth(self, camera: str, number: int) -> Path:
        """Return the path of a depth file; ``camera`` is one of :attr:`CameraSetup.depths`."""
        return self.root / "depth" / camera / f"{self._file(number)}.depth"

    def about(self, number: int) -> Path:
        """Return the path of an episode's metadata."""
        return self.episodes / f"{number:06d}.json"

    def common(self, name: str) -> Path:
        """Return the path of metadata that several episodes have in common, by its name."""
        return self.episodes / f"{name}.json"

    def commons(self) -> Iterator[Path]:
        """Yield every file of metadata that episodes have in common."""
        return self.episodes.glob("common-*.json")

    def partial(self, number: int) -> Path:
        """Return the folder of an episode that is not part of the dataset yet."""
        return self.episodes / f"{number:06d}.partial"

    @property
    def change(self) -> Path:
        """The partial folder of a change of finished episodes (:mod:`~hal.recording.changing`)."""
        return self.episodes / "change.partial"

    def partials(self) -> list[Path]:
        """Return all partial folders, oldest first."""
        return sorted(self._folders(".partial"))

    def _folders(self, ending: str) -> list[Path]:
        """Return what is in ``episodes/`` with this ending; far quicker than glob among 10,000 episodes."""
        with contextlib.suppress(FileNotFoundError):
            return [self.episodes / name for name in os.listdir(self.episodes) if name.endswith(ending)]
        return []

    @property
    def interrupted(self) -> list[Path]:
        """Partial folders of episodes that count as saved, but whose files are not all in their places yet."""
        return [partial for partial in self.partials() if (partial / MOVES).exists()]

    def files_of(self, number: int, place: EpisodePlace, videos: Iterable[str]) -> list[Path]:
        """Return the paths of an episode's files, existing or not; of depth only those that exist."""
        found = [self.about(number), self.data(place.data[0]), self.entry(place.entry)]
        found += [self.video(name, place.video(name)[0]) for name in videos]
        return [*found, *self.root.glob(f"depth/*/{self._file(number)}.depth")]

    def finished(self) -> Iterator[Path]:
        """Yield every file of a finished episode."""
        yield from self.episodes.glob(_ABOUT_FILES)
        for kind, ending in (
            ("data", "parquet"),
            ("meta/episodes", "parquet"),
            ("videos/*", "mp4"),
            ("depth/*", "depth"),
        ):
            yield from self.root.glob(f"{kind}/{_CHUNK_FILES}.{ending}")

    def numbers(self) -> list[int]:
        """Return the numbers of the episodes whose metadata file exists, in order."""
        return sorted(int(path.stem) for path in self.episodes.glob(_ABOUT_FILES))

    def target(self, name: str) -> Path:
        """Return the destination of a file in a partial folder's list.

        Raises ValueError for a path outside of the dataset.
        """
        path = self.root / name
        if Path(name).is_absolute() or ".." in Path(name).parts or path == self.root:
            raise ValueError(f"{name!r} is outside of the dataset")
        there = path.parent
        while not there.exists():
            there = there.parent
        if not there.resolve().is_relative_to(self.root.resolve()):
            raise ValueError(f"{name!r} leads out of the dataset through a link")
        return path

    def beside(self, what: str) -> Path:
        """Return a hidden folder beside the dataset, on the same file system."""
        return self.root.with_name(f".{self.root.name}.{what}")

    def remove(self, partial: Path) -> None:
        """Remove a partial folder by renaming it first, so that a crash leaves nothing that looks like an episode."""
        gone = partial.with_suffix(".removed")
        shutil.rmtree(gone, ignore_errors=True)
        partial.rename(gone)
        sync_to_disk(self.episodes)
        shutil.rmtree(gone, ignore_errors=True)

    def sweep(self) -> None:
        """Remove folders whose removal was interrupted."""
        for gone in self._folders(".removed"):
            shutil.rmtree(gone, ignore_errors=True)


def put_in_place(building: Path, target: Path, *, replaces: bool) -> None:
    """Move a complete dataset to its place. With ``replaces`` the one that is there is removed.

    Both are exchanged in one step, so that there is a dataset in this place at any moment.

    Raises:
        OSError: The place is taken, or the file system cannot exchange folders; what is there stays as it was.
    """
    if not replaces:
        building.rename(target)  # over an empty folder at most
    elif _exchange(building, target):
        shutil.rmtree(building, ignore_errors=True)
    else:
        text = "the file system cannot replace a folder in one step, as NFS: choose a new folder for the result"
        raise OSError(errno.ENOTSUP, text, str(target))
    sync_to_disk(target.parent)


_HERE, _EXCHANGE = -100, 2  # AT_FDCWD, RENAME_EXCHANGE


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step. Return False, and do nothing, where that is not possible."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    return rename is not None and rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0


def file_version(path: Path) -> tuple[int, int] | None:
    """Return two numbers that change when a file is written anew; None if there is no file."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


@contextlib.contextmanager
def lock_dataset(layout: DatasetLayout, *, only_read: bool = False) -> Iterator[None]:
    """Hold the dataset's lock, so that no other process adds to it. The lock ends with the process.

    Args:
        layout: The dataset.
        only_read: Whether nothing will be written into it: then its folder may be write-protected.

    Raises:
        CommandError: Another process holds it (code ``dataset_locked``), or ``episodes/`` is a link
            (``dataset_link``).
    """
    deadline = time.monotonic() + _PATIENCE
    while (fd := _lock_now(layout, only_read)) is None:
        if time.monotonic() > deadline:
            raise CommandError(f"another program is writing {layout.root}", code="dataset_locked")
        time.sleep(0.05)
    try:
        yield
    finally:
        os.close(fd)


@contextlib.contextmanager
def building_folder(target: DatasetLayout, what: str) -> Iterator[DatasetLayout]:
    """Hold an empty hidden folder beside a place, to build there what comes into it. It is removed in the end.

    What a killed program left in it is removed first.

    Raises:
        CommandError: Another process holds this folder (code ``dataset_locked``).
    """
    building = DatasetLayout(target.beside(what))
    with lock_dataset(building):
        try:
            for path in (*building.root.iterdir(), *building.episodes.iterdir()):
                if path.is_dir() and not path.is_symlink():
                    if path != building.episodes:
                        shutil.rmtree(path)
                elif path.name != ".lock":
                    path.unlink()
            yield building
        finally:
            shutil.rmtree(building.root, ignore_errors=True)


def _lock_now(layout: DatasetLayout, only_read: bool) -> int | None:
    """Return the open lock file of a dataset.

    None if another process holds it, or has put another dataset in this place since the file was opened.
    """
    layout.episodes.mkdir(parents=True, exist_ok=True)
    if layout.episodes.is_symlink():
        raise CommandError(f"{layout.episodes} is a link; nothing is recorded through it", code="dataset_link")
    path, fd = layout.episodes / ".lock", None
    with contextlib.suppress(BlockingIOError, FileNotFoundError):
        try:
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            if not only_read or error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM) or not path.exists():
                raise
            fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(fd), path.stat()):
            return fd
    if fd is not None:
        os.close(fd)
    return None


def sync_to_disk(path: Path) -> None:
    """Block until a file or folder is on the disk."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def count_bytes(path: Path) -> int:
    """Return the size of a file, or of all files in a folder, bytes."""
    files = [path] if path.is_file() else path.rglob("*")
    return sum(file.stat().st_size for file in files if file.is_file())


def read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, data: Any, indent: int | None = 1) -> None:
    """Write a JSON file, whole or not at all. Numbers that are not finite become null: JSON has no NaN."""
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    with beside.open("x", encoding="utf-8") as file:
        file.write(json.dumps(make_finite(data), indent=indent, default=str, allow_nan=False) + "\n")
    sync_to_disk(beside)
    beside.replace(path)
    sync_to_disk(path.parent)


def make_finite(data: Any) -> Any:
    """Return plain data, with None for numbers that are not finite."""
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, dict):
        return {key: make_finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [make_finite(value) for value in data]
    return data


def make_plain(data: Any) -> Any:
    """Return data as JSON: NumPy's numbers and arrays as Python's, None for what is not finite, else texts."""
    text = json.dumps(data, default=lambda value: value.tolist() if hasattr(value, "tolist") else str(value))
    return make_finite(json.loads(text))
