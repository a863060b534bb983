"""The emulator at work: one thread moves the arms of a rig in real time, and answers; commands inject faults.

with ServoBusEmulator(find_arms("so101")) as emulator:
    emulator.execute("lose next 3 2")         # from any thread
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import termios
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

from hal.config.loader import load
from hal.drivers.servo_bus.protocol import ALL, PING, READ, SYNC_READ, SYNC_WRITE, WRITE, Answer
from hal.specs import RobotSpec
from hal_emulators.control import Command, assign, make_commands, read_end, read_switch, run_command
from hal_emulators.shared_world import PRIORITY, load_real, raise_priority
from hal_emulators.terminal import PseudoTerminal

from .arm import EmulatedArm
from .servo import ALERT, SERVOS, DynamixelServo, Servo

__all__ = ["COMMANDS", "ServoBusEmulator", "find_arms", "find_leaders"]

_STEP = 0.002
"""Step of the mechanics, s."""
_LONGEST_GAP = 0.25
"""Time that the mechanics make up for after the machine had no time for them, s."""


class ServoLine:
    """The line of one arm, with the faults of its frames; times are on the monotonic clock, s."""

    def __init__(self, arm: EmulatedArm, seed: int = 0) -> None:
        self.arm = arm
        self.terminal = PseudoTerminal(arm.port)
        self._random = random.Random(seed)
        self._came = b""
        self._late: list[tuple[float, bytes]] = []
        self.out_until = self.off_until = 0.0
        self.twins: set[int] = set()
        """Ids that two motors have."""
        self.reset()

    def reset(self) -> None:
        """End the faults of frames."""
        self.lost_share = self.delay = 0.0
        self.lose_next: dict[int, int] = {}
        """Id, 0 for any -> how many of its next answers are lost."""
        self.silent_until: dict[int, float] = {}
        self.copies, self.spoil_next = 1, 0

    def serve(self) -> None:
        """Take what has come, and answer."""
        self.terminal.free()
        try:
            came = os.read(self.terminal.descriptors[0], 4096)
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
        return servo.plugged and servo.boot <= now and rate == self.terminal.baud and not silent

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

    def _is_lost(self, id: int) -> bool:
        for key in (id, 0):
            if self.lose_next.get(key, 0) > 0:
                self.lose_next[key] -= 1
                return True
        return self._random.random() < self.lost_share

    def _reply(self, answers: Sequence[tuple[Servo, int, bytes]]) -> None:
        """Let motors answer with an error and registers."""
        for servo, error, data in answers:
            if self._is_lost(servo.id):
                continue
            error |= (ALERT if servo.errors else 0) if isinstance(servo, DynamixelServo) else servo.errors
            frame = self.arm.protocol.encode_answer(servo.id, error, data)
            if self.spoil_next:
                self.spoil_next -= 1
                frame = frame[:-1] + bytes((frame[-1] ^ 0x55,))
            copies = self.copies + (servo.id in self.twins)
            self._late.append((monotonic() + self.delay, frame * copies))
        self.send_due(monotonic())

    def send_due(self, now: float) -> None:
        """Send the answers that are due, and let the line come back."""
        if (now < self.out_until) == bool(self.terminal.descriptors):
            (self.terminal.close if self.terminal.descriptors else self.terminal.open)()
        due = b"".join(frame for t, frame in self._late if t <= now)
        self._late = [(t, frame) for t, frame in self._late if t > now]
        if due and self.terminal.descriptors:
            with contextlib.suppress(OSError):
                os.write(self.terminal.descriptors[0], due)


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


class ServoBusEmulator:
    """All arms of a rig on servo buses, each on its line.

    Attributes:
        arms: The arms by name.
        lines: Their lines.
    """

    def __init__(self, arms: Iterable[RobotSpec], seed: int = 0, paced: bool = True, realtime: bool = False) -> None:
        """Build the arms.

        Args:
            arms: Their records; see :func:`find_arms`.
            seed: Of random losses.
            paced: Whether they move in real time; otherwise only by :meth:`advance`.
            realtime: Give the thread the priority of a servo, for a process that does nothing else.

        Raises:
            ValueError: Two are on one port, which this emulator does not play, or a port is not an emulator's.
        """
        self.arms = {spec.name: EmulatedArm(spec) for spec in arms}
        if len({arm.port for arm in self.arms.values()}) < len(self.arms):
            raise ValueError("two emulated arms need two ports")
        self.lines = {name: ServoLine(arm, seed) for name, arm in self.arms.items()}
        self._paced, self._realtime = paced, realtime
        self.lock = threading.Lock()
        self.read_end = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="servo-bus-emulator", daemon=True)

    def advance(self, seconds: float) -> None:
        """Take what has come, and move the arms by ``seconds`` at once."""
        with self.lock:
            for line in self.lines.values():
                if line.terminal.descriptors and select.select(line.terminal.descriptors, [], [], 0.0)[0]:
                    line.serve()
            self._advance(seconds)

    def _advance(self, seconds: float) -> None:
        for _ in range(round(min(seconds, _LONGEST_GAP) / _STEP)):
            for arm in self.arms.values():
                arm.step(_STEP)

    def _serve(self) -> None:
        if self._realtime:
            raise_priority(PRIORITY)  # a busy computer must not look like a silent motor
        done = monotonic()
        """Time up to which the arms have moved."""
        while not self.read_end.is_set():
            with self.lock:
                now = monotonic()
                done = max(done, now - _LONGEST_GAP)
                if self._paced and now - done >= _STEP:  # one step at a time: who asks meanwhile is answered
                    self._advance(_STEP)
                    done += _STEP
                for line in self.lines.values():
                    line.send_due(now)
                lines = {one: line for line in self.lines.values() for one in line.terminal.descriptors}
            behind = self._paced and now - done >= _STEP
            ready, _, _ = select.select(list(lines), [], [], _STEP / 20 if behind else _STEP / 2)
            with self.lock:
                for descriptor in ready:
                    if descriptor in lines[descriptor].terminal.descriptors:  # no command took it away meanwhile
                        lines[descriptor].serve()

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command, and return its answer; with several arms the arm's name is its first word.

        Raises:
            ValueError: It is invalid.
        """
        words = line.split()
        name = words.pop(0) if words and words[0] in self.lines else next(iter(self.lines))
        with self.lock:
            return run_command(COMMANDS, self.lines[name], words)

    def __enter__(self) -> ServoBusEmulator:
        for line in self.lines.values():
            line.terminal.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.read_end.set()
        self._thread.join(5.0)
        for line in self.lines.values():
            line.terminal.close()


# Commands.


def _lose(line: ServoLine, words: list[str]) -> None:
    if words[0] == "next":
        line.lose_next[int(words[2]) if len(words) > 2 else 0] = int(words[1])
    else:
        line.lost_share = float(words[0])


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
    Command("lose P | next N [ID]", "lose that share of the answers, or exactly the next N", _lose),
    Command("late S", "send answers S seconds late", assign("delay", float)),
    Command("double on|off", "send each answer twice", assign("copies", lambda word: 1 + read_switch(word))),
    Command("spoil N", "spoil the checksum of the next N answers", assign("spoil_next", int)),
    Command("silent ID|all S|on|off", "neither hear nor answer", _silence),
    Command("unplug S|on|off", "take the line away", assign("out_until", read_end)),
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
)
