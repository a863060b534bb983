"""What LeRobot's own tools leave of a recording, written here as its version 0.4.4 writes it.

``delete_episodes`` and ``split_dataset`` number the episodes again, and encode the pictures again where a file held
others; ``merge_datasets`` joins rows with pandas (lists of any length, unknown numbers missing) and videos;
``remove_feature`` and ``add_features`` change the columns. Nothing has ``episodes/`` or ``depth/``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hal.recording import Dataset
from hal.recording.finish import tasks_table
from hal.recording.layout import BOOKKEEPING

ADDED: dict[str, dict[str, Any]] = {
    "reward": {"dtype": "float32", "shape": [1], "names": None},
    "embedding": {"dtype": "float32", "shape": [3], "names": None},
    "remark": {"dtype": "string", "shape": [1], "names": None},
}


def edit_as_lerobot(
    source: Dataset,
    out: Path,
    episodes: Sequence[int],
    *,
    remove: Collection[str] = (),
    add: bool = False,
    file: int = 0,
) -> Path:
    """Write a dataset of some episodes: rows in one file, and each camera in another one, encoded again.

    Args:
        source: The recording.
        out: Folder of the result.
        episodes: Numbers of its episodes, in the order of the result.
        remove: Columns and videos that are left out.
        add: Add columns of other programs.
        file: Number of the files of rows and videos.
    """
    features = {key: feature for key, feature in source.info["features"].items() if key not in remove}
    features |= ADDED if add else {}
    chosen = [source.episodes[number] for number in episodes]
    starts = np.cumsum([0, *(episode.length for episode in chosen)]).tolist()
    tasks = list(dict.fromkeys(episode.task for episode in source.episodes))
    columns: dict[str, Any] = {}
    for key, feature in features.items():
        if feature["dtype"] != "video":
            columns[key] = []
            for number, episode in enumerate(chosen):
                columns[key] += _values(key, number, starts[number], episode, add)
    _write(out / f"data/chunk-000/file-{file:03d}.parquet", pa.table(columns, _schema(features)))
    numbered = tasks_table(tasks)
    texts = ["task" if name != "task_index" else name for name in numbered.column_names]  # as version 0.6 has it
    _write(out / "meta/tasks.parquet", numbered.rename_columns(texts))
    videos = [key for key, feature in features.items() if feature["dtype"] == "video"]
    rows = []
    for number, episode in enumerate(chosen):
        row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": episode.length}
        row |= {"data/chunk_index": 0, "data/file_index": file}
        row |= {"dataset_from_index": starts[number], "dataset_to_index": starts[number + 1]}
        for key in videos:
            row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": file}
            row |= {f"videos/{key}/from_timestamp": starts[number] / source.fps}
            row |= {f"videos/{key}/to_timestamp": starts[number + 1] / source.fps}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": number}  # sic: there is one file
        rows.append(row | {"stats/action/count": [episode.length]})
    _write(out / "meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
    for key in videos:
        pictures = [picture for episode in chosen for picture in episode.frames(key.split(".")[-1])]
        _encode(out / f"videos/{key}/chunk-000/file-{file:03d}.mp4", pictures, source.fps)
    counts = {"total_episodes": len(chosen), "total_frames": starts[-1], "total_tasks": len(tasks)}
    info = source.info | counts | {"features": features, "splits": {"train": f"0:{len(chosen)}"}}
    (out / "meta/info.json").write_text(json.dumps(info))
    return out


def _values(key: str, number: int, start: int, episode: Any, add: bool) -> list[Any]:
    rows = episode.length
    if add and key in ADDED:
        return {"reward": [0.5] * rows, "embedding": [[1.0, 2.0, 3.0]] * rows, "remark": ["ok"] * rows}[key]
    if key in ("episode_index", "index"):
        return [number] * rows if key == "episode_index" else list(range(start, start + rows))
    return [_known(value) for value in episode.columns[key].tolist()]


def _known(value: Any) -> Any:
    if isinstance(value, list):
        return [_known(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _schema(features: dict[str, Any]) -> pa.Schema:
    types = {"float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}
    fields = []
    for key, feature in features.items():
        if feature["dtype"] != "video":
            kind = types.get(feature["dtype"], pa.string())
            single = key in BOOKKEEPING or feature["shape"] == [1]
            fields.append((key, kind if single else pa.list_(kind)))
    return pa.schema(fields)


def _write(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _encode(path: Path, pictures: list[Any], fps: int) -> None:
    """Write a video whose key frames are far apart, with pictures that refer to later ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=fps, options={"g": "12", "bf": "2", "crf": "30"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
