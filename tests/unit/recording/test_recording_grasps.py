"""Recordings of versions that recorded a grasp as the width of its object: what is said, and what can be repaired."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from app_kit import run_here
from recording_kit import make_grasps_old, mock_rig

import hal
from hal.apps import dataset as app
from hal.recording import Dataset, Episode, Recorder, repair
from hal.recording.checking import check_dataset
from hal.recording.grasps import find_closings

WIDTH = 0.03


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grasp of an object narrower than expected, one of an object of just that width, and one by a person."""
    out = tmp_path_factory.mktemp("grasps") / "demo"
    with mock_rig("lock_step", "cameras={}") as rig, Recorder(rig, out, fps=20, task="lift") as recorder:
        gripper = rig.robots["panda"].gripper
        assert gripper is not None
        for width, source in ((WIDTH - 0.004, "program"), (WIDTH, ""), (WIDTH - 0.004, "person")):
            recorder.source = lambda source=source: source  # type: ignore[misc]
            gripper.inject(object_width=width)
            recorder.start()
            gripper.open()
            assert gripper.grasp(WIDTH)
            lift(rig)
            recorder.save(True, wait=True)
    make_grasps_old(out, WIDTH)
    return out


def lift(rig: hal.Rig) -> None:
    with rig.robots["panda"].control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            if tick.elapsed > 0.8:
                break
            control.send(hal.Twist([0.0, 0.0, 0.05]))


def grip(episode: Episode, key: str) -> np.ndarray:
    return episode.columns[key][:, -1]


def test_an_old_recording_says_what_it_lacks_and_proven_grasps_are_repaired(old: Path, tmp_path: Path) -> None:
    demo = Path(shutil.copytree(old, tmp_path / "demo"))
    assert not list(check_dataset(Dataset(demo)))
    before = Dataset(demo)
    assert ["rig.setpoint_force" in note for note in before.notes] == [True]
    asked = [grip(episode, "rig.setpoint") for episode in before.episodes]
    assert all(abs(values.min() - WIDTH) < 1e-6 for values in asked)

    done = run_here(app.main, "repair", str(demo))
    assert done.returncode == 0
    closed, unknown, force = done.stdout.splitlines()
    assert "1 closing of a gripper in episode 0," in closed
    assert "1 closing of a gripper in episode 1 may" in unknown
    assert "force" in force
    after = Dataset(demo)
    assert after.notes != before.notes
    assert not list(check_dataset(after)), "statistics are those of the new numbers"
    for one, other, was in zip(before.episodes, after.episodes, asked, strict=True):
        grasped = np.abs(was - WIDTH) < 1e-6
        expected = np.where(grasped, 0.0, was) if other.number == 0 else was
        assert np.array_equal(grip(other, "rig.setpoint"), expected.astype(np.float32))
        assert np.array_equal(grip(other, "action"), [*expected[1:].astype(np.float32), np.float32(expected[-1])])
        for key, values in one.columns.items():
            same = values if key not in ("rig.setpoint", "action") else values[:, :-1]
            found = other.columns[key] if same is values else other.columns[key][:, :-1]
            assert np.array_equal(same, found, equal_nan=same.dtype.kind == "f"), key
    listed = json.loads((demo / "episodes/000000.json").read_text())["grasps"]
    assert [len(listed[kind]) for kind in ("closed", "unknown")] == [1, 0]
    assert repair(demo) == [], "once"


def test_an_object_that_moves_with_the_hand_was_grasped(old: Path) -> None:
    episode = Dataset(old).episodes[1]
    (closing,) = find_closings(episode)
    assert closing.proof == ""
    tcp = episode.columns["observation.tcp"]
    assert np.ptp(tcp[closing.first :, 2]) > 0.02, "the hand moves"
    still = np.tile(tcp[:1], (episode.length, 1))
    for name, poses, proves in (("carried", tcp, True), ("left", still, False), ("lost", np.nan * tcp, False)):
        episode.columns[f"rig.object.{name}"] = poses
        (closing,) = find_closings(episode)
        assert (closing.proof == f"{name} was carried") is proves
        del episode.columns[f"rig.object.{name}"]
