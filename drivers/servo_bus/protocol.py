"""What the servos of a bus have in common, whoever made them: frames, state, and what they have stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import pi
from typing import ClassVar, NamedTuple

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
"""Instructions, the same in both protocols."""
ALL = 0xFE
"""Id at which every motor listens."""
TURN = 4096
"""Counts of a turn."""
COUNT = 2.0 * pi / TURN
"""rad"""

Block = tuple[int, int]
"""Address of the first register, and the number of bytes."""


class Answer(NamedTuple):
    """A motor's answer; of a question, ``error`` is its instruction."""

    id: int
    error: int
    data: bytes


class MotorState(NamedTuple):
    """A motor's state, or that of the motors of one joint. Positions and speeds are in counts, and per s."""

    t: float
    """When it was asked, s."""
    error: int
    """Bits of :attr:`ServoProtocol.errors`."""
    on: bool
    """Whether its torque is on."""
    stopped: bool
    """Whether it stopped by itself, because it heard nothing, and takes no goals."""
    goal: int
    torque_limit: int
    """In :attr:`ServoProtocol.full` of its stall torque, as is the load."""
    position: int
    velocity: float
    load: int
    """Duty cycle of its bridge."""
    voltage: float
    """V"""
    temperature: int
    """deg C"""
    twist: int = 0
    """Greatest difference between two motors of a joint."""


class Calibration(NamedTuple):
    """What LeRobot's calibration stores for a motor, in counts."""

    drive_mode: int
    """Whether the motor itself turns backwards."""
    homing_offset: int
    """See :attr:`ServoProtocol.homing`."""
    range_min: int
    range_max: int
    """Ends of the joint's way, as the motor then reports them."""


class Registers(NamedTuple):
    """What a motor has stored, as far as it matters."""

    model: str
    """Its name; empty for one that this project does not know."""
    number: int
    return_delay: int
    """2 us"""
    calibration: Calibration
    nominal: float
    """Voltage of its data sheet, V."""
    stall_torque: float
    """There, Nm."""
    speed: float
    """Without a load, rad/s."""
    stiffness: float
    """Torque for each rad off its goal, Nm/rad."""
    limit_max: int
    """Greatest torque limit, in :attr:`ServoProtocol.full`."""
    wrong: str = ""
    """Why it can not be used as it is set, and what to do; empty if it can."""
    turns: int = 1
    """0: it reports one turn only; 1: it counts turns while its torque is off; 2: always, until it loses its power."""
    follows: int = 255
    """Id of the motor whose frames it takes, too; 253 and above for none."""


class ServoProtocol(ABC):
    """A maker's frames and registers."""

    name: ClassVar[str]
    baud: ClassVar[int] = 1_000_000
    bauds: ClassVar[Mapping[int, int]]
    """Other rates at which a motor may listen, as far as the kernel has them -> its register's value."""
    full: ClassVar[int]
    """Torque limit that is the stall torque."""
    stored: ClassVar[Block]
    state: ClassVar[Block]
    status: ClassVar[Block | None]
    """What is read of two motors at a time; None if the state says it all."""
    torque: ClassVar[int]
    """Address of the switch of its torque."""
    limit: ClassVar[int]
    """Address of the torque limit, two bytes."""
    goal: ClassVar[Block]
    watchdog: ClassVar[int | None]
    """Address of the time without a frame after which it stops, 0 for never; None if it has none."""
    homing: ClassVar[int]
    """1 if the homing offset is added to what the encoder reads, -1 if it is subtracted."""
    id_address: ClassVar[int]
    baud_address: ClassVar[int]
    delay_address: ClassVar[int]
    lock: ClassVar[int | None]
    """Address of the lock of what is stored; None if that is locked by the torque alone."""
    free: ClassVar[tuple[int, int]]
    """Address and value of the mode in which a motor is calibrated, and driven afterwards, as LeRobot has it."""
    restart: ClassVar[float]
    """Longest time until errors that were cleared are gone, s."""
    errors: ClassVar[Mapping[int, tuple[str, str, str]]]
    """Bit of a motor's errors -> code, what is wrong, remedy."""

    @abstractmethod
    def encode(self, id: int, instruction: int, data: bytes = b"") -> bytes:
        """Return the frame of a question."""

    def encode_answer(self, id: int, error: int, data: bytes = b"") -> bytes:
        """Return the frame of an answer."""
        return self.encode(id, error, data)

    @abstractmethod
    def split(self, came: bytes) -> tuple[list[Answer], bytes, int]:
        """Return the whole frames in what has come, the rest, and the number of frames with a wrong checksum."""

    @abstractmethod
    def place(self, address: int, *size: int) -> bytes:
        """Return the parameters that name registers: the first one, and, but for a write, how many bytes."""

    def time_reading(self, motors: int, baud: int) -> float:
        """Return how long a reading of so many motors takes on the wire, s: ten bits for each byte."""
        size = 0
        for block, count in ((self.state, motors), (self.status, 2)):
            if block is not None:
                size += len(self.encode(ALL, SYNC_READ, self.place(*block) + bytes(count)))
                size += count * len(self.encode_answer(0, 0, bytes(block[1])))
        return 10.0 * size / baud

    @abstractmethod
    def decode_state(self, now: float, answer: Answer, status: bytes) -> MotorState:
        """Return the state in an answer that was asked for at ``now``, s, and the newest :attr:`status`."""

    @abstractmethod
    def decode_registers(self, data: bytes) -> Registers:
        """Return what is in :attr:`stored`."""

    @abstractmethod
    def prepare(self, ids: Sequence[int], goals: Sequence[int], limits: Sequence[int], watch: bool) -> Writes:
        """Return what gives each motor its goal, counts, and its torque limit, and takes away its profile.

        With ``watch`` they shall stop when they hear nothing for a while, where they can.
        """

    @abstractmethod
    def clear(self, states: Mapping[int, MotorState]) -> list[tuple[int, int, bytes]]:
        """Return the questions that end the errors of these motors: id, instruction, data."""

    @abstractmethod
    def store_calibration(self, calibration: Calibration) -> list[tuple[int, bytes]]:
        """Return what a motor has to be given to have this calibration: address and bytes."""


Writes = list[tuple[int, dict[int, bytes]]]
"""Address, and bytes of the same length by id."""


def signed(value: int, bit: int) -> int:
    """Return a number whose sign is in a bit of its own."""
    return -(value & ~(1 << bit)) if value >> bit & 1 else value


def unsigned(value: int, bit: int) -> int:
    """Return what :func:`signed` reads."""
    return abs(value) | (1 << bit if value < 0 else 0)
