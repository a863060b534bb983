"""Curation against LeRobot's own tools: every number and picture is equal.

LeRobot needs an environment of its own (docs/export.md). This file runs only where ``HAL_TEST_LEROBOT`` is that
environment's interpreter, and CI has none:

    HAL_TEST_LEROBOT=~/lerobot/bin/python pytest tests/system/test_lerobot_tools.py
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_kit import mock_rig, record

from hal.recording import Dataset, KeptRows, Recorder, delete_episodes, extract, mark_episodes, merge, pack, split, trim

Items = dict[str, np.ndarray[Any, Any]]
PROGRAM = Path(__file__).parents[1] / "kits" / "lerobot_program.py"
NUMBERED = {"episode_index", "index", "frame_index", "timestamp", "task_index"}
UNKNOWN = "rig.camera_pose.wrist"
"""Unknown in a mock. LeRobot's merging makes unknown numbers missing ones, which its reader then refuses."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lerobot")


@pytest.fixture(scope="module")
def seen(folder: Path) -> dict[str, Items]:
    """What LeRobot reads in datasets that each side made of one recording, loose and packed."""
    loose, packed = folder / "loose", folder / "packed"
    with mock_rig() as rig, Recorder(rig, loose, fps=20, task="lift") as recorder:
        for seconds, success in ((0.3, True), (0.4, False), (0.5, None), (0.6, True)):
            recorder.task = "lower" if seconds > 0.55 else "lift"
            record(recorder, seconds, success)
    merge([loose], packed)
    pack(packed)
    extract(packed, [0, 2, 3], folder / "extracted")
    merge([packed, loose], folder / "merged")
    split(packed, {"a": [0, 3], "b": [1, 2]}, folder / "split")
    trim(packed, {1: KeptRows(2, 7), 3: KeptRows(4, 13)}, folder / "trimmed")
    merge([loose], folder / "marked")
    mark_episodes(folder / "marked", {1: True, 3: None})
    merge([loose], folder / "deleted")
    delete_episodes(folder / "deleted", [1])
    jobs: list[list[Any]] = [
        ["delete", str(loose), str(folder / "their_loose"), [1]],
        ["delete", str(packed), str(folder / "their_packed"), [1]],
        ["split", str(packed), str(folder / "their_split"), {"a": [0, 3], "b": [1, 2]}],
        ["remove", str(packed), str(folder / "their_removed"), [UNKNOWN]],
        ["merge", str(folder / "their_removed"), str(folder / "their_merged")],
        ["delete", str(folder / "their_merged"), str(folder / "their_rest"), [2, 5]],
        ["add", str(packed), str(folder / "their_added")],
    ]
    names = [
        "loose",
        "packed",
        "extracted",
        "merged",
        "split/a",
        "split/b",
        "trimmed",
        "deleted",
        "marked",
        "their_split/a",
    ]
    names += [Path(job[2]).name for job in jobs if job[0] != "split"]
    reads = [["read", str(folder / name), str(folder / f"{name}.npz")] for name in names]
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "cache")}
    python = os.environ["HAL_TEST_LEROBOT"]
    for name in ("PYTHONPATH", "PYTHONHOME"):
        environment.pop(name, None)
    done = subprocess.run(
        [python, str(PROGRAM), json.dumps(jobs + reads)], env=environment, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return {name: dict(np.load(folder / f"{name}.npz")) for name in names}


def rows_of(items: Items, episodes: Sequence[int], kept: dict[int, KeptRows]) -> list[int]:
    found: list[int] = []
    for number in episodes:
        rows = np.flatnonzero(items["episode_index"] == number)
        found += rows[slice(*kept.get(number, (0, len(rows))))].tolist()
    return found


@pytest.mark.parametrize(
    ("name", "episodes", "kept"),
    [
        ("packed", [0, 1, 2, 3], {}),
        ("extracted", [0, 2, 3], {}),
        ("deleted", [0, 2, 3], {}),
        ("merged", [0, 1, 2, 3, 0, 1, 2, 3], {}),
        ("split/a", [0, 3], {}),
        ("split/b", [1, 2], {}),
        ("trimmed", [0, 1, 2, 3], {1: KeptRows(2, 7), 3: KeptRows(4, 13)}),
        ("their_loose", [0, 2, 3], {}),
    ],
)
def test_lerobot_reads_the_numbers_and_pictures_of_the_recording(
    seen: dict[str, Items], name: str, episodes: list[int], kept: dict[int, KeptRows]
) -> None:
    """The last one is made by LeRobot's own ``delete_episodes``, which encodes nothing again there."""
    items, source = seen[name], seen["loose"]
    rows = rows_of(source, episodes, kept)
    assert items.keys() == source.keys()
    for key, values in items.items():
        expected = source[key][rows]
        if key.startswith("rig.time.") and kept:
            continue  # since the first row that was kept
        if key in ("next.success", "next.done") and kept:
            assert values.sum() == {"next.success": 2, "next.done": 4}[key]
            continue
        if key not in NUMBERED:
            assert np.array_equal(values, expected, equal_nan=values.dtype.kind == "f"), key
    assert np.array_equal(items["index"], np.arange(len(rows)))


def test_a_mark_is_what_lerobot_reads(seen: dict[str, Items]) -> None:
    items, source = seen["marked"], seen["loose"]
    for key, values in items.items():
        if key != "next.success":
            assert np.array_equal(values, source[key], equal_nan=values.dtype.kind == "f"), key
    ends = np.flatnonzero(items["next.done"])
    assert items["next.success"][ends].tolist() == [True, True, False, False]
    assert items["next.success"].sum() == 2


def test_a_deletion_is_the_same_by_either(seen: dict[str, Items]) -> None:
    ours, theirs = seen["deleted"], seen["their_loose"]
    assert ours.keys() == theirs.keys()
    for key in ours.keys() - {"task_index"}:  # LeRobot may number the same tasks in another order
        assert np.array_equal(ours[key], theirs[key], equal_nan=ours[key].dtype.kind == "f"), key


@pytest.mark.parametrize(
    "name",
    ["their_loose", "their_packed", "their_split/a", "their_removed", "their_merged", "their_rest", "their_added"],
)
def test_what_lerobot_made_is_read_as_lerobot_reads_it(folder: Path, seen: dict[str, Items], name: str) -> None:
    items, dataset = seen[name], Dataset(folder / name)
    assert len(dataset.notes) == 1
    for key, values in items.items():
        if key == "task":
            found = np.array([episode.task for episode in dataset.episodes for _ in range(episode.length)])
        elif key.startswith("observation.images."):
            camera = key.rpartition(".")[2]
            found = np.array([picture for episode in dataset.episodes for picture in episode.frames(camera)])
        else:
            found = np.concatenate([episode.columns[key] for episode in dataset.episodes])
            found = found.reshape(values.shape).astype(values.dtype)  # LeRobot makes all numbers 32 bits
        assert np.array_equal(found, values, equal_nan=values.dtype.kind == "f"), key
