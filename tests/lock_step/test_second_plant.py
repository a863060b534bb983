"""CAN arms on a plant that shares no code with the emulator: its frames and its mechanics are written again here.

The layout of the frames is that of the vendors' public code (openarm_can, i2rt, piper_sdk), the mechanics are
pinocchio's articulated-body algorithm. Unlike the emulator's motors, a motor here lets go if its error is cleared while
it is on.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import can
import numpy as np
import pinocchio as pin
import pytest
from can_kit import can_overrides
from stepped_can import SteppedArm, take_for_off

import hal
from hal.config.loader import load
from hal.drivers.can import damiao_chain, piper_link
from hal.errors import MotionStopped, RobotFault
from hal.specs import RobotSpec

TURN = hal.JointVelocity([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
STILL = hal.JointVelocity([0.0] * 6)
pytestmark = pytest.mark.filterwarnings("ignore:arm was stopped")
SAFE = 0.5
"""Greatest speed of a joint, rad/s."""
STEP = 5e-4
"""Of the mechanics, s."""
ENABLE, DISABLE, CLEAR = 0xFC, 0xFD, 0xFB


class Plant:
    """A rigid-body arm on a bus. It is on a stand until :meth:`torques` first carries it."""

    def __init__(self, rig: str, rotor: Sequence[float], friction: Sequence[float]) -> None:
        self.spec: RobotSpec = load(rig, sim=False, overrides=can_overrides("virtual")).resolve().robots[0]
        full = pin.buildModelFromUrdf(self.spec.kinematics.urdf)
        others = [k for k in range(1, full.njoints) if full.names[k] not in self.spec.joints]
        self.model: Any = pin.buildReducedModel(full, others, pin.neutral(full))
        self.model.armature = np.array(rotor)
        self.data = self.model.createData()
        self.friction = np.array(friction)
        self.q, self.dq, self.peak = np.array(self.spec.initial), np.zeros(6), np.zeros(6)
        self.lower, self.upper = self.model.lowerPositionLimit.copy(), self.model.upperPositionLimit.copy()
        self.standing = True
        self.passed = 0.0
        self.arm = SimpleNamespace(plant=self)
        self.bus = can.Bus(interface="virtual", channel=self.spec.options["channel"])

    def take(self, id: int, data: bytes) -> None:
        """Take a frame."""

    def pass_time(self, dt: float) -> None:
        """Let the electronics work for ``dt``, s."""

    def torques(self) -> Any:
        """Return the motors' torques (6,), Nm."""

    def send(self, id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=id, data=data, is_extended_id=False))

    def advance(self, seconds: float) -> None:
        """Take the frames that came, and let time pass."""
        for _ in range(max(1, round(seconds / 1e-3))):
            self.passed += 1e-3
            while (frame := self.bus.recv(0.0)) is not None:
                self.take(frame.arbitration_id, bytes(frame.data))
            self.pass_time(1e-3)
            for _ in range(0 if self.standing else round(1e-3 / STEP)):
                tau = self.torques() - self.friction * np.tanh(self.dq / 0.01)
                beyond = self.q - np.clip(self.q, self.lower, self.upper)
                tau -= 3000.0 * beyond + 4.0 * self.dq * (beyond != 0.0)
                self.dq = self.dq + STEP * pin.aba(self.model, self.data, self.q, self.dq, tau)
                self.q = self.q + STEP * self.dq
                self.peak = np.maximum(self.peak, abs(self.dq))


class Yam(Plant):
    """Six Damiao motors: DM4340 at the shoulder and the elbow, DM4310 at the wrist."""

    RANGES = ((12.5, 10.0, 28.0),) * 3 + ((12.5, 30.0, 10.0),) * 3
    SHORTED = np.array([15.0] * 3 + [1.2] * 3)
    """Damping of a motor after its TIMEOUT, Nm s/rad; chosen."""

    def __init__(self) -> None:
        super().__init__("yam", [0.02] * 3 + [0.002] * 3, [0.2] * 3 + [0.05] * 3)
        self.status, self.silence, self.tau = [0] * 6, [0.0] * 6, np.zeros(6)
        self.drives: list[tuple[float, ...]] = [(0.0,) * 5] * 6
        self.broken: set[int] = set()
        """Motors that do not switch on."""

    def take(self, id: int, data: bytes) -> None:
        if id == 0x7FF:
            k = (data[0] | data[1] << 8) - 1
            if 0 <= k < 6 and data[2] == 0xCC:
                self.report(k)
            elif 0 <= k < 6 and data[2] == 0x33:
                p, v, t = self.RANGES[k]
                value = {7: k + 0x11, 8: k + 1, 9: 8000, 10: 1, 21: p, 22: v, 23: t}.get(data[3], 100.0)
                self.send(k + 0x11, data[:4] + struct.pack("<I" if isinstance(value, int) else "<f", value))
        elif 1 <= id <= 6:
            k = id - 1
            self.silence[k] = 0.0
            if data[:7] == b"\xff" * 7:
                self.switch(k, data[7])
            elif self.status[k] == 1:
                self.drives[k] = self.unpack(k, data)
            self.report(k)

    def switch(self, k: int, code: int) -> None:
        if code == ENABLE and self.status[k] == 0 and k not in self.broken:
            self.status[k], self.drives[k] = 1, (0.0,) * 5
            self.standing = self.standing and 0 in self.status
        elif code in (DISABLE, CLEAR):
            self.status[k] = 0

    def unpack(self, k: int, d: bytes) -> tuple[float, ...]:
        """Return position, speed, stiffness, damping and torque of a command."""
        numbers = (
            (d[0] << 8 | d[1], 65535),
            (d[2] << 4 | d[3] >> 4, 4095),
            ((d[3] & 15) << 8 | d[4], 4095),
            (d[5] << 4 | d[6] >> 4, 4095),
            ((d[6] & 15) << 8 | d[7], 4095),
        )
        p, v, t = self.RANGES[k]
        spans = ((-p, p), (-v, v), (0.0, 500.0), (0.0, 5.0), (-t, t))
        return tuple(low + u * (high - low) / most for (u, most), (low, high) in zip(numbers, spans, strict=True))

    def report(self, k: int) -> None:
        p, v, t = self.RANGES[k]
        q = int((self.q[k] + p) / (2 * p) * 65535)
        dq = int((np.clip(self.dq[k], -v, v) + v) / (2 * v) * 4095)
        tau = int((np.clip(self.tau[k], -t, t) + t) / (2 * t) * 4095)
        head = bytes([self.status[k] << 4 | k + 1, q >> 8, q & 255, dq >> 4])
        self.send(k + 0x11, head + bytes([(dq & 15) << 4 | tau >> 8, tau & 255, 30, 30]))

    def pass_time(self, dt: float) -> None:
        self.silence = [silence + dt for silence in self.silence]
        self.status = [13 if s == 1 and t > 0.4 else s for s, t in zip(self.status, self.silence, strict=True)]

    def torques(self) -> Any:
        q, dq, kp, kd, tau = np.array(self.drives).T
        status, most = np.array(self.status), np.array([t for _, _, t in self.RANGES])
        driven = np.clip(kp * (q - self.q) + kd * (dq - self.dq) + tau, -most, most)
        self.tau = np.where(status == 1, driven, np.where(status == 13, -self.SHORTED * self.dq, 0.0))
        return self.tau


class Piper(Plant):
    """The PiPER's controller goes to its target at 2 rad/s, stiffly, and carries its own weight."""

    def __init__(self) -> None:
        super().__init__("piper", [0.05] * 6, [0.2] * 6)
        self.target = self.goal = self.q.copy()
        self.on = self.joined = False
        self.error = 0
        """Code of the arm's state; with one, it takes no targets."""
        self.age = 0

    def take(self, id: int, data: bytes) -> None:
        if id == 0x471:
            self.on = self.on or data[1] == 2
            self.standing = self.standing and not self.on
        elif id == 0x151:
            self.joined = data[0] == 1 and data[1] == 1
        elif id == 0x475 and data[5] == 0xAE:
            self.error = 0
        elif id in (0x155, 0x156, 0x157) and self.joined and not self.error:
            self.target[2 * (id - 0x155) :][:2] = np.radians(np.array(struct.unpack(">ii", data)) * 1e-3)

    def pass_time(self, dt: float) -> None:
        self.age += 1
        self.goal = self.goal if self.error else self.goal + np.clip(self.target - self.goal, -2.0 * dt, 2.0 * dt)
        if self.age % 5:
            return
        self.send(0x2A1, bytes([int(self.joined), self.error, 1, 0, 0, 0, 0, 0]))
        for k, pair in enumerate(np.degrees(self.q).reshape(3, 2)):
            self.send(0x2A5 + k, struct.pack(">ii", *(round(1e3 * x) for x in pair)))
        for k in range(6):
            self.send(0x251 + k, struct.pack(">hhi", round(1e3 * self.dq[k]), 0, 0))
            if self.age % 25 == 0:
                self.send(0x261 + k, struct.pack(">HhbBH", 240, 30, 30, 64 * self.on, 0))

    def torques(self) -> Any:
        weight = pin.computeGeneralizedGravity(self.model, self.data, self.q)
        most = np.array([30.0] * 3 + [10.0] * 3)  # chosen
        return np.clip(weight + 2000.0 * (self.goal - self.q) - 60.0 * self.dq, -most, most) * self.on


@contextlib.contextmanager
def driven(plant: Plant) -> Iterator[SteppedArm]:
    """Yield an arm that turns about its vertical axis."""
    clock = SimpleNamespace(monotonic=lambda: 1000.0 + plant.passed, sleep=plant.advance)
    with contextlib.ExitStack() as stack:
        for module in (damiao_chain, piper_link):
            stack.enter_context(patch.object(module, "time", clock))
        stack.callback(plant.bus.shutdown)
        arm = SteppedArm(plant)  # type: ignore[arg-type]
        stack.callback(arm.host.close)
        with arm.control:
            assert arm.run(0.5, TURN) is None
            assert plant.dq[0] > 0.3
            yield arm
            take_for_off(arm.driver)


def block(plant: Plant) -> None:
    """Put something in the way of the first joint."""
    plant.upper[0] = plant.q[0]


def free(plant: Plant) -> None:
    """Take it away, and forget how fast the arm was."""
    plant.upper[0], plant.peak = 3.0, np.zeros(6)


def go_on(arm: SteppedArm) -> None:
    """Recover, and press again: the arm follows, and was never fast."""
    plant: Any = arm.far
    arm.robot.recover()
    arm.run(1.0)
    arm.control.rearm()
    at = plant.q[0]
    assert arm.run(1.0, STILL) is None
    assert plant.peak.max() <= SAFE
    assert arm.run(0.5, TURN) is None
    assert plant.q[0] > at + 0.1


@pytest.mark.parametrize("make", [Yam, Piper])
def test_an_arm_that_was_blocked_is_slow_once_it_is_free(make: type[Plant]) -> None:
    plant = make()
    with driven(plant) as arm:
        block(plant)
        assert isinstance(arm.run(3.0, TURN), RobotFault)
        assert arm.robot.state().fault.code == "not_following"
        arm.run(1.0)
        free(plant)
        arm.run(1.0)
        go_on(arm)


def test_a_piper_that_met_something_is_slow_after_recover() -> None:
    plant = Piper()
    with driven(plant) as arm:
        block(plant)
        assert arm.run(0.12, TURN) is None
        plant.error = 7
        assert isinstance(arm.run(1.0, TURN), RobotFault)
        plant.target = plant.target + [0.3, 0.0, 0.0, 0.0, 0.0, 0.0]
        arm.run(0.1)
        plant.goal = plant.q.copy()  # it gives way to a collision
        free(plant)
        go_on(arm)


def test_a_joint_that_pushes_is_slow_after_the_fault_of_another_one() -> None:
    plant = Yam()
    with driven(plant) as arm:
        block(plant)
        assert arm.run(0.3, TURN) is None
        plant.status[5] = 10
        assert isinstance(arm.run(1.0, TURN), RobotFault)
        arm.run(1.0)
        free(plant)
        arm.run(0.5)
        go_on(arm)


def test_motors_that_heard_nothing_are_recovered_without_a_fall() -> None:
    plant = Yam()
    with driven(plant) as arm:
        plant.advance(0.45)
        assert isinstance(arm.run(0.2, TURN), RobotFault)
        free(plant)
        go_on(arm)


@pytest.mark.parametrize("number", [2, 3, 5])
def test_a_motor_that_does_not_switch_on_leaves_the_others_holding(number: int) -> None:
    plant = Yam()
    with driven(plant) as arm:
        plant.advance(0.45)
        plant.broken = {number - 1}
        assert isinstance(arm.run(0.2, TURN), RobotFault)
        arm.robot.recover()
        arm.run(0.02)
        arm.control.rearm()
        assert isinstance(arm.run(2.0, STILL), MotionStopped)
        arm.run(1.5)  # the limp joint has fallen
        free(plant)
        arm.run(1.0)
        assert [status for k, status in enumerate(plant.status) if k != number - 1] == [1] * 5
        assert np.delete(plant.peak, number - 1).max() <= SAFE


@pytest.mark.parametrize("who", ["power", "foreign frame"])
def test_an_arm_whose_motors_were_switched_off_falls_and_its_fault_says_so(who: str) -> None:
    """Nothing can hold it: the fault names the motor, and the next press holds what is left."""
    plant = Yam()
    with driven(plant) as arm:
        free(plant)
        if who == "power":
            plant.status = [0] * 6
        else:
            other = can.Bus(interface="virtual", channel=plant.spec.options["channel"])
            other.send(can.Message(arbitration_id=2, data=b"\xff" * 7 + bytes([DISABLE]), is_extended_id=False))
            other.shutdown()
        assert isinstance(arm.run(0.3, TURN), RobotFault)
        fault = arm.robot.state().fault
        assert fault.code == "switched_off"
        assert "falls" in fault.cause
        assert ("motor 1" if who == "power" else "motor 2") in fault.cause
        while abs(plant.dq).max() > 0.01 or plant.peak[1] < SAFE:
            arm.run(0.1)
        arm.robot.recover()
        arm.run(0.1)
        arm.control.rearm()
        assert arm.run(1.0, STILL) is None
        assert plant.status == [1] * 6
