"""From a demonstration to a policy and back: what is generated or recorded lifts the cube again.

Demonstrations and policies go through the command line, in lock-step, with few episodes on one engine each;
``HAL_SOAK=1`` runs 60 or 20 of each on both, and policies on two sets of 20 unseen seeds. ``HAL_TEST_LEROBOT``, the
interpreter of LeRobot's environment, adds its reader.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from app_kit import write_pad
from demonstrations import ServedRegression, is_lifted

import hal
from hal.apps import collect, generate, rollout
from hal.apps.serve_lerobot import ENVIRONMENT, STATE, describe
from hal.learning.remote import PolicyServer
from hal.learning.replay import RecordedTrajectory, TrajectoryPlayer
from hal.recording import Dataset, Episode

SOAK = os.environ.get("HAL_SOAK") == "1"
pytestmark = pytest.mark.timeout(1200 if SOAK else 120)
ENGINES = pytest.mark.parametrize("engine", ["pybullet", "mujoco"] if SOAK else ["mujoco"])
_PAIRS = list(
    itertools.product(
        ["examples.pick:pick", "demonstrations:grasp_it", "demonstrations:grasp_gently", "demonstrations:push_it"],
        ["pybullet", "mujoco"],
    )
)
SKILLS = pytest.mark.parametrize(("skill", "engine"), _PAIRS if SOAK else _PAIRS[::3])
"""All skills on both engines; without a soak some of both."""
PROGRAM = Path(__file__).parents[1] / "kits" / "lerobot_program.py"
BARE = ["--sim", "--set", "cameras={}"]


def generated(out: Path, skill: str, engine: str, episodes: int, *more: str) -> list[Episode]:
    """Return generated episodes, of which at least 19 of 20 are successes."""
    options = ["--episodes", str(episodes), "--workers", "2", "--out", str(out), *more]
    assert generate.main(["--skill", skill, "--engine", engine, *BARE, *options]) == 0
    found = Dataset(out).episodes
    assert sum(one.success is True for one in found) >= 0.95 * episodes
    return [one for one in found if one.success]


def opened(engine: str) -> hal.Rig:
    """Open a simulated rig in lock-step, without cameras and pad."""
    bare = {"cameras": {}}
    return hal.open("panda_table", sim=True, clock="lock_step", pad="none", engine=engine, overrides=bare)


def replayed(episode: Episode, engine: str) -> bool:
    """Return whether a replay from the recorded scene does to the cube what the recording did, within 1 cm."""
    with opened(engine) as rig:
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
    found = generated(tmp_path / "out", skill, engine, 60 if SOAK else 1)
    same = sum(replayed(one, engine) for one in found)
    print(f"RESULT {skill} {engine}: {same} of {len(found)} replayed")
    assert same >= 0.95 * len(found)


@ENGINES
def test_what_a_person_recorded_is_replayed(tmp_path: Path, engine: str) -> None:
    clock = ["--set", "simulation.clock=lock_step"]
    options = ["--pad", "demo", "--engine", engine, "--seed", "0", "--episodes", "2", "--out", str(tmp_path / "out")]
    assert collect.main([*BARE, *clock, *options]) == 0
    found = [one for one in Dataset(tmp_path / "out").episodes if one.success]
    assert found
    assert all(replayed(one, engine) for one in found)


@ENGINES
def test_an_episode_with_a_takeover_is_replayed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    pad = write_pad(tmp_path, (2.0, "BTN_TL"), (4.0, "BTN_TL"), until=25.0, held=(0.5, 24.0))
    policy = ["--policy", "demonstrations:Picker", "--success", f"demonstrations:{is_lifted.__name__}"]
    options = [*policy, *BARE, "--set", "simulation.clock=lock_step", "--engine", engine, "--seconds", "20"]
    seeds = range(500, 520 if SOAK else 501)
    for seed in seeds:
        rollout.main([*options, "--takeover", "--pad", pad, "--seed", str(seed), "--out", str(tmp_path / "out")])
    found = [one for one in Dataset(tmp_path / "out").episodes if one.success]
    assert len(found) >= 0.95 * len(seeds)
    assert all(one.columns["intervention"].any() for one in found)
    assert sum(replayed(one, engine) for one in found) >= 0.95 * len(found)


@pytest.fixture(scope="module", params=["pybullet", "mujoco"] if SOAK else ["mujoco"])
def picks(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """An engine, and demonstrations there."""
    out = tmp_path_factory.mktemp("picks") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[2])
        generated(out, "examples.pick:pick", request.param, 60 if SOAK else 20)
        yield request.param, out


def rolled_out(folder: Path, engine: str, *policy: str) -> None:
    """Roll a policy out on seeds that nothing was chosen with; at least 18 of 20 episodes are successes."""
    count = 20 if SOAK else 1
    for seed in (2000, 3000) if SOAK else (2000,):
        unseen = ["--seed", str(seed), "--episodes", str(count), "--report", str(folder / "report.json")]
        options = [*BARE, "--set", "simulation.clock=lock_step", "--engine", engine, "--seconds", "7", *unseen]
        rollout.main([*policy, "--success", f"demonstrations:{is_lifted.__name__}", *options])
        report = json.loads((folder / "report.json").read_text())
        lifted = sum(one["success"] is True for one in report["episodes"])
        print(f"RESULT {policy[1]} {engine} seeds {seed} on: {lifted} of {count}")
        assert lifted >= 0.9 * count


@pytest.mark.slow
@pytest.mark.parametrize("reader", ["hal", *(["lerobot"] if "HAL_TEST_LEROBOT" in os.environ else [])])
def test_a_regression_of_the_demonstrations_lifts_the_cube(
    picks: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    engine, place = picks
    if reader == "lerobot":  # an environment of its own, as for tests/system/test_lerobot_tools.py
        job, place = ["read", str(place), str(tmp_path / "items.npz")], tmp_path / "items.npz"
        command = [os.environ["HAL_TEST_LEROBOT"], str(PROGRAM), json.dumps([job])]
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache")}
        subprocess.run(command, env=environment | offline, check=True, timeout=500)
    monkeypatch.setenv("DEMONSTRATIONS", str(place))
    rolled_out(tmp_path, engine, "--policy", "demonstrations:Regression")


@pytest.mark.slow
def test_a_served_regression_of_the_demonstrations_lifts_the_cube(picks: tuple[str, Path], tmp_path: Path) -> None:
    engine, place = picks
    robot = Dataset(place).episodes[0].info["rig"]["resolved"]["robots"][0]
    policy = ServedRegression(place, hal.Pose(robot["base_position"], robot["base_orientation"]))
    (tmp_path / "steps.yaml").write_text(json.dumps(policy.CONFIG))
    with PolicyServer(policy.infer, reset=policy.reset, port=0) as server:
        rolled_out(tmp_path, engine, "--policy", server.url, "--policy-config", str(tmp_path / "steps.yaml"))


class Recall:
    """A policy that sees numbers only: it plays the demonstration of the most similar scene on from the nearest row."""

    def __init__(self, episodes: list[Episode]) -> None:
        self.demonstrations = [{key: one.columns[key] for key in (ENVIRONMENT, STATE, "action")} for one in episodes]
        self.unlike: list[float] = []
        """Distance of each scene from the most similar demonstration's, m and numbers of the quaternions."""
        self.row = -1

    def reset(self, request: object) -> None:
        self.row = -1

    def infer(self, request: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        if self.row < 0:
            away = [abs(one[ENVIRONMENT][0] - request[ENVIRONMENT]).max() for one in self.demonstrations]
            self.unlike.append(float(min(away)))
            self.followed = self.demonstrations[int(np.argmin(away))]
        ahead = self.followed[STATE][self.row + 1 : self.row + 60]
        if len(ahead):
            self.row += 1 + int(np.argmin(np.square(ahead - request[STATE]).sum(axis=1)))
        rows = np.minimum(np.arange(self.row, self.row + 40), len(self.followed["action"]) - 1)
        return {"actions": self.followed["action"][rows]}


@ENGINES
def test_a_served_policy_sees_the_objects_as_they_were_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    found = generated(tmp_path / "out", "examples.pick:pick", engine, 3, "--streams", "objects")
    poses = [found[0].columns[f"rig.object.{name}"] for name in ("cube", "duck")]
    assert np.array_equal(found[0].columns[ENVIRONMENT], np.hstack(poses))
    metadata = describe(json.loads((tmp_path / "out" / "meta" / "info.json").read_text()), [STATE, ENVIRONMENT])
    policy = Recall(found)
    judged = ["--success", f"demonstrations:{is_lifted.__name__}", "--report", str(tmp_path / "report.json")]
    options = ["--set", "simulation.clock=lock_step", "--engine", engine, "--seconds", "12", "--episodes", "3"]
    with PolicyServer(policy.infer, reset=policy.reset, metadata=metadata, port=0) as server:
        rollout.main(["--policy", server.url, *judged, *BARE, *options])
    report = json.loads((tmp_path / "report.json").read_text())
    assert [one["success"] for one in report["episodes"]] == [True] * 3, report
    assert max(policy.unlike[-3:]) < 5e-3, "but for the cube that settles, after a rehearsal in another scene"
