"""Emulated UFACTORY control boxes for tests: each a process of its own at a loopback address of its own."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from hal_emulators.control import EmulatorControl

from .franka_kit import END_LIMIT, free_host

__all__ = ["XArmEmulator"]

PORTS = (502, 30001, 30002, 30003, 1339)


class XArmEmulator:
    """A running emulator. ``options`` are those of its command line."""

    def __init__(self, *options: str, model: str = "xarm7") -> None:
        pytest.importorskip("xarm", reason="needs xarm-python-sdk: pip install 'robot-hal[xarm]'")
        try:
            self.host, self.model = free_host(PORTS), model
        except RuntimeError:  # for ordinary users
            pytest.skip("may not listen at port 502: sudo sysctl net.ipv4.ip_unprivileged_port_start=502")
        command = [sys.executable, "-m", "hal_emulators.xarm", "--host", self.host, *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("ready:"), line
        self.control = EmulatorControl(self.host)

    def rig(self, **real: Any) -> dict[str, Any]:
        """Return a rig with this arm."""
        return {"sim": False, "robots": {"arm": {"model": self.model, "real": {"host": self.host, **real}}}}

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
