"""A rig as a Gymnasium environment."""

from __future__ import annotations

import functools
import importlib
import os
import re
import sys
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.drivers.mock.camera import read_picture

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'robot-hal[gym]'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from hal.gym import EnvSettings, RigEnv  # noqa: E402
from hal.world import World  # noqa: E402

BARE = ("cameras={}",)
SMALL = tuple(f"cameras.{name}.output.{size}" for name in ("scene", "wrist") for size in ("width=64", "height=48"))


def test_a_missing_gymnasium_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "hal.learning.gym")
    with raises_code(hal.DriverMissing, "driver_missing"):
        importlib.import_module("hal.learning.gym")


@pytest.mark.parametrize("argument", ["cameras", "streams", "objects"])
def test_one_name_in_place_of_a_list_is_refused(argument: str) -> None:
    with raises_code(hal.CommandError, "not_a_list"):
        EnvSettings(**{argument: "cube"})  # type: ignore[arg-type]  # the mistake


@pytest.mark.filterwarnings("ignore:.*Box observation space.*")
@pytest.mark.parametrize("action", ["joint", "tcp_delta", "twist"])
def test_it_passes_gymnasiums_own_checks(action: str) -> None:
    env = RigEnv("panda_table", EnvSettings(action=action, max_steps=50), sim=True, overrides=SMALL)
    try:
        check_env(env, skip_render_check=True)
    finally:
        env.close()


STREAMS = "cameras.scene.streams=[color, depth, infrared, segmentation]"


def test_keys_are_identifiers_and_every_stream_can_be_chosen() -> None:
    streams = ["color", "infrared", "segmentation", "points"]
    env = RigEnv("panda_table", EnvSettings(streams=streams, objects=["cube"]), sim=True, overrides=(STREAMS,))
    try:
        seen, _ = env.reset()
        assert env.observation_space.contains(seen)
        assert all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", key) for key in seen)
        pictures = {key: (space.shape, space.dtype) for key, space in env.observation_space.items() if "_" in key}
        del pictures["object_cube"]
        size = (256, 256)
        assert pictures == {
            "scene_color": ((*size, 3), np.uint8),
            "scene_infrared": ((*size, 1), np.uint8),
            "scene_segmentation": ((*size, 1), np.int32),
            "scene_points": ((*size, 3), np.float32),
            "wrist_color": ((*size, 3), np.uint8),
            "wrist_points": ((*size, 3), np.float32),
        }
        assert env.rig.world is not None
        bodies = env.rig.world.bodies
        assert {bodies.index("cube"), bodies.index("panda")} <= set(np.unique(seen["scene_segmentation"]))
        assert seen["scene_infrared"].std() > 5.0
        on_cube = (seen["scene_segmentation"] == bodies.index("cube"))[..., 0]
        in_world = env.rig.robots["panda"].base @ hal.Pose(np.median(seen["scene_points"][on_cube], axis=0))
        assert in_world.position == pytest.approx(seen["object_cube"][:3], abs=0.04)
    finally:
        env.close()
    for wrong in (["color", "thermal"], ["segmentation"]):
        with raises_code(hal.NotSupported, "unknown_stream"):
            RigEnv("panda_table", EnvSettings(streams=wrong), driver="mock")


def test_two_parts_of_an_observation_never_share_a_key() -> None:
    twins = ("cameras.scene-2={model: realsense_d435}", "cameras.scene_2={model: realsense_d435}")
    with raises_code(hal.CommandError, "duplicate_name"):
        RigEnv("panda_table", driver="mock", overrides=twins)


if os.environ.get("HAL_SB3") == "1":  # not by default: PyTorch may bring gigabytes of CUDA

    @pytest.mark.timeout(600)
    def test_stable_baselines3_trains_with_pictures() -> None:
        from stable_baselines3 import PPO
        from stable_baselines3.common import env_checker

        small = ("cameras.scene.output={width: 64, height: 64}", "cameras.wrist.output={width: 64, height: 64}")
        env = RigEnv(
            "panda_table", EnvSettings(action="tcp_delta", objects=["cube"], max_steps=50), sim=True, overrides=small
        )
        try:
            env_checker.check_env(env)
            PPO("MultiInputPolicy", env, n_steps=100, batch_size=50).learn(500)
            assert env.observation is not None
        finally:
            env.close()


def test_an_action_moves_the_arm_by_its_values() -> None:
    env = RigEnv("panda_table", EnvSettings(action="tcp_delta"), sim=True, overrides=BARE)
    try:
        before, _ = env.reset()
        for _ in range(20):
            after, *_ = env.step(np.array([0.005, 0, 0, 0, 0, 0, 1.0], np.float32))
        assert after["tcp"][0] - before["tcp"][0] == pytest.approx(0.1, abs=0.015)
        assert np.abs(after["tcp"][1:3] - before["tcp"][1:3]).max() < 0.01
        assert after["gripper"][0] < 0.5 * before["gripper"][0], "closing"
    finally:
        env.close()


def test_a_reset_restores_poses_or_sets_the_given_ones() -> None:
    calls = []

    class Arranged(RigEnv):
        settings = EnvSettings(action="twist")

        def arrange(self, options: dict[str, Any]) -> None:
            calls.append(options)

    env = Arranged("panda_table", sim=True, overrides=BARE)
    try:
        first, info = env.reset(seed=1)
        assert info["elapsed"] == 0.0
        for _ in range(20):
            env.step(np.array([0.2, 0.1, 0, 0, 0, 0, 0], np.float32))
        again, info = env.reset(options={"poses": {"cube": hal.Pose([0.1, 0.1, 0.7])}})
        assert info["poses"]["cube"] == pytest.approx([0.1, 0.1, 0.7, 0, 0, 0, 1]), "not where it was drawn"
        assert again["q"] == pytest.approx(first["q"], abs=1e-3)
        assert env.rig.world.pose("cube").position[:2] == pytest.approx([0.1, 0.1], abs=1e-3)
        assert len(calls) == 2
        q = np.array(first["q"]) + 0.05
        elsewhere, _ = env.reset(options={"q": q})
        assert elsewhere["q"] == pytest.approx(q, abs=1e-3)
    finally:
        env.close()


@pytest.mark.parametrize(("action", "mode"), [("velocity", hal.ControlMode.JOINT_IMPEDANCE), ("torque", None)])
def test_joints_move_by_velocities_with_a_controller_or_by_bare_torques(
    action: str, mode: hal.ControlMode | None
) -> None:
    controller = hal.JointImpedance() if mode is not None else None
    env = RigEnv("panda_table", EnvSettings(action=action, controller=controller), sim=True, overrides=BARE)
    try:
        first, _ = env.reset(seed=1)
        assert env.action_names[:1] == ("panda_joint1",)
        most = env.action_space.high[0]
        assert most == pytest.approx(0.3 * 2.175 if action == "velocity" else 87.0)
        for _ in range(10):
            last, _, _, _, _ = env.step(np.array([0.1 if mode is not None else 1.0, *[0.0] * 7], np.float32))
        assert env.robot.state().controller is (mode or hal.ControlMode.TORQUE)
        assert last["q"][0] - first["q"][0] > 0.02
    finally:
        env.close()


def test_a_stop_at_a_limit_names_the_limit() -> None:
    env = RigEnv("panda_table", EnvSettings(action="torque"), driver="mock", overrides=BARE)
    try:
        env.reset()
        for _ in range(100):
            _, _, _, truncated, info = env.step(np.array([0.0] * 6 + [12.0, 0.0], np.float32))
            if truncated:
                break
        assert info["stopped"].endswith("(here: position)")
    finally:
        env.close()


def test_poses_of_objects_are_observed_on_request() -> None:
    env = RigEnv("panda_table", EnvSettings(action="twist", objects=["duck", "cube"]), sim=True, overrides=BARE)
    try:
        seen, info = env.reset(seed=3)
        assert env.observation_space.contains(seen)
        assert [key for key in seen if key.startswith("object_")] == ["object_duck", "object_cube"]
        assert seen["object_cube"] == pytest.approx(info["poses"]["cube"], abs=1e-3)
        assert env.rig.world is not None
        env.rig.world.set_velocity("cube", linear=(0.0, 0.5, 0.0))
        after, *_ = env.step(np.zeros(7, np.float32))
        assert after["object_cube"][1] - seen["object_cube"][1] > 0.005
        assert (after["object_cube"][:3] == env.rig.world.pose("cube").position).all()
    finally:
        env.close()
    with pytest.raises(hal.DeviceNotFound):
        RigEnv("panda_table", EnvSettings(objects=["cup"]), sim=True, overrides=BARE)
    with raises_code(hal.NotSupported, "no_world"):
        RigEnv("panda_table", EnvSettings(objects=["cube"]), driver="mock", overrides=BARE)


class Forward(RigEnv):
    """Go 5 cm ahead."""

    settings = EnvSettings(action="twist", max_steps=10)
    goal = 1.0

    def reward(self) -> float:
        assert self.observation is not None
        return float(self.observation.robots["panda"].tcp.position[0])

    def success(self) -> bool:
        return self.reward() > self.goal


def test_a_subclass_decides_and_steps_are_counted() -> None:
    env = Forward("panda_table", driver="mock", overrides=BARE)
    try:
        for goal in (1.0, 0.33):
            env.goal, (seen, _) = goal, env.reset()
            assert seen["tcp"][0] < 0.32
            ends = [(False, False)]
            while not any(ends[-1]):
                seen, reward, terminated, truncated, _ = env.step(np.array([0.2, *[0.0] * 6], np.float32))
                assert reward == seen["tcp"][0], "of the new observation"
                assert terminated == (reward > goal)
                ends.append((terminated, truncated))
            assert (len(ends) == 11) == (not terminated)
            assert ends[-1] == ((True, False) if goal < 1.0 else (False, True))
    finally:
        env.close()


def test_a_stop_truncates_with_its_reason_and_a_reset_does_not_acknowledge_it() -> None:
    env = RigEnv("panda_table", EnvSettings(action="twist"), driver="mock", overrides=BARE)
    try:
        env.reset()
        env.step(np.zeros(7, np.float32))
        late = env.rig.clock.now() + 0.02
        stop = env.rig.clock.call_every(0.02, lambda: env.rig.clock.now() > late and env.rig.stop())
        *_, truncated, info = env.step(np.zeros(7, np.float32))  # stopped after its action was sent
        stop()
        assert truncated
        assert "rig.stop()" in info["stopped"]
        assert "control.rearm" not in info["stopped"], "an environment has no session to rearm"
        before = env.robot.state().q
        for _ in range(2):  # a training loop that does not notice the stop
            with raises_code(hal.MotionStopped, hal.Trip.STOP.code):
                env.reset()
        assert env.robot.state().q == pytest.approx(before)
        env.rearm()
        env.reset()
        *_, truncated, info = env.step(np.zeros(7, np.float32))
        assert not truncated
        assert "stopped" not in info
    finally:
        env.close()


def test_a_stop_stays_in_a_simulated_world_too() -> None:
    env = RigEnv("panda_table", EnvSettings(action="twist"), sim=True, overrides=BARE)
    try:
        env.reset()
        env.rig.stop()
        with raises_code(hal.MotionStopped, hal.Trip.STOP.code):
            env.reset()
    finally:
        env.close()


def test_in_real_time_every_observation_is_a_fresh_one() -> None:
    """Another system handed out the same observation again in 96 to 98 of 100 steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "hal.learning.gym.RigEnv._open",
            staticmethod(lambda *a, **k: hal.open("panda_table", driver="mock", clock="real_time", pad="none")),
        )
        env = RigEnv(settings=EnvSettings(action="twist", rate_hz=10.0))
    try:
        env.reset()
        pictures, stamps = [], []
        for _ in range(8):
            sent = env.rig.clock.now()
            seen, *_ = env.step(np.array([0.05, 0, 0, 0, 0, 0, 0], np.float32))
            assert env.observation is not None
            frames = [moment.frame for moment in env.observation.cameras.values()]
            assert all(frame.stamp.t > sent for frame in frames)
            pictures.append(read_picture(seen["scene_color"]).seq)
            stamps.append(env.observation.robots["panda"].stamp.t)
        assert len(set(pictures)) == len(pictures)
        assert (np.diff(stamps) > 0.0).all()
    finally:
        env.close()


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"rate_hz": 0.0}, "bad_command"),
        ({"rate_hz": 0.5}, "rate_too_low"),
        ({"action": "jump"}, "unknown_action"),
        ({"robots": "pandda"}, "no_robot"),
        ({"cameras": ["wirst"]}, "no_camera"),
        ({"controller": "impedance"}, "bad_controller"),
        ({"controller": hal.JointImpedance(stiffness=[1.0])}, "bad_controller"),
        ({"controller": hal.JointImpedance(), "action": "torque"}, "torques_by_controller"),
    ],
)
def test_arguments_of_later_calls_are_checked_at_once(wrong: dict[str, object], code: str) -> None:
    with raises_code(hal.HalError, code):
        RigEnv("panda_table", EnvSettings(**wrong), driver="mock", overrides=BARE)  # type: ignore[arg-type]
    with raises_code(hal.CommandError, "not_callable"):
        RigEnv("panda_table", driver="mock", deadman="pad")  # type: ignore[arg-type]
    env = RigEnv("panda_table", driver="mock", overrides=BARE)
    try:
        with raises_code(hal.CommandError, "not_reset"):
            env.step(np.zeros(8, np.float32))
        env.reset()
        with raises_code(hal.CommandError, "bad_action"):
            env.step(np.zeros(3, np.float32))
    finally:
        env.close()
        env.close()


@pytest.mark.slow
def test_several_in_processes_of_their_own() -> None:
    make = functools.partial(
        RigEnv, "panda_table", EnvSettings(action="twist"), sim=True, overrides=BARE
    )  # importable there
    envs = gymnasium.vector.AsyncVectorEnv([make, make], context="spawn")
    try:
        seen, infos = envs.reset(seed=3)
        assert seen["q"].shape == (2, 7)
        cubes = infos["poses"]["cube"]
        assert cubes.shape == (2, 7)
        assert (cubes[0] != cubes[1]).any(), "each has a seed of its own"
        for _ in range(5):
            seen, *_ = envs.step(np.array([[0.1, 0, 0, 0, 0, 0, 0], [-0.1, 0, 0, 0, 0, 0, 0]], np.float32))
        assert seen["tcp"][0, 0] - seen["tcp"][1, 0] > 0.01
    finally:
        envs.close()


TWO_ARMS = {
    "robots": {
        name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("left", 0.5), ("right", -0.5))
    }
}


def test_two_arms_are_one_environment_with_their_names_in_front() -> None:
    env = RigEnv(TWO_ARMS, EnvSettings(robots=["left", "right"], action="twist", max_steps=50), sim=True)
    try:
        check_env(env, skip_render_check=True)
        start, _ = env.reset(seed=1, options={"q": {"left": env.robot.home + 0.05}})
        assert list(start) == [f"{arm}_{part}" for arm in ("left", "right") for part in ("q", "dq", "tcp", "gripper")]
        assert start["left_q"] == pytest.approx(env.robot.home + 0.05, abs=1e-3)
        assert start["right_q"] == pytest.approx(env.rig.robots["right"].home, abs=1e-3)
        assert env.action_space.shape == (14,)
        assert env.action_names[::7] == ("left.x", "right.x")
        action = np.zeros(14)
        action[2], action[9] = 0.1, -0.1
        for _ in range(20):
            seen, _, _, truncated, _ = env.step(action)
        moved = {arm: seen[f"{arm}_tcp"] - start[f"{arm}_tcp"] for arm in ("left", "right")}
        assert moved["left"][2] > 0.05
        assert moved["right"][2] < -0.05
        assert not truncated
        env.rig.stop()
        *_, truncated, info = env.step(action)
        *_, truncated, info = env.step(action)
        assert truncated
        assert info["stopped"].startswith("left: ")
    finally:
        env.close()


def test_a_scene_with_two_arms_is_varied_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, randomize = [], World.randomize
    monkeypatch.setattr(World, "randomize", lambda world, seed: seeds.append(seed) or randomize(world, seed))
    varied = {
        **TWO_ARMS,
        "objects": ["cube"],
        "simulation": {"randomize": {"objects": {"cube": {"mass_scale": [0.5, 2]}}}},
    }
    env = RigEnv(varied, EnvSettings(robots=["left", "right"]), sim=True)
    try:
        seeds.clear()
        _, info = env.reset(seed=3)
        assert (seeds, info["randomization"]["seed"]) == ([3], 3)
    finally:
        env.close()


def test_arms_of_an_environment_are_named_once() -> None:
    for wrong in (["left", "left"], []):
        with raises_code(hal.CommandError, "bad_robots"):
            RigEnv(TWO_ARMS, EnvSettings(robots=wrong), driver="mock")
