"""Benches for a Franka and its hand: the unmodified drivers and Franka's own libraries, against emulators."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from hal.config import load
from hal.testing import GripperBench, RobotBench

from ..wire.franka_kit import Emulator
from .apart import Apart

_AWAY = 0.3
"""Duration of a restart, s."""


class FR3:
    """An emulated robot that serves many checks, each as after switching on."""

    def __init__(self) -> None:
        pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
        self.emulator = Emulator("--lockstep", "--unpaced", robot="fr3")
        overrides = ["cameras={}", f"robots.arm.real.host={self.emulator.host}", "robots.arm.gripper.enabled=false"]
        self.spec = load("franka_emulator", overrides=overrides).resolve().robots[0]
        self._back_at = 0.0

    @contextmanager
    def arm(self) -> Iterator[RobotBench]:
        """Its driver, in a process of its own."""
        self._be_back()
        self.emulator.refresh()
        driver = Apart("hal.drivers.franka.arm:FrankaArm", self.spec)
        try:
            yield RobotBench(
                driver=driver, patience=10.0, lose=self._leave, restore=self._be_back, fail=self._fail_in_reflex
            )
        finally:
            driver.end()

    def _leave(self) -> None:
        self.emulator.control.send("restart", _AWAY)
        self._back_at = time.monotonic() + _AWAY

    def _be_back(self) -> None:
        time.sleep(max(0.0, self._back_at - time.monotonic()))

    def _fail_in_reflex(self) -> str:
        self.emulator.control.send("reflex joint_reflex")
        return "torque"

    def close(self) -> None:
        self.emulator.close()


@contextmanager
def franka_hand() -> Iterator[GripperBench]:
    """In real time, as the emulated hand is."""
    pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")
    from hal_emulators.franka.hand_fingers import FULL_WIDTH

    from ..wire.hand_kit import HandBench

    with HandBench(connect=False) as bench:
        fingers = bench.server.fingers
        fingers.width = FULL_WIDTH

        def restore() -> None:
            time.sleep(_AWAY)
            fingers.homed = True  # as done in Desk: a hand that was off is not homed

        yield GripperBench(
            driver=bench.hand,
            real_time=True,
            dt=0.01,
            patience=10.0,
            put_object=lambda width: bench.command(f"object {width}") and None,
            lose=lambda: bench.command(f"restart {_AWAY}") and None,
            restore=restore,
            freeze=lambda: bench.command("silence 30") and None,
        )
