"""An emulator of a CAN arm that advances only when a test lets it, so that nothing waits and nothing is late.

Driver and emulator run in one thread, on python-can's ``virtual`` bus. Where a driver waits for the emulator, which it
does only while it opens, closes or clears errors, a clock of the kit takes the place of the module ``time``.

with SteppedEmulator("yam") as far:
    driver = DamiaoArm(far.spec)
    driver.open()
    far.advance(0.004)
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from can_kit import can_overrides
from numpy.typing import NDArray

from hal.clock import LockStepClock
from hal.commands import Command
from hal.config.loader import load
from hal.drivers.can import damiao_chain, piper_link
from hal.errors import ConnectionLost, HalError, MotionStopped, RobotFault
from hal.gripper import Gripper
from hal.host import cycle as host_cycle
from hal.host.hosts import LocalHost
from hal.robot import Robot
from hal.specs import GroupSpec, RobotSpec
from hal_emulators import control
from hal_emulators.can import console, server

Array = NDArray[np.float64]


class SteppedEmulator:
    """The emulator of a rig's first arm, and its time.

    Attributes:
        spec: The arm's record, for a driver.
        arm: The emulated arm.
        bus: Its bus.
        passed: Time that has passed, s.
    """

    def __init__(self, rig: str) -> None:
        overrides = can_overrides("virtual")
        self.emulator = server.CanEmulator(rig, overrides)
        self.spec: RobotSpec = load(rig, sim=False, overrides=overrides).resolve().robots[0]
        self.arm: Any = self.emulator.arms[self.spec.name]
        self.bus = self.emulator.bus_of(self.arm)
        self.passed = 0.0
        self._patches = contextlib.ExitStack()

    def advance(self, seconds: float) -> None:
        """Let time pass; parts of a millisecond are rounded up."""
        seconds = max(seconds, 1e-3)
        self.passed += seconds
        self.bus.advance(seconds)

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator's console."""
        return self.emulator.execute(line)

    def cut(self, state: str) -> None:
        """Let no frame pass (``on``), or all (``off``)."""
        self.execute(f"cut {state}")

    def __enter__(self) -> SteppedEmulator:
        clock = SimpleNamespace(monotonic=lambda: 1000.0 + self.passed, sleep=self.advance)
        self.clock = clock
        for module in (damiao_chain, piper_link, server, console, control, host_cycle):
            self._patches.enter_context(patch.object(module, "time", clock))
        self.bus.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.stop()
        self._patches.close()


class SteppedArm:
    """An arm with Damiao motors in lock-step with its emulator, moved by a session at 50 Hz.

    Attributes:
        far: The emulator.
        host: The arm's host.
        robot: The arm, as a program has it.
        driver: Its driver.
        control: A session, which is not open.
    """

    def __init__(self, far: SteppedEmulator, grips: bool = False) -> None:
        """Open it, with its gripper if ``grips``."""
        self.far = far
        gripper = far.spec.gripper if grips else None
        spec = replace(far.spec, gripper=gripper, workspace=None)  # an arm that sank may be below the table
        grippers = () if gripper is None else (gripper,)
        self.host = LocalHost(GroupSpec("arm", "lock_step", spec.rate_hz, (spec,), None, grippers))
        cycle = self.host.cycle
        step = cycle.step

        def step_both(*arguments: Any) -> None:
            far.advance(cycle.dt)
            step(*arguments)
            for unit in cycle.grippers.values():
                unit.publish(cycle.t)  # a CAN gripper is driven when it is read, in real time in every cycle

        cycle.step = step_both  # type: ignore[method-assign]
        self.clock = LockStepClock(self.host.now, self.host.advance_to)
        hand = None if gripper is None else Gripper(gripper, spec.name, self.host, self.clock)
        self.robot = Robot(spec, self.host, self.clock, hand)
        self.driver: Any = cycle.arms[spec.name].driver
        self.control = self.robot.control(rate_hz=50, unattended=True)

    @property
    def q(self) -> Array:
        """The true position of the plant (n,), rad."""
        return np.array(self.far.arm.plant.q)

    @property
    def dq(self) -> Array:
        """The true velocity of the plant (n,), rad/s."""
        return np.array(self.far.arm.plant.dq)

    def run(self, seconds: float, command: Command | None = None) -> HalError | None:
        """Let time pass; send ``command`` 50 times a second until the session raises, and return that error."""
        for _ in range(round(seconds / 0.02)):
            if command is not None:
                try:
                    self.control.send(command)
                except (MotionStopped, RobotFault, ConnectionLost) as error:
                    return error
            self.clock.sleep(0.02)
        return None


def take_for_off(driver: Any) -> None:
    """Let a Damiao driver believe that its motors are off: otherwise its close lowers the arm for up to six seconds."""
    if hasattr(driver, "chain"):
        for motor in driver.chain.motors:
            motor.on = False


@contextlib.contextmanager
def stepped_arm(rig: str = "yam") -> Iterator[SteppedArm]:
    """Yield an arm whose session is open."""
    with SteppedEmulator(rig) as far:
        arm = SteppedArm(far)
        try:
            with arm.control:
                yield arm
                take_for_off(arm.driver)
        finally:
            arm.host.close()
