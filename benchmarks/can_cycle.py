"""An arm on a CAN bus against the emulator, in real time: missed cycles, incomplete cycles, time per cycle.

    python benchmarks/can_cycle.py [--seconds 60] [--rig openarm|yam]

The bus is python-can's ``udp_multicast``; the emulator, with its mechanics, is another process on this computer, and
takes a share of the processors that motors would not. A cycle is incomplete if a motor's reply is not there by the next
one, 2 ms later, so a busy computer shows in it. An OpenArm has 7 motors and that of its hand, at 500 Hz.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import hal

RIGS: dict[str, dict[str, Any]] = {
    "openarm": {
        "model": "openarm_left",
        "base": {"position": [0, 0, 0.7], "orientation": [-0.7071068, 0, 0, 0.7071068]},
    },
    "yam": {"model": "yam"},
}
"""The arm's entry in the rig."""


@contextlib.contextmanager
def rig_file(arm: str) -> Iterator[str]:
    """Yield the path of a rig with one arm on a bus of its own."""
    channel = f"239.74.{os.getpid() // 256 % 256}.{os.getpid() % 256}"
    entry = {**RIGS[arm], "real": {"interface": "udp_multicast", "channel": channel}}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rig.yaml"
        file.write_text(yaml.safe_dump({"sim": False, "robots": {"arm": entry}}))
        yield str(file)


@contextlib.contextmanager
def emulator(rig: str) -> Iterator[None]:
    """Run the emulator of a rig."""
    command = [sys.executable, "-m", "hal.drivers.can.emulator", "--config", rig]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if not any(line.startswith("ready:") for line in process.stdout):
                raise SystemExit("the emulator did not start")
            threading.Thread(target=process.stdout.read, daemon=True).start()
            yield
        finally:
            process.terminate()
            process.wait(5.0)


def drive(rig_path: str, seconds: float) -> dict[str, Any]:
    """Move all joints and the gripper for ``seconds``, and return the figures of the arm's process."""
    with hal.open(rig_path, pad="none") as rig:
        arm = rig.robots["arm"]
        center = arm.home
        arm.move_to(center, unattended=True, speed=0.3)
        room = np.minimum(np.array(arm.spec.limits.upper) - center, center - np.array(arm.spec.limits.lower))
        swing = np.clip(0.8 * room, 0.0, 0.15)
        rates = np.linspace(0.7, 1.7, len(center))
        with arm.control(rate_hz=50, unattended=True) as control:
            before = rig.statistics()["arm"]
            start = rig.clock.now()
            for tick in rig.clock.rate(50):
                t = tick.t - start
                grip = 0.5 + 0.4 * np.sin(0.8 * t) if arm.gripper is not None else None
                control.send(hal.JointTarget(center + swing * np.sin(rates * t)), grip=grip)
                if t > seconds:
                    break
            after = rig.statistics()["arm"]
    old, new = before["robots"]["arm"]["driver"], after["robots"]["arm"]["driver"]
    counters = {name: new[name] - old[name] for name in ("cycles", "incomplete", "missing", "late", "doubled")}
    ticks = {name: after[name] - before[name] for name in ("ticks", "missed")}
    return {**ticks, **counters, "read_and_write_s": new["read_and_write_s"], "bus": new["bus"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rig", choices=sorted(RIGS), default="openarm")
    options = parser.parse_args()
    with rig_file(options.rig) as path, emulator(path):
        found = drive(path, options.seconds)
    times = found["read_and_write_s"]
    print(f"{options.rig}, {options.seconds:g} s over udp_multicast, emulator in another process")
    print(f"  ticks            {found['ticks']}, missed {found['missed']} ({found['missed'] / found['ticks']:.3%})")
    print(
        f"  cycles           {found['cycles']}, incomplete {found['incomplete']} "
        f"({found['incomplete'] / max(1, found['cycles']):.3%}); late replies {found['late']} of {found['missing']}"
    )
    print(
        "  read + write     "
        + ", ".join(f"{name} {1e3 * value:.3f} ms" for name, value in times.items() if isinstance(value, float))
    )
    print(f"  bus              {found['bus']}")


if __name__ == "__main__":
    main()
