"""``apps/serve_lerobot.py``: how a recording describes the policy that is trained on it. LeRobot is not needed here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from app_kit import run_here
from errors_kit import raises_code
from recording_kit import mock_rig, record

import hal
from hal.apps.serve_lerobot import IMAGES, STATE, describe, main
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
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
