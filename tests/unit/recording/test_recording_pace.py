"""The pace of an arm's own clock in a recording: measured over its rows, reported if a simulation is too slow."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from recording_kit import mock_rig, record

from hal.recording import Dataset, Recorder
from hal.recording.metadata import ClockPace, simulated_pace

COLUMNS = [
    ("rig.time.grid", "float64", ("t",)),
    ("rig.time.robot.left", "float64", ("t", "t_device", "seq")),
    ("rig.time.robot.right", "float64", ("t", "t_device", "seq")),
]


def rows(seconds: float, left: float, right: float, start: float = 100.0) -> Iterator[list[float]]:
    """Thirty a second; the arms' own clocks go at these paces."""
    for k in range(round(30 * seconds) + 1):
        t = k / 30
        yield [start + t, start + t, 7.0 + left * t, k, start + t, right * t, k]


def measured(seconds: float, left: float, right: float, simulated: tuple[str, ...] = ("left",)) -> ClockPace:
    pace = ClockPace(COLUMNS, simulated)
    for row in rows(seconds, left, right):
        pace.add(row)
    return pace


def test_the_pace_is_that_of_each_arms_own_clock() -> None:
    pace = measured(4.0, 0.89, 1.0)
    assert pace.as_json() == {"left": 0.89, "right": 1.0}
    assert pace.trouble.startswith("the simulation runs at 0.89 of real time: speeds in this recording are too low")


@pytest.mark.parametrize(
    ("seconds", "left", "right", "simulated"),
    [
        (1.9, 0.5, 1.0, ("left",)),  # too early to say
        (4.0, 0.98, 1.0, ("left",)),  # not noticeable
        (4.0, 1.0, 0.5, ("left",)),  # a real arm, whose clock drifts
        (4.0, 0.5, 0.5, ()),
        (4.0, math.nan, math.nan, ("left", "right")),
    ],
)
def test_no_trouble_is_reported(seconds: float, left: float, right: float, simulated: tuple[str, ...]) -> None:
    assert measured(seconds, left, right, simulated).trouble == ""


def test_a_clock_that_is_unknown_or_restarts_is_left_out() -> None:
    pace = ClockPace(COLUMNS, ("left",))
    for row in rows(2.0, 0.9, math.nan):
        pace.add(row)
    for row in rows(2.0, 0.9, math.nan, start=200.0):  # 98 s later: its clock is at 7 s again
        pace.add(row)
    assert pace.as_json() == {"left": 0.9}
    assert ClockPace(COLUMNS).as_json() == {}


def test_the_reported_trouble_does_not_change_with_every_row() -> None:
    pace, troubles = ClockPace(COLUMNS, ("left",)), []
    for k in range(3000):
        t = k / 30
        pace.add([t, t, 0.9 * t + 0.01 * math.sin(t), k, t, t, k])
        if pace.trouble not in troubles:
            troubles.append(pace.trouble)
    assert troubles[0] == ""
    assert len(troubles) == 2, troubles


def test_an_episode_in_real_time_has_its_pace_and_one_in_lock_step_has_none(tmp_path: Path) -> None:
    for clock in ("real_time", "lock_step"):
        with mock_rig(clock) as rig, Recorder(rig, tmp_path / clock) as recorder:
            record(recorder, 0.5)
            assert recorder.status().trouble == ""
    assert Dataset(tmp_path / "real_time").episodes[0].info["pace"] == {"panda": pytest.approx(1.0, abs=0.01)}
    assert Dataset(tmp_path / "lock_step").episodes[0].info["pace"] == {}


def test_in_an_episodes_file_only_a_simulated_world_is_slow() -> None:
    robots = [{"name": "left", "driver": "pybullet"}, {"name": "right", "driver": "franka"}]

    def info(world: dict[str, Any] | None, pace: dict[str, float]) -> dict[str, Any]:
        return {"rig": {"resolved": {"world": world, "robots": robots}}, "pace": pace}

    pace = {"left": 0.9, "right": 0.5}
    assert simulated_pace(info({"driver": "pybullet"}, pace)) == 0.9
    assert simulated_pace(info({"driver": "pybullet"}, {})) is None
    assert simulated_pace(info(None, pace)) is None
    assert simulated_pace({}) is None, "recorded before this was measured"
