"""The reason of a motion's end is reported at least once, however short it was, and is true."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from waiting import wait_until

import hal
from hal.config import load
from hal.driver import Setpoint
from hal.drivers.franka.arm import FrankaArm
from hal.drivers.franka.link import ArmLink, ArmMode, ArmSample, StreamKind
from hal.types import RobotStatus

from .franka_kit import Emulator
from .rig_kit import Drive, arm_of, rig_of, settled

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")
pytestmark = pytest.mark.alone

HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
ZERO = (0.0,) * 7


class ScriptedLink(ArmLink):
    """A robot whose next states are given, and whose motion ends with a user stop."""

    owns_loop = True

    def __init__(self, modes: list[ArmMode]) -> None:
        super().__init__()
        self.modes = modes
        self.t = 1.0
        self.started = 0

    def connect(self, host: str) -> None: ...

    def read(self) -> ArmSample:
        self.t += 1e-3
        mode = self.modes.pop(0) if len(self.modes) > 1 else self.modes[0]
        values: dict[str, Any] = dict.fromkeys(ArmSample._fields, ZERO)
        values |= {"t": self.t, "mode": mode, "q": HOME, "q_d": HOME, "success_rate": 1.0}
        return ArmSample(**values)

    def start(self, kind: StreamKind) -> None:
        self.started += 1
        self.motion = kind

    def send(self, values: Sequence[float]) -> None: ...

    def finish(self) -> None: ...

    def run(self, turn: Callable[[], None]) -> None:
        self.abandon()
        raise RuntimeError("libfranka: Move command aborted: User Stop pressed!")

    def errors(self, names: Sequence[str]) -> list[str]:
        return []

    def configure(self, settings: object) -> None: ...


def test_a_brief_user_stop_is_still_reported() -> None:
    """It was seen once, by the driver itself; in the next state it is released. The servo has to hear of it."""
    plan = load("franka_emulator", overrides=["robots.arm.model=panda", "cameras={}"]).resolve()
    arm = FrankaArm(plan.robots[0])
    link = ScriptedLink([ArmMode.MOVE, ArmMode.USER_STOPPED, ArmMode.IDLE])
    arm._connection.link = link
    arm.wait()
    arm.read(0.0)
    link.motion = StreamKind.POSITION
    arm.loop(lambda: None)
    arm.wait()
    reading = arm.read(0.0)
    assert reading.fault is not None, "the user stop that ended the motion is not reported"
    arm.write(Setpoint(HOME, ZERO, ZERO))
    assert link.started == 0, "it continues by itself"


def test_a_raised_error_is_not_reported_again() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm = rig.robots["panda"]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with arm.control(rate_hz=50, unattended=True) as control, pytest.raises(hal.RobotFault):
                for tick in rig.clock.rate(50):
                    if tick.elapsed > 0.1:
                        rig.driver("panda").inject(fault="a contact")
                    control.send(hal.Twist(linear=[0.0, 0.0, 0.02]))


def test_the_share_that_came_in_time_is_not_from_before_the_loss() -> None:
    with Emulator() as emulator, rig_of(emulator.host) as rig:
        arm = arm_of(rig)
        drive = Drive(arm)
        struck: list[float] = []

        def strike() -> bool:
            again = not struck or time.monotonic() > struck[-1] + 1.0  # the emulator may have slept through it
            if again and abs(arm.state(5.0).tcp_twist[1]) > 0.03:
                struck.append(time.monotonic())
                emulator.control.send("silence 0.05")
            return False

        drive.go(rig, 5.0, until=strike)
        assert "in a row" in str(drive.error)
        assert "100% of the last 100" not in str(drive.error)
        settled(arm)


def test_a_robot_that_comes_back_with_another_tool_is_not_driven() -> None:
    with Emulator() as emulator, rig_of(emulator.host) as rig:
        arm = arm_of(rig)
        emulator.close()
        with Emulator("--end-effector", "none", host=emulator.host) as other:

            def answers() -> bool:
                try:
                    return arm.state().status is not RobotStatus.LOST
                except hal.HalError as error:
                    return "tool centre point" in str(error)

            wait_until(answers, "back")
            with pytest.raises(hal.HalError, match="tool centre point"):
                Drive(arm).go(rig, 0.3)
                raise arm_error(arm)
            assert not other.events("motion started")


def arm_error(arm: hal.Robot) -> Exception:
    """What its state raises."""
    try:
        arm.state()
    except hal.HalError as error:
        return error
    return AssertionError("it is driven as if nothing had changed")
