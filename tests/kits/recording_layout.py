"""Is this folder a LeRobotDataset v3.0? Asked of its documentation and its loader, and not of the recorder.

One file of each kind per episode, which both allow.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hal.recording import Episode

pa = pytest.importorskip("pyarrow", reason="pip install 'robot-hal[record]'")
av = pytest.importorskip("av", reason="pip install 'robot-hal[record]'")

import pyarrow.parquet as pq  # noqa: E402

TYPES = {"float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}
BOOKKEEPING = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
AFTERWARDS = ("intervention", "next.success", "next.done")
INFO = {
    "codebase_version": str,
    "robot_type": str,
    "total_episodes": int,
    "total_frames": int,
    "total_tasks": int,
    "chunks_size": int,
    "data_files_size_in_mb": int,
    "video_files_size_in_mb": int,
    "fps": int,
    "splits": dict,
    "data_path": str,
    "features": dict,
}
QUANTILES = ("q01", "q10", "q50", "q90", "q99")
PARTS = ("min", "max", "mean", "std", "count", *QUANTILES)
INDICES = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
PER_FILE = 1000


def check_layout(root: Path) -> dict[str, Any]:
    """Check a whole dataset; return its ``info``."""
    info = strict_json(root / "meta/info.json")
    check_info(info)
    total, features = info["total_episodes"], info["features"]
    videos = [key for key, feature in features.items() if feature["dtype"] == "video"]
    tasks = read_tasks(root, info["total_tasks"])
    stats = strict_json(root / "meta/stats.json")
    for key, found in stats.items():
        check_stats(found, features[key], key)

    entries = sorted(root.glob("meta/episodes/*/*.parquet"))
    rows = [(entry, row) for entry in entries for row in read_entries(entry)]
    assert len(rows) == total
    data_files = [row["data/file_index"] + PER_FILE * row["data/chunk_index"] for _, row in rows]
    assert data_files == sorted(data_files), "LeRobot reads the files of rows in the order of their names"
    unknown = set()
    """Columns of which a number was not known in some episode: the whole dataset may have no statistics of those."""
    at = 0
    files = {root / "meta/info.json", root / "meta/stats.json", root / "meta/tasks.parquet", *entries}
    for number, (_, row) in enumerate(rows):
        place = place_of(row, "data")
        length = row["length"]
        assert [row[key] for key in INDICES] == [number, length, at, at + length]
        data = root / info["data_path"].format(**place)
        check_rows(data, info, row, tasks)
        for key, feature in features.items():
            own = {part: row[f"stats/{key}/{part}"] for part in PARTS}
            check_stats(own, feature, key)
            unknown |= set() if np.isfinite(np.array(own["mean"])).all() else {key}
        files.add(data)
        for key in videos:
            span = row[f"videos/{key}/from_timestamp"], row[f"videos/{key}/to_timestamp"]
            assert span[1] - span[0] == pytest.approx(length / info["fps"])
            video = root / info["video_path"].format(video_key=key, **place_of(row, f"videos/{key}"))
            check_video(video, features[key], info["fps"], span[0], length)
            files.add(video)
        at += length
        strict_json(root / f"episodes/{number:06d}.json")
    assert at == info["total_frames"]
    assert set(features) - unknown <= set(stats)
    for folder in ("meta", "data", "videos"):
        assert {path for path in (root / folder).rglob("*") if path.is_file()} <= files, "nothing is left over"
    assert not list(root.glob("episodes/*.partial"))
    return info


def strict_json(path: Path) -> dict[str, Any]:
    """Read a file as JSON is defined: without NaN and infinities, which Python would take."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{path.name} holds {name}")

    return dict(json.loads(path.read_text(), parse_constant=refuse))


def check_info(info: dict[str, Any]) -> None:
    """Check ``meta/info.json``: the whole, and each column."""
    assert {key: type(info[key]) for key in INFO} == INFO
    assert info["codebase_version"] == "v3.0"
    assert info["chunks_size"] == PER_FILE
    assert info["splits"] == {"train": f"0:{info['total_episodes']}"}
    features = info["features"]
    assert (info["video_path"] is None) == all(feature["dtype"] != "video" for feature in features.values())
    for key, dtype in BOOKKEEPING.items():
        assert features[key] == {"dtype": dtype, "shape": [1], "names": None}
    for key in ("observation.state", "action"):
        assert features[key]["dtype"] == "float32"
    assert [key for key in features if key.startswith("action")] == ["action"], "each one would count as an action"
    for key, feature in features.items():
        assert "/" not in key
        if feature["dtype"] == "video":
            assert feature["names"] == ["height", "width", "channels"]
        elif key in AFTERWARDS:
            assert feature == {"dtype": "bool", "shape": [1], "names": None}
        elif key not in BOOKKEEPING:
            assert feature["shape"] == [len(feature["names"])]
            assert len(set(feature["names"])) == len(feature["names"])


def read_tasks(root: Path, total: int) -> list[str]:
    """The texts, by their number, from a table that pandas reads with the text as its index."""
    table = pq.read_table(root / "meta/tasks.parquet")
    assert table.schema.names == ["task_index", "__index_level_0__"]
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    assert table["task_index"].to_pylist() == list(range(total))
    texts: list[str] = table["__index_level_0__"].to_pylist()
    return texts


def place_of(row: dict[str, Any], lead: str) -> dict[str, int]:
    """The number of a file, in two parts."""
    return {part: row[f"{lead}/{part}"] for part in ("chunk_index", "file_index")}


def read_entries(path: Path) -> list[dict[str, Any]]:
    """The rows of a file of the index, one per episode."""
    table = pq.read_table(path)
    for name in table.schema.names:
        kind = table.schema.field(name).type
        if name.startswith("stats/"):
            assert pa.types.is_list(kind)
        elif name == "tasks":
            assert kind == pa.list_(pa.string())
        elif name.startswith("camera_"):
            assert pa.types.is_list(kind)
        elif name == "success":
            assert kind == pa.bool_()
        else:
            assert kind == (pa.float64() if name.endswith("timestamp") else pa.int64()), name
    rows: list[dict[str, Any]] = table.to_pylist()
    for row in rows:
        place = place_of(row, "meta/episodes")
        assert path.parts[-2:] == (f"chunk-{place['chunk_index']:03d}", f"file-{place['file_index']:03d}.parquet")
    return rows


def check_rows(path: Path, info: dict[str, Any], entry: dict[str, Any], tasks: list[str]) -> None:
    """The rows of an episode: types, numbers, and that the statistics are those of these rows."""
    features = {key: feature for key, feature in info["features"].items() if feature["dtype"] != "video"}
    length, start = entry["length"], entry["dataset_from_index"]
    table = pq.read_table(path)
    assert table.schema.names == list(features)
    table = table.filter(pa.compute.equal(table["episode_index"], entry["episode_index"]))
    assert len(table) == length > 0
    for key, feature in features.items():
        kind, (size,) = TYPES[feature["dtype"]], feature["shape"]
        assert table.schema.field(key).type == (kind if size == 1 else pa.list_(kind, size)), key
        assert table[key].null_count == 0
        column = table[key].combine_chunks()
        values = (
            (column if size == 1 else column.flatten())
            .to_numpy(zero_copy_only=False)
            .reshape(length, size)
            .astype(float)
        )
        known = np.isfinite(values).any(axis=0)
        for part, of in (("min", np.nanmin), ("max", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
            said = np.array(entry[f"stats/{key}/{part}"])[known]
            assert np.allclose(said, of(values[:, known], axis=0), atol=1e-6), (key, part)
        assert entry[f"stats/{key}/count"] == [length]
    assert table["index"].to_pylist() == list(range(start, start + length))
    assert table["frame_index"].to_pylist() == list(range(length))
    assert set(table["episode_index"].to_pylist()) == {entry["episode_index"]}
    (task,) = set(table["task_index"].to_pylist())
    assert entry["tasks"] == [tasks[task]]
    stamps = table["timestamp"].to_numpy()
    assert np.abs(stamps - np.arange(length) / info["fps"]).max() < 1e-5


def check_stats(stats: dict[str, Any], feature: dict[str, Any], key: str) -> None:
    """Shapes, and an order that statistics of anything have."""
    shape = (3, 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
    found = {part: np.array(value, float) for part, value in stats.items()}
    assert set(found) == set(PARTS)
    assert found.pop("count").shape == (1,)
    assert stats["count"][0] > 0
    for part, values in found.items():
        assert values.shape == shape, (key, part)
    rising = [found[part] for part in ("min", *QUANTILES, "max")]
    for low, high in itertools.pairwise(rising):
        assert not (low > high + 1e-6 * np.abs(high)).any(), key
    if feature["dtype"] == "video":
        assert found["min"].min() >= 0.0
        assert found["max"].max() <= 1.0


def check_video(path: Path, feature: dict[str, Any], fps: int, start: float, length: int) -> None:
    """Check that a video is as its feature describes, with every picture at its time to within 0.1 ms (as LeRobot)."""
    height, width, _ = feature["shape"]
    with av.open(str(path)) as container:
        (stream,) = container.streams
        said = {
            "video.height": stream.codec_context.height,
            "video.width": stream.codec_context.width,
            "video.codec": stream.codec_context.codec.canonical_name,
            "video.pix_fmt": stream.codec_context.pix_fmt,
            "video.fps": float(stream.average_rate),
            "video.channels": 3,
            "video.is_depth_map": False,
            "has_audio": False,
        }
        assert said == feature["info"]
        assert [height, width, 3] == feature["shape"]
        assert said["video.fps"] == fps
        times = []
        for frame in container.decode(stream):
            t = float(frame.pts * stream.time_base) - start
            if -0.5 / fps < t < (length - 0.5) / fps:
                times.append(t)
                assert (frame.height, frame.width) == (height, width)
    assert len(times) == length
    assert np.abs(np.array(times) - np.arange(length) / fps).max() < 1e-4


def check_stamps(episode: Episode) -> None:
    """Rows follow each other in time, and so do the samples in them; a picture's stamp is new as a whole or not."""
    assert (np.diff(episode.stamps["grid"]) > 0.0).all()
    for key, column in episode.columns.items():
        if not key.startswith("rig.time.") or column.ndim == 1:
            continue
        source = key.removeprefix("rig.time.")
        known: NDArray[np.float64] = column[np.isfinite(column[:, 0])]
        steps = np.diff(known, axis=0)
        assert (steps >= 0.0).all(), source
        if source.startswith("robot."):
            assert (steps[:, 0] > 0.0).all(), source
        if source.startswith("camera."):
            new = steps[:, 2] > 0.0
            assert (steps[new] > 0.0).all(), source
            assert (steps[~new] == 0.0).all(), source
            assert new.sum() > 0.5 * len(new), f"{source}: most rows have a picture of their own"
    if "objects" in episode.stamps:
        assert (np.diff(episode.stamps["objects"]) >= 0.0).all()
