"""Datasets that LeRobot's tools edited: what is left is read, and what is missing is listed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from app_kit import run_here
from errors_kit import raises_code
from lerobot_edits import edit_as_lerobot
from recording_kit import make_recording, mock_rig

from hal.apps import dataset as dataset_app
from hal.apps import review as review_app
from hal.errors import CommandError, DatasetError, DeviceNotFound
from hal.recording import Dataset, Recorder, delete_episodes, merge, repair
from hal.recording.checking import check_dataset
from hal.recording.exporters import export
from hal.recording.videos import read_video

NUMBERED = {"episode_index", "index"}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_recording(tmp_path_factory.mktemp("source") / "demo")


@pytest.fixture(scope="module")
def edited(source: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of which one was deleted and one is there twice, in files of another number."""
    return edit_as_lerobot(source, tmp_path_factory.mktemp("edited") / "demo", [2, 0, 2], file=7)


def test_every_number_and_picture_is_read(source: Dataset, edited: Path) -> None:
    dataset = Dataset(edited)
    assert [episode.length for episode in dataset.episodes] == [source.episodes[k].length for k in (2, 0, 2)]
    stored = {
        camera: list(read_video(edited / f"videos/observation.images.{camera}/chunk-000/file-007.mp4"))
        for camera in ("scene", "wrist")
    }
    at = 0
    for number, episode in zip((2, 0, 2), dataset.episodes, strict=True):
        original = source.episodes[number]
        assert (episode.task, episode.cameras) == (original.task, ("scene", "wrist"))
        assert episode.success is (True if number == 0 else None), "from the rows, which know no failure"
        for key, values in original.columns.items():
            found = episode.columns[key]
            assert found.dtype == values.dtype
            assert key in NUMBERED or np.array_equal(found, values, equal_nan=values.dtype.kind == "f"), key
        assert np.allclose(np.diff(episode.stamps["grid"]), np.diff(original.stamps["grid"]), atol=1e-9)
        for camera, pictures in stored.items():
            frames = list(episode.frames(camera))
            assert np.array_equal(frames, pictures[at : at + episode.length])
        with pytest.raises(DeviceNotFound):
            episode.depth["wrist"]
        at += episode.length
    assert list(check_dataset(dataset)) == []


def test_one_notice_lists_what_is_missing(source: Dataset, edited: Path, tmp_path: Path) -> None:
    assert source.notes == ()
    (note,) = Dataset(edited).notes
    assert "metadata" in note
    assert "depth" in note
    assert "true times" not in note
    gone = [key for key in source.info["features"] if key.startswith(("rig.", "next."))]
    poor = edit_as_lerobot(source, tmp_path / "poor", [0], remove=[*gone, "observation.images.scene"], add=True)
    (note,) = Dataset(poor).notes
    for missing in ("true times", "marks of success", "camera matrices", "not read: remark"):
        assert missing in note, missing
    episode = Dataset(poor).episodes[0]
    assert episode.cameras == ("wrist",)
    assert episode.success is None
    assert episode.columns["embedding"].tolist() == [[1.0, 2.0, 3.0]] * episode.length
    assert np.allclose(episode.stamps["grid"], np.arange(episode.length) / 20, atol=1e-6), "nominal"
    with pytest.raises(DatasetError):
        episode.columns["rig.setpoint"]
    features = Dataset(poor).info["features"]
    features["observation.images.wrist"]["info"] |= {"is_depth_map": True}
    change_info(features=features)(poor)
    assert Dataset(poor).episodes[0].cameras == (), "depth is not shown as colour"


@pytest.mark.parametrize("poor", [False, True])
def test_programs_work_with_what_is_left(source: Dataset, tmp_path: Path, poor: bool) -> None:
    gone = [key for key in source.info["features"] if key.startswith("rig.")] if poor else []
    folder = edit_as_lerobot(source, tmp_path / "edited", [1, 0], remove=gone, add=poor)
    listed = run_here(dataset_app.main, "list", str(folder))
    assert (listed.returncode, listed.stdout.count("note: ")) == (0, 1)
    reviewed = run_here(review_app.main, str(folder), "--check")
    assert (reviewed.returncode, reviewed.stdout.splitlines()[-1]) == (0, "2 episodes checked, 0 problem(s)")
    for kind in ("npz", "zarr"):
        made = export(folder, kind, tmp_path / kind)
        assert made.notes[0] == Dataset(folder).notes[0]
        assert made.rows == sum(source.episodes[k].length for k in (0, 1))
    if not poor:
        assert run_here(review_app.main, str(folder)).returncode == 0


def test_nothing_is_written_into_it(source: Dataset, edited: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in edited.rglob("*") if path.is_file()}
    for act in (
        lambda: delete_episodes(edited, [0]),
        lambda: merge([source.root, edited], tmp_path / "both"),
        lambda: repair(edited),
    ):
        with pytest.raises((CommandError, DatasetError)) as refused:
            act()
        assert refused.value.code == "foreign_dataset"
    with mock_rig() as rig, raises_code(CommandError, "foreign_dataset"):
        Recorder(rig, edited, fps=20)
    assert {path: path.read_bytes() for path in edited.rglob("*") if path.is_file()} == before
    assert not (edited / "episodes").exists()


def change_info(**new: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "meta/info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | new))

    return change


def change_entry(key: str, value: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "meta/episodes/chunk-000/file-000.parquet"
        table = pq.read_table(path)
        values = [value, *table[key].to_pylist()[1:]]
        pq.write_table(table.set_column(table.schema.get_field_index(key), key, [values]), path)

    return change


@pytest.mark.parametrize(
    "damage",
    [
        change_info(codebase_version="v2.1"),
        change_info(data_path="rows/{episode_index}.parquet"),
        change_info(total_episodes=3),
        change_info(fps=29.97),
        change_info(features={"observation.images.../../x": {"dtype": "video", "shape": [2, 2, 3], "names": None}}),
        change_entry("length", 3),
        change_entry("length", -1),
        change_entry("data/file_index", 4000),
        change_entry("data/chunk_index", -1),
        change_entry("dataset_from_index", 1),
        change_entry("videos/observation.images.wrist/from_timestamp", float("nan")),
        change_entry("videos/observation.images.wrist/to_timestamp", 99.0),
        lambda folder: (folder / "meta/tasks.parquet").write_bytes(b"PAR1"),
    ],
)
def test_a_damaged_index_is_an_error_that_names_the_file(
    source: Dataset, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    folder = edit_as_lerobot(source, tmp_path / "edited", [0, 1], remove=["observation.images.scene"])
    damage(folder)
    with pytest.raises(DatasetError) as found:
        Dataset(folder)
    assert found.value.file is not None


def test_rows_of_another_episode_are_not_taken_for_its_own(source: Dataset, tmp_path: Path) -> None:
    folder = edit_as_lerobot(source, tmp_path / "edited", [0, 1], remove=["observation.images.scene"])
    path = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(1), path)
    with pytest.raises(DatasetError):
        _ = Dataset(folder).episodes[0].columns
