"""Where everything of a dataset lies, and how a file or a folder is brought there so that a crash leaves it whole."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import json
import math
import os
import shutil
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import CommandError, DriverMissing

if TYPE_CHECKING:
    pass

__all__ = [
    "ACTION",
    "BOOKKEEPING",
    "CameraSetup",
    "Column",
    "GRID",
    "LIST",
    "Layout",
    "MORE_STREAMS",
    "PAD",
    "Pace",
    "SEGMENTATION",
    "SETPOINT",
    "SLOW",
    "STATE",
    "TIMES",
    "VERSION",
    "features_of",
    "locked",
    "read_json",
    "require",
    "simulated_pace",
    "sync",
    "video_key",
    "write_json",
]

# [columns.py] The columns of a recording: one row of plain numbers per grid time, and how a dataset announces
# them.

STATE = "observation.state"
SETPOINT = "observation.setpoint"
ACTION = "action"
PAD = "observation.pad"
"""No ``action.pad``: LeRobot takes every column whose name begins with ``action`` for an action."""
TIMES = "observation.time."
"""What stands first in these columns is a time, s: on the rig's clock while it is recorded, in the dataset since the
episode's first row."""
GRID = f"{TIMES}grid"

SEGMENTATION = "segmentation"
MORE_STREAMS = ("infrared", "infrared_right", SEGMENTATION)
"""Streams of a camera that are recorded on request."""
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
    """``float32``, ``float64`` or ``int64``, on disk; while a row is on its way, every number is a double."""
    names: tuple[str, ...]

    @property
    def feature(self) -> dict[str, Any]:
        """As ``meta/info.json`` says it."""
        return {"dtype": self.dtype, "shape": [len(self.names)], "names": list(self.names)}


class CameraSetup(NamedTuple):
    """How the pictures of one camera are kept."""

    name: str
    width: int
    height: int
    color: bool
    depth_unit: float | None
    """Metres in one unit of the stored depth; None where no depth is kept."""
    depth_lossless: bool
    """Does the camera itself measure in that unit?"""
    seq: int
    """Which number of a row counts this camera's frames."""
    more: Sequence[str] = ()
    """Streams that are kept besides colour and depth: some of :data:`MORE_STREAMS`."""

    @property
    def videos(self) -> dict[str, str]:
        """Names of the videos, each with its stream: ``wrist`` has the colour, ``wrist_infrared`` the infrared."""
        color = {self.name: "color"} if self.color else {}
        return color | {f"{self.name}_{stream}": stream for stream in self.more if stream != SEGMENTATION}

    @property
    def depths(self) -> dict[str, str]:
        """Names of the files of lossless pictures, each with its stream: depth, segmentation."""
        depth = {self.name: "depth"} if self.depth_unit is not None else {}
        return depth | {f"{self.name}_{stream}": stream for stream in self.more if stream == SEGMENTATION}


def video_key(video: str) -> str:
    """Return the dataset's key of a video: of a camera's colour, or of ``<camera>_infrared``."""
    return f"observation.images.{video}"


def features_of(
    columns: Sequence[Column], cameras: Sequence[CameraSetup], fps: int, video: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """``features`` of ``meta/info.json``; ``video`` is what the encoder says of itself."""
    found = {column.key: column.feature for column in columns}
    features = {STATE: found.pop(STATE), ACTION: {**found[SETPOINT]}, **found}
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


# [library.py] The libraries that recording needs, and what to say where they are missing.

_LIBRARIES = ("pyarrow", "av", "zstandard")


def require() -> None:
    """Raise DriverMissing, with the command that installs them, where a library is missing. Imports none of them."""
    missing = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise DriverMissing(
            f"recordings need {', '.join(missing)}; install with: pip install 'robot-hal[record]'", name=missing[0]
        )


# [pace.py] Does the time of an arm's own clock pass as fast as that of the rig? A simulation that cannot keep up
# is slower.

SLOW = 0.97
"""Of real time: below it, speeds in a recording are noticeably too low."""
_ENOUGH = 2.0
"""s of an episode before anything is said."""
_CHANGED = 0.02
"""By less the number that a person was told is not corrected."""
_ROBOT = f"{TIMES}robot."


class Pace:
    """That of each arm, over the rows of one episode so far."""

    def __init__(self, columns: Iterable[Sequence[Any]], simulated: Collection[str] = ()) -> None:
        """``columns`` (key, type, names) are those of a row; ``simulated`` are the arms in a simulated world."""
        self._places: dict[str, int] = {}
        self._simulated = simulated
        self._told = 1.0
        place = 0
        for key, _, names in columns:
            if key.startswith(_ROBOT):
                self._places[key.removeprefix(_ROBOT)] = place
            place += len(names)
        self._last: dict[str, tuple[float, float]] = {}
        self._passed: dict[str, tuple[float, float]] = {}
        """s on the rig's clock, and on the arm's own, while both went on."""

    def add(self, row: Sequence[float]) -> None:
        """One more row. An arm whose clock is not known, or begins anew, is left out as long as that is so."""
        for name, place in self._places.items():
            now = float(row[place]), float(row[place + 1])
            before, self._last[name] = self._last.get(name, now), now
            t, own = now[0] - before[0], now[1] - before[1]
            if t > 0.0 and own >= 0.0:  # false for NaN, too
                sums = self._passed.get(name, (0.0, 0.0))
                self._passed[name] = sums[0] + t, sums[1] + own

    def as_json(self) -> dict[str, float]:
        """By the arms' names; those are missing whose own clock is not known."""
        return {name: round(own / t, 4) for name, (t, own) in self._passed.items() if math.isfinite(own)}

    @property
    def trouble(self) -> str:
        """What a person should know of a simulation that is too slow; empty where it keeps up."""
        found = [
            own / t
            for name, (t, own) in self._passed.items()
            if name in self._simulated and t >= _ENOUGH and own < t * SLOW
        ]
        if not found:
            self._told = 1.0
            return ""
        if self._told == 1.0 or abs(min(found) - self._told) >= _CHANGED:
            self._told = min(found)
        return (
            f"the simulation runs at {self._told:.2f} of real time: speeds in this recording are too low; fewer or "
            "smaller cameras help"
        )


def simulated_pace(info: Mapping[str, Any]) -> float | None:
    """The slowest arm of a simulated world in an episode's own file; None where there is none, or it is not known."""
    resolved = info.get("rig", {}).get("resolved", {})
    driver = (resolved.get("world") or {}).get("driver")
    simulated = {robot["name"] for robot in resolved.get("robots", ()) if driver and robot["driver"] == driver}
    found = [float(pace) for name, pace in (info.get("pace") or {}).items() if name in simulated]
    return min(found, default=None)


# [about.py] What an episode's own file says besides its rows: where they come from, and with what they were made.


CHUNK = 1000
"""Files in a folder."""
LIST = "list.json"
"""In a partial folder: which of its files goes where. From then on the episode counts as saved."""
_DIGITS = "[0-9]" * 3
_ABOUT_FILES = f"{_DIGITS}{_DIGITS}.json"
_CHUNK_FILES = f"chunk-{_DIGITS}/file-{_DIGITS}"
_PATIENCE = 5.0
"""s that somebody else may take to let go of a dataset: the writer of a program that was killed just ends."""


class Layout:
    """The files of one dataset. One file of each kind per episode, so that no episode can harm another."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser().absolute()
        self.info = self.root / "meta" / "info.json"
        self.stats = self.root / "meta" / "stats.json"
        self.tasks = self.root / "meta" / "tasks.parquet"
        self.episodes = self.root / "episodes"
        """Ours: a JSON file per episode, and what is being recorded."""

    @staticmethod
    def _file(number: int) -> str:
        return f"chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}"

    def data(self, number: int) -> Path:
        """Rows of an episode."""
        return self.root / "data" / f"{self._file(number)}.parquet"

    def entry(self, number: int) -> Path:
        """What LeRobot knows of an episode: one row."""
        return self.root / "meta" / "episodes" / f"{self._file(number)}.parquet"

    def video(self, camera: str, number: int) -> Path:
        """Colour of a camera."""
        return self.root / "videos" / video_key(camera) / f"{self._file(number)}.mp4"

    def depth(self, camera: str, number: int) -> Path:
        """Depth of a camera."""
        return self.root / "depth" / camera / f"{self._file(number)}.depth"

    def about(self, number: int) -> Path:
        """What else is known of an episode."""
        return self.episodes / f"{number:06d}.json"

    def partial(self, number: int) -> Path:
        """The folder of an episode that is not part of the dataset yet."""
        return self.episodes / f"{number:06d}.partial"

    def partials(self) -> list[Path]:
        """All of them, oldest first."""
        return sorted(self.episodes.glob("*.partial"))

    @property
    def interrupted(self) -> list[Path]:
        """Partial folders of episodes that count as saved, and whose files are not all in their places yet."""
        return [partial for partial in self.partials() if (partial / LIST).exists()]

    def files_of(self, number: int) -> list[Path]:
        """Return where an episode's files are, or would be; of videos and depth those that exist."""
        file = self._file(number)
        found = [self.data(number), self.about(number), self.entry(number)]
        return found + [path for kind in ("videos", "depth") for path in self.root.glob(f"{kind}/*/{file}.*")]

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

    @staticmethod
    def number_of(path: Path) -> int:
        """Return the number of the episode that a file of :meth:`finished` belongs to."""
        if path.suffix == ".json":
            return int(path.stem)
        return CHUNK * int(path.parent.name.removeprefix("chunk-")) + int(path.stem.removeprefix("file-"))

    def numbers(self) -> list[int]:
        """Return the numbers of the episodes whose own file is there, in order."""
        return sorted(int(path.stem) for path in self.episodes.glob(_ABOUT_FILES))

    def target(self, name: str) -> Path:
        """Return where a file of a partial folder's list goes. ValueError for a place outside of the dataset."""
        path = self.root / name
        if Path(name).is_absolute() or ".." in Path(name).parts or path == self.root:
            raise ValueError(f"{name!r} is not a place in the dataset")
        there = path.parent
        while not there.exists():
            there = there.parent
        if not there.resolve().is_relative_to(self.root.resolve()):
            raise ValueError(f"{name!r} leads out of the dataset through a link")
        return path

    def remove(self, partial: Path) -> None:
        """Remove a partial folder as a whole: whoever dies in the middle leaves nothing that looks like an episode."""
        gone = partial.with_suffix(".removed")
        shutil.rmtree(gone, ignore_errors=True)
        partial.rename(gone)
        sync(self.episodes)
        shutil.rmtree(gone, ignore_errors=True)

    def sweep(self) -> None:
        """Remove what a program that was killed did not get to."""
        for gone in self.episodes.glob("*.removed"):
            shutil.rmtree(gone, ignore_errors=True)


@contextlib.contextmanager
def locked(layout: Layout) -> Iterator[None]:
    """Nobody else adds to this dataset meanwhile; the lock goes with the process. CommandError where somebody does."""
    layout.episodes.mkdir(parents=True, exist_ok=True)
    if layout.episodes.is_symlink():
        raise CommandError(f"{layout.episodes} is a link; nothing is recorded through it")
    fd = os.open(layout.episodes / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    with os.fdopen(fd, "w") as file:
        deadline = time.monotonic() + _PATIENCE
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise CommandError(f"another program is recording into {layout.root}") from None
                time.sleep(0.05)
        yield


def sync(path: Path) -> None:
    """Wait until a file or a folder is on the disk."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def read_json(path: Path) -> Any:
    """Return what a JSON file holds."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file, whole or not at all. Numbers that are not finite become null: JSON has no NaN."""
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    with beside.open("x", encoding="utf-8") as file:
        file.write(json.dumps(_finite(data), indent=1, default=str, allow_nan=False) + "\n")
    sync(beside)
    beside.replace(path)
    sync(path.parent)


def _finite(data: Any) -> Any:
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_finite(value) for value in data]
    return data


VERSION = "v3.0"
