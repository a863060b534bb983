"""The files of a dataset, and how they are read."""

from __future__ import annotations

import json
import os
import random
import re
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import CAMERAS, check_layout, drive, join_metadata, kill_writer, mock_rig, record, small

import hal
from hal.errors import CommandError, DeviceNotFound, HalError
from hal.recording import Dataset, Recorder, dataset, recover, repair
from hal.recording.checking import check_dataset
from hal.recording.exporters import export


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "demo"
    with mock_rig() as rig, Recorder(rig, out, task="lift") as recorder:
        recorder.start(seed=7, info={"note": "the first"})
        drive(rig, 1.0)
        recorder.save(True, wait=True)
        recorder.task = "lower"
        record(recorder, 0.5, success=False)
        record(recorder, 0.5, success=None)
    return out


def test_an_episode_has_the_metadata_of_its_source(made: Path) -> None:
    episodes = Dataset(made).episodes
    assert [episode.task for episode in episodes] == ["lift", "lower", "lower"]
    assert [episode.success for episode in episodes] == [True, False, None]
    info = episodes[0].info
    assert (info["seed"], info["info"]) == (7, {"note": "the first"})
    assert info["rig"]["resolved"]["robots"][0]["name"] == "panda"
    assert "cameras:" in info["rig"]["written"], "the file itself"
    assert {"python", "numpy", "av", "pyarrow"} <= set(info["versions"])
    assert info["engine"] is None, "a mock has no world"
    assert info["gaps"] == []


def test_columns_of_a_long_dataset_do_not_fill_the_memory(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, third = Dataset(made).episodes
    before = first.columns
    size = dataset._bytes(before)
    monkeypatch.setattr(dataset, "_MEMORY", dataset._ReadMemory(2 * size))
    for episode in (second, third):
        episode.__dict__.pop("columns", None)
    dataset._MEMORY.add(first, "columns", size)
    assert second.columns is second.columns
    assert first.columns is before, "both fit"
    assert third.columns is third.columns
    found = Dataset(made).episodes[0].columns
    assert "columns" not in first.__dict__, "the one that was read first"
    assert "columns" in third.__dict__
    assert first.columns is not before
    assert np.array_equal(first.columns["action"], found["action"])


def test_pictures_are_read_in_any_order_by_threads_and_forked_processes(made: Path) -> None:
    episode = Dataset(made).episodes[0]
    expected = {camera: list(episode.frames(camera)) for camera in CAMERAS}

    def is_right(seed: int) -> bool:
        dice = random.Random(seed)
        rows = [(dice.choice(CAMERAS), dice.randrange(episode.length)) for _ in range(40)]
        return all(np.array_equal(episode.frame(camera, row), expected[camera][row]) for camera, row in rows)

    assert is_right(0), "the videos are open now"
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(is_right, range(1, 5)))
    children = []
    for seed in (5, 6):
        if (child := os.fork()) == 0:
            os._exit(0 if is_right(seed) else 1)
        children.append(child)
    assert is_right(7), "while they read, too"
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    assert is_right(8)


def test_rows_are_at_their_times_and_nothing_is_missing(made: Path) -> None:
    episode = Dataset(made).episodes[0]
    assert episode.length == len(episode.columns["timestamp"])
    grid = episode.stamps["grid"]
    assert 1.0 <= grid[-1] - grid[0] <= 1.2
    assert np.abs(np.diff(grid) - 1 / 30).max() < 0.005, "to within a step of the simulation"
    for name, times in episode.stamps.items():
        assert (np.diff(times) > 0).all() or name == "pad.pad", name
        assert name == "pad.pad" or np.abs(times - grid).max() < 1e-9, f"{name}: in lock-step everything is of now"
    assert set(episode.stamps) >= {"robot.panda", "gripper.panda", "camera.scene", "camera.wrist"}


def test_the_action_is_the_setpoint_of_the_next_row(made: Path) -> None:
    columns = Dataset(made).episodes[0].columns
    action, setpoint = columns["action"], columns["rig.setpoint"]
    assert np.array_equal(action[:-1], setpoint[1:])
    assert np.array_equal(action[-1], setpoint[-1])
    assert np.ptp(action[:, :7], axis=0).max() > 0.01, "it moved"
    assert action[-1, -1] == pytest.approx(0.04, abs=1e-3), "half closed, m"


def test_pictures_and_depth_come_back(made: Path) -> None:
    episode = Dataset(made).episodes[0]
    for camera in CAMERAS:
        frames, depths = list(episode.frames(camera)), list(episode.depth(camera))
        assert len(frames) == len(depths) == episode.length
        assert frames[0].shape == (48, 64, 3)
        assert frames[0].dtype == np.uint8
        numbers = episode.columns[f"rig.time.camera.{camera}"][:, 2].astype(int)
        for number, frame, depth in zip(numbers, frames, depths, strict=True):
            left = int(number) * 4 % 64  # where the mock's bright square is
            assert frame[24, min(63, left + 4) :].max() > 200
            near = depth < depth.max() - 0.05
            assert near.any(), "the square is nearer than the background"
            assert np.unique(depth).size == 2
            assert np.isclose(np.unique(depth), [0.9, 1.0], atol=2e-4).all()
        assert all(np.array_equal(episode.depth[camera][k], depths[k]) for k in (len(depths) - 1, -3, 0))
        assert np.array_equal(episode.depth[camera][2:4], depths[2:4])
        with pytest.raises(IndexError):
            episode.depth[camera][len(depths)]
    for absent in (lambda: episode.frames("nose"), lambda: episode.depth["nose"], lambda: episode.depth[0]):
        with pytest.raises(DeviceNotFound):
            absent()


def test_statistics_are_those_of_all_rows(made: Path) -> None:
    stats = json.loads((made / "meta/stats.json").read_text())
    states = np.concatenate([episode.columns["observation.state"] for episode in Dataset(made).episodes])
    found = stats["observation.state"]
    assert found["count"] == [len(states)]
    assert np.allclose(found["mean"], states.mean(axis=0), atol=1e-6)
    assert np.allclose(found["std"], states.std(axis=0), atol=1e-6)
    assert np.allclose(found["min"], states.min(axis=0), atol=1e-6)
    assert np.allclose(found["max"], states.max(axis=0), atol=1e-6)
    pixels = np.concatenate([list(episode.frames("scene")) for episode in Dataset(made).episodes]) / 255.0
    assert np.allclose(np.ravel(stats["observation.images.scene"]["mean"]), pixels.mean(axis=(0, 1, 2)), atol=0.02)


def test_differences_are_reported_before_anything_is_written(made: Path) -> None:
    before = sorted(str(path) for path in made.rglob("*"))
    with mock_rig("lock_step", "cameras.wrist.output.width=80") as rig, pytest.raises(CommandError) as caught:
        Recorder(rig, made, fps=15, depth=False)
    assert caught.value.code == "other_dataset"
    said = str(caught.value).partition("another format: ")[2].split("; ")
    assert said == [
        "fps is 30 there, and 15 here",
        "shape of observation.images.wrist is [48, 64, 3] there, and [48, 80, 3] here",
        "depth of scene is kept there, and not here",
        "depth of wrist is kept there, and not here",
        "choose a new folder",
    ], "each once, and in words"
    assert sorted(str(path) for path in made.rglob("*")) == before


def test_depth_in_another_unit_is_another_kind(made: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(made, copy)
    join_metadata(copy)
    for file in copy.glob("episodes/*.json"):
        about = json.loads(file.read_text())
        unit = about["cameras"]["wrist"]["depth_unit_m"]
        about["cameras"]["wrist"]["depth_unit_m"] = 2.0 * unit
        file.write_text(json.dumps(about))
    with mock_rig() as rig, raises_code(CommandError, "other_dataset"):
        Recorder(rig, copy)


def test_another_gripper_is_another_kind(made: Path) -> None:
    hand = "robots.panda.gripper=robotiq_2f85"
    with (
        mock_rig("lock_step", hand) as rig,
        pytest.raises(CommandError, match=r"opens 0\.08 m there, and 0\.085 m here"),
    ):
        Recorder(rig, made)


def test_only_differing_names_are_reported(made: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(made, copy)
    info = json.loads((copy / "meta/info.json").read_text())
    info["features"]["action"]["names"][0] = "elbow"
    info["features"]["observation.images.scene"]["info"]["video.codec"] = "vp9"
    (copy / "meta/info.json").write_text(json.dumps(info))
    with mock_rig() as rig, pytest.raises(CommandError) as caught:
        Recorder(rig, copy)
    said = str(caught.value)
    assert "the names of action differ: only there it has elbow; only here it has panda_joint1;" in said
    assert re.search(r"video\.codec of observation\.images\.scene is vp9 there, and \w+ here", said)
    assert len(said.partition("another format")[2]) < 250


def test_the_suggested_command_recovers_an_unfinished_episode(tmp_path: Path) -> None:
    out = tmp_path / "it's here"
    with mock_rig() as rig, Recorder(rig, out) as recorder:
        recorder.start()
        drive(rig, 1.5)
        kill_writer(recorder)
        with pytest.raises(HalError):
            recorder.save(wait=True)
    with pytest.raises(CommandError, match="1 was not finished; finish with: hal review ") as caught:
        Dataset(out)
    words = shlex.split(str(caught.value).partition("with: ")[2])
    done = subprocess.run(
        [sys.executable, "-m", "hal.apps.main", *words[1:]], capture_output=True, text=True, timeout=60
    )
    assert "recovered as episode 0" in done.stdout, done.stderr
    assert len(Dataset(out)) == 1


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("important")
    with mock_rig() as rig, raises_code(CommandError, "foreign_dataset"):
        Recorder(rig, tmp_path)
    with mock_rig() as rig, Recorder(rig, tmp_path / "new"):
        assert not (tmp_path / "new").exists(), "before the first episode nothing is written"


@pytest.mark.parametrize("wrong", [{"fps": 0}, {"fps": 2.5}, {"codec": "mpeg2"}, {"cameras": ["nose"]}])
def test_what_cannot_be_is_refused_at_once(tmp_path: Path, wrong: dict[str, object]) -> None:
    with mock_rig() as rig, pytest.raises((CommandError, DeviceNotFound)):
        Recorder(rig, tmp_path / "out", **wrong)


def test_a_discarded_episode_is_gone_and_one_that_is_left_open_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with mock_rig() as rig:
        with Recorder(rig, out) as recorder:
            recorder.start()
            drive(rig, 0.3)
            assert recorder.status().state == "recording"
            with raises_code(CommandError, "episode_open"):
                recorder.start()
            recorder.discard()
            assert not list(out.rglob("*.parquet"))
            recorder.start()
            drive(rig, 0.3)
        assert recorder.status().state == "idle"
        with raises_code(CommandError, "recorder_closed"):
            recorder.start()
    check_layout(out)
    assert [episode.success for episode in Dataset(out).episodes] == [None]
    assert recover(out) == []


@pytest.mark.slow
def test_two_programs_do_not_record_into_one_folder(tmp_path: Path) -> None:
    with mock_rig() as rig, Recorder(rig, tmp_path / "out") as first, Recorder(rig, tmp_path / "out") as second:
        first.start()
        with raises_code(CommandError, "dataset_locked"):
            second.start()
        drive(rig, 0.2)
        first.save(wait=True)
    check_layout(tmp_path / "out")


def test_only_depth_and_only_colour(tmp_path: Path) -> None:
    streams = "cameras.scene.streams={depth: {format: z16}}"
    with mock_rig("lock_step", streams) as rig, Recorder(rig, tmp_path / "a", cameras=["scene"]) as recorder:
        record(recorder, 0.3)
    assert check_layout(tmp_path / "a")["video_path"] is None
    episode = Dataset(tmp_path / "a").episodes[0]
    assert sum(1 for _ in episode.depth("scene")) == episode.length
    assert np.array_equal(episode.depth[1], episode.depth["scene"][1]), "there is only one"
    with mock_rig() as rig, Recorder(rig, tmp_path / "b", depth=False, codec="av1") as recorder:
        record(recorder, 0.3)
    info = check_layout(tmp_path / "b")
    assert info["features"]["observation.images.scene"]["info"]["video.codec"] == "av1"
    with pytest.raises(DeviceNotFound):
        Dataset(tmp_path / "b").episodes[0].depth("scene")


def test_the_package_imports_without_its_libraries() -> None:
    """An error names what to install when it is used."""
    code = (
        "import sys\n"
        "class No:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('pyarrow', 'av', 'zstandard'): raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, No())\n"
        "import importlib.util as u; real = u.find_spec\n"
        "u.find_spec = lambda n, p=None: None if n in ('pyarrow', 'av', 'zstandard') else real(n, p)\n"
        "from hal.recording import Dataset, Recorder, recover\n"
        "for use in (lambda: Dataset('x'), lambda: recover('x'), lambda: Recorder(None, 'x')):\n"
        "    try: use()\n"
        "    except ImportError as error: print(error)\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.count("pip install 'robot-hal[record]'") == 3


def test_poses_of_objects_are_refused_where_nothing_knows_them(tmp_path: Path) -> None:
    with (
        hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig,
        raises_code(CommandError, "no_objects"),
    ):
        Recorder(rig, tmp_path / "out", streams=["objects"])


def test_infrared_and_segmentation_are_recorded_on_request(tmp_path: Path) -> None:
    out, streams = tmp_path / "out", "[color, depth, infrared, segmentation]"
    overrides = [*small(), f"cameras.scene.streams={streams}"]
    drawn = []
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        with Recorder(rig, tmp_path / "plain") as recorder:
            assert "camera scene: infrared, segmentation not recorded" in recorder.notes
        with Recorder(rig, out, streams=["color", "infrared", "segmentation"]) as recorder:
            assert "camera wrist has no infrared, segmentation" in recorder.notes
            recorder.start()
            for _ in range(6):
                drawn.append(rig.cameras["scene"].read())
                rig.clock.sleep(1 / 30)
            recorder.save(wait=True)
        with raises_code(CommandError, "other_dataset"):
            Recorder(rig, out, streams=["color"])
        with raises_code(CommandError, "unknown_stream"):
            Recorder(rig, out, streams=["thermal"])
    info = check_layout(out)
    assert info["features"]["observation.images.scene_infrared"]["shape"] == [48, 64, 3]
    assert "observation.images.wrist_infrared" not in info["features"]
    episode = Dataset(out).episodes[0]
    assert list(episode.files("scene")) == ["color", "infrared", "segmentation"]
    numbers, infrared = (list(episode.pictures("scene", stream)) for stream in ("segmentation", "infrared"))
    assert len(numbers) == len(infrared) == episode.length
    assert numbers[0].dtype == np.int32
    assert np.array_equal(numbers[0], drawn[0].segmentation)
    assert len(np.unique(numbers[0])) > 3, "several bodies are seen"
    assert infrared[0].dtype == np.uint8
    assert np.abs(infrared[0].astype(float) - drawn[0].infrared).mean() < 6.0
    assert np.ptp(infrared[0]) > 30
    with np.load(export(out, "npz", tmp_path / "npz").path / "episode_000000.npz") as file:
        assert np.array_equal(file["camera_segmentation"], numbers)
        assert np.array_equal(file["camera_infrared"], infrared)
    small_ones = export(out, "zarr", tmp_path / "zarr", size=(32, 24)).path / "data"
    for name, kind in (("scene_infrared", "|u1"), ("scene_segmentation", "<i4")):
        head = json.loads((small_ones / name / ".zarray").read_text())
        assert (head["shape"], head["dtype"]) == ([episode.length, 24, 32, 1], kind)
    for camera, stream in (("scene", "depth"), ("wrist", "segmentation"), ("wrist", "infrared")):
        with pytest.raises(DeviceNotFound):
            episode.pictures(camera, stream)
    assert list(check_dataset(Dataset(out))) == []
    (out / "meta/info.json").unlink()
    repair(out)
    assert check_layout(out) == info
    assert list(check_dataset(Dataset(out))) == []
