"""A whole rig with an emulated Franka, as a user opens it, without cameras and pads."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass

from waiting import wait_until

import hal
from hal.rig import Rig
from hal.robot import Robot
from hal.types import RobotState, RobotStatus


def rig_of(host: str, robot: str = "fr3", *more: str, lock_step: bool = False, sim: bool = False) -> Rig:
    """Open the emulator's rig without cameras and, unless ``more`` enables it, without its hand."""
    model = "panda" if robot == "panda" else "fr3"
    overrides = [f"robots.arm.model={model}", "cameras={}", f"robots.arm.real.host={host}"]
    overrides += [] if sim else ["robots.arm.gripper.enabled=false"]
    clock = "lock_step" if lock_step else "real_time"
    return hal.open("franka_emulator", sim=sim, pad="none", clock=clock, overrides=[*overrides, *more])


def arm_of(rig: Rig) -> Robot:
    """Return its arm."""
    return rig.robots["arm"]


@dataclass
class Drive:
    """An arm in motion: alternating twists, more often than it needs them, and the first error that the app got."""

    arm: Robot
    error: Exception | None = None
    t_error: float = 0.0
    """Time of the error on the monotonic clock, s."""
    t_stale: float = 0.0
    """Time of the first StaleStateError, s; 0 for none."""

    def go(self, rig: Rig, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Send for ``seconds``, or until a condition, or until the first error."""
        with contextlib.suppress(hal.HalError), self.arm.control(rate_hz=10, unattended=True) as control:
            start = rig.clock.now()
            for tick in rig.clock.rate(50):
                forth = int((tick.t - start) / 1.0) % 2 == 0
                try:
                    control.send(hal.Twist([0.0, 0.05 if forth else -0.05, 0.0]))
                    self.arm.state()
                except hal.StaleStateError:
                    self.t_stale = self.t_stale or time.monotonic()
                except hal.HalError as error:
                    self.error, self.t_error = error, time.monotonic()
                    return
                if until() or tick.t - start > seconds:
                    return


def settled(arm: Robot) -> RobotState:
    """Return its state once it is idle, in fault or lost."""
    wait_until(
        lambda: arm.state(max_age=5.0).status in (RobotStatus.IDLE, RobotStatus.FAULT, RobotStatus.LOST), "settled"
    )
    return arm.state(max_age=5.0)
