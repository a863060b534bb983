"""An emulated arm with its gripper: the registers of its servos, and its mechanics. Time passes only in ``step``.

A servo's torque is its stiffness times the distance from its goal, within its torque limit, less the voltage that its
own speed induces. What Feetech's tables leave open is assumed: when an overload begins, and that switching the torque
on ends it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.drivers.feetech.bus import Answer
from hal.drivers.feetech.chain import COUNT, MODEL, STALL_TORQUES, STIFFNESS
from hal.drivers.feetech.settings import FeetechArmSettings, FeetechGripperSettings
from hal.specs import RobotSpec
from hal_emulators.can.plant import OFF, ArmPlant, Drive, GripperPlant, JointMechanics
from hal_emulators.shared_world import ArmInWorld

__all__ = ["EmulatedArm", "Servo"]

_STALL = STALL_TORQUES[12.0]
_SPEED = 4.7
"""Without a load, rad/s: 45 rpm."""
_MECHANICS = JointMechanics(inertia=0.006, coulomb=0.05, viscous=0.05, torque=_STALL)
"""Chosen."""
_SIZE, _EEPROM = 90, 40
_OVERLOAD, _OVERLOAD_TIME, _PROTECTED = 0.8, 2.0, 200
"""Share of the stall torque that is an overload after so many s, as delivered; then the torque limit, 1/1000."""


class Servo:
    """The registers of one servo, and its drive.

    Attributes:
        error: Bits of errors that are raised from outside.
        angle: Where its shaft is, counts within its present homing.
        voltage: Supply, 0.1 V.
        temperature: deg C
    """

    def __init__(self, id: int, homing: int, low: int, high: int) -> None:
        self.registers = bytearray(_SIZE)
        self.error = 0
        self.voltage, self.temperature = 121, 31
        self.angle, self.speed, self.torque = 0.0, 0.0, 0.0
        self.overloaded, self._strained = False, 0.0
        for address, value in ((0, 3), (1, 9), (5, id), (8, 1), (13, 70), (14, 140), (15, 40), (18, 12), (21, 32)):
            self.registers[address] = value
        offset = abs(homing) | (0x800 if homing < 0 else 0)
        for address, value in ((3, MODEL), (9, low), (11, high), (16, 1000), (31, offset)):
            self.put(address, value)
        self.restart()

    def word(self, address: int) -> int:
        """Return two registers."""
        return self.registers[address] | self.registers[address + 1] << 8

    def put(self, address: int, value: int) -> None:
        """Set two registers."""
        self.registers[address : address + 2] = (value & 0xFFFF).to_bytes(2, "little")

    def restart(self) -> None:
        """Become as after switching on: no torque."""
        self.registers[_EEPROM:] = bytes(_SIZE - _EEPROM)
        self.put(48, self.word(16))
        self.registers[55] = 1
        self._target = self.angle
        self.overloaded, self._strained = False, 0.0
        self.put(42, round(self.angle))

    @property
    def errors(self) -> int:
        """The bits that it reports."""
        wrong = not self.registers[15] <= self.voltage <= self.registers[14]
        hot = self.temperature > self.registers[13]
        return self.error | wrong | hot << 2 | self.overloaded << 5

    def read(self, address: int, size: int) -> bytes:
        """Return registers, with the present state."""
        speed, load = round(self.speed / COUNT), round(1000 * self.torque / _STALL)
        self.put(56, _sign(round(self.angle), 15))
        self.put(58, _sign(speed, 15))
        self.put(60, _sign(load, 10))
        self.registers[62], self.registers[63], self.registers[65] = self.voltage, self.temperature, self.errors
        self.registers[66] = abs(speed) > 5
        self.put(69, _sign(round(0.4 * load), 15))
        return bytes(self.registers[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        """Take registers; those of the EEPROM only while it is not locked."""
        for k, value in enumerate(data, address):
            if k < 56 and (k >= _EEPROM or not self.registers[55]):
                self.registers[k] = value
        if address <= 40 < address + len(data):
            self.overloaded, self._strained = False, 0.0

    def drive(self, dt: float, off: float) -> Drive:
        """Return what its motor does in a step of ``dt`` s; ``off`` is the joint's angle at the count 0, rad."""
        if not self.registers[40] or self.errors & 0x0D:
            self._target = self.angle
            return OFF
        goal = min(max(self.word(42), self.word(9)), self.word(11))
        step = self.word(46) * dt or 1e9
        self._target += min(max(goal - self._target, -step), step)
        limit = min(self.word(48), self.word(16), _PROTECTED if self.overloaded else 1000) / 1000 * _STALL
        stiffness, damping = STIFFNESS * self.registers[21], _STALL / _SPEED
        torque = stiffness * (self._target - self.angle) * COUNT
        self._strained = self._strained + dt if abs(self.torque) > _OVERLOAD * _STALL else 0.0
        self.overloaded |= self._strained > _OVERLOAD_TIME
        if abs(torque) > limit:
            return Drive(kd=damping, tau=limit if torque > 0.0 else -limit)
        return Drive(self._target * COUNT + off, 0.0, stiffness, damping)


def _sign(value: int, bit: int) -> int:
    return abs(value) | (1 << bit if value < 0 else 0)


class EmulatedArm:
    """An arm on a servo bus, and the gripper there.

    Attributes:
        servos: Its servos, by their ids.
        plant: The arm's mechanics.
        world: The simulated world that it is in; None for none.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        settings = FeetechArmSettings.of(spec)
        self.port = settings.port
        self.plant = ArmPlant(spec.kinematics, [_MECHANICS] * len(settings.ids), spec.initial, spec.base_orientation)
        if spec.payload is not None:
            self.plant.load(payload=(spec.payload.mass, spec.payload.position))
        self.servos: dict[int, Servo] = {}
        self._off: list[float] = []
        """Angle of each joint at the count 0, rad."""
        for k, id in enumerate(settings.ids):
            half = min(round(max(-self.plant.lower[k], self.plant.upper[k]) / COUNT), 2047)
            low, high = (0, 4095) if half > 1800 else (2047 - half, 2047 + half)
            self.servos[id] = Servo(id, 211 * k - 500, low, high)
            self._off.append(-0.5 * (low + high) * COUNT)
        self.joints = list(self.servos.values())
        self.jaw: GripperPlant | None = None
        self.object_width = 0.0
        gripper = spec.gripper
        if gripper is not None and gripper.driver == spec.driver:
            way = abs(gripper.opened[0] - gripper.closed[0])
            id = FeetechGripperSettings.of(gripper).id
            self.servos[id] = Servo(id, 77, 2000, 2000 + round(way / COUNT))
            self.jaw = GripperPlant(_MECHANICS, 0.5 * way, 0.0, way)
            self._way, self._jaw_servo = way, self.servos[id]
        self.world: ArmInWorld | None = None
        self.peak = [0.0] * len(self.joints)
        """Greatest speed of each joint since the last reset, rad/s."""
        self._hand: deque[tuple[float, NDArray[np.float64]]] = deque()
        """Motions that a hand still makes: duration, s, and where they end: the joints, rad, then the lever, 0 to 1."""
        self._begun, self._t_hand = np.zeros(0), 0.0
        self.place(spec.initial)

    def lead(self, seconds: float, end: Sequence[float]) -> None:
        """Let a hand move an arm without torque, after the motions that it makes already.

        Args:
            seconds: Duration of the motion.
            end: Where it ends: the joints, rad, and the lever from 0 (open) to 1 (closed), or only the joints.

        Raises:
            ValueError: The wrong number of values, or a motor has torque.
        """
        count = len(self.joints)
        if len(end) not in (count, count + 1) or not seconds > 0.0:
            raise ValueError(f"needs a duration, {count} angles and perhaps the lever")
        if any(servo.registers[40] for servo in self.servos.values()):
            raise ValueError("its motors have torque: no hand moves it")
        before = self._hand[-1][1] if self._hand else self._held
        self._hand.append((seconds, np.array([*end, *before[len(end) :]])))

    @property
    def _held(self) -> NDArray[np.float64]:
        lever = [] if self.jaw is None else [1.0 - self.jaw.q / self._way]
        return np.array([*self.plant.q.tolist(), *lever])

    def _move_by_hand(self, dt: float) -> None:
        if not self._t_hand:
            self._begun = self._held
        self._t_hand += dt
        seconds, end = self._hand[0]
        share = min(1.0, self._t_hand / seconds)
        at = self._begun + share**2 * (3.0 - 2.0 * share) * (end - self._begun)
        count = len(self.joints)
        self.plant.q[:] = at[:count]
        if self.jaw is not None:
            self.jaw.q = (1.0 - float(at[count])) * self._way
        if share >= 1.0:
            self._hand.popleft()
            self._t_hand = 0.0

    def place(self, q: Sequence[float]) -> None:
        """Put the arm at rest at a position, rad, without torque, and hold it there until its torque is on."""
        self.plant.place(q)
        self._hand.clear()
        self._t_hand = 0.0
        self._report()
        for servo in self.servos.values():
            servo.restart()

    def _report(self) -> None:
        """Let the servos feel their shafts."""
        for k, servo in enumerate(self.joints):
            servo.angle = (float(self.plant.q[k]) - self._off[k]) / COUNT
            servo.speed, servo.torque = float(self.plant.dq[k]), float(self.plant.tau[k])
        if self.jaw is not None:
            servo = self._jaw_servo
            servo.angle, servo.speed, servo.torque = 2000 + self.jaw.q / COUNT, self.jaw.dq, self.jaw.tau

    def step(self, dt: float) -> None:
        """Let ``dt`` s pass."""
        drives = [servo.drive(dt, off) for servo, off in zip(self.joints, self._off, strict=True)]
        if all(servo.registers[40] for servo in self.joints):
            self.plant.held = False
        self.plant.step(dt, drives)
        if self._hand:
            self._move_by_hand(dt)
        self.peak = [max(peak, abs(speed)) for peak, speed in zip(self.peak, self.plant.dq.tolist(), strict=True)]
        if self.jaw is not None:
            width = self.object_width if self.world is None else self.world.object_width or 0.0
            assert self.spec.gripper is not None
            self.jaw.lower = max(0.0, self.spec.gripper.travel_at(width)) * self._way if width else 0.0
            self.jaw.step(dt, self._jaw_servo.drive(dt, -2000 * COUNT))
        self._report()
        if self.world is not None:
            if self.jaw is not None:
                self.world.fingers = self.world.now, self.width, abs(self.jaw.tau) / 0.07
            self.world.exchange(dt, self.plant.q.tolist())

    @property
    def width(self) -> float:
        """Width of its gripper, m; 0 without one."""
        gripper = self.spec.gripper
        return 0.0 if self.jaw is None or gripper is None else gripper.width_at(self.jaw.q / self._way)

    def answer(self, id: int, address: int, size: int) -> Answer:
        """Return a servo's answer to a question for registers; without any if ``size`` is 0."""
        servo = self.servos[id]
        return Answer(id, servo.errors, servo.read(address, size) if size else b"")

    def report(self) -> dict[str, Any]:
        """Return the state of the arm, for programs and people."""
        plant = self.plant
        return {
            "q": plant.q.tolist(),
            "dq": plant.dq.tolist(),
            "tau": plant.tau.tolist(),
            "goals": [servo.word(42) for servo in self.servos.values()],
            "counts": [round(servo.angle) for servo in self.servos.values()],
            "on": [bool(servo.registers[40]) for servo in self.servos.values()],
            "limits": [servo.word(48) for servo in self.servos.values()],
            "errors": [servo.errors for servo in self.servos.values()],
            "width": self.width,
            "peak_speed": self.peak,
        }
