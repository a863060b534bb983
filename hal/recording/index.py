"""Read the JSON and Parquet files of a dataset, and validate their content before it is used."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .about import read_about
from .codecs import Stats, merge_stacked, merge_stats
from .layout import CHUNK, DatasetLayout, EpisodePlace, read_json, video_names
from .validation import CameraName, Feature, Model, dataset_errors, wrong_file

_TASK = "__index_level_0__"
"""LeRobot 0.4's name of the column of texts in ``meta/tasks.parquet``; 0.6's is ``task``, and it reads both."""


class _Info(Model):
    """The keys of ``meta/info.json`` that are used here."""

    codebase_version: str
    fps: Annotated[int, Field(ge=1, le=1000)]
    robot_type: str | None = None
    total_episodes: Annotated[int, Field(ge=0, le=CHUNK * CHUNK)]
    total_frames: Annotated[int, Field(ge=0)]
    features: dict[CameraName, Feature]


def repair_command(layout: DatasetLayout) -> str:
    """Return the command that repairs a dataset."""
    return f"hal review {shlex.quote(str(layout.root))} --repair"


def validated_info(data: Any) -> dict[str, Any]:
    """Return ``data`` if it is a valid ``meta/info.json``. Raises pydantic's ValidationError."""
    _Info.model_validate(data)
    found: dict[str, Any] = data
    return found


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
        text = f"is missing, but there are finished episodes ({found.relative_to(layout.root)}); nothing is recorded "
        text += f"over them. Rebuild the index from the episodes with: {repair_command(layout)}"
        raise wrong_file(layout, layout.info, text, code="index_missing")
    if not layout.episodes.is_dir():
        text = f"{layout.root} was not recorded by this program: it has no folder episodes"
        raise wrong_file(layout, layout.info, text, code="foreign_dataset")
    with dataset_errors(layout, layout.info):
        info = validated_info(read_json(layout.info))
    last = info["total_episodes"] - 1
    if last >= 0 and not any(path.exists() for path in layout.files_of(last, EpisodePlace.of(last, {}), ())):
        text = f"lists {last + 1} episodes, and there is no file of episode {last}; to rebuild it: "
        raise wrong_file(layout, layout.info, text + repair_command(layout), code="index_wrong")
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
            text = "exists, but meta/info.json does not list this episode; nothing is recorded over it. Rebuild the "
            text += f"index from the episodes with: {repair_command(layout)}"
            raise wrong_file(layout, path, text, number, "index_wrong")
    for path in (layout.stats, layout.tasks) if number else ():
        if not path.exists():
            text = f"is missing; rebuild it with: {repair_command(layout)}"
            raise wrong_file(layout, path, text, code="index_wrong")


def stray_files(
    layout: DatasetLayout, places: Iterable[tuple[int, EpisodePlace]], videos: Collection[str]
) -> list[Path]:
    """Return the files of finished episodes that belong to none of these (number, place)."""
    known = {path for number, place in places for path in layout.files_of(number, place, videos)}
    return [path for path in layout.finished() if path not in known]


def read_entries(path: Path) -> dict[int, dict[str, Any]]:
    """Return the rows of a file of ``meta/episodes`` by the number of the episode, without the statistics."""
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
    return {row["episode_index"]: row for row in file.read(columns=names).to_pylist()}


def read_table(path: Path) -> Any:
    """Return a file of ``meta/episodes`` as an Arrow table."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        return file.read(use_threads=False)


def column_values(column: Any) -> NDArray[Any]:
    """Return a column of an Arrow table as an array (rows, n)."""
    whole = column.combine_chunks()
    found: NDArray[Any] = (whole.flatten() if hasattr(whole, "flatten") else whole).to_numpy(zero_copy_only=False)
    return found.reshape(len(whole), -1)


def make_column(values: NDArray[Any]) -> Any:
    """Return an array (rows, n) as an Arrow array: of numbers if n is 1, else of lists of n numbers."""
    import pyarrow as pa

    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def read_stats(table: Any, keys: Collection[str] | None = None) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the statistics in a file of ``meta/episodes``, by column or video and by name, each (episodes, ...)."""
    found: dict[str, dict[str, NDArray[Any]]] = {}
    for name in table.column_names:
        if name.startswith("stats/") and (keys is None or name.split("/")[1] in keys):
            _, key, what = name.split("/")
            values, shape = table[name].combine_chunks(), [len(table)]
            while hasattr(values, "flatten"):
                size, values = len(values), values.flatten()
                shape.append(len(values) // size)
            found.setdefault(key, {})[what] = values.to_numpy(zero_copy_only=False).reshape(shape)
    return found


def stats_parts(layout: DatasetLayout) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
    """Yield the statistics of each column and video in each file of ``meta/episodes``, as :func:`read_stats` does.

    Raises DatasetError if a file is damaged.
    """
    for path in sorted(layout.entry(0).parent.parent.glob("*/*.parquet")):
        with dataset_errors(layout, path):
            yield from read_stats(read_table(path)).items()


def merged_stats(layout: DatasetLayout) -> dict[str, Stats]:
    """Return the statistics over all episodes. Raises DatasetError if a file is damaged."""
    parts: dict[str, list[Stats]] = {}
    for key, found in stats_parts(layout):
        parts.setdefault(key, []).append(merge_stacked(found))
    return {key: merge_stats(found) for key, found in parts.items()}


def read_tasks(path: Path) -> list[str]:
    """Return all tasks, in the order of their numbers."""
    if not path.exists():
        return []
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read()
    texts = table["task" if "task" in table.column_names else _TASK]
    numbered = sorted(zip(table["task_index"].to_pylist(), texts.to_pylist(), strict=True))
    return [text for _, text in numbered]
