"""Emulated UR controllers for tests: each a process of its own at a loopback address of its own."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from hal_emulators.control import EmulatorControl

from .franka_kit import END_LIMIT, free_host

__all__ = ["UrEmulator"]

PORTS = (30001, 30002, 30003, 30004, 29999, 1339)


class UrEmulator:
    """A running emulator of an arm. ``options`` are further ones of its command line."""

    def __init__(self, *options: str, robot: str = "ur5e") -> None:
        pytest.importorskip("rtde_control", reason="needs ur_rtde: pip install 'robot-hal[ur]'")
        self.host, self.robot = free_host(PORTS), robot
        command = [sys.executable, "-m", "hal_emulators.ur", "--host", self.host, "--robot", robot, *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("ready:"), line
        self.control = EmulatorControl(self.host)

    def rig(self, **real: Any) -> dict[str, Any]:
        """Return a rig with this arm."""
        arm = {"model": self.robot, "real": {"host": self.host, **real}, "gripper": {"enabled": False}}
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
