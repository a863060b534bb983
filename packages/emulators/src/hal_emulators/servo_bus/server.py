"""The emulator at work: the lines of a rig's arms on servo buses, which answer; commands inject faults.

with ServoBusEmulator(find_arms("so101")) as emulator:
    emulator.execute("lose next 3 2")         # from any thread
"""

from __future__ import annotations

import os
import termios
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

from hal.config.loader import load
from hal.drivers.servo_bus.protocol import ALL, PING, READ, SYNC_READ, SYNC_WRITE, WRITE, Answer
from hal.specs import RobotSpec
from hal_emulators.control import Command, assign, make_commands, read_end, read_switch
from hal_emulators.lines import LINE_COMMANDS, Line, LineEmulator
from hal_emulators.shared_world import load_real
from hal_emulators.terminal import PseudoTerminal

from .arm import EmulatedArm
from .servo import ALERT, SERVOS, DynamixelServo, Servo

__all__ = ["COMMANDS", "ServoBusEmulator", "find_arms", "find_leaders"]


class ServoLine(Line):
    """The line of one arm, with the faults of its frames."""

    def __init__(self, arm: EmulatedArm, seed: int = 0) -> None:
        super().__init__(seed)
        self.arm = arm
        self._terminal = PseudoTerminal(arm.port)
        self._came = b""
        self.off_until = 0.0
        self.twins: set[int] = set()
        """Ids that two motors have."""

    def reset(self) -> None:
        super().reset()
        self.silent_until: dict[int, float] = {}
        self.copies = 1

    def open(self) -> None:
        self._terminal.open()

    def close(self) -> None:
        self._terminal.close()

    def descriptors(self) -> list[int]:
        return self._terminal.descriptors

    def serve(self, descriptor: int) -> None:
        self._terminal.free()
        try:
            came = os.read(descriptor, 4096)
        except OSError:
            return
        self._hearing = [] if monotonic() < self.off_until else [s for s in self.arm.servos if self._can_hear(s)]
        if not self._hearing:
            return
        frames, self._came, _ = self.arm.protocol.split(self._came + came)
        for frame in frames:  # of a question: in the place of an answer's errors it has the instruction
            self._take(frame)
            for servo in self._hearing:
                servo.quiet = 0.0

    def _can_hear(self, servo: Servo) -> bool:
        now, rate = monotonic(), getattr(termios, f"B{servo.baud}", None)
        silent = any(self.silent_until.get(key, 0.0) > now for key in (0, servo.id))
        return servo.plugged and servo.boot <= now and rate == self._terminal.baud and not silent

    def _take(self, frame: Answer) -> None:
        id, instruction, data = frame
        width = len(self.arm.protocol.place(0))
        words = [int.from_bytes(data[k : k + width], "little") for k in (0, width)]
        there = [servo for servo in self._hearing if id in (servo.id, ALL)]
        if instruction == PING:
            self._reply([(servo, 0, servo.ping()) for servo in there])
        elif instruction == READ:
            self._reply([(servo, 0, servo.read(*words)) for servo in there])
        elif instruction == SYNC_READ:
            asked = [servo for one in data[2 * width :] for servo in self._hearing if servo.id == one]
            self._reply([(servo, 0, servo.read(*words)) for servo in asked])
        elif instruction == WRITE:
            self._reply([(servo, servo.write(words[0], data[width:]), b"") for servo in there])
            self._follow(id, words[0], data[width:])
        elif instruction == SYNC_WRITE:
            size = words[1] + 1
            for k in range(2 * width, len(data), size):
                for servo in self._hearing:
                    if servo.id == data[k]:
                        servo.write(words[0], data[k + 1 : k + size])
                self._follow(data[k], words[0], data[k + 1 : k + size])
        else:
            for servo in there:
                servo.take_other(instruction)
            self._reply([(servo, 0, b"") for servo in there])

    def _follow(self, id: int, address: int, data: bytes) -> None:
        """Let the motors with this secondary id take a frame, as far as it is none for what they store."""
        for servo in self._hearing:
            if isinstance(servo, DynamixelServo) and id == servo.registers[12] != servo.id and address >= servo.memory:
                servo.write(address, data)

    def _reply(self, answers: Sequence[tuple[Servo, int, bytes]]) -> None:
        """Let motors answer with an error and registers."""
        for servo, error, data in answers:
            error |= (ALERT if servo.errors else 0) if isinstance(servo, DynamixelServo) else servo.errors
            frame = self.arm.protocol.encode_answer(servo.id, error, data)
            copies = self.copies + (servo.id in self.twins)
            self.answer(self.descriptors()[0], frame, servo.id, copies)


def find_arms(config: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> list[RobotSpec]:
    """Return the arms of a rig that this emulator can play. Raises ConfigError."""
    return [spec for spec in load_real(config, overrides).robots if spec.driver in SERVOS]


def find_leaders(config: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> list[RobotSpec]:
    """Return the leaders of a rig that this emulator can play, as arms that they lead. Raises ConfigError."""
    arms: dict[str, Any] = {}
    for pad in load(config, overrides=overrides).resolve().pads:
        if pad.leader is not None and pad.driver in SERVOS:
            drivers, real = {"real": pad.driver}, {key: pad.options[key] for key in ("port", "ids")}
            lever = {"id": pad.options["lever"], "zero": 2048, "widths": [[0, 0], [0.75, 0.1]]}
            gripper = {"drivers": drivers, "real": lever}
            own = pad.driver == "feetech"
            arms[pad.name] = {
                "model": pad.leader.leads[0],
                "drivers": drivers,
                "real": real if own else real | {"zero": 2048},
            }
            arms[pad.name] |= {} if own else {"gripper": gripper}
    return list(load({"sim": False, "robots": arms}).resolve().robots)


class ServoBusEmulator(LineEmulator):
    """All arms of a rig on servo buses, each on its line.

    Attributes:
        arms: The arms by name.
    """

    def __init__(self, arms: Iterable[RobotSpec], seed: int = 0, paced: bool = True, realtime: bool = False) -> None:
        """Build the arms, of :func:`find_arms`; ``seed`` is that of random losses, for the others see LineEmulator.

        Raises:
            ValueError: Two are on one port, which this emulator does not play, or a port is not an emulator's.
        """
        super().__init__(paced, realtime)
        self.arms = {spec.name: EmulatedArm(spec) for spec in arms}
        if len({arm.port for arm in self.arms.values()}) < len(self.arms):
            raise ValueError("two emulated arms need two ports")
        self.lines = {name: ServoLine(arm, seed) for name, arm in self.arms.items()}

    def step(self, dt: float) -> None:
        for arm in self.arms.values():
            arm.step(dt)


# Commands.


def _silence(line: ServoLine, words: list[str]) -> None:
    line.silent_until[0 if words[0] == "all" else int(words[0])] = read_end(words[1])


def _twin(line: ServoLine, words: list[str]) -> None:
    (line.twins.add if read_switch(words[1]) else line.twins.discard)(int(words[0]))


def _power(line: ServoLine, words: list[str]) -> None:
    line.off_until = read_end(words[0] if words else "0.05")
    for servo in line.arm.servos:
        servo.restart()


def _set_servos(name: str, factor: float = 1.0) -> Callable[[ServoLine, list[str]], None]:
    def run(line: ServoLine, words: list[str]) -> None:
        for servo in line.arm.servos:
            if words[0] in ("all", str(servo.id)):
                setattr(servo, name, round(factor * float(words[1])))

    return run


def _register(line: ServoLine, words: list[str]) -> None:
    for servo in line.arm.find(int(words[0])):
        servo.put(int(words[1]), int(words[2]))


def _turn(line: ServoLine, words: list[str]) -> None:
    for servo in line.arm.find(int(words[0])):
        servo.lost_turns -= int(words[1])


def _plug(line: ServoLine, words: list[str]) -> None:
    for k, servo in enumerate(line.arm.servos, 1):
        servo.plugged = words[0] == "all" or str(k) in words


def _baud(line: ServoLine, words: list[str]) -> None:
    for servo in line.arm.servos:
        servo.put(servo.protocol.baud_address, servo.protocol.bauds[int(words[0])])


def _place(line: ServoLine, words: list[str]) -> None:
    line.arm.place([float(word) for word in words] or line.arm.plant.q.tolist())


def _lead(line: ServoLine, words: list[str]) -> None:
    line.arm.lead(float(words[0]), [float(word) for word in words[1:]])


def _push(line: ServoLine, words: list[str]) -> None:
    line.arm.plant.push[int(words[0]) - 1] = float(words[1])


def _put(line: ServoLine, words: list[str]) -> None:
    if line.arm.world is not None:
        raise ValueError("the jaw meets the objects of the simulated world: use rig.world, or --no-world")
    line.arm.object_width = 0.0 if words[0] == "none" else float(words[0])


def _reset(line: ServoLine, _: list[str]) -> None:
    line.reset()
    line.out_until = line.off_until = 0.0
    line.arm.plant.push[:] = 0.0
    line.arm.peak[:] = [0.0] * len(line.arm.peak)
    for servo in line.arm.servos:
        servo.error, servo.voltage, servo.temperature = 0, 121, 31


COMMANDS = make_commands(
    Command(
        "lose P | next N [ID]",
        "lose that share of the answers, or exactly the next N",
        lambda line, words: line.losses.set(words),
    ),
    Command("double on|off", "send each answer twice", assign("copies", lambda word: 1 + read_switch(word))),
    Command("spoil N", "spoil the checksum of the next N answers", assign("spoil_next", int)),
    Command("silent ID|all S|on|off", "neither hear nor answer", _silence),
    Command("power [S|on|off]", "a brown-out: silent for 0.05 s or S, then without torque", _power),
    Command("twin ID on|off", "two motors have this id", _twin),
    Command("baud N", "let the motors listen at this rate only", _baud),
    Command(
        "error ID|all BITS",
        "raise errors: 1 voltage, 4 heat, 32 overload; Feetech: 2 sensor, 8 current; Dynamixel: 8 sensor, 16 shock",
        _set_servos("error"),
    ),
    Command("voltage ID|all V", "change the supply", _set_servos("voltage", 10.0)),
    Command("temperature ID|all C", "change what a motor reports, deg C", _set_servos("temperature")),
    Command("register ID ADDRESS VALUE", "change a register, whatever its size", _register),
    Command("turn ID N", "let a Dynamixel motor count N turns more", _turn),
    Command("plug all|N ...", "only these motors are on the bus, counted from the base", _plug),
    Command("place [Q ...]", "switch off, and hold the arm there until its torque is on", _place),
    Command("hand S Q ... [LEVER]", "a hand moves a leader there in S seconds, after its other motions", _lead),
    Command("push JOINT NM", "push a joint with this torque, until 0", _push),
    Command("object M|none", "put an object of this width into the jaw", _put),
    Command("state", "motion, goals, torque, errors", lambda line, _: line.arm.report()),
    Command("reset", "end all faults of frames and motors", _reset),
    *LINE_COMMANDS,
)
ServoBusEmulator.COMMANDS = COMMANDS
