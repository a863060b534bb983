"""Emulated arms on servo buses for tests: in this process, stepped by the test, or in a process of their own."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from unittest.mock import patch

from hal.config import load
from hal.drivers.servo_bus import bus
from hal.drivers.servo_bus.leader import ServoLeader
from hal.specs import RobotSpec
from hal_emulators.control import EmulatorControl
from hal_emulators.servo_bus import servo
from hal_emulators.servo_bus.server import ServoBusEmulator, find_arms

__all__ = ["ServoBusProcess", "SteppedServos", "servo_bus_overrides", "so101_leader"]

_numbers = itertools.count(1)


def servo_bus_overrides() -> list[str]:
    """Return overrides that put the arm of a rig on a port that no other test uses, without camera and pad."""
    port = Path(gettempdir(), f"servos-{os.getpid()}-{next(_numbers)}.emulated")
    return ["cameras={}", "gamepads={}", f"robots.arm.real.port={port}"]


@cache
def _find_arm(rig: str) -> RobotSpec:
    (spec,) = find_arms(rig, servo_bus_overrides())
    return spec


class SteppedServos(ServoBusEmulator):
    """An emulator that answers at once, and whose arm moves only when it is told to.

    Attributes:
        spec: The arm's record, for a driver.
    """

    def __init__(self, rig: str = "so101", **gripper: Any) -> None:
        """Create it; ``gripper`` has changes of the gripper's record."""
        spec = _find_arm(rig)
        assert spec.gripper is not None
        self.spec = replace(spec, gripper=replace(spec.gripper, **gripper))
        super().__init__([self.spec], paced=False)
        self.arm = self.arms["arm"]
        self._patience = patch.multiple(bus, _ANSWER=2.0), patch.multiple(servo, _BOOT=0.0)

    def __enter__(self) -> SteppedServos:
        for part in self._patience:  # no answer is late because this computer is busy
            part.start()
        super().__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        for part in self._patience:
            part.stop()


def so101_leader(emulator: SteppedServos, **entry: Any) -> ServoLeader:
    """Return the driver of a leader whose motors are those of an emulated arm; ``entry`` has more of its entry."""
    leader = {"model": "so101_leader", "port": emulator.arm.port, **entry}
    return ServoLeader(load({"leaders": {"lead": leader}}).resolve().pads[0])


class ServoBusProcess:
    """A running ``python -m hal_emulators.servo_bus``, also as a context manager.

    Attributes:
        rig: Its rig.
        overrides: For :func:`hal.open` of it.
        port: Where it is.
    """

    def __init__(self, rig: str = "so101", overrides: Sequence[str] = ()) -> None:
        self.rig = rig
        self.overrides = [*overrides] or servo_bus_overrides()
        self.port = self.overrides[-1].partition("=")[2]
        options = [word for value in self.overrides for word in ("--set", value)]
        command = [sys.executable, "-m", "hal_emulators.servo_bus", "--config", rig, *options]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("ready:"), line
        self._control = EmulatorControl("127.0.0.1", int(line.partition("control port ")[2].partition(";")[0]))

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator."""
        return self._control.send(line)

    def __enter__(self) -> ServoBusProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._control.close()
        self.process.terminate()
        self.process.wait(10.0)
        assert self.process.stdout is not None
        self.process.stdout.close()
