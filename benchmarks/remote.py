"""A rig over two computers, over loopback and over networks in namespaces: delays, pictures, processor time."""

from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.keys import make_key
from hal.types import Trip

from ._network import SERVER, run_apart
from .kit import ROOT, Table, compare, ms

PATHS = ("hal/remote/", "hal/keys.py")
RATE = 1000.0
"""Of the servo, Hz."""
CHANGES = [f"simulation.physics_hz={RATE:g}", "cameras={}", "objects=[]"]
LOST = 5.0
"""Time after which a command counts as lost, s."""
TURN = hal.JointVelocity([0.0] * 7)
WITH_TLS = "127.0.0.2"
"""An address at which certificates are needed."""


@contextmanager
def serve(address: str) -> Iterator[tuple[str, int]]:
    """Run ``hal serve`` at an address; yield that with its port, and the number of its process."""
    changes = [word for change in CHANGES for word in ("--set", change)]
    command = [sys.executable, str(ROOT / "apps" / "serve.py"), "--sim", "--listen", f"{address}:0", *changes]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            line = next(line for line in server.stdout if line.startswith("listening at "))
            yield line.removeprefix("listening at ").partition(",")[0], server.pid
        finally:
            server.terminate()


def measure_delays(rig: hal.Rig, count: int) -> dict[str, Any]:
    """Return the times from sending a command until its set-point is written, ms, and how often the arm was stopped."""
    found, stops, chance = list[float](), 0, random.Random(1)
    arm: Any = rig.robots["panda"]
    with arm.control(rate_hz=10) as control:
        control.send(TURN)
        rig.clock.sleep(0.2)
        for _ in range(count):
            sent = time.monotonic()
            control.send(TURN)
            number = arm._commands
            while (servo := arm._mail.peek()).target_seq < number:
                if control.trip is not Trip.NONE:
                    stops += restart(control, TURN)
                    break
                if time.monotonic() > sent + LOST:
                    raise TimeoutError("a command did not arrive")
                time.sleep(0.0001)
            else:
                found.append(servo.t_written - sent)
            time.sleep(chance.uniform(0.003, 0.006))
    return {"median, 99 % (ms)": ms(found, 0.5, 0.99), "stops": stops}


def restart(control: hal.Control, command: hal.Command) -> int:
    """Acknowledge a stop, and wait until a command is taken; return 1."""
    control.rearm()
    end = time.monotonic() + LOST
    while True:
        try:
            control.send(command)
            return 1
        except hal.MotionStopped:
            if time.monotonic() > end:
                raise
            time.sleep(0.01)


def measure_load(rig: hal.Rig, pids: tuple[int, int], seconds: float) -> list[float]:
    """Return the shares of a core that two processes take while commands are sent at 1 kHz."""
    with rig.robots["panda"].control(rate_hz=10) as control:
        control.send(TURN)
        before, began, sent = [_cpu(pid) for pid in pids], time.monotonic(), 0
        while (now := time.monotonic()) < began + seconds:
            control.send(TURN)
            sent += 1
            time.sleep(max(0.0, began + sent / RATE - now))
        return [(_cpu(pid) - start) / (now - began) for pid, start in zip(pids, before, strict=True)]


def _cpu(pid: int) -> float:
    """Return the processor's time of a process, s."""
    runs = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(run.read_text().split()[0]) for run in runs) / 1e9


SERVE_CAMERAS = f"""
import hal
from hal.remote.server import Server
cameras = {{"model": "realsense_d435", "capture": {{"width": 640, "height": 480, "rate_hz": 30}}}}
cameras |= {{"look_at": {{"target": [0, 0, 0], "distance": 1.0}}}}
changes = {{"cameras": {{"one": cameras, "two": cameras}}, "objects": []}}
with hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=changes) as rig:
    server = Server(rig, "{SERVER}", 7447, print)
    print("listening", flush=True)
    server.run()
"""


def find_delays(count: int) -> dict[str, Any]:
    """Return the delays of commands to the server of the other namespace."""
    with hal.open({"robots": {"panda": {"at": SERVER}}}, pad="none") as rig:
        return measure_delays(rig, count) | {"round trip (ms)": 1e3 * rig.statistics()[SERVER]["link"]["round_trip_s"]}


def find_ages(seconds: float, cameras: tuple[str, ...]) -> dict[str, Any]:
    """Return the ages of states and frames of the other namespace at a program that reads them 200 times a second."""
    rig_file = {"robots": {"panda": {"at": SERVER}}, "cameras": {name: {"at": SERVER} for name in cameras}}
    with hal.open(rig_file, pad="none") as rig:
        ages = []
        for tick in rig.clock.rate(200):
            if tick.elapsed > seconds:
                break
            ages.append(rig.clock.now() - rig.robots["panda"].state().stamp.t)
        found: dict[str, Any] = {"states, median, 99 % (ms)": ms(ages, 0.5, 0.99), "oldest state (ms)": 1e3 * max(ages)}
        for name, camera in rig.cameras.items():
            counts, there = camera.counts(), rig.driver(name).statistics()
            found[f"{name}: frames a second"] = counts.fps
            found[f"{name}: age, median (ms)"] = 1e3 * (counts.age_p50 or math.nan)
            found[f"{name}: uncertainty of its time (ms)"] = 500.0 * there["round_trip_s"]
        return found


SERVE_WATCHED = """
import hal, threading
from benchmarks import remote
from hal.remote.server import Server
changes = {{"cameras": {{}}, "objects": []}}
with hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=changes) as rig:
    threading.Thread(target=Server(rig, "{server}", 7447, print).run, daemon=True).start()
    print("listening", flush=True)
    remote.watch_limits(rig.robots["panda"], {file!r})
"""
BAD = {"delay": 0.05, "jitter": 0.05, "loss": 0.05, "reorder": 1.0}
"""Of each packet, each way; TCP turns loss and reordering into stalls of up to some 100 ms."""


def watch_limits(arm: hal.Robot, file: str) -> None:
    """Compare the set-points of an arm with its limits until the process is ended; write what was found to a file."""
    period, limits = 1.0 / arm.spec.rate_hz, arm.limits
    lower, upper, fastest, most = map(np.array, (limits.lower, limits.upper, limits.velocity, limits.acceleration))
    last, points, outside, way, due = arm.state(LOST), 0, 0, 0.0, 0.0
    while True:
        time.sleep(0.2 * period)
        state = arm.state(LOST)
        if state.stamp.seq == last.stamp.seq:
            continue
        changes = np.abs(state.dq_set - last.dq_set) / (period * (state.stamp.seq - last.stamp.seq))
        beyond = np.concatenate(
            (lower - state.q_set, state.q_set - upper, np.abs(state.dq_set) - fastest, changes - most)
        )
        way += float(np.abs(state.q_set - last.q_set).sum())
        last, points, outside = state, points + 1, outside + int(not (beyond < 1e-6).all())  # NaN is beyond, too
        if time.monotonic() > due:
            due = time.monotonic() + 0.5
            Path(file).write_text(json.dumps([points, outside, way]))


def find_trips(seconds: float, file: str) -> dict[str, Any]:
    """Drive an arm at random, into its limits as well, whatever stops it; return what was found, and the stops."""
    stops, end = Counter[str](), time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            rig_file = {"robots": {"panda": {"at": SERVER}}}
            with hal.open(rig_file, pad="none") as rig, rig.robots["panda"].control(rate_hz=10) as control:
                _drive_at_random(rig, control, end, stops)
        except hal.HalError as error:  # the link was lost, or is too slow for a session
            stops[error.code or type(error).__name__] += 1
            time.sleep(0.5)
    points, outside, way = json.loads(Path(file).read_text())
    found = {"set-points": points, "outside of a limit": outside, "way of all joints (rad)": way}
    return found | {f"stops ({name})": count for name, count in stops.items()}


def _drive_at_random(rig: hal.Rig, control: hal.Control, end: float, stops: Counter[str]) -> None:
    chance, command, due = random.Random(1), TURN, 0.0
    for tick in rig.clock.rate(100):
        if time.monotonic() > end:
            return
        if tick.elapsed >= due:
            due += 0.5
            command = hal.JointVelocity([chance.uniform(-1.0, 1.0) for _ in range(7)])
        try:
            control.send(command)
        except hal.MotionStopped as stop:
            stops[stop.code or ""] += restart(control, TURN)


def soak(seconds: float) -> Table:
    """Return what became of an arm that was driven over a bad link for some time."""
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/found.json"
        found = apart(
            [sys.executable, "-c", SERVE_WATCHED.format(server=SERVER, file=file)], find_trips, seconds, file, **BAD
        )
    return compare(f"{seconds:g} s over a link with 5 % loss and 0 to 100 ms of delay each way", {"": found})


def apart(
    serve: Sequence[str], find: Callable[..., dict[str, Any]], *arguments: Any, **network: float
) -> dict[str, Any]:
    """Return what a function of this file finds in the namespace of a client."""
    program = f"import json; from benchmarks import remote; print(json.dumps(remote.{find.__name__}(*{arguments!r})))"
    found: dict[str, Any] = run_apart(serve, [sys.executable, "-c", program], **network)
    return found


def networks() -> Iterator[Table]:
    """Yield the tables over networks in namespaces, which need the rights of a user namespace."""
    changes = [word for change in CHANGES for word in ("--set", change)]
    arm = [sys.executable, str(ROOT / "apps" / "serve.py"), "--sim", "--listen", SERVER, *changes]
    count, seconds = 300, 10.0
    yield compare(
        "The same over a network with this round trip",
        {f"{trip:g} ms": apart(arm, find_delays, count, delay=0.5e-3 * trip) for trip in (0.3, 20.0)}
        | {"100 ms, each way 10 ms more or less": apart(arm, find_delays, count, delay=0.05, jitter=0.01)},
    )
    yield soak(seconds)
    both = [sys.executable, "-c", SERVE_CAMERAS]
    yield compare(
        "A mock arm and two RGB-D cameras, 640x480 at 30 Hz, over 1 Gbit/s",
        {
            "without cameras": apart(both, find_ages, seconds, (), rate=1e9),
            "with both": apart(both, find_ages, seconds, ("one", "two"), rate=1e9),
        },
    )


def local(quick: bool) -> Iterator[Table]:
    """Yield the table over loopback."""
    count, seconds = (20, 0.5) if quick else (2000, 5.0)
    with hal.open("panda_table", sim=True, clock="real_time", pad="none", overrides=CHANGES) as rig:
        results: dict[str, dict[str, Any]] = {"one computer": measure_delays(rig, count)}
    with tempfile.TemporaryDirectory() as keys:
        os.environ["HAL_KEYS"] = keys
        make_key("host", "here", [WITH_TLS])
        make_key("person", "me")
        for name, address in (("over a link", "127.0.0.1"), ("with TLS", WITH_TLS)):
            with serve(address) as (at, pid), hal.open({"robots": {"panda": {"at": at}}}, pad="none") as rig:
                found = measure_delays(rig, count)
                found["round trip (ms)"] = 1e3 * rig.statistics()[at]["link"]["round_trip_s"]
                host: Any = rig._hosts[0]
                shares = measure_load(rig, (host.child.process.pid, pid), seconds)
            for end, share in zip(("client", "server"), shares, strict=True):
                found[f"{end}, of a core (%)"] = 100.0 * share
            results[name] = found
        del os.environ["HAL_KEYS"]
    yield compare(f"From a command to its set-point, servo and commands at {RATE:g} Hz", results)


def run(quick: bool = False) -> Iterator[Table]:
    """Yield the tables."""
    yield from local(quick)
    if not quick:
        yield from networks()


if __name__ == "__main__":  # python -m benchmarks.remote SECONDS: the bad link alone, for so long
    print(soak(float(sys.argv[1])))
