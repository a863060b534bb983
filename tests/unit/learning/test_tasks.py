"""Tasks with a name: Gymnasium's checks, seeds, scripted solutions, tasks of a user, and errors."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'robot-hal[gym]'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from hal.gym import TaskEnv, make_vec  # noqa: E402
from hal.learning.tasks import TASKS  # noqa: E402
from hal.learning.tasks.by_depth import DepthJudge  # noqa: E402
from hal.learning.tasks.pick_cube import PickCube  # noqa: E402
from hal.recording import Dataset, Recorder  # noqa: E402


@pytest.fixture(scope="module", params=TASKS)
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    env = gymnasium.make(f"hal/{request.param}-v0")
    yield env
    env.close()


def test_the_checkers_have_nothing_to_warn_of(env: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_close_check=True)
        if os.environ.get("HAL_SB3") == "1":  # not by default: PyTorch may bring gigabytes of CUDA
            from stable_baselines3.common import env_checker

            env_checker.check_env(env)
    boxes = [*env.observation_space.values(), env.action_space]
    assert all(box.dtype == np.float32 and box.is_bounded() for box in boxes)


def test_the_same_seed_gives_the_same_episode_to_the_bit(env: Any) -> None:
    def run(seed: int) -> bytes:
        seen, _ = env.reset(seed=seed)
        env.action_space.seed(1)
        trace = [seen]
        for _ in range(5):
            seen, reward, *_ = env.step(env.action_space.sample())
            trace += [seen, {"reward": np.array(reward)}]
        return b"".join(value.tobytes() for part in trace for value in part.values())

    assert run(3) == run(3)
    assert run(3) != run(4)


def test_its_scripted_solution_succeeds_and_ends_the_episode(env: Any) -> None:
    env.reset(seed=0)
    rewards = []
    for action in env.unwrapped.solve():
        assert env.action_space.contains(action)
        _, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        assert info["success"] is terminated
        if terminated or truncated:
            break
    assert terminated
    assert rewards[-1] == 0.0
    assert -1.0 <= min(rewards) < max(rewards[:-1]) < 0.0
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 0.2, "the reward shows the way"


def test_an_episode_without_success_is_truncated() -> None:
    env = gymnasium.make("hal/PushCube-v0", reward_type="sparse", max_episode_steps=3)
    try:
        env.reset(seed=0)
        still = np.array([0.0, 0.0, 0.0, 0.0, -1.0], np.float32)
        ends = [env.step(still)[1:] for _ in range(3)]
        assert [(reward, *end) for reward, *end, _ in ends] == [(-1.0, False, False)] * 2 + [(-1.0, False, True)]
        assert ends[-1][-1]["success"] is False
    finally:
        env.close()


class Reach(PickCube):
    """Bring the hand to the goal."""

    def success(self) -> bool:
        return self._off() < 0.02

    def reward(self) -> float:
        return -min(1.0, self._off())

    def _off(self) -> float:
        return self.tcp.distance(self.poses["goal"])[0]


def test_a_user_registers_an_own_task() -> None:
    gymnasium.register("test/Reach-v0", Reach, max_episode_steps=100)
    env = gymnasium.make("test/Reach-v0")
    try:
        goal, cube = hal.Pose([0.5, 0.05, 0.1]), hal.Pose([0.45, -0.05, 0.025])
        seen, _ = env.reset(options={"poses": {"goal": goal, "cube": cube}})
        assert seen["object_goal"][:3] == pytest.approx(goal.position)
        assert seen["object_cube"][:3] == pytest.approx(cube.position, abs=1e-3)
        for action in env.unwrapped.go(goal.position, 0.0, -1.0):
            seen, reward, terminated, _, _ = env.step(action)
            if terminated:
                break
        assert terminated
        off = np.linalg.norm(seen["tcp"][:3] - goal.position)
        assert (reward, off) == (pytest.approx(-off, abs=1e-6), pytest.approx(0.02, abs=0.015))
    finally:
        gymnasium.registry.pop("test/Reach-v0")
        env.close()


def test_what_cannot_be_is_named() -> None:
    make = functools.partial(gymnasium.make, "hal/PickCube-v0")
    with pytest.raises(gymnasium.error.NameNotFound, match="PickCube"):
        gymnasium.make("hal/PickCup-v0")
    with raises_code(hal.ConfigError, "config"):
        make(robot="pandda")
    with raises_code(hal.NotSupported, "no_gripper"):
        make(robot={"model": "panda", "gripper": {"enabled": False}})
    with raises_code(hal.CommandError, "out_of_reach"):
        make(distance=0.9)
    with raises_code(hal.CommandError, "bad_reward_type"):
        make(reward_type="shaped")
    with pytest.raises(TypeError, match="robott"):
        make(robott="panda")
    with raises_code(hal.NotSupported, "not_by_depth"):
        gymnasium.make("hal/PegInHole-v0", judge="depth")
    with raises_code(hal.NotSupported, "no_depth"):
        make(rig="panda_table", sim=True, judge="depth", overrides=("cameras={}",))


def test_worlds_of_a_task_step_together_and_each_is_the_task_with_its_seed() -> None:
    envs = make_vec("hal/OpenDrawer-v0", 2, processes=1)
    alone = gymnasium.make("hal/OpenDrawer-v0")
    try:
        seen, _ = envs.reset(seed=4)
        expected, _ = alone.reset(seed=5)
        assert all((seen[key][1] == values).all() for key, values in expected.items())
        actions = np.array([[0.5, 0.0, -0.5, 0.0, -1.0], [-0.5, 0.2, 0.0, 0.5, 1.0]], np.float32)
        seen, rewards, *_ = envs.step(actions)
        expected, reward, *_ = alone.step(actions[1])
        assert all((seen[key][1] == values).all() for key, values in expected.items())
        assert rewards[1] == reward
    finally:
        envs.close()
        alone.close()


@pytest.mark.slow
def test_depth_finds_the_cube_and_its_verdict_is_the_truth(tmp_path: Path) -> None:
    pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")
    env = gymnasium.make("hal/PickCube-v0", judge="depth")
    task = env.unwrapped
    try:
        env.reset(seed=2)
        with Recorder(task.rig, tmp_path, fps=20, task="pick") as recorder:
            recorder.start()
            for action in task.solve():
                seen, _, terminated, truncated, info = env.step(action)
                truth = task.robot.base.inverse() @ task.rig.world.pose("cube")
                assert seen["object_cube"][:3] == pytest.approx(truth.position, abs=0.006)
                at_goal = np.linalg.norm(truth.position - task.poses["goal"].position) < 0.025
                assert not terminated or at_goal
                if terminated or truncated:
                    break
            recorder.save(success=info["success"], wait=True)
        assert terminated
        (episode,) = Dataset(tmp_path).episodes
        assert episode.success
        assert episode.columns["rig.object.cube"][-1, 2] > 0.66, "recorded on the way to its goal"
        task.rig.world.set_pose("cube", hal.Pose([0.0, 0.0, -1.0]))
        still = task.move(np.zeros(4), -1.0)
        assert env.step(still)[-1]["success"] is False
        assert task.hidden == {"cube"}
    finally:
        env.close()


def test_an_object_out_of_reach_and_a_step_before_the_reset_are_refused() -> None:
    env = gymnasium.make("hal/PickCube-v0").unwrapped
    assert isinstance(env, TaskEnv)
    try:
        with raises_code(hal.CommandError, "not_reset"):
            env.step(np.zeros(5, np.float32))
        with pytest.raises(hal.CommandError, match="cube is out of reach"):
            env.reset(options={"poses": {"cube": hal.Pose([1.2, 0.0, 0.025])}})
        env.reset()
        with raises_code(hal.CommandError, "bad_action"):
            env.step(np.zeros(7, np.float32))
    finally:
        env.close()


def test_a_closed_drawer_that_was_put_elsewhere_is_no_success() -> None:
    env = gymnasium.make("hal/OpenDrawer-v0").unwrapped
    try:
        x, y = env.centre
        env.reset(seed=1, options={"poses": {"drawer": hal.Pose([x - 0.05, y, 0.0])}})
        ends = [env.step(env.move(np.zeros(4), -1.0)) for _ in range(3)]
        assert not any(info["success"] for *_, info in ends)
        assert env.measure_opening() == pytest.approx(0.0, abs=1e-3)
    finally:
        env.close()


def test_a_hidden_object_is_named_and_pays_nothing_wherever_it_was_seen_last(monkeypatch: pytest.MonkeyPatch) -> None:
    goal = hal.Pose([0.5, 0.0, 0.025])
    seen = {"cube": goal}
    monkeypatch.setattr(DepthJudge, "find", lambda *_: dict(seen))
    env = gymnasium.make("hal/PickCube-v0", judge="depth").unwrapped
    try:
        still = env.move(np.zeros(4), -1.0)
        env.reset(seed=0, options={"poses": {"cube": goal, "goal": goal}})
        _, reward, done, _, info = env.step(still)
        assert (reward, done, "hidden" in info) == (0.0, True, False)
        seen.clear()
        _, reward, done, _, info = env.step(still)
        assert (reward, done, info["success"], info["hidden"]) == (-1.0, False, False, ["cube"])
    finally:
        env.close()


def test_closing_around_the_cube_pays_at_once() -> None:
    env = gymnasium.make("hal/PickCube-v0").unwrapped
    try:
        env.reset(seed=0, options={"poses": {"cube": hal.Pose([0.5, 0.0, 0.025])}})
        for action in env.go((0.5, 0.0, 0.03), 0.0, -1.0):
            env.step(action)
        assert min(np.diff([env.step(action)[1] for action in env.wait(5, 1.0)])) > 0.005
    finally:
        env.close()


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_a_policy_that_explores_around_the_cube_does_not_stop_the_arm(engine: str) -> None:
    pytest.importorskip(engine, reason=f"pip install 'robot-hal[{engine}]'")
    env = gymnasium.make("hal/PickCube-v0", engine=engine).unwrapped
    random = np.random.default_rng(0)
    try:
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(80):
                off = env.poses["cube"].position - env.tcp.position
                towards = np.array([16.0 * off[0], 16.0 * off[1], -0.5, 0.0, 0.3])
                *_, info = env.step((towards + 0.4 * random.normal(size=5)).clip(-1.0, 1.0))
                assert "stopped" not in info
    finally:
        env.close()


def test_a_hand_that_only_lags_is_not_slowed_down() -> None:
    late = "simulation.randomize={robots: {'*': {command_latency_s: [0.04, 0.04]}}}"
    ways = []
    for overrides in ((), (late,)):
        env = gymnasium.make("hal/PickCube-v0", overrides=overrides).unwrapped
        try:
            env.reset(seed=0)
            start = env.tcp.position
            for _ in range(16):
                env.step(np.array([0.0, 1.0, 0.0, 0.0, -1.0]))
            state = env.robot.state()
            ways.append(np.linalg.norm(state.tcp_set.position - start))
        finally:
            env.close()
    assert np.linalg.norm(state.tcp_set.position - state.tcp.position) > 0.008, "it lags"
    assert ways[1] == pytest.approx(ways[0], rel=0.05)


def test_a_script_ends_where_it_does_not_arrive() -> None:
    env = gymnasium.make("hal/PushCube-v0", rate_hz=5.0).unwrapped
    try:
        env.reset(seed=0)
        way = env.go((0.5, 0.0, 2.0), 0.0, -1.0)
        with pytest.raises(hal.CommandError, match=r"\(0.5, 0.0, 2.0\) m within 15 s"):
            for steps in range(100):  # noqa: B007
                next(way)
        assert steps == 75
    finally:
        env.close()
