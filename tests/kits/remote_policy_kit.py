"""A policy on a server in the test's own process, and an episode that it drives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyOutcome, PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer

Rig = hal.Rig
STEPS = 16
CONFIG: dict[str, Any] = {
    "rate_hz": 15,
    "execute": 8,
    "observation": {"state": {"state": ["q", "closed"]}, "prompt": {"text": "task"}},
    "action": {"kind": "joint_position", "gripper": {"index": 7, "threshold": 0.5}},
}


def stay(request: dict[str, Any]) -> dict[str, Any]:
    """Answer with the positions of the request, and an open gripper."""
    return {"actions": np.tile([*request["state"][:7], 0.0], (STEPS, 1))}


def assert_within_limits(rig: Rig) -> None:
    """Check every set-point that the drivers were given since the rig was opened."""
    for group in rig.statistics().values():
        for robot in group["robots"].values():
            assert max(robot["peak"].values()) <= 1.0 + 1e-6, robot["peak"]


def run(
    rig: Rig,
    infer: Callable[[dict[str, Any]], Any],
    *,
    config: dict[str, Any] = CONFIG,
    latency: float = 0.0,
    seconds: float = 3.0,
    timeout: float = 5.0,
    metadata: dict[str, Any] | None = None,
    reset: Callable[[dict[str, Any]], None] | None = None,
    rehearse: bool = False,
    on_turn: Callable[[float], None] = lambda seconds: None,
) -> PolicyOutcome:
    """Run an episode of a policy on a server of its own."""
    with PolicyServer(infer, reset=reset, metadata=metadata) as server:
        policy = RemotePolicy(
            rig, PolicyClient(server.url, timeout=timeout), load_policy_config(config), task="wave", latency=latency
        )
        runner = PolicyRunner(rig, policy, rate_hz=50, seconds=seconds, cameras=())
        try:
            if rehearse:
                runner.rehearse()
            return runner.run(seed=1, on_turn=on_turn)
        finally:
            policy.close()


def sine(rig: Rig) -> Callable[[float], np.ndarray]:
    """Return joint positions (7,), rad, at a time, s: the first joint swings around where it is."""
    start = np.array(rig.robots["panda"].state().q_set)
    begun = rig.clock.now()
    return lambda t: start + 0.1 * np.sin(2 * np.pi * 0.3 * max(0.0, t - begun)) * np.eye(7)[0]
