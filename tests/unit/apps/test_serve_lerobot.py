"""``apps/serve_lerobot.py``: how a recording describes the policy that is trained on it. LeRobot is not needed here."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from app_kit import run_here
from errors_kit import raises_code
from recording_kit import mock_rig, record

import hal
from hal.apps.serve_lerobot import IMAGES, STATE, LeRobotPolicy, describe, main
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer
from hal.recording import Dataset, Recorder

pytest.importorskip("msgpack")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "demo"
    with mock_rig() as rig, Recorder(rig, out, fps=20, task="lift") as recorder:
        record(recorder, 0.3, True)
    return out


def test_a_policy_trained_on_a_recording_drives_the_rig_that_it_was_recorded_with(recorded: Path) -> None:
    info = Dataset(recorded).info
    metadata = describe(info, [STATE, f"{IMAGES}wrist"])
    requests: list[dict[str, Any]] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(request)
        target = np.tile(request[STATE], (20, 1))
        target[:, -1] = 0.01  # of the fingers, m
        return {"actions": target}

    with PolicyServer(infer, metadata=metadata) as server, mock_rig() as rig:
        policy = RemotePolicy(rig, PolicyClient(server.url), task="lift")
        runner = PolicyRunner(rig, policy, rate_hz=50, seconds=2.0, cameras=policy.config.cameras())
        assert runner.run().ended == "time"
        gripper = rig.robots["panda"].gripper
        assert gripper is not None
        assert abs(gripper.state().width - 0.01) < 1e-3
        policy.close()
    features = info["features"]
    assert requests[0][f"{IMAGES}wrist"].shape == tuple(features[f"{IMAGES}wrist"]["shape"])
    assert requests[0][STATE].shape == tuple(features[STATE]["shape"])
    assert requests[0]["task"] == "lift"


def test_a_recording_of_two_arms_describes_the_numbers_of_each() -> None:
    names = [f"{arm}.{part}" for arm in ("left", "right") for part in ("a", "b", "gripper")]
    features = {key: {"names": names, "shape": [6]} for key in (STATE, "action")}
    metadata = describe({"fps": 30, "features": features}, [STATE])
    assert metadata["joints"] == ["left.a", "left.b", "right.a", "right.b"]
    config = load_policy_config(metadata["policy_config"])
    assert [(action.robot, action.columns) for action in config.actions] == [("left", (0, 3)), ("right", (3, 6))]
    assert config.observation[STATE].state == ["left.q", "left.width", "right.q", "right.width"]


class FakeTensor(np.ndarray[Any, np.dtype[Any]]):
    """The few methods of a tensor that are used, on an array."""

    def to(self, *_: object) -> FakeTensor:
        return self

    def numpy(self) -> np.ndarray[Any, np.dtype[Any]]:
        return np.asarray(self)


@pytest.mark.parametrize("asked", [True, False])
def test_what_is_executed_anyway_reaches_the_policy_normalised_as_in_training(asked: bool) -> None:
    calls: list[dict[str, Any]] = []

    class Network:
        def predict_action_chunk(self, batch: dict[str, Any], **options: Any) -> FakeTensor:
            calls.append(options)
            assert "action" not in batch or not asked
            return np.zeros((1, 4, 2)).view(FakeTensor)

    policy = object.__new__(LeRobotPolicy)
    policy.inputs, policy.rtc_delay, policy._device = [STATE], 6, "cpu"
    policy._torch = SimpleNamespace(
        from_numpy=lambda array: array.view(FakeTensor),
        no_grad=contextlib.nullcontext,
        stack=lambda parts, dim: np.stack(parts, dim).view(FakeTensor),
        float32=None,
    )
    policy._policy, policy._after = Network(), lambda actions: actions
    policy._before = lambda batch: {**batch, "action": 0.5 * batch["action"]} if "action" in batch else batch
    rtc = {"actions": np.ones((3, 2), np.float32), "delay_steps": 2}
    reply = policy.infer({STATE: np.zeros(2, np.float32)} | ({"rtc": rtc} if asked else {}))
    assert reply["actions"].shape == (4, 2)
    if not asked:
        assert calls == [{}]
        return
    assert calls[0]["inference_delay"] == 2
    np.testing.assert_array_equal(calls[0]["prev_chunk_left_over"], np.full((1, 3, 2), 0.5))


def test_a_policy_for_other_joints_is_refused(recorded: Path) -> None:
    metadata = describe(Dataset(recorded).info, [STATE]) | {"joints": ["a", "b"]}
    with PolicyServer(lambda request: {}, metadata=metadata) as server, mock_rig() as rig:
        client = PolicyClient(server.url)
        with raises_code(hal.PolicyError, "policy_mismatch"):
            RemotePolicy(rig, client)
        client.close()


def test_a_server_that_does_not_describe_itself_needs_a_file() -> None:
    with PolicyServer(lambda request: {}) as server, mock_rig() as rig:
        client = PolicyClient(server.url)
        with raises_code(hal.PolicyError, "policy_mismatch"):
            RemotePolicy(rig, client)
        client.close()


def test_what_is_not_served_is_named(recorded: Path) -> None:
    info = Dataset(recorded).info
    with raises_code(hal.CommandError, "unknown_input"):
        describe(info, [STATE, "observation.environment_state"])
    features = {**info["features"], "action": {"names": ["x", "y"], "shape": [2]}}
    with raises_code(hal.CommandError, "foreign_dataset"):
        describe({**info, "features": features}, [STATE])


@pytest.mark.parametrize("made", [(), ("config.json",)])
def test_a_folder_that_is_no_checkpoint_is_refused(tmp_path: Path, made: tuple[str, ...]) -> None:
    for name in made:
        (tmp_path / name).write_text("{}")
    assert run_here(main, tmp_path, "--port", "0").returncode == 2
