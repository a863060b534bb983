"""Rows in real time: none is missing, and each says what was so at its time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_kit import CAMERAS, check_layout, small

import hal
from hal.recording import Dataset, Recorder
from hal.types import RobotState

pytestmark = [pytest.mark.slow, pytest.mark.pair]

SECONDS = 4.0


def test_a_drive_is_recorded_as_it_was(tmp_path: Path) -> None:
    seen: list[RobotState] = []
    with (
        hal.open("panda_table", sim=True, clock="real_time", pad="demo", overrides=small(96, 64)) as rig,
        Recorder(rig, tmp_path / "out", task="drive") as recorder,
    ):
        arm = rig.robots["panda"]
        recorder.start()
        began = rig.clock.now()
        with arm.control(rate_hz=10) as control:
            for tick in rig.clock.rate(50):
                if tick.elapsed > SECONDS:
                    break
                try:
                    control.send(hal.Twist([0.05, 0.1 * np.sin(3 * tick.elapsed), -0.05]))
                except hal.MotionStopped:  # a busy machine: what is recorded is the same as what happens all the same
                    control.rearm()
                seen += arm.states(seen[-1].stamp.t if seen else began)
        status = recorder.status()
        recorder.save(True, wait=True)
    assert status.dropped == 0
    assert status.frames >= 30 * SECONDS - 6, "the newest 0.1 s are still on their way"
    check_layout(tmp_path / "out")
    episode = Dataset(tmp_path / "out").episodes[0]
    assert episode.info["gaps"] == []
    grid = episode.stamps["grid"]
    assert np.abs(np.diff(grid) - 1 / 30).max() < 1e-6
    assert np.array_equal(episode.stamps["robot.panda"], grid), "states are of the time of their row, exactly"
    for camera in CAMERAS:
        stamps = episode.stamps[f"camera.{camera}"]
        assert (stamps[1:] <= grid[1:]).all(), "a picture is never of later than its row"
        assert (np.diff(stamps) >= 0.0).all()
        assert np.median(grid - stamps) < 0.2
    t = np.array([state.stamp.t for state in seen])
    inside = (grid > t[0]) & (grid < t[-1])
    assert inside.sum() > 100
    for key, of in (("observation.state", "q"), ("rig.setpoint", "q_set")):
        values = np.array([getattr(state, of) for state in seen])
        assert np.ptp(values, axis=0).max() > 0.02, "it moved"
        for joint in range(7):
            want = np.interp(grid[inside], t, values[:, joint])
            assert np.abs(episode.columns[key][inside, joint] - want).max() < 1e-6
    pad = episode.columns["rig.pad"]
    assert (pad[:, episode.names("rig.pad").index("connected")] == 1.0).all(), "the pad was recorded, too"
    assert (np.diff(episode.stamps["objects"]) >= 0.0).all(), "two rows share one where the thread came late"
