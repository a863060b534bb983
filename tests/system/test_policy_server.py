"""A policy on a server in real time: answers that are slow and irregular, and a server that is killed or freezes."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from policy_server import CONFIG, EXECUTE, RATE, SPEED, serving

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyOutcome, PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient

pytest.importorskip("msgpack")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rig() -> Iterator[hal.Rig]:
    overrides = ["cameras={}"]
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=overrides) as opened:
        yield opened


def drive(
    rig: hal.Rig, policy: RemotePolicy, seconds: float, on_turn: Callable[[float], None] = lambda seconds: None
) -> PolicyOutcome:
    runner = PolicyRunner(rig, policy, rate_hz=50, seconds=seconds, cameras=())
    runner.rehearse()
    return runner.run(on_turn=on_turn)


def policy_at(rig: hal.Rig, url: str, timeout: float = 5.0) -> RemotePolicy:
    way = "left" if rig.robots["panda"].state().q[0] < 0.0 else "right"
    return RemotePolicy(rig, PolicyClient(url, timeout=timeout), load_policy_config(CONFIG), task=way)


def assert_within_limits(rig: hal.Rig) -> None:
    """Check every set-point that the driver was given since the rig was opened."""
    (group,) = (group for group in rig.statistics().values() if "panda" in group["robots"])
    peak = group["robots"]["panda"]["peak"]
    assert max(peak.values()) <= 1.0 + 1e-6, peak


@pytest.mark.parametrize(("latency", "jitter", "seconds"), [(0.05, 0.04, 1.0), (0.2, 0.15, 1.5), (0.8, 0.3, 3.0)])
def test_slow_and_irregular_answers_drive_within_the_limits(
    rig: hal.Rig, latency: float, jitter: float, seconds: float
) -> None:
    start = rig.robots["panda"].state().q[0]
    with serving(latency, jitter) as (_, url):
        policy = policy_at(rig, url)
        outcome = drive(rig, policy, seconds)
        policy.close()
    assert (outcome.ended, outcome.reason) == ("time", "")
    moved = abs(rig.robots["panda"].state().q[0] - start)
    assert 0.5 * SPEED * (seconds - latency - jitter) < moved < 1.2 * SPEED * seconds
    figures = outcome.statistics
    assert latency - jitter < figures["latency"]["p50"] < latency + jitter + 0.1
    assert figures["splice"] < rig.robots["panda"].limits.velocity[0] / RATE
    assert_within_limits(rig)


@pytest.mark.parametrize(
    ("blow", "codes"),
    [(signal.SIGKILL, {"policy_lost"}), (signal.SIGSTOP, {"policy_timeout", "policy_too_late"})],
)
def test_a_server_that_is_killed_or_frozen_stops_the_arm_within_its_chunk(
    rig: hal.Rig, blow: signal.Signals, codes: set[str]
) -> None:
    arm = rig.robots["panda"]
    ended: list[float] = []
    with serving(0.05) as (server, url):
        policy = policy_at(rig, url)

        def strike(seconds: float) -> None:
            if seconds > 0.3 and not ended:
                ended.append(rig.clock.now())
                server.send_signal(blow)

        outcome = drive(rig, policy, 10.0, strike)
        stopped = rig.clock.now()
        assert np.abs(arm.state().dq_set).max() < 1e-9
        assert stopped - ended[0] < 2 * EXECUTE / RATE + 0.3
        assert isinstance(outcome.error, hal.PolicyError)
        assert outcome.error.code in codes
        assert_within_limits(rig)
        # Neither the server's return nor a new connection moves the arm.
        at_rest = np.array(arm.state().q_set)
        if blow is signal.SIGSTOP:
            server.send_signal(signal.SIGCONT)
            policy.reset()
            assert policy.client.connected
        time.sleep(0.3)
        np.testing.assert_array_equal(arm.state().q_set, at_rest)
        policy.close()
