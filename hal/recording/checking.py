"""Compare every file of a dataset with its index: rows, pictures, depth, time stamps."""

from __future__ import annotations

import contextlib
import json
import shlex
from collections import deque
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from ..errors import DatasetError, HalError
from .dataset import Dataset, Episode
from .finish import read_entry, read_tasks
from .layout import BOOKKEEPING, CHUNK, STATE, Layout, read_json

__all__ = [
    "CameraName",
    "check_dataset",
    "check_index",
    "check_next",
    "check_rows",
    "plain_name",
    "read_about",
    "read_index",
    "reading",
    "repair_command",
    "validated_info",
]

# [index.py] The JSON files of a dataset, read as untrusted input: shapes, sizes and names are checked before they
# are used.

_SIDE = 16384
"""Pixels; no picture is larger."""


def plain_name(name: str) -> str:
    """Return ``name``, which becomes part of a file's name. ValueError for one that would lead to another folder."""
    if not name or "/" in name or "\0" in name or name in (".", ".."):
        raise ValueError("must be a name without slashes")
    return name


CameraName = Annotated[str, AfterValidator(plain_name)]


class _Model(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Feature(_Model):
    dtype: str
    shape: list[Annotated[int, Field(ge=1, le=_SIDE)]]
    names: list[str] | None = None

    @model_validator(mode="after")
    def _has_a_name_per_number(self) -> _Feature:
        if self.dtype != "video" and self.names is not None and [len(self.names)] != self.shape:
            raise ValueError(f"{len(self.names)} names for the shape {self.shape}")
        return self


class _Info(_Model):
    """The keys of ``meta/info.json`` that are used here."""

    codebase_version: str
    fps: Annotated[int, Field(ge=1, le=1000)]
    robot_type: str | None = None
    total_episodes: Annotated[int, Field(ge=0, le=CHUNK * CHUNK)]
    total_frames: Annotated[int, Field(ge=0)]
    features: dict[CameraName, _Feature]


class _Camera(_Model):
    K: Annotated[list[Annotated[list[float], Field(min_length=3, max_length=3)]], Field(min_length=3, max_length=3)]
    distortion: list[float]
    depth_unit_m: Annotated[FiniteFloat, Field(gt=0)] | None = None
    streams: list[str] = []


class _World(_Model):
    driver: str


class _Robot(_Model):
    name: str
    model: str
    driver: str
    base_position: Annotated[list[float], Field(min_length=3, max_length=3)]
    base_orientation: Annotated[list[float], Field(min_length=4, max_length=4)]


class _View(_Model):
    robot: str | None = None


class _RigCamera(_Model):
    name: str
    view: _View | None = None


class _Resolved(_Model):
    world: _World | None = None
    robots: list[_Robot] = []
    cameras: list[_RigCamera] = []


class _Rig(_Model):
    resolved: _Resolved


class _About(_Model):
    """The keys of ``episodes/N.json`` that are used here."""

    length: Annotated[int, Field(ge=1)]
    t_start: FiniteFloat
    task: str
    success: bool | None
    cameras: dict[CameraName, _Camera]
    rig: _Rig
    dropped: int | None = None
    gaps: list[Any] = []
    trouble: str | None = None
    recovered: bool = False
    pace: dict[str, float] = {}
    info: dict[str, Any] = {}
    seed: int | None = None
    started: str | None = None
    fps: Annotated[int, Field(ge=1, le=1000)] | None = None
    robot_type: str | None = None
    clock: Literal["real_time", "lock_step"] | None = None
    features: dict[CameraName, _Feature] | None = None
    """Missing in episodes of older versions."""


def repair_command(layout: Layout) -> str:
    """Return the command that repairs a dataset."""
    return f"hal-review {shlex.quote(str(layout.root))} --repair"


@contextlib.contextmanager
def reading(root: Path, path: Path, episode: int | None = None) -> Iterator[None]:
    """Raise whatever a missing or damaged file leads to as a DatasetError that names the file and the episode."""
    try:
        yield
    except HalError:
        raise
    except Exception as error:
        file = str(path.relative_to(root)) if path.is_relative_to(root) else str(path)
        raise DatasetError(_reason(error), file=file, episode=episode) from error


def _reason(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "is missing"
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    text = (str(error).splitlines() or [""])[0][:200]
    return f"cannot be read: {text or type(error).__name__}"


def _validated(model: type[BaseModel], data: Any) -> dict[str, Any]:
    model.model_validate(data)
    found: dict[str, Any] = data
    return found


def validated_info(data: Any) -> dict[str, Any]:
    """Return ``data`` once it is known to be a ``meta/info.json``. Raises pydantic's ValidationError."""
    return _validated(_Info, data)


def read_index(layout: Layout) -> dict[str, Any] | None:
    """Return ``meta/info.json``; None for a folder that holds no episode yet.

    Raises:
        DatasetError: The file is damaged, or is missing although there are finished episodes.
    """
    if not layout.info.exists():
        found = next(layout.finished(), None)
        if found is None or layout.interrupted:
            return None
        raise DatasetError(
            f"is missing, but there are finished episodes ({found.relative_to(layout.root)}); nothing is recorded "
            f"over them. Rebuild the index from the episodes with: {repair_command(layout)}",
            file="meta/info.json",
        )
    if not layout.episodes.is_dir():
        raise DatasetError(
            f"{layout.root} was not recorded by this program: it has no folder episodes", file="meta/info.json"
        )
    with reading(layout.root, layout.info):
        info = validated_info(read_json(layout.info))
    last = info["total_episodes"] - 1
    if last >= 0 and not any(path.exists() for path in layout.files_of(last)):
        raise DatasetError(
            f"lists {last + 1} episodes, and there is no file of episode {last}; to rebuild it: "
            f"{repair_command(layout)}",
            file="meta/info.json",
        )
    return info


def check_next(layout: Layout, info: dict[str, Any] | None) -> None:
    """Raise DatasetError where the next episode would be written over a finished one, or the index is not whole."""
    number = int(info["total_episodes"]) if info is not None else 0
    for path in layout.files_of(number):
        if path.exists():
            raise DatasetError(
                f"exists, but meta/info.json does not list this episode; nothing is recorded over it. Rebuild the "
                f"index from the episodes with: {repair_command(layout)}",
                file=str(path.relative_to(layout.root)),
                episode=number,
            )
    for path in (layout.stats, layout.tasks) if number else ():
        if not path.exists():
            raise DatasetError(
                f"is missing; rebuild it with: {repair_command(layout)}", file=str(path.relative_to(layout.root))
            )


def read_about(layout: Layout, number: int) -> dict[str, Any]:
    """Return ``episodes/N.json`` of an episode. Raises DatasetError."""
    path = layout.about(number)
    with reading(layout.root, path, number):
        return _validated(_About, read_json(path))


_CLOSE = 1e-4
"""s by which LeRobot lets a time stamp differ."""


def check_dataset(dataset: Dataset, episodes: Collection[int] | None = None) -> Iterator[DatasetError]:
    """Yield everything that is wrong with a dataset, or with these episodes of it.

    Every row is read and every picture is decoded. The index is checked where ``episodes`` is None.
    """
    if episodes is None:
        yield from check_index(Layout(dataset.root))
    start: int | None = 0
    for episode in dataset.episodes:
        first = start
        try:
            start = None if start is None else start + episode.length
        except DatasetError:
            start = None  # of the episodes to come, it is not known where they begin
        if episodes is None or episode.number in episodes:
            for check in _checks(episode, first):
                try:
                    check()
                except DatasetError as error:
                    yield error


def _checks(episode: Episode, start: int | None) -> Iterator[Callable[[], object]]:
    yield partial(check_rows, episode, start)
    with contextlib.suppress(DatasetError):  # the first check found the same
        for camera in episode.cameras:
            for stream in episode.files(camera):
                yield partial(_read_all, episode, camera, stream)


def _read_all(episode: Episode, camera: str, stream: str) -> None:
    deque(episode.pictures(camera, stream), maxlen=0)


def check_rows(episode: Episode, start: int | None) -> None:
    """Raise DatasetError where an episode's rows are not numbered as the index counts them, or times go backwards.

    ``start`` is the number of its first row in the whole dataset; None where it is not known.
    """
    columns, rows = episode.columns, np.arange(episode.length)
    file = episode.data_file

    def need(right: Any, what: str) -> None:
        if not np.all(right):
            raise DatasetError(what, file=file, episode=episode.number)

    for key in BOOKKEEPING:
        need(columns[key].ndim == 1, f"{key} is not one number per row")
    need(columns["frame_index"] == rows, "frame_index does not count the rows")
    need(columns["episode_index"] == episode.number, "episode_index is another episode's")
    need(np.diff(columns["index"]) == 1, "index does not count the rows")
    need(start is None or columns["index"][0] == start, f"index does not begin with {start}")
    need(np.diff(columns["task_index"]) == 0, "has rows of several tasks")
    need(np.abs(columns["timestamp"] - rows / episode.fps) < _CLOSE + 1e-6 * rows, "timestamp is not that of the grid")
    for name, times in episode.stamps.items():
        if name == "grid":
            need(np.isfinite(times), "observation.time.grid has values that are not numbers")
            need(np.diff(times) > 0.0, "observation.time.grid does not increase")
        elif name.startswith(("robot.", "camera.")):
            need(np.diff(times[np.isfinite(times)]) >= 0.0, f"observation.time.{name} goes backwards")


def check_index(layout: Layout) -> Iterator[DatasetError]:
    """Yield everything in ``meta/`` that is wrong in itself, or does not fit the episodes' own files."""
    try:
        info = read_index(layout)
    except DatasetError as error:
        yield error
        return
    if info is None:
        return

    def wrong(path: Path, what: str, number: int | None = None) -> DatasetError:
        return DatasetError(what, file=str(path.relative_to(layout.root)), episode=number)

    total, numbers = int(info["total_episodes"]), layout.numbers()
    for number in range(total):
        if number not in numbers:
            yield wrong(layout.about(number), "is missing", number)
    for path in layout.finished():
        if (number := layout.number_of(path)) >= total:
            yield wrong(path, "is not in the index", number)
    tasks: list[str] = []
    try:
        with reading(layout.root, layout.tasks):
            tasks = read_tasks(layout.tasks)
        if len(tasks) != info.get("total_tasks"):
            yield wrong(layout.tasks, f"has {len(tasks)} tasks, and meta/info.json lists {info.get('total_tasks')}")
    except DatasetError as error:
        yield error
    start: int | None = 0
    for number in range(total):
        try:
            start = None if start is None else _check_entry(layout, number, start, tasks)
        except DatasetError as error:
            start = None
            yield error
    if start is not None and start != info["total_frames"]:
        yield wrong(layout.info, f"lists {info['total_frames']} rows, and the episodes have {start}")
    try:
        with reading(layout.root, layout.stats):
            stats = json.loads(layout.stats.read_text(encoding="utf-8"), parse_constant=_no_constant)
            if start is not None and stats[STATE]["count"] != [start]:
                yield wrong(layout.stats, f"counts {stats[STATE]['count']} rows, and there are {start}")
    except DatasetError as error:
        yield error


def _check_entry(layout: Layout, number: int, start: int, tasks: list[str]) -> int:
    """Check an episode's row in ``meta/episodes``; return where the next episode begins."""
    about, path = read_about(layout, number), layout.entry(number)
    end = start + int(about["length"])
    expected = {
        "episode_index": number,
        "length": about["length"],
        "dataset_from_index": start,
        "dataset_to_index": end,
        "tasks": [about["task"]],
    }
    with reading(layout.root, path, number):
        row = read_entry(path)
        for key, value in expected.items():
            if row[key] != value:
                raise DatasetError(
                    f"{key} is {row[key]!r}, and must be {value!r}",
                    file=str(path.relative_to(layout.root)),
                    episode=number,
                )
    if about["task"] not in tasks:
        raise DatasetError(
            f"the task {about['task']!r} is missing", file=str(layout.tasks.relative_to(layout.root)), episode=number
        )
    return end


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")
