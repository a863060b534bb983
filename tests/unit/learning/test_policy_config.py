"""A policy's file: what the policy sees and how its actions move the arm."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.geometry import apply_rotation
from hal.learning.policy_config import PolicyConfig, load_policy_config

CONFIG: dict[str, Any] = {
    "rate_hz": 15,
    "execute": 8,
    "observation": {"state": {"state": ["q", "closed"]}, "prompt": {"text": "task"}},
    "action": {"kind": "joint_position", "gripper": {"index": 7, "threshold": 0.5}},
}
LEFT: dict[str, Any] = {"robot": "left", "columns": [0, 7], "kind": "joint_position"}
RIGHT = {**LEFT, "robot": "right", "columns": [7, 14]}


# What a policy sees.


@pytest.mark.parametrize("name", ["droid", "roboarena", "libero"])
def test_built_in_files_fit_the_built_in_rig(name: str) -> None:
    config = load_policy_config(name)
    with hal.open("panda_table", driver="mock") as rig:
        robots = config.robots(rig, rig.robots["panda"])
        request = config.request(rig, rig.observe(), robots, "wave")
    pictures = [value for value in request.values() if getattr(value, "dtype", None) == np.uint8]
    assert [picture.shape for picture in pictures] == 2 * [(224, 224, 3)]
    assert request["prompt"] == "wave"
    assert config.numbers(robots) == (7 if name == "libero" else 8)


def test_numbers_are_scaled_and_moved_into_the_policys_frame() -> None:
    config = load_policy_config("libero")
    with hal.open("panda_table", driver="mock") as rig:
        arm, observation = rig.robots["panda"], rig.observe()
        picture = config.request(rig, observation, rig.robots, "")
    state, tcp = picture["observation/state"], observation.robots["panda"].tcp
    finger = observation.grippers["panda"].width / 2.0
    np.testing.assert_allclose(state[:3], tcp.position + [-0.66, 0.0, 0.912], atol=1e-6)
    np.testing.assert_allclose(state[6:], [finger, -finger], atol=1e-6)
    assert arm.n == 7
    plain = config.model_copy(
        update={
            "observation": {
                key: source.model_copy(update={"mirror": False}) for key, source in config.observation.items()
            }
        }
    ).request(rig, observation, {"panda": arm}, "")
    np.testing.assert_array_equal(picture["observation/image"], plain["observation/image"][:, ::-1])
    assert (picture["observation/image"] != plain["observation/image"]).any()


def test_orientations_become_angles_and_rotation_vectors(rig: hal.Rig) -> None:
    both = {"state": {"state": ["tcp_rotvec", "tcp_rpy"]}}
    config, observation = load_policy_config({**CONFIG, "observation": both}), rig.observe(cameras=())
    half = np.sqrt(0.5)
    special = [[0, 0, 0, 1], [1, 0, 0, 0], [0, 1, 0, 0], [half, half, 0, 0], [0, half, 0, half], [0, -half, 0, half]]
    quaternions = np.concatenate([special, np.random.default_rng(1).normal(size=(50, 4))])
    for quaternion in quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True):
        pose = hal.Pose([0.0, 0.0, 0.0], quaternion)
        state = {"panda": replace(observation.robots["panda"], tcp=pose)}
        request = config.request(rig, replace(observation, robots=state), rig.robots, "")
        vector, rpy = np.split(request["state"].astype(float), 2)
        assert np.linalg.norm(vector) <= np.pi + 1e-6
        turned = hal.Pose([0.0, 0.0, 0.0], apply_rotation([0.0, 0.0, 0.0, 1.0], vector.tolist()))
        np.testing.assert_allclose(turned.matrix(), pose.matrix(), atol=1e-6)
        np.testing.assert_allclose(hal.Pose.from_rpy([0.0, 0.0, 0.0], rpy).matrix(), pose.matrix(), atol=1e-6)


def test_columns_of_a_recording_are_asked_for_and_answered_in_metres() -> None:
    config = load_policy_config("lerobot")
    with hal.open("panda_table", driver="mock") as rig:
        arm, observation = rig.robots["panda"], rig.observe()
        request = config.request(rig, observation, config.robots(rig, arm), "wave")
        decoded = config.decode(np.tile([*np.zeros(7), 0.02], (2, 1)), observation, rig.robots)["panda"]
        assert arm.gripper is not None
        share = 1.0 - 0.02 / arm.gripper.width_max
    assert request["observation.state"][7] == pytest.approx(observation.grippers["panda"].width)
    np.testing.assert_allclose(decoded.grip, share)
    assert config.due == 1


def test_a_scale_for_another_number_of_numbers_is_refused(rig: hal.Rig) -> None:
    config = load_policy_config({**CONFIG, "observation": {"state": {"state": ["q", "width"], "scale": [1.0] * 7}}})
    with raises_code(hal.NotSupported, "policy_mismatch"):
        config.request(rig, rig.observe(cameras=()), rig.robots, "")


def test_objects_are_seen_in_a_simulated_world_that_has_them_only(rig: hal.Rig) -> None:
    config = load_policy_config({**CONFIG, "observation": {"scene": {"objects": ["cup"]}}})
    with raises_code(hal.NotSupported, "policy_mismatch"):
        config.robots(rig, rig.robots["panda"])
    with (
        hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides={"cameras": {}}) as there,
        pytest.raises(hal.DeviceNotFound, match=r"cup.*cube"),
    ):
        config.robots(there, there.robots["panda"])


def test_a_rig_without_the_camera_is_refused_with_both_lists(rig: hal.Rig) -> None:
    with pytest.raises(hal.DeviceNotFound, match=r"scene, wrist.*none"):
        load_policy_config("droid").robots(rig, rig.robots["panda"])


@pytest.mark.parametrize(
    "change",
    [
        {"rate_hz": 0},
        {"execute": 0},
        {"observation": {"state": {"state": "speed"}}},
        {"observation": {"picture": {"camera": "scene", "size": [0, 10]}}},
        {"action": {"kind": "jump"}},
        {"action": {"kind": "joint_position", "gripper": {"open": 1.0, "closed": 1.0}}},
        {"observation": {"state": {"state": "q", "camera": "scene"}}},
        {"observation": {"state": {"state": "left.speed"}}},
        {"observation": {"state": {"state": "q"}, "high": {"camera": "scene", "within": "state"}}},
        {"arms": [{"robot": "left", "columns": [0, 7], "kind": "joint_position"}]},
        {"action": None},
        {"action": None, "arms": [LEFT, {**RIGHT, "robot": "left"}]},
        {"action": None, "arms": [LEFT, {**RIGHT, "columns": None}]},
        {"action": None, "arms": [LEFT, {**RIGHT, "columns": [6, 13]}]},
        {"action": None, "arms": [LEFT, {**RIGHT, "kind": "joint_velocity"}]},
        {"extra": 1},
    ],
)
def test_a_wrong_file_is_a_config_error(change: dict[str, Any]) -> None:
    load_policy_config({**CONFIG, "action": None, "arms": [LEFT, RIGHT]})
    with pytest.raises(hal.ConfigError):
        load_policy_config({**CONFIG, **change})


def test_a_gripper_that_a_policy_only_sees_must_be_there(rig: hal.Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig.robots["panda"], "gripper", None)
    with raises_code(hal.NotSupported, "no_gripper"):
        load_policy_config({**CONFIG, "action": {"kind": "joint_position"}}).robots(rig, rig.robots["panda"])


def test_pictures_are_scaled_to_fit_and_padded() -> None:
    config = PolicyConfig.model_validate(
        {**CONFIG, "observation": {"image": {"camera": "scene", "size": [32, 32], "layout": "chw"}}}
    )
    with hal.open("panda_table", driver="mock", overrides=["cameras.scene.output={width: 64, height: 32}"]) as rig:
        picture = config.request(rig, rig.observe(), rig.robots, "")["image"]
    assert picture.shape == (3, 32, 32)
    assert not picture[:, :8].any()
    assert not picture[:, 24:].any()
    assert picture[:, 10:22].any()


# Actions.


@pytest.mark.parametrize(
    ("action", "row", "expected"),
    [
        ({"kind": "joint_delta"}, [0.1] + 6 * [0.0], [0.1, 0.1]),
        ({"kind": "joint_velocity", "scale": 0.01, "clip": True}, [2.0, 1.0] + 5 * [0.0], [0.01, 0.02]),
    ],
)
def test_relative_actions_start_from_the_observed_positions(
    rig: hal.Rig, action: dict[str, Any], row: list[float], expected: list[float]
) -> None:
    config = load_policy_config({**CONFIG, "action": action})
    arm, observation = rig.robots["panda"], rig.observe(cameras=())
    decoded = config.decode(np.tile(row, (2, 1)), observation, {"panda": arm})["panda"]
    np.testing.assert_allclose(decoded.q[:, 0] - observation.robots["panda"].q[0], expected, atol=1e-12)
    assert config.due == (action["kind"] == "joint_velocity")


def test_steps_of_the_tcp_become_joint_positions(rig: hal.Rig) -> None:
    config = load_policy_config({**CONFIG, "action": {"kind": "tcp_delta", "scale": 0.01, "turn": 0.03}})
    arm, observation = rig.robots["panda"], rig.observe(cameras=())
    decoded = config.decode(np.tile([1.0, 0, 0, 0, 0, 1.0], (3, 1)), observation, {"panda": arm})["panda"]
    before, after = observation.robots["panda"].tcp, arm.fk(decoded.q[-1])
    np.testing.assert_allclose(after.position - before.position, [0.03, 0.0, 0.0], atol=1e-4)
    assert abs(before.distance(after)[1] - 0.09) < 1e-3


@pytest.mark.parametrize(
    ("action", "row"),
    [
        ({"kind": "joint_velocity", "scale": 0.2}, [0, 0, 0, 0, 0.2, 0, 1]),
        ({"kind": "joint_velocity", "scale": 0.2}, [1, 0, 0, 0, 0, 0, 0]),
        ({"kind": "tcp_delta", "scale": 0.05, "turn": 0.5}, [0, 0, 1, 0, 0, 0]),
        ({"kind": "tcp_delta", "scale": 0.05, "turn": 0.5}, [0, 0.1, 0, 0, 0, 1]),
    ],
)
def test_steps_that_are_too_fast_for_the_rig_are_shortened(
    rig: hal.Rig, action: dict[str, Any], row: list[float]
) -> None:
    config = load_policy_config({**CONFIG, "action": action})
    arm, observation = rig.robots["panda"], rig.observe(cameras=())
    q = config.decode(np.tile(row, (4, 1)), observation, {"panda": arm})["panda"].q
    q = np.vstack([observation.robots["panda"].q, q])
    joints = (np.abs(np.diff(q, axis=0)) / (arm.spec.speed * np.asarray(arm.limits.velocity))).max() * 15
    tcp = np.array([arm.fk(row).position for row in q])
    fastest = max(joints, np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() * 15 / arm.spec.tcp_speed)
    assert 0.85 < fastest < 0.95


@pytest.mark.parametrize("kind", ["joint_position", "joint_delta", "joint_velocity"])
def test_actions_of_a_chunk_return_from_its_targets(rig: hal.Rig, kind: str) -> None:
    gripper = {"index": 2, "open": 1.0, "closed": -1.0}
    config = load_policy_config({**CONFIG, "action": {"kind": kind, "scale": 0.003, "gripper": gripper}})
    actions, observation = np.random.default_rng(1).uniform(-1.0, 1.0, (6, 8)), rig.observe(cameras=())
    targets = config.decode(actions, observation, rig.robots)
    np.testing.assert_allclose(config.encode(targets, observation, rig.robots), actions, atol=1e-12)
