"""Datasets of LeRobot without this project's own files: those that LeRobot's tools edited, or that it recorded.

Its tools write a new folder with rows, videos and ``meta/``; ``episodes/`` and ``depth/`` are not copied. Everything
that is left is read; :attr:`~hal.recording.Dataset.notes` names what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..errors import DatasetError
from .index import read_entries, read_tasks, validated_info
from .layout import CHUNK, GRID, MORE_STREAMS, DatasetLayout, current_key, read_json, video_key, video_names
from .validation import dataset_errors

_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_PATHS = {"data_path": f"data/{_PLACE}.parquet", "video_path": f"videos/{{video_key}}/{_PLACE}.mp4"}
_NUMBERS = ("float32", "float64", "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")


class ForeignDataset(NamedTuple):
    """What is known about a dataset without this project's own files."""

    info: dict[str, Any]
    """``meta/info.json``, with the columns and videos that can be read."""
    episodes: list[dict[str, Any]]
    """Metadata of each episode, as far as it is known, with the keys of ``episodes/N.json``."""
    notes: tuple[str, ...]
    """What is missing."""


def is_foreign(layout: DatasetLayout) -> bool:
    """Return whether a folder is a dataset of LeRobot without this project's own files."""
    return layout.info.exists() and not layout.episodes.is_dir()


def read_foreign(layout: DatasetLayout) -> ForeignDataset:
    """Read the index of a dataset for which :func:`is_foreign` is true.

    Raises:
        DatasetError: It is damaged, or has a version of LeRobot's format that is not read (code ``foreign_dataset``).
    """
    with dataset_errors(layout, layout.info):
        info = read_json(layout.info)
        odd = [key for key, path in _PATHS.items() if info.get(key) not in (path, None)]
        if not str(info["codebase_version"]).startswith("v3.") or odd:
            raise DatasetError(
                f"is of LeRobot's format {info['codebase_version']}{' with other file names' if odd else ''}, and "
                "v3.0 is read; LeRobot converts older ones",
                file="meta/info.json",
                code="foreign_dataset",
            )
        left_out = [key for key, feature in info["features"].items() if not _is_read(key, feature)]
        features = {key: _feature(each) for key, each in info["features"].items() if key not in left_out}
        info = validated_info(info | {"features": features, "fps": _whole(info["fps"])})
    entries = _entries(layout, info)
    with dataset_errors(layout, layout.tasks):
        tasks = read_tasks(layout.tasks)
    cameras = _cameras(features)
    with dataset_errors(layout, layout.root / "meta/episodes"):
        abouts = [_about(info, entry, cameras, tasks) for entry in _places(layout, info, entries)]
    return ForeignDataset(info, abouts, (_notice(info, entries, cameras, left_out),))


def _is_read(key: str, feature: Mapping[str, Any]) -> bool:
    if feature["dtype"] == "video":
        about = feature.get("info") or {}
        depth = about.get("is_depth_map") or about.get("video.is_depth_map")  # LeRobot's own form of depth
        return key.startswith(video_key("")) and not depth
    return feature["dtype"] in _NUMBERS and len(feature["shape"]) == 1


def _whole(number: float) -> int:
    if number != int(number):
        raise ValueError(f"{number} is not a whole number")
    return int(number)


def _feature(feature: Mapping[str, Any]) -> dict[str, Any]:
    """Return a column's entry with a flat list of names, and a video's with the shape height, width, channels."""
    shape, names = [_whole(side) for side in feature["shape"]], _flat(feature.get("names"))
    if feature["dtype"] == "video" and names == ["channels", "height", "width"]:
        shape, names = [*shape[1:], shape[0]], ["height", "width", "channels"]
    elif feature["dtype"] != "video" and [len(names)] != shape:
        names = []
    return {**feature, "shape": shape, "names": names or None}


def _flat(names: Any) -> list[str]:
    if isinstance(names, str):
        return [names]
    if isinstance(names, Mapping):
        return _flat(list(names.values()) if any(not isinstance(each, int) for each in names.values()) else list(names))
    return [part for each in names or () for part in _flat(each)]


def _entries(layout: DatasetLayout, info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of ``meta/episodes``, without statistics, in the order of the episodes."""
    found: dict[int, dict[str, Any]] = {}
    for path in sorted(layout.root.glob("meta/episodes/*/*.parquet")):
        with dataset_errors(layout, path):
            found |= read_entries(path)
    with dataset_errors(layout, layout.info):
        if sorted(found) != list(range(info["total_episodes"])):
            raise ValueError(f"it lists {info['total_episodes']} episodes, and meta/episodes has {len(found)}")
    return [found[number] for number in sorted(found)]


def _places(
    layout: DatasetLayout, info: Mapping[str, Any], entries: Iterable[Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Yield the row of each episode with ``files``: where its rows and pictures are."""
    videos = video_names(info["features"])
    starts: dict[int, int] = {}
    """Number of the first row of each file in the whole dataset."""
    for number, entry in enumerate(entries):
        with dataset_errors(layout, layout.root / "meta/episodes", number):
            start, rows = _count(entry["dataset_from_index"]), _count(entry["length"])
            if not 0 < rows == entry["dataset_to_index"] - start:
                raise ValueError(f"its length is {rows}, from row {start} to {entry['dataset_to_index']}")
            file = _file(entry, "data")
            first = start - starts.setdefault(file, start)
            places = {}
            for name in videos:
                lead = f"videos/{video_key(name)}"
                begin, end = (float(entry[f"{lead}/{side}_timestamp"]) * info["fps"] for side in ("from", "to"))
                if not (math.isfinite(begin) and begin > -0.5 and abs(end - begin - rows) < 0.5):
                    raise ValueError(f"{name} has pictures {begin:g} to {end:g} for {rows} rows")
                places[name] = [_file(entry, lead), round(begin)]
        yield {**entry, "files": {"index": 0, "data": [file, first], "videos": places}}


def _count(value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{value!r} is not a number of rows or of a file")
    return value


def _file(entry: Mapping[str, Any], lead: str) -> int:
    """Return the number of a file, counted through all folders."""
    chunk, file = (_count(entry[f"{lead}/{name}_index"]) for name in ("chunk", "file"))
    if file >= CHUNK:
        raise ValueError(f"{lead} has more than {CHUNK} files in a folder")
    return chunk * CHUNK + file


def _cameras(features: Mapping[str, Any]) -> list[str]:
    """Return the names of the cameras: of the videos, without the further streams of a camera."""
    videos = video_names(features)
    further = {f"{name}_{stream}" for name in videos for stream in MORE_STREAMS}
    return [name for name in videos if name not in further]


def _about(
    info: Mapping[str, Any], entry: Mapping[str, Any], cameras: Iterable[str], tasks: list[str]
) -> dict[str, Any]:
    texts = entry.get("tasks") or tasks[:1]
    return {
        "episode": entry["episode_index"],
        "length": entry["length"],
        "files": entry["files"],
        "t_start": 0.0,
        "task": str(texts[0]) if texts else "",
        "success": entry.get("success"),
        "dropped": None if entry.get("dropped") is None else int(entry["dropped"]),
        "cameras": {
            name: {
                "K": _matrix(entry.get(f"camera_matrix/{name}")),
                "distortion": entry.get(f"camera_distortion/{name}"),
                "depth_unit_m": None,
                "streams": [],
            }
            for name in cameras
        },
        "rig": {"written": None, "resolved": {"world": None, "robots": [], "cameras": []}},
        "gaps": [],
        "pace": {},
        "info": {},
        "seed": None,
        "robot_type": info.get("robot_type"),
    }


def _matrix(numbers: Any) -> list[list[float]] | None:
    """Return a camera matrix (3, 3); None for one that is missing or damaged."""
    try:
        return np.array(numbers, np.float64).reshape(3, 3).tolist()
    except (TypeError, ValueError):
        return None


def _notice(info: Mapping[str, Any], entries: list[dict[str, Any]], cameras: list[str], left_out: list[str]) -> str:
    columns = {current_key(key) for key in info["features"]}
    missing = ["the episodes' own metadata (rig, seeds, dropped rows)", "depth"]
    if GRID not in columns:
        missing.append("true times (nominal ones take their place)")
    if "next.success" not in columns and not any("success" in entry for entry in entries):
        missing.append("marks of success")
    if any(f"camera_matrix/{name}" not in entry for entry in entries for name in cameras):
        missing.append("camera matrices")
    text = f"this dataset was edited or recorded by another program; missing: {', '.join(missing)}"
    return f"{text}; not read: {', '.join(left_out)}" if left_out else text
