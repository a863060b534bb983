"""A policy on a server: round trip of pictures, cost of asking, tracking of a late policy, and takeovers.

python benchmarks/remote_policy.py
"""

from __future__ import annotations

import argparse
import resource
import time
from typing import Any

import numpy as np

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer
from hal.learning.takeover import Takeover

STEPS, RATE = 16, 15.0
SINE, FREQUENCY = 0.1, 0.3
CONFIG = {
    "rate_hz": RATE,
    "execute": 8,
    "observation": {"state": {"state": "q"}},
    "action": {"kind": "joint_position"},
}


def round_trip(count: int) -> None:
    pictures = {name: np.zeros((224, 224, 3), np.uint8) for name in ("scene", "wrist")}
    with PolicyServer(lambda request: {"actions": np.zeros((STEPS, 8), np.float32)}) as server:
        client = PolicyClient(server.url)
        client.connect()
        times = []
        for _ in range(count):
            begin = time.perf_counter()
            client.request({**pictures, "state": np.zeros(8, np.float32)}).result()
            times.append(1e3 * (time.perf_counter() - begin))
        client.close()
    p50, p99 = np.percentile(times, [50, 99])
    print(f"two 224x224 pictures there, a chunk back, {count} times: p50 {p50:.2f} ms, p99 {p99:.2f} ms")


def _sine(rig: hal.Rig) -> Any:
    start, begun = np.array(rig.robots["panda"].state().q_set), rig.clock.now()
    return lambda t: start + SINE * np.sin(2 * np.pi * FREQUENCY * max(0.0, t - begun)) * np.eye(7)[0]


def tracking(latency: float, seconds: float) -> None:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        wave, arm, seen = _sine(rig), rig.robots["panda"], []

        def infer(request: dict[str, Any]) -> dict[str, Any]:
            return {"actions": np.array([wave(t) for t in rig.clock.now() + np.arange(STEPS) / RATE])}

        def turn(_: float) -> None:
            state = arm.state()
            seen.append((state.stamp.t, state.q_set[0], state.dq_set[0]))

        with PolicyServer(infer) as server:
            policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG), latency=latency)
            outcome = PolicyRunner(rig, policy, rate_hz=100, seconds=seconds, cameras=()).run(on_turn=turn)
            policy.close()
        reach = float(np.linalg.norm(arm.fk(arm.home).position[:2]))
        limit = arm.limits.acceleration[0]
    t, q, dq = np.array(seen).T
    settled = t > t[0] + 3.0
    away = 1e3 * reach * (q - np.array([wave(x)[0] for x in t]))[settled]
    change = np.abs(np.diff(dq) / np.diff(t)).max() / limit
    figures = outcome.statistics
    print(
        f"latency {1e3 * latency:3.0f} ms: {np.sqrt((away**2).mean()):.2f} mm rms from a sine of {FREQUENCY} Hz at the "
        f"tcp, greatest acceleration {change:.2f} of the limit, {figures['chunks']} chunks, {figures['late']} late"
    )


def cost(seconds: float) -> None:
    with hal.open("panda_table", driver="mock", clock="real_time", overrides=["cameras={}"]) as rig:
        arm = rig.robots["panda"]
        q = np.array(arm.state().q_set)

        def idle(observation: hal.Observation) -> hal.JointTarget:
            return hal.JointTarget(q)

        def used(policy: Any) -> float:
            before, begin = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
            PolicyRunner(rig, policy, rate_hz=50, seconds=seconds, cameras=()).run()
            after = resource.getrusage(resource.RUSAGE_SELF)
            took = time.perf_counter() - begin
            return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / took

        answer = {"actions": np.tile(q, (STEPS, 1))}
        with PolicyServer(lambda request: answer) as server:
            policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG))
            remote, local = used(policy), used(idle)
            policy.close()
    print(
        f"a program that runs a policy at 50 Hz: {100 * remote:.1f} % of a core with one on a server (which is in the "
        f"same process), {100 * local:.1f} % with a constant one"
    )


def takeovers(count: int) -> None:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        arm, pad = rig.robots["panda"], rig.driver("pad")
        pad.press("l2")
        begun, seen, delays = rig.clock.now(), [], []
        period, held = 1.6, 0.5

        def policy(observation: hal.Observation) -> hal.Twist:
            return hal.Twist([0.0, 0.0, 0.02 * np.sign(np.sin(4 * np.pi / period * observation.t))])

        def turn(_: float) -> None:
            elapsed = (rig.clock.now() - begun) % (2 * period)
            side = 1.0 if elapsed < period else -1.0
            pad.stick("dpad_x", side if elapsed % period < held else 0.0)
            state = arm.state()
            seen.append((elapsed % period, *state.q_set, *state.dq_set))

        takeover = Takeover(hal.Teleop(arm), rig.gamepads["pad"])
        hold = rig.gamepads["pad"].hold("l2")
        runner = PolicyRunner(
            rig, policy, rate_hz=50, seconds=count * period, cameras=(), deadman=hold, takeover=takeover
        )
        outcome = runner.run(on_turn=turn)
        velocity, acceleration = (np.asarray(x) for x in (arm.limits.velocity, arm.limits.acceleration))
    rows = np.array(seen)
    q, dq = rows[:, 1:8], rows[:, 8:15]
    for first in np.flatnonzero(np.diff(rows[:, 0]) < 0.0) + 1:
        moved = np.flatnonzero(np.abs(dq[first : first + 20, 0]) > 1e-3)
        delays.append(rows[first + moved[0], 0] - rows[first, 0] if moved.size else np.inf)
    speed = (np.abs(np.diff(q, axis=0)) / 0.02 / velocity).max()
    change = (np.abs(np.diff(dq, axis=0)) / 0.02 / acceleration).max()
    print(
        f"{len(outcome.interventions)} takeovers in simulated time: press to motion p99 "
        f"{1e3 * np.percentile(delays, 99):.0f} ms; between two turns at most {speed:.2f} of the speed limits and "
        f"{change:.2f} of the acceleration limits"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=500, help="round trips and takeovers (%(default)s)")
    args = parser.parse_args()
    round_trip(args.count)
    for latency in (0.05, 0.2, 0.4):
        tracking(latency, 12.0)
    cost(10.0)
    takeovers(args.count)


if __name__ == "__main__":
    main()
