"""The tables of a LeRobotDataset v3.0: rows, episodes, tasks, and what ``info.json`` says of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .columns import video_key
from .layout import CHUNK, sync
from .stats import Stats

__all__ = ["VERSION", "entry_table", "new_info", "read_entry", "read_tasks", "rows_table", "tasks_table", "write_table"]

VERSION = "v3.0"
_TASK = "__index_level_0__"


def new_info(features: Mapping[str, Any], fps: int, robot_type: str) -> dict[str, Any]:
    """``meta/info.json`` of a dataset without any episode."""
    videos = any(feature["dtype"] == "video" for feature in features.values())
    place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    return {
        "codebase_version": VERSION,
        "robot_type": robot_type,
        "total_episodes": 0,
        "total_frames": 0,
        "total_tasks": 0,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": "0:0"},
        "data_path": f"data/{place}.parquet",
        "video_path": f"videos/{{video_key}}/{place}.mp4" if videos else None,
        "features": dict(features),
    }


def rows_table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Any]) -> Any:
    """The rows of an episode, columns (rows, n), in the order and the types of ``features``."""
    import pyarrow as pa

    arrays = {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        flat = pa.array(np.ascontiguousarray(columns[key].astype(feature["dtype"])).reshape(-1))
        size = int(feature["shape"][0])
        arrays[key] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.table(arrays)


def entry_table(
    number: int, length: int, start: int, task: str, cameras: list[str], fps: int, stats: Mapping[str, Stats]
) -> Any:
    """The one row of ``meta/episodes`` for an episode whose first row is number ``start`` of the whole dataset."""
    import pyarrow as pa

    chunk, file = pa.array([number // CHUNK]), pa.array([number % CHUNK])
    row: dict[str, Any] = {
        "episode_index": pa.array([number]),
        "tasks": pa.array([[task]]),
        "length": pa.array([length]),
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": pa.array([start]),
        "dataset_to_index": pa.array([start + length]),
    }
    for camera in cameras:
        place = f"videos/{video_key(camera)}"
        row |= {f"{place}/chunk_index": chunk, f"{place}/file_index": file}
        row |= {f"{place}/from_timestamp": pa.array([0.0]), f"{place}/to_timestamp": pa.array([length / fps])}
    row |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
    for key, found in stats.items():
        row.update({f"stats/{key}/{name}": pa.array([value.tolist()]) for name, value in found.items()})
    return pa.table(row)


def write_table(path: Path, table: Any) -> None:
    """Write a Parquet file, whole or not at all."""
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    pq.write_table(table, beside, use_dictionary=False, write_statistics=False)
    sync(beside)
    beside.replace(path)
    sync(path.parent)


def read_entry(path: Path) -> dict[str, Any]:
    """Return the one row of an episode's :func:`entry_table`. ValueError where there is not one."""
    import pyarrow.parquet as pq

    (row,) = pq.ParquetFile(path).read().to_pylist()
    return dict(row)


def read_tasks(path: Path) -> list[str]:
    """All tasks, by their number."""
    if not path.exists():
        return []
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read()
    numbered = sorted(zip(table["task_index"].to_pylist(), table[_TASK].to_pylist(), strict=True))
    return [text for _, text in numbered]


def tasks_table(tasks: list[str]) -> Any:
    """``meta/tasks.parquet``: a pandas frame whose index is the text, as LeRobot reads it."""
    import pyarrow as pa

    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), _TASK: pa.array(tasks, pa.string())})
    columns: list[dict[str, Any]] = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": None, "field_name": _TASK, "pandas_type": "unicode", "numpy_type": "object"},
    ]
    pandas = {
        "index_columns": [_TASK],
        "column_indexes": [{"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}],
        "columns": [column | {"metadata": None} for column in columns],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({b"pandas": json.dumps(pandas).encode()})
