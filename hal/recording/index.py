"""Read the JSON and Parquet files of a dataset, and validate their content before it is used."""

from __future__ import annotations

import contextlib
import errno
import shlex
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from ..errors import DatasetError, HalError
from .layout import CHUNK, DatasetLayout, EpisodePlace, read_json, video_names

__all__ = [
    "CameraName",
    "check_next_episode",
    "checked_name",
    "next_place",
    "read_about",
    "read_entries",
    "read_index",
    "read_tasks",
    "dataset_errors",
    "repair_command",
    "stray_files",
    "validated_info",
]

_SIDE = 16384
"""Pixels; no picture is larger."""
_DISK_REFUSES = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
_TASK = "__index_level_0__"
"""LeRobot's name of the column of texts in ``meta/tasks.parquet``."""


def checked_name(name: str) -> str:
    """Return ``name``, a part of a file name. Raises ValueError for one that would lead to another folder."""
    if not name or "/" in name or "\0" in name or name in (".", ".."):
        raise ValueError("must be a name without slashes")
    return name


CameraName = Annotated[str, AfterValidator(checked_name)]


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


_At = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]


class _Files(_Model):
    index: Annotated[int, Field(ge=0)]
    data: _At
    videos: dict[CameraName, _At]


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
    files: _Files | None = None
    features: dict[CameraName, _Feature] | None = None
    """Missing in episodes of older versions."""


def repair_command(layout: DatasetLayout) -> str:
    """Return the command that repairs a dataset."""
    return f"hal review {shlex.quote(str(layout.root))} --repair"


@contextlib.contextmanager
def dataset_errors(root: Path, path: Path, episode: int | None = None) -> Iterator[None]:
    """Raise any error of a missing or damaged file as a DatasetError that names the file and the episode.

    A disk that refuses what is written meanwhile is no damage: its OSError is raised as it is.
    """
    try:
        yield
    except HalError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK_REFUSES:
            raise
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
    """Return ``data`` if it is a valid ``meta/info.json``. Raises pydantic's ValidationError."""
    return _validated(_Info, data)


def read_index(layout: DatasetLayout) -> dict[str, Any] | None:
    """Return ``meta/info.json``; None for a folder that holds no episode yet.

    Raises:
        DatasetError: The file is damaged, or is missing although there are finished episodes (code ``index_missing``),
            lists episodes that are not there (``index_wrong``), or belongs to another program (``foreign_dataset``).
    """
    if not layout.info.exists():
        found = next(layout.finished(), None)
        if found is None or layout.interrupted:
            return None
        raise DatasetError(
            f"is missing, but there are finished episodes ({found.relative_to(layout.root)}); nothing is recorded "
            f"over them. Rebuild the index from the episodes with: {repair_command(layout)}",
            file="meta/info.json",
            code="index_missing",
        )
    if not layout.episodes.is_dir():
        raise DatasetError(
            f"{layout.root} was not recorded by this program: it has no folder episodes",
            file="meta/info.json",
            code="foreign_dataset",
        )
    with dataset_errors(layout.root, layout.info):
        info = validated_info(read_json(layout.info))
    last = info["total_episodes"] - 1
    if last >= 0 and not any(path.exists() for path in layout.files_of(last, EpisodePlace.of(last, {}), ())):
        raise DatasetError(
            f"lists {last + 1} episodes, and there is no file of episode {last}; to rebuild it: "
            f"{repair_command(layout)}",
            file="meta/info.json",
            code="index_wrong",
        )
    return info


def next_place(layout: DatasetLayout, info: dict[str, Any] | None) -> EpisodePlace:
    """Return the place of a dataset's next episode, in files of its own; ``info`` is None for the first one."""
    number = int(info["total_episodes"]) if info is not None else 0
    before = EpisodePlace.of(number - 1, read_about(layout, number - 1)) if number else EpisodePlace(-1, (-1, 0), {})
    return before.after(video_names(info["features"]) if info is not None else ())


def check_next_episode(layout: DatasetLayout, info: dict[str, Any] | None) -> None:
    """Check that the index is complete, and that the next episode overwrites no finished one.

    Raises:
        DatasetError: It is not, or does (code ``index_wrong``).
    """
    number = int(info["total_episodes"]) if info is not None else 0
    videos = video_names(info["features"]) if info is not None else []
    for path in layout.files_of(number, next_place(layout, info), videos):
        if path.exists():
            raise DatasetError(
                f"exists, but meta/info.json does not list this episode; nothing is recorded over it. Rebuild the "
                f"index from the episodes with: {repair_command(layout)}",
                file=str(path.relative_to(layout.root)),
                episode=number,
                code="index_wrong",
            )
    for path in (layout.stats, layout.tasks) if number else ():
        if not path.exists():
            raise DatasetError(
                f"is missing; rebuild it with: {repair_command(layout)}",
                file=str(path.relative_to(layout.root)),
                code="index_wrong",
            )


def stray_files(
    layout: DatasetLayout, places: Iterable[tuple[int, EpisodePlace]], videos: Collection[str]
) -> list[Path]:
    """Return the files of finished episodes that belong to none of these (number, place)."""
    known = {path for number, place in places for path in layout.files_of(number, place, videos)}
    return [path for path in layout.finished() if path not in known]


def read_about(layout: DatasetLayout, number: int) -> dict[str, Any]:
    """Return ``episodes/N.json`` of an episode. Raises DatasetError."""
    path = layout.about(number)
    with dataset_errors(layout.root, path, number):
        return _validated(_About, read_json(path))


def read_entries(path: Path, *, stats: bool) -> dict[int, dict[str, Any]]:
    """Return the rows of a file of ``meta/episodes`` by the number of the episode, with or without the statistics."""
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    names = [name for name in file.schema_arrow.names if stats or not name.startswith("stats/")]
    return {row["episode_index"]: row for row in file.read(columns=names).to_pylist()}


def read_tasks(path: Path) -> list[str]:
    """Return all tasks, in the order of their numbers."""
    if not path.exists():
        return []
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read()
    numbered = sorted(zip(table["task_index"].to_pylist(), table[_TASK].to_pylist(), strict=True))
    return [text for _, text in numbered]
