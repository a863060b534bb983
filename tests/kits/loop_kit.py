"""A program that drives an arm, for tests of what a user does; and the drivers of a laboratory's own devices.

The mock arm runs in lock-step, so the times are exact. The laboratory's arm counts as a real one: it has a process of
its own, in real time, and needs a dead-man. Its faults are those of the mock, and what can happen to its process.
"""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

import hal
from hal.driver import Reading, Setpoint
from hal.drivers.mock.gamepad import MockPad
from hal.drivers.mock.robot import MockRobot
from hal.registry import DriverSpec

TURN = hal.JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
PERIOD = 0.02
"""Of the program, s."""


class LabArm(MockRobot):
    """An arm that counts as real. ``inject`` also takes what happens to the computer or to the process."""

    simulated: ClassVar[bool] = False
    hangs = False

    def wait(self) -> None:
        time.sleep(60.0 if self.hangs else 0.004)

    def inject(self, **faults: Any) -> None:
        """Set faults of the mock, and these: ``suspend`` (s that the computer slept), ``hang`` (the library does not
        return, and paces the process), ``shorten`` ({"module:NAME": value}: limits that a test cannot wait for)."""
        seconds = faults.pop("suspend", 0.0)
        if seconds:
            clock, real = time.CLOCK_BOOTTIME, time.clock_gettime
            time.clock_gettime = lambda which: real(which) + seconds * (which == clock)
        for place, value in faults.pop("shorten", {}).items():
            module, _, name = place.partition(":")
            setattr(importlib.import_module(module), name, value)
        self.hangs = faults.pop("hang", self.hangs)
        super().inject(**faults)


class PacingArm(LabArm):
    """The same, whose library sets the pace."""

    paces_itself: ClassVar[bool] = True


class LabPad(MockPad):
    """A pad whose silence nobody notices, as of many on Bluetooth."""

    simulated: ClassVar[bool] = False
    proves_liveness = False


class LabPlayer(LabPad):
    """A recording."""

    simulated: ClassVar[bool] = True


ARM = DriverSpec("lab_arm", robot="loop_kit:LabArm")
PACING_ARM = DriverSpec("lab_pacing_arm", robot="loop_kit:PacingArm")
PAD = DriverSpec("lab_pad", gamepad="loop_kit:LabPad")
PLAYER = DriverSpec("lab_player", gamepad="loop_kit:LabPlayer")


def mock_rig(**overrides: Any) -> hal.Rig:
    """Open a Panda with a hand and a pad in lock-step; ``overrides`` are keys of the rig with ``__`` for the dot."""
    keys = {name.replace("__", "."): value for name, value in overrides.items()}
    return hal.open("panda_table", driver="mock", overrides={"cameras": {}, **keys})


def laboratory(driver: str = "ARM", pad: str | None = None, **keys: Any) -> hal.Rig:
    """Open a rig with the laboratory's arm, in real time; ``keys`` are the rig's."""
    arm = {"model": "panda", "drivers": {"real": f"loop_kit:{driver}"}, "gripper": {"enabled": False}}
    arm |= {"real": {"host": "127.0.0.1"}, **keys.pop("arm", {})}
    return hal.open({"sim": False, "robots": {"panda": arm}, **keys}, pad=pad)


class Loop:
    """A program that sends a command 50 times a second to an arm.

    Attributes:
        rig: The rig.
        arm: Its arm.
        control: The open session.
        command: What the program sends.
    """

    def __init__(self, rig: hal.Rig, control: hal.Control, command: hal.Command) -> None:
        self.rig, self.control, self.command = rig, control, command
        self.arm = control.robot
        self.grip: float | None = None
        self.has_deadman = control.deadman is not None

    @property
    def now(self) -> float:
        """Time of the rig's clock, s."""
        return self.rig.clock.now()

    @property
    def pad(self) -> MockPad:
        """The hand at the pad."""
        return self.rig.driver("pad")  # type: ignore[no-any-return]

    @property
    def device(self) -> MockRobot:
        """The arm's driver, in lock-step."""
        return self.rig.driver(self.arm.name)  # type: ignore[no-any-return]

    @property
    def log(self) -> list[Setpoint]:
        """What was written to the arm."""
        return list(self.device.log)

    @property
    def servo(self) -> Any:
        """The newest report of the servo, which is there when the arm is not."""
        return self.arm._mail.peek()

    @property
    def moves(self) -> bool:
        """Whether the set-point moves, or the measured arm that torques drive."""
        return bool(np.abs(self.servo.dq_set).max() > 1e-9)

    def wait(self, seconds: float) -> None:
        """Let time pass, without a command."""
        self.rig.clock.sleep(seconds)

    def drive(self, seconds: float = 0.4) -> hal.HalError | None:
        """Send the command until a call raises; return that error."""
        for _ in range(round(seconds / PERIOD)):
            try:
                self.control.send(self.command, grip=self.grip)
            except (hal.MotionStopped, hal.RobotFault, hal.ConnectionLost) as error:
                return error
            self.wait(PERIOD)
        return None

    def press(self) -> None:
        """Press the dead-man, and keep it pressed."""
        self.pad.press("l2")
        self.wait(0.05)

    def release(self) -> None:
        """Release the dead-man."""
        self.pad.release("l2")
        self.wait(0.05)

    def acknowledge(self) -> None:
        """Do what continues after a trip: release and press, or rearm."""
        if self.has_deadman:
            self.release()
            self.press()
        else:
            self.control.rearm()
            self.wait(PERIOD)

    def rest(self, most: float = 2.0) -> None:
        """Wait until nothing moves."""
        begun = self.now
        while self.moves:
            assert self.now < begun + most, "the arm did not come to rest"
            self.wait(0.01)

    def assert_stays(self, seconds: float = 0.3) -> None:
        """Go on sending, whatever the session says to that: the set-point must stay where it is."""
        at = list(self.servo.q_set)
        for _ in range(round(seconds / PERIOD)):
            self.drive(PERIOD)
            self.wait(PERIOD)
            assert not self.moves
        assert list(self.servo.q_set) == at

    def assert_continues(self) -> None:
        """The arm follows the command."""
        at = np.array(self.servo.q_set)
        assert self.drive(0.5) is None
        assert self.moves
        assert np.abs(np.array(self.servo.q_set) - at).max() > 0.01

    def alter(self, change: Callable[[Reading], Reading]) -> None:
        """Let the arm report something else, until :meth:`restore`."""
        read = MockRobot.read.__get__(self.device)
        self.device.read = lambda now: change(read(now))  # type: ignore[method-assign]

    def restore(self) -> None:
        """Let the arm report the truth."""
        self.device.__dict__.pop("read", None)


@contextlib.contextmanager
def driving(
    *, deadman: bool = False, command: hal.Command = TURN, rate_hz: float = 50.0, **overrides: Any
) -> Iterator[Loop]:
    """Yield a program whose arm moves in lock-step, with the dead-man held or without one."""
    with mock_rig(**overrides) as rig:
        rig.clock.sleep(0.1)
        switch = rig.gamepads["pad"].hold("l2") if deadman else None
        with rig.robots["panda"].control(deadman=switch, rate_hz=rate_hz) as control:
            loop = Loop(rig, control, command)
            if deadman:
                loop.press()
            assert loop.drive() is None
            assert loop.moves
            yield loop
