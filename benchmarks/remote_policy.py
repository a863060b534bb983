"""A policy on a server: round trip of pictures, and tracking with a late or noisy policy."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer

from .kit import Table, ms, timed

PATHS = ("hal/learning/remote.py", "hal/learning/asynchronous.py", "hal/learning/policy.py")
STEPS, RATE = 16, 15.0
SINE, FREQUENCY = 0.1, 0.3
CONFIG = {
    "rate_hz": RATE,
    "execute": 8,
    "observation": {"state": {"state": "q"}},
    "action": {"kind": "joint_position"},
}


def round_trips(count: int) -> list[float]:
    """Return the times that two 224x224 pictures take to the server, and a chunk back, s."""
    pictures = {name: np.zeros((224, 224, 3), np.uint8) for name in ("scene", "wrist")}
    request = {**pictures, "state": np.zeros(8, np.float32)}
    with PolicyServer(lambda request: {"actions": np.zeros((STEPS, 8), np.float32)}) as server:
        client = PolicyClient(server.url)
        client.connect()
        found = [timed(lambda: client.request(request).result()) for _ in range(count)]
        client.close()
    return found


def _sine(rig: hal.Rig) -> Any:
    start, begun = np.array(rig.robots["panda"].state().q_set), rig.clock.now()
    return lambda t: start + SINE * np.sin(2 * np.pi * FREQUENCY * max(0.0, t - begun)) * np.eye(7)[0]


def track(latency: float, seconds: float, sigma: float, each: bool, naive: bool) -> tuple[float, float]:
    """Return the rms distance of a set-point from its sine, mrad, and its rms jerk, rad/s^3.

    Args:
        latency: Between an observation and its answer, s.
        seconds: Length, s.
        sigma: Noise, rad, of ``each`` target of a chunk, or of all alike.
        each: See ``sigma``.
        naive: Play each chunk from its first action when it arrives: the reference.
    """
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


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    trips = 20 if quick else 500
    table = Table("two 224x224 pictures there and a chunk back, over loopback", ("", "ms"))
    table.add(f"{trips} times", ms(round_trips(trips), 0.5, 0.99))
    yield table
    columns = ("latency, noise", "mrad rms from the sine", "naive runner", "rms jerk, of the naive runner's")
    table = Table(f"a sine of {FREQUENCY} Hz as chunks of {RATE:g} Hz", columns)
    noises = {"none": (0.0, False), "0.01 rad in each target": (0.01, True), "0.01 rad in each chunk": (0.01, False)}
    for latency in (0.1,) if quick else (0.1, 0.3):
        for name, noise in noises.items():
            joined, naive = (track(latency, 4.0 if quick else 12.0, *noise, how) for how in (False, True))
            table.add(
                f"{1e3 * latency:.0f} ms, {name}", joined[0], naive[0], joined[1] / naive[1] if noise[0] else None
            )
    yield table
