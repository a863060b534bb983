"""From a demonstration to a policy and back: what is generated or recorded lifts the cube again.

Demonstrations and policies go through the command line, in lock-step, with few episodes on one engine each;
``HAL_SOAK=1`` runs 20 of each on both.
"""

from __future__ import annotations

import itertools
import json
import os
from pathlib import Path

import pytest
from demonstrations import is_lifted

import hal
from hal.apps import collect, generate, rollout
from hal.learning.replay import RecordedTrajectory, TrajectoryPlayer
from hal.recording import Dataset, Episode

SOAK = os.environ.get("HAL_SOAK") == "1"
ENGINES = pytest.mark.parametrize("engine", ["pybullet", "mujoco"] if SOAK else ["mujoco"])
_PAIRS = list(
    itertools.product(
        ["examples.pick:pick", "demonstrations:grasp_it", "demonstrations:grasp_gently", "demonstrations:push_it"],
        ["pybullet", "mujoco"],
    )
)
SKILLS = pytest.mark.parametrize(("skill", "engine"), _PAIRS if SOAK else _PAIRS[::3])
"""All skills on both engines; without a soak some of both."""
BARE = ["--sim", "--set", "cameras={}"]


def generated(out: Path, skill: str, engine: str, episodes: int) -> list[Episode]:
    """Return generated episodes, of which at least 19 of 20 are successes."""
    options = ["--episodes", str(episodes), "--workers", "2", "--out", str(out)]
    assert generate.main(["--skill", skill, "--engine", engine, *BARE, *options]) == 0
    found = Dataset(out).episodes
    assert sum(one.success is True for one in found) >= 0.95 * episodes
    return [one for one in found if one.success]


def replayed(episode: Episode, engine: str) -> bool:
    """Return whether a replay from the recorded scene does to the cube what the recording did, within 1 cm."""
    options = {"cameras": {}}
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", engine=engine, overrides=options) as rig:
        arm = rig.robots["panda"]
        player = TrajectoryPlayer(rig, arm, RecordedTrajectory.from_episode(episode, arm))
        player.approach()
        player.play()
        cube = episode.columns["rig.object.cube"][-1, :3]
        return bool(abs(rig.world.pose("cube").position - cube).max() < 0.01)


@SKILLS
def test_a_generated_success_is_replayed_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, skill: str, engine: str
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    found = generated(tmp_path / "out", skill, engine, 20 if SOAK else 1)
    assert sum(replayed(one, engine) for one in found) >= 0.95 * len(found)


@ENGINES
def test_what_a_person_recorded_is_replayed(tmp_path: Path, engine: str) -> None:
    clock = ["--set", "simulation.clock=lock_step"]
    options = ["--pad", "demo", "--engine", engine, "--seed", "0", "--episodes", "2", "--out", str(tmp_path / "out")]
    assert collect.main([*BARE, *clock, *options]) == 0
    found = [one for one in Dataset(tmp_path / "out").episodes if one.success]
    assert found
    assert all(replayed(one, engine) for one in found)


@ENGINES
def test_a_regression_of_the_demonstrations_lifts_the_cube(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    monkeypatch.setenv("DEMONSTRATIONS", str(tmp_path / "out"))
    generated(tmp_path / "out", "examples.pick:pick", engine, 60)
    episodes = 20 if SOAK else 2
    unseen = ["--seed", "1000", "--episodes", str(episodes), "--report", str(tmp_path / "report.json")]
    judged = ["--policy", "demonstrations:Regression", "--success", f"demonstrations:{is_lifted.__name__}"]
    rollout.main([*judged, *BARE, "--set", "simulation.clock=lock_step", "--engine", engine, "--seconds", "7", *unseen])
    report = json.loads((tmp_path / "report.json").read_text())
    assert sum(one["success"] is True for one in report["episodes"]) >= 0.9 * episodes
