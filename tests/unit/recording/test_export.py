"""What every export shares: which episodes, which pictures, and that a file appears whole or not at all."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import SIZE, make_recording, pictures

import hal
from hal.errors import CommandError, DatasetError
from hal.recording import Dataset, Recorder
from hal.recording.exporters import default_path, export
from hal.recording.exporters.content import parse_episodes
from hal.recording.exporters.output import write_atomically


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_recording(tmp_path_factory.mktemp("export") / "demo")


def test_episodes_are_numbers_and_ranges() -> None:
    assert parse_episodes("0, 3-5,7") == [0, 3, 4, 5, 7]
    for wrong in ("", "1-", "a", "3-1", "-1", "1,,2"):
        with raises_code(CommandError, "bad_episodes"):
            parse_episodes(wrong)


@pytest.mark.parametrize(
    ("chosen", "numbers"),
    [
        ({}, [0, 1, 2]),
        ({"episodes": "2,0-1,1"}, [0, 1, 2]),
        ({"episodes": [2, 1]}, [1, 2]),
        ({"successful_only": True}, [0]),
    ],
)
def test_the_chosen_episodes_are_written_in_their_order(
    dataset: Dataset, tmp_path: Path, chosen: dict[str, object], numbers: list[int]
) -> None:
    made = export(dataset, "npz", tmp_path / "out", cameras=[], **chosen)  # type: ignore[arg-type]
    about = json.loads((made.path / "export.json").read_text())
    assert [episode["episode"] for episode in about["episodes"]] == numbers
    assert [episode["success"] for episode in about["episodes"]] == [(True, False, None)[k] for k in numbers]
    assert made.episodes == len(numbers)
    assert made.rows == sum(dataset.episodes[k].length for k in numbers)


@pytest.mark.parametrize(
    ("kind", "wrong", "code"),
    [
        ("npz", {"episodes": "0-3"}, "no_episodes"),
        ("npz", {"episodes": "1", "successful_only": True}, "no_episodes"),
        ("npz", {"episodes": []}, "no_episodes"),
        ("zarr", {"cameras": ["front"]}, "no_such_camera"),
        ("npz", {"camera": "front"}, "no_such_camera"),
        ("npz", {"camera": "wrist", "gripper_camera": "wrist"}, "duplicate_name"),
        ("zarr", {"size": (0, 4)}, "bad_export"),
        ("robomimic", {"valid": 1.0}, "bad_export"),
        ("tfds", {}, "bad_export"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_is_left(
    dataset: Dataset, tmp_path: Path, kind: str, wrong: dict[str, object], code: str
) -> None:
    if kind == "robomimic":
        pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    with raises_code(CommandError, code):
        export(dataset, kind, tmp_path / "out", **wrong)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_it_goes_beside_the_dataset(dataset: Dataset) -> None:
    made = export(dataset, "zarr", cameras=[])
    assert made.path == default_path(dataset.root, "zarr") == dataset.root.with_name("demo.zarr")
    files = [file for file in made.path.rglob("*") if file.is_file()]
    assert made.size == sum(file.stat().st_size for file in files) > 0


# Whole or not at all.


@pytest.mark.parametrize("kind", ["npz", "zarr", "robomimic"])
def test_only_such_an_export_is_overwritten_and_only_when_asked(dataset: Dataset, tmp_path: Path, kind: str) -> None:
    if kind == "robomimic":
        pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    path = tmp_path / "out"
    first = export(dataset, kind, path, cameras=[])
    with raises_code(CommandError, "exists"):
        export(dataset, kind, path, cameras=[], episodes="0")
    assert export(dataset, kind, path, cameras=[], episodes="0", force=True).size < first.size
    strange = tmp_path / "mine"
    strange.mkdir()
    (strange / "thesis.txt").write_text("years of work")
    with raises_code(CommandError, "not_an_export"):
        export(dataset, kind, strange, cameras=[], force=True)
    assert (strange / "thesis.txt").read_text() == "years of work"
    with raises_code(CommandError, "not_an_export"):
        export(dataset, kind, dataset.root, cameras=[], force=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["mine", "out"]


def test_an_export_that_fails_leaves_the_old_one(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "out"
    export(dataset, "npz", path, cameras=[])
    before = sorted((file.name, file.stat().st_mtime_ns) for file in path.iterdir())

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(dataset, "npz", path, force=True, on_episode=stop)
    assert sorted((file.name, file.stat().st_mtime_ns) for file in path.iterdir()) == before
    assert [file.name for file in tmp_path.iterdir()] == ["out"]


def test_what_a_killed_program_left_is_removed_and_what_runs_is_left_alone(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (tmp_path / f".out.{gone.pid}.partial").mkdir()
    other = tmp_path / f".out.{os.getppid()}.partial"
    other.mkdir()
    with pytest.raises(ZeroDivisionError), write_atomically(tmp_path / "out", force=False, is_ours=Path.is_dir):
        raise ZeroDivisionError
    assert [file.name for file in tmp_path.iterdir()] == [other.name]


def test_a_missing_library_is_named(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(hal.errors.DriverMissing, match=r"pip install 'robot-hal\[export\]'"):
        export(dataset, "robomimic", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


# Pictures.


def test_pictures_are_cropped_and_scaled_and_the_lens_with_them(dataset: Dataset, tmp_path: Path) -> None:
    width, height = SIZE
    assert (width, height) == (64, 48)
    made = export(dataset, "npz", tmp_path / "out", size=(24, 24), episodes="1")
    with np.load(made.path / "episode_000001.npz", allow_pickle=False) as file:
        color, depth = file["camera_rgb"], file["camera_depth"]
        lens = json.loads(str(file["info"]))["cameras_written"]["scene"]
    assert color.shape == (dataset.episodes[1].length, 24, 24, 3)
    whole = pictures(dataset, "rgb", "scene")[1][:, :, 8:56].astype(np.float64)  # the middle 48 x 48
    mean = whole.reshape(-1, 24, 2, 24, 2, 3).mean(axis=(2, 4))
    assert np.abs(color - mean).max() <= 1.0, "rounded once for each direction"
    assert np.isin(np.unique(depth), np.unique(pictures(dataset, "depth", "scene")[1])).all(), "nothing in between"
    K, before = np.array(lens["K"]), np.array(dataset.episodes[1].info["cameras"]["scene"]["K"])
    assert (lens["width"], lens["height"]) == (24, 24)
    assert K[0, 0] == pytest.approx(before[0, 0] / 2)
    assert K[0, 2] == pytest.approx((before[0, 2] - 8 + 0.5) / 2 - 0.5)
    assert K[1, 2] == pytest.approx((before[1, 2] + 0.5) / 2 - 0.5)


def test_progress_goes_from_nothing_to_all(dataset: Dataset, tmp_path: Path) -> None:
    reports = []
    export(dataset, "npz", tmp_path / "out", on_episode=lambda done, total: reports.append((done, total)))
    assert reports == [(done + 1, len(dataset)) for done in range(len(dataset))]


def test_episodes_with_different_pictures_are_refused(tmp_path: Path) -> None:
    """Depth is no column of the dataset, so one episode may have it and the next one not."""
    from recording_kit import join_metadata, mock_rig, record

    with mock_rig() as rig, Recorder(rig, out=tmp_path / "demo", fps=20, task="x") as recorder:
        record(recorder, 0.2)
        record(recorder, 0.2)
    join_metadata(tmp_path / "demo")
    file = tmp_path / "demo/episodes/000001.json"  # as a recorder that did not look at this once left it
    about = json.loads(file.read_text())
    for name, camera in about["cameras"].items():
        camera |= {"depth_unit_m": None, "depth_lossless": None}
        (tmp_path / f"demo/depth/{name}/chunk-000/file-001.depth").unlink()
    file.write_text(json.dumps(about))
    with raises_code(CommandError, "episodes_differ"):
        export(tmp_path / "demo", "zarr", tmp_path / "out")
    assert export(tmp_path / "demo", "zarr", tmp_path / "out", depth=False).episodes == 2


def test_a_video_that_is_too_short_is_an_error(tmp_path: Path) -> None:
    dataset = make_recording(tmp_path / "demo")
    short = dataset.root / "videos/observation.images.wrist/chunk-000"
    (short / "file-000.mp4").write_bytes((short / "file-002.mp4").read_bytes())
    with pytest.raises(
        DatasetError, check=lambda error: error.episode == 0 and str(error.file).endswith("file-000.mp4")
    ):
        export(dataset, "zarr", tmp_path / "out")
    assert [file.name for file in tmp_path.iterdir()] == ["demo"]
