"""Emulated UR controllers and UFACTORY control boxes for tests: processes at loopback addresses of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest

import hal
from hal_emulators.control import EmulatorControl

from .franka_kit import END_LIMIT, free_host

__all__ = ["UR_PORTS", "UrEmulator", "XArmEmulator", "check_same_poses", "kill_app"]

UR_PORTS = (30001, 30002, 30003, 30004, 29999, 1339)
_XARM_PORTS = (502, 30001, 30002, 30003, 1339)
_APP = """
import json, sys, hal
with hal.open(json.loads(sys.argv[1])) as rig, rig.robots["arm"].control(rate_hz=50, unattended=True) as control:
    for tick in rig.clock.rate(50):
        control.send(hal.JointVelocity([0, 0, 0, 0.1, *[0] * (rig.robots["arm"].n - 4)]))
"""


class _NetworkEmulator:
    """A running emulator. ``options`` are those of its command line."""

    without_gripper: ClassVar[dict[str, Any]] = {}
    """What a rig's entry has if its model has a gripper."""

    def __init__(self, module: str, host: str, model: str, *options: str) -> None:
        self.host, self.model = host, model
        command = [sys.executable, "-m", f"hal_emulators.{module}", "--host", self.host, *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("ready:"), line
        self.control = EmulatorControl(self.host)

    def rig(self, **real: Any) -> dict[str, Any]:
        """Return a rig with this arm, without a gripper."""
        arm = {"model": self.model, "real": {"host": self.host, **real}, **self.without_gripper}
        return {"sim": False, "robots": {"arm": arm}}

    def status(self) -> dict[str, Any]:
        """Return what the arm does."""
        return self.control.send("status")

    def wait_for(self, what: Callable[[dict[str, Any]], bool], timeout: float = 5.0) -> dict[str, Any]:
        """Wait until the status is as wanted, and return it."""
        end = time.monotonic() + timeout
        while not what(status := self.status()):
            assert time.monotonic() < end, status
            time.sleep(0.002)
        return status

    def close(self) -> None:
        """End it."""
        self.control.close()
        self.process.terminate()
        self.process.wait(END_LIMIT)


class UrEmulator(_NetworkEmulator):
    """A running emulator of a UR arm. ``options`` are further ones of its command line."""

    without_gripper: ClassVar[dict[str, Any]] = {"gripper": {"enabled": False}}

    def __init__(self, *options: str, robot: str = "ur5e") -> None:
        pytest.importorskip("rtde_control", reason="needs ur_rtde: pip install 'robot-hal[ur]'")
        super().__init__("ur", free_host(UR_PORTS), robot, "--robot", robot, *options)


class XArmEmulator(_NetworkEmulator):
    """A running emulator of a UFACTORY arm. ``options`` are those of its command line."""

    def __init__(self, *options: str, model: str = "xarm7") -> None:
        pytest.importorskip("xarm", reason="needs xarm-python-sdk: pip install 'robot-hal[xarm]'")
        try:
            host = free_host(_XARM_PORTS)
        except RuntimeError:  # for ordinary users
            pytest.skip("may not listen at port 502: sudo sysctl net.ipv4.ip_unprivileged_port_start=502")
        super().__init__("xarm", host, model, *options)


def kill_app(emulator: _NetworkEmulator) -> None:
    """Kill a program that moves the arm, and wait until the arm rests."""
    with subprocess.Popen([sys.executable, "-c", _APP, json.dumps(emulator.rig())]) as app:
        emulator.wait_for(lambda status: max(status["dq"]) > 0.05, 30.0)
        app.kill()
    emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3, 1.0)


def check_same_poses(emulator: _NetworkEmulator, *changes: Sequence[float]) -> None:
    """Check that one program ends at the same poses, so far from home, on the arm and in simulation."""

    def run(rig: hal.Rig) -> list[hal.RobotState]:
        arm, found = rig.robots["arm"], []
        for change in (*changes, [0.0] * rig.robots["arm"].n):
            arm.move_to(arm.home + change, unattended=True, speed=0.3)
            rig.clock.sleep(0.3)
            found.append(arm.state())
        return found

    with hal.open(emulator.rig()) as rig:
        real = run(rig)
    with hal.open(emulator.rig(), sim=True, clock="lock_step") as rig:
        simulated = run(rig)
    off = max(float(np.abs(a.q - b.q).max()) for a, b in zip(real, simulated, strict=True))
    apart = max(a.tcp.distance(b.tcp)[0] for a, b in zip(real, simulated, strict=True))
    print(f"{1e3 * apart:.3f} mm, {off:.5f} rad")
    assert off < 0.003
    assert apart < 0.001
