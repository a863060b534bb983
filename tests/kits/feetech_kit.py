"""Emulated SO-101s for tests: in this process, in real time or stepped by the test, or in a process of their own."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from unittest.mock import patch

from hal.config import load
from hal.drivers.feetech import bus
from hal.drivers.feetech.leader import FeetechLeader
from hal.specs import RobotSpec
from hal_emulators.control import EmulatorControl
from hal_emulators.feetech.server import FeetechEmulator, find_arms

__all__ = ["FeetechProcess", "SteppedFeetech", "feetech_overrides", "so101_leader"]

_numbers = itertools.count(1)


def feetech_overrides() -> list[str]:
    """Return overrides that put the arm of ``so101`` on a port that no other test uses, without camera and pad."""
    port = Path(gettempdir(), f"feetech-{os.getpid()}-{next(_numbers)}.emulated")
    return ["cameras={}", "gamepads={}", f"robots.arm.real.port={port}"]


@cache
def _find_arm() -> RobotSpec:
    (spec,) = find_arms("so101", feetech_overrides())
    return spec


class SteppedFeetech(FeetechEmulator):
    """An emulator that answers at once, and whose arm moves only when it is told to.

    Attributes:
        spec: The arm's record, for a driver.
    """

    def __init__(self, **gripper: Any) -> None:
        """Create it; ``gripper`` has changes of the gripper's record."""
        spec = _find_arm()
        assert spec.gripper is not None
        self.spec = replace(spec, gripper=replace(spec.gripper, **gripper))
        super().__init__([self.spec], paced=False)
        self.arm = self.arms["arm"]
        self._patience = patch.object(bus, "_ANSWER", 2.0)

    def __enter__(self) -> SteppedFeetech:
        self._patience.start()  # no answer is late because this computer is busy
        super().__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._patience.stop()


def so101_leader(emulator: SteppedFeetech) -> FeetechLeader:
    """Return the driver of a leader whose motors are those of an emulated arm."""
    rig = {"leaders": {"lead": {"model": "so101_leader", "port": emulator.arm.port}}}
    return FeetechLeader(load(rig).resolve().pads[0])


class FeetechProcess:
    """A running ``python -m hal_emulators.feetech``, also as a context manager.

    Attributes:
        overrides: For :func:`hal.open` of ``so101``.
        port: Where it is.
    """

    def __init__(self) -> None:
        self.overrides = feetech_overrides()
        self.port = self.overrides[-1].partition("=")[2]
        options = [word for value in self.overrides for word in ("--set", value)]
        command = [sys.executable, "-m", "hal_emulators.feetech", "--config", "so101", *options]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("ready:"), line
        self._control = EmulatorControl("127.0.0.1", int(line.partition("control port ")[2].partition(";")[0]))

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator."""
        return self._control.send(line)

    def __enter__(self) -> FeetechProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._control.close()
        self.process.terminate()
        self.process.wait(10.0)
        assert self.process.stdout is not None
        self.process.stdout.close()
