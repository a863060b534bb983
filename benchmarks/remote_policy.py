"""A policy on a server: round trip of pictures, cost of asking, tracking of a late or noisy policy, and takeovers.

python benchmarks/remote_policy.py
"""

from __future__ import annotations

import argparse
import contextlib
import resource
import tempfile
import threading
import time
from typing import Any, cast

import numpy as np

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer
from hal.learning.takeover import Takeover
from hal.recording import Recorder

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


def seams(latency: float, seconds: float) -> None:
    """Compare lag and jerk with a naive runner, which plays each chunk from its first action when it arrives."""
    for sigma, each in ((0.0, False), (0.01, True), (0.01, False)):
        joined, naive = (_drive_noisy(latency, seconds, sigma, each, how) for how in (False, True))
        noise = f"noise of {sigma:g} rad in each {'target' if each else 'chunk'}" if sigma else "no noise"
        ratio = f", rms jerk {joined[1] / naive[1]:.2f} of naive" if sigma else ""
        lag = f"{joined[0]:.1f} mrad rms from the sine, naive {naive[0]:.1f}"
        print(f"latency {1e3 * latency:3.0f} ms, {noise}: {lag}{ratio}")


def _drive_noisy(latency: float, seconds: float, sigma: float, each: bool, naive: bool) -> tuple[float, float]:
    """Return the rms distance of a set-point from its sine, mrad, and its rms jerk, rad/s^3."""
    chance, execute = np.random.default_rng(1), CONFIG["execute"]
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        wave, begun, chunks, seen = _sine(rig), rig.clock.now(), list[tuple[float, Any]](), list[tuple[float, float]]()

        def infer(request: dict[str, Any]) -> dict[str, Any]:
            rows = np.array([wave(t) for t in rig.clock.now() + np.arange(STEPS) / RATE])
            return {"actions": rows + chance.normal(0.0, sigma, (STEPS if each else 1, 7))}

        def play(observation: hal.Observation) -> hal.JointChunk | None:
            now = rig.clock.now()
            if not chunks or (now >= chunks[-1][0] + execute / RATE and chunks[-1][1] is None):
                chunks.append((now, infer({})["actions"]))
            asked, rows = chunks[-1]
            if rows is None or now < asked + latency:
                return None
            chunks[-1] = (asked, None)
            return hal.JointChunk(now + np.arange(STEPS) / RATE, rows)

        def turn(_: float) -> None:
            seen.append((rig.clock.now(), rig.robots["panda"].state().q_set[0]))

        with PolicyServer(infer) as server:
            remote = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG), latency=latency)
            policy: Any = play if naive else remote
            PolicyRunner(rig, policy, rate_hz=100, seconds=seconds, cameras=()).run(on_turn=turn)
            remote.close()
        log = np.array([point.q for point in cast(Any, rig.driver("panda")).log])
        period = (rig.clock.now() - begun) / len(log)
    jerk = np.diff(log, 3, axis=0)[len(log) // 4 :] / period**3
    t, q = np.array(seen).T
    away = (q - np.array([wave(x)[0] for x in t]))[t > t[0] + 3.0]
    return 1e3 * float(np.sqrt((away**2).mean())), float(np.sqrt((jerk**2).mean()))


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


class Stick:
    """A pad whose state is set by this program."""

    def __init__(self) -> None:
        self.side = 0.0

    def state(self) -> hal.PadState:
        return hal.PadState(hal.Stamp(0.0, 0.0, 0), axes={"dpad_x": self.side}, connected=True)


def takeovers(count: int, clock: str) -> None:
    """Move and release a stick ``count`` times, at any time within a turn; see in every tick when the arm follows."""
    period, held = 1.0, 0.25
    chance, stick = np.random.default_rng(1), Stick()
    presses = np.cumsum(np.full(count, period)) + chance.uniform(0.0, 0.1, count)
    delays: list[float] = []
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        rig = stack.enter_context(hal.open("panda_table", sim=True, clock=clock, pad="none", overrides=["cameras={}"]))
        recorder = stack.enter_context(Recorder(rig, f"{folder}/runs", fps=30))
        arm, begun, pressed = rig.robots["panda"], rig.clock.now(), [0.0]

        def policy(observation: hal.Observation) -> hal.Twist:
            return hal.Twist([0.0, 0.0, 0.02 * np.sign(np.sin(4 * np.pi * observation.t))])

        def watch() -> None:
            now, number = rig.clock.now() - begun, len(delays)
            if pressed[0]:  # wait for the motion of this press: the policy alone moves less than 2 mm/s sidewards
                state = arm.state()
                speed = (arm.kinematics.jacobian(state.q_set) @ state.dq_set)[1]
                if abs(speed) > 5e-3:
                    delays.append(state.stamp.t - pressed[0])
                    pressed[0] = 0.0
            elif number < count and now >= presses[number]:
                stick.side = 1.0 if number % 2 else -1.0
                pressed[0] = rig.clock.now()
            elif stick.side and now >= presses[number - 1] + held:
                stick.side = 0.0

        ended = threading.Event()
        if rig.lock_step:
            rig.clock.call_every(1.0 / 240.0, watch)
        else:

            def watch_always() -> None:
                while not ended.wait(0.001):
                    watch()

            threading.Thread(target=watch_always, daemon=True).start()
        takeover = Takeover(hal.Teleop(arm), cast(Any, stick))
        seconds = (count + 1) * period
        runner = PolicyRunner(rig, policy, rate_hz=50, seconds=seconds, cameras=(), unattended=True, takeover=takeover)
        recorder.start()
        outcome = runner.run()
        ended.set()
        rows, dropped = recorder.status().frames, recorder.status().dropped
        recorder.save(wait=True)
        (group,) = rig.statistics().values()
        peak = group["robots"]["panda"]["peak"]
    limits = ", ".join(f"{name} {peak[name]:.2f}" for name in ("velocity", "acceleration", "jerk"))
    print(
        f"{len(outcome.interventions)} takeovers ({clock}, {outcome.ended}): press to motion p50 "
        f"{1e3 * np.percentile(delays, 50):.0f}, p99 {1e3 * np.percentile(delays, 99):.0f}, max "
        f"{1e3 * max(delays):.0f} ms; shares of the limits in all set-points: {limits}; {rows} rows, {dropped} lost"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--count", type=int, default=500, help="round trips, and half the simulated takeovers (%(default)s)"
    )
    args = parser.parse_args()
    round_trip(args.count)
    for latency in (0.05, 0.2, 0.4):
        tracking(latency, 12.0)
    for latency in (0.1, 0.3):
        seams(latency, 12.0)
    cost(10.0)
    takeovers(2 * args.count, "lock_step")
    takeovers(50, "real_time")


if __name__ == "__main__":
    main()
