"""The registers of one emulated servo, and its drive. Time passes only in ``drive``.

A servo's torque is its stiffness times the distance from its goal, within its torque limit, less the voltage that its
own speed induces. What the makers' tables leave open is assumed: when an overload begins; that a Feetech motor's
overload ends when its torque is written; that a Dynamixel motor which hears nothing ends its profile and holds, that
all frames which it can read count as heard, and that it takes a frame for its secondary id without an answer.
"""

from __future__ import annotations

from time import monotonic
from typing import ClassVar

from hal.drivers.servo_bus.dynamixel import MODELS, REBOOT, Dynamixel
from hal.drivers.servo_bus.feetech import MODEL, Feetech
from hal.drivers.servo_bus.protocol import COUNT, TURN, Calibration, Registers, ServoProtocol, unsigned
from hal_emulators.can.plant import OFF, Drive

_OVERLOAD, _OVERLOAD_TIME, _PROTECTED = 0.8, 2.0, 0.2
"""Share of the stall torque that is an overload after so many s, as delivered; what a Feetech motor then reduces to."""
_BOOT = 0.2
"""Silence of a motor that restarts, s."""
DATA_RANGE, DATA_LIMIT, ACCESS, ALERT = 0x04, 0x06, 0x07, 0x80
"""Errors in a Dynamixel's answer."""


class Servo:
    """What both kinds have in common.

    Attributes:
        error: Bits of errors that are raised from outside.
        shaft: Where its shaft is, counts as its homing was at first.
        voltage: Supply, 0.1 V.
        temperature: deg C
        quiet: Time without a frame, s.
        plugged: Whether it is on the bus.
        sign, zero: Joint angle = sign * (count - zero), as its homing was at first.
    """

    protocol: ClassVar[ServoProtocol]
    sizes: ClassVar[dict[int, int]]
    """Address of each register that has more than a byte -> its bytes."""
    memory: ClassVar[int]
    """First register that is lost with the power."""

    def __init__(self, id: int, homing: int, ends: tuple[int, int], sign: int, zero: float) -> None:
        self.registers = bytearray(160)
        self.sign, self.zero = sign, zero
        self.error, self.plugged = 0, True
        self.temperature, self.voltage = 31, 121
        self.shaft, self.speed, self.torque, self.quiet, self.boot = zero, 0.0, 0.0, 0.0, 0.0
        self.lost_turns = 0
        """Turns that it does not count."""
        self.store()
        self.put(self.protocol.id_address, id)
        for address, data in self.protocol.store_calibration(Calibration(0, homing, *ends)):
            self.registers[address : address + len(data)] = data
        self.stored: Registers = self.decode()
        self.homing = self.offset
        self.restart()

    def store(self) -> None:
        """Set the registers that keep their values, as delivered."""

    def become(self, torque: float, leader: int) -> None:
        """Be a model with about this torque, Nm, that follows another motor if it is not its own."""

    def decode(self) -> Registers:
        """Return what it has stored."""
        address, size = self.protocol.stored
        return self.protocol.decode_registers(bytes(self.registers[address : address + size]))

    def get(self, address: int) -> int:
        """Return a register."""
        size = self.sizes.get(address, 1)
        return int.from_bytes(self.registers[address : address + size], "little", signed=size == 4)

    def put(self, address: int, value: int) -> None:
        """Set a register."""
        size = self.sizes.get(address, 1)
        self.registers[address : address + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")
        self.stored = self.decode()

    @property
    def id(self) -> int:
        return self.registers[self.protocol.id_address]

    @property
    def baud(self) -> int:
        """Rate at which it listens, bit/s."""
        value = self.registers[self.protocol.baud_address]
        return next((rate for rate, known in self.protocol.bauds.items() if known == value), 0)

    @property
    def on(self) -> bool:
        return self.registers[self.protocol.torque] == 1

    @property
    def offset(self) -> int:
        """What its homing adds to the encoder's count."""
        raise NotImplementedError

    @property
    def angle(self) -> float:
        """Where its shaft is, counts as it counts."""
        return self.shaft + self.offset - self.homing - TURN * self.lost_turns

    @property
    def errors(self) -> int:
        """The bits that it reports."""
        raise NotImplementedError

    @property
    def goal(self) -> int:
        return self.get(self.protocol.goal[0])

    def restart(self) -> None:
        """Become as after switching on: no torque."""
        self.registers[self.memory :] = bytes(160 - self.memory)
        self.put(self.protocol.limit, self.stored.limit_max)
        self._strained = self.quiet = 0.0
        self._target = self.angle
        self.put(self.protocol.goal[0], round(self.angle))

    def read(self, address: int, size: int) -> bytes:
        """Return registers, with the present state."""
        self.refresh()
        return bytes(self.registers[address : address + size])

    def refresh(self) -> None:
        """Set the registers of the present state."""
        raise NotImplementedError

    def write(self, address: int, data: bytes) -> int:
        """Take registers, and return the error of the answer."""
        raise NotImplementedError

    def overload(self) -> None:
        """Be overloaded from now on."""

    def ping(self) -> bytes:
        """Return what the answer to a ping has."""
        return b""

    def take_other(self, instruction: int) -> None:
        """Take an instruction that only one kind has."""

    def turn_to(self, q: float, dq: float, tau: float) -> None:
        """Feel the joint: rad, rad/s, Nm."""
        self.shaft, self.speed, self.torque = self.zero + self.sign * q / COUNT, self.sign * dq, self.sign * tau

    def _push(self, dt: float, low: float, high: float, step: float, limit: float) -> Drive:
        """Return what its motor does in a step of ``dt`` s; ``limit`` is a share of its stall torque."""
        stored = self.stored
        goal = min(max(self.goal, low), high)
        self._target += min(max(goal - self._target, -step), step)
        damping = stored.stall_torque / stored.speed
        torque = stored.stiffness * (self._target - self.angle) * COUNT
        strained = abs(self.torque) > _OVERLOAD * stored.stall_torque
        self._strained = self._strained + dt if strained else 0.0
        limit *= stored.stall_torque
        if abs(torque) > limit:
            return Drive(kd=damping, tau=self.sign * (limit if torque > 0.0 else -limit))
        q = self.sign * (self._target - self.angle + self.shaft - self.zero) * COUNT
        return Drive(q, 0.0, stored.stiffness, damping)

    def drive(self, dt: float) -> Drive:
        """Return what its motor does in a step of ``dt`` s."""
        raise NotImplementedError


class FeetechServo(Servo):
    """An STS3215 for 12 V."""

    protocol = Feetech()
    sizes: ClassVar[dict[int, int]] = dict.fromkeys((3, 9, 11, 16, 31, 42, 46, 48, 56, 58, 60, 69), 2)
    memory = 40
    overloaded = False

    def store(self) -> None:
        for address, value in ((0, 3), (1, 9), (8, 1), (13, 70), (14, 140), (15, 40), (18, 12), (21, 32)):
            self.registers[address] = value
        for address, value in ((3, MODEL), (16, 1000)):
            self.put(address, value)

    @property
    def offset(self) -> int:
        return -self.stored.calibration.homing_offset

    def restart(self) -> None:
        self.overloaded = False
        super().restart()
        self.registers[55] = 1

    @property
    def errors(self) -> int:
        wrong = not self.registers[15] <= self.voltage <= self.registers[14]
        hot = self.temperature > self.registers[13]
        return self.error | wrong | hot << 2 | self.overloaded << 5

    def refresh(self) -> None:
        speed, load = round(self.speed / COUNT), round(1000 * self.torque / self.stored.stall_torque)
        for address, value, bit in ((56, round(self.angle), 15), (58, speed, 15), (60, load, 10)):
            self.registers[address : address + 2] = unsigned(value, bit).to_bytes(2, "little")
        self.registers[62], self.registers[63], self.registers[65] = self.voltage, self.temperature, self.errors
        self.registers[66] = abs(speed) > 5

    def write(self, address: int, data: bytes) -> int:
        """Registers of the EEPROM are taken only while it is not locked."""
        for k, value in enumerate(data, address):
            if k < 56 and (k >= self.memory or not self.registers[55]):
                self.registers[k] = value
        if address <= 40 < address + len(data):
            self.overloaded, self._strained = False, 0.0
        self.stored = self.decode()
        return self.errors

    def drive(self, dt: float) -> Drive:
        if not self.on or self.errors & 0x0D:
            self._target = self.angle
            return OFF
        low, high = self.stored.calibration[2:]
        limit = min(self.get(48), self.get(16)) / 1000
        drive = self._push(dt, low, high, self.get(46) * dt or 1e9, min(limit, _PROTECTED if self.overloaded else 1.0))
        if self._strained > _OVERLOAD_TIME:
            self.overload()
        return drive

    def overload(self) -> None:
        self.overloaded = True


class DynamixelServo(Servo):
    """A motor of the X series, in the mode of one turn."""

    protocol = Dynamixel()
    sizes: ClassVar[dict[int, int]] = {
        **dict.fromkeys((0, 32, 34, 36, 38, 84, 100, 124, 126, 144), 2),
        **dict.fromkeys((20, 48, 52, 108, 112, 116, 128, 132), 4),
    }
    memory = 64
    latched = 0

    def store(self) -> None:
        for address, value in ((6, 46), (8, 3), (11, 3), (12, 255), (13, 2), (31, 80), (63, 0x34)):
            self.registers[address] = value
        for address, value in ((0, 1120), (32, 160), (34, 95), (36, 885), (38, 2047)):
            self.put(address, value)

    def become(self, torque: float, leader: int) -> None:
        known = {number: MODELS[number].stall_torque for number in (1020, 1060, 1120)}
        self.put(0, min(known, key=lambda number: abs(known[number] - torque)))
        self.put(12, 255 if leader == self.id else leader)

    @property
    def offset(self) -> int:
        return self.get(20)

    def restart(self) -> None:
        """It knows no turns any more."""
        self.latched, self.lost_turns = 0, 0
        self.lost_turns = int(self.angle // TURN)
        super().restart()
        self.put(84, 800)
        self.registers[68] = 2

    @property
    def errors(self) -> int:
        wrong = not self.get(34) <= self.voltage <= self.get(32)
        hot = self.temperature > self.registers[31]
        self.latched |= self.error | wrong | hot << 2
        return self.latched

    def refresh(self) -> None:
        load = round(885 * self.torque / self.stored.stall_torque)
        words = (124, load), (126, load), (128, round(self.speed * 60 / 0.229 / 6.28319)), (132, round(self.angle))
        for address, value in (*words, (144, self.voltage)):
            size = self.sizes[address]
            self.registers[address : address + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")
        self.registers[70], self.registers[146] = self.errors, self.temperature

    def ping(self) -> bytes:
        return bytes((*self.registers[0:2], self.registers[6]))

    def write(self, address: int, data: bytes) -> int:
        """Stored registers are taken only while its torque is off, goals only inside of its range."""
        if address < self.memory and self.on:
            return ACCESS
        before, was_on = bytes(self.registers), self.on
        if address >= 100 and self.registers[98] == 255:
            return DATA_RANGE
        self.registers[address : address + len(data)] = data
        low, high = self.get(52), self.get(48)
        if self.registers[11] == 3 and address < 120 <= address + len(data) and not low <= self.goal <= high:
            self.registers[:] = before
            return DATA_LIMIT
        self.stored = self.decode()
        if self.latched & self.registers[63]:
            self.registers[64] = 0
        if self.on and not was_on:
            if self.registers[11] == 3:
                self.lost_turns += int(self.angle // TURN)
            self._target = self.angle
        return 0

    def take_other(self, instruction: int) -> None:
        if instruction == REBOOT:
            self.restart()
            self.boot = monotonic() + _BOOT

    def drive(self, dt: float) -> Drive:
        self.quiet += dt
        watchdog = self.registers[98]
        if 0 < watchdog < 128 and self.quiet > 0.02 * watchdog:
            self.registers[98] = 255
            self.put(116, round(self._target))
        if self.errors & self.registers[63]:
            self.registers[64] = 0
        if not self.on:
            self._target = self.angle
            return OFF
        low, high = (self.get(52), self.get(48)) if self.registers[11] == 3 else (-1e6, 1e6)
        step = self.get(112) * 0.229 / 60 * TURN * dt or 1e9
        drive = self._push(dt, low, high, step, min(self.get(100), self.get(36)) / 885)
        if self._strained > _OVERLOAD_TIME:
            self.overload()
        return drive

    def overload(self) -> None:
        self.latched |= 32


SERVOS: dict[str, type[Servo]] = {"feetech": FeetechServo, "dynamixel": DynamixelServo}
"""By the driver of the arm."""
