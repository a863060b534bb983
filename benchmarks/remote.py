"""A rig over two computers, here over loopback: from a command to its set-point; processor time of the link."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hal
from hal.keys import make_key

from .kit import ROOT, Table, compare, ms

PATHS = ("hal/remote/", "hal/keys.py")
RATE = 1000.0
"""Of the servo, Hz."""
CHANGES = [f"simulation.physics_hz={RATE:g}", "cameras={}", "objects=[]"]
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


def measure_delays(rig: hal.Rig, count: int) -> list[float]:
    """Return the times from sending a command until its set-point is written, s."""
    found, chance = [], random.Random(1)
    arm: Any = rig.robots["panda"]
    with arm.control(rate_hz=10) as control:
        control.send(TURN)
        rig.clock.sleep(0.2)
        for _ in range(count):
            sent = time.monotonic()
            control.send(TURN)
            number = arm._commands
            while (servo := arm._mail.peek()).target_seq < number:
                time.sleep(0.0001)
            found.append(servo.t_written - sent)
            time.sleep(chance.uniform(0.003, 0.006))
    return found


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


def run(quick: bool = False) -> Iterator[Table]:
    """Yield the tables."""
    count, seconds = (20, 0.5) if quick else (2000, 5.0)
    with hal.open("panda_table", sim=True, clock="real_time", pad="none", overrides=CHANGES) as rig:
        results = {"one computer": {"median, 99 % (ms)": ms(measure_delays(rig, count), 0.5, 0.99)}}
    with tempfile.TemporaryDirectory() as keys:
        os.environ["HAL_KEYS"] = keys
        make_key("host", "here", [WITH_TLS])
        make_key("person", "me")
        for name, address in (("over a link", "127.0.0.1"), ("with TLS", WITH_TLS)):
            with serve(address) as (at, pid), hal.open({"robots": {"panda": {"at": at}}}, pad="none") as rig:
                found: dict[str, Any] = {"median, 99 % (ms)": ms(measure_delays(rig, count), 0.5, 0.99)}
                found["round trip (ms)"] = 1e3 * rig.statistics()[at]["link"]["round_trip_s"]
                host: Any = rig._hosts[0]
                shares = measure_load(rig, (host.child.process.pid, pid), seconds)
            for end, share in zip(("client", "server"), shares, strict=True):
                found[f"{end}, of a core (%)"] = 100.0 * share
            results[name] = found
        del os.environ["HAL_KEYS"]
    yield compare(f"From a command to its set-point, servo and commands at {RATE:g} Hz", results)
