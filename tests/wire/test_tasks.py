"""A task with a name on the emulated FR3 and Franka Hand: judged by a depth picture, not by a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import hal

from .franka_kit import Emulator

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'robot-hal[gym]'")
pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")

import hal.gym  # noqa: E402  # registers the tasks

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(300)]

CUBE = "{name: cube, shape: box, half_extents: [0.025, 0.025, 0.025], mass: 0.2, rgba: [0.85, 0.2, 0.2, 1.0]}"
VIEW = "look_at: {target: [-0.1, 0, 0.7], distance: 0.85, yaw_deg: 60, pitch_deg: -30}"
CAMERA = f"{{sim: true, model: pinhole, streams: [color, depth], output: {{width: 256, height: 256}}, {VIEW}}}"
STEPS, FEW = 100, 20


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    with Emulator("--lockstep", hand=True) as robot:  # it waits for a set-point that is late, as on a busy machine
        overrides = (
            f"robots.arm.real.host={robot.host}",
            "robots.arm.gripper.enabled=true",
            f"objects=[floor, table, {CUBE}]",
            f"cameras={{scene: {CAMERA}}}",
        )
        options: dict[str, Any] = {"rig": "franka_emulator", "sim": False, "unattended": True, "overrides": overrides}
        options |= {"rate_hz": 10.0}
        env = gymnasium.make("hal/PickCube-v0", max_episode_steps=STEPS, **options)
        yield env
        env.close()


def test_an_arm_that_only_moves_above_the_cube_has_not_solved_the_task_at_its_end(env: Any) -> None:
    env = gymnasium.wrappers.TimeLimit(env, FEW)
    seen, _ = env.reset(seed=3)
    task = env.unwrapped
    assert env.observation_space.contains(seen)
    truth = task.robot.base.inverse() @ task.rig.world.pose("cube")
    assert seen["object_cube"][:3] == pytest.approx(truth.position, abs=0.008)
    way, still = task.go((*seen["object_cube"][:2], 0.13), 0.0, -1.0), task.move(np.zeros(4), -1.0)
    start, moved, steps, truncated = seen["tcp"][:3], 0.0, 0, False
    while not truncated:
        seen, reward, terminated, truncated, info = env.step(next(way, still))
        moved, steps = max(moved, float(np.linalg.norm(seen["tcp"][:3] - start))), steps + 1
        assert (terminated, info["success"], reward < 0.0) == (False, False, True)
        assert "stopped" not in info
    assert (steps, moved > 0.03) == (FEW, True)


def test_depth_says_that_a_cube_is_at_its_goal_and_that_one_is_missing(env: Any) -> None:
    cube = hal.Pose([0.5, 0.05, 0.025])
    still = env.unwrapped.move(np.zeros(4), -1.0)
    env.reset(options={"poses": {"cube": cube, "goal": cube}})
    assert env.step(still)[-1]["success"] is True
    env.reset(options={"poses": {"cube": cube, "goal": hal.Pose([0.5, 0.05, 0.06])}})
    assert env.step(still)[-1]["success"] is False
    with pytest.raises(hal.CommandError, match="no camera sees cube"):
        env.reset(options={"poses": {"cube": hal.Pose([0.6, 0.0, -0.6])}})
