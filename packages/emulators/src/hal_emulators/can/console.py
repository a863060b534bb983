"""Commands of the emulator: typed at its prompt, sent to its control port, or given to ``CanEmulator.execute``.

Where a rig has several arms, a command begins with the arm's name: ``left status 3 A``. The control port listens on
this computer only; a line holds a command, and its answer is a line of JSON.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from hal_emulators.control import (
    Command,
    assign,
    between,
    make_commands,
    read_end,
    read_number,
    read_switch,
    run_command,
)

from .server import CanEmulator, EmulatedArm, EmulatedBus, FrameFaults

_MOST = 1e4
"""Greatest number of a command, in SI units."""


class _Target(NamedTuple):
    arm: EmulatedArm
    bus: EmulatedBus
    faults: FrameFaults


# Values of a command. A wrong one is a ValueError, in words.


def _int(word: str, what: str, least: int, most: int, base: int = 0) -> int:
    """Return a whole number; with base 0, one that begins with 0x is hexadecimal."""
    try:
        value = int(word, base)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        bounds = f"{least:X} to {most:X} (hexadecimal)" if base == 16 else f"{least} to {most}"
        raise ValueError(f"{what} must be {bounds}, not {word!r}")
    return value


def _motor(target: _Target, word: str, other: str = "") -> int:
    """Return the number of a motor; ``other`` is a further word that the command takes."""
    numbers = target.arm.numbers
    try:
        number = int(word, 0)
    except ValueError:
        number = -1
    if number not in numbers:
        raise ValueError(f"there is no motor {word!r}; motors: {', '.join(map(str, numbers))}{other and f', {other}'}")
    return number


# Faults of the bus.


def _lose(target: _Target, words: list[str]) -> None:
    if len(words) > 2:
        _motor(target, words[2])
    target.faults.losses.set(words)


def _silent(target: _Target, words: list[str]) -> None:
    number = 0 if words[0] == "all" else _motor(target, words[0], "or all")
    target.faults.silent_until[number] = read_end(words[1])


def _frame(target: _Target, words: list[str]) -> None:
    id = _int(words[0], "the id", 0, 0x7FF)
    longest = 64 if target.bus.settings.fd else 8
    try:
        data = bytes.fromhex(words[1])
    except ValueError:
        data = bytes(longest + 1)
    if len(data) > longest:
        raise ValueError(f"the data must be up to {longest} bytes in hexadecimal, such as 01ff, not {words[1]!r}")
    for _ in range(_int(words[2], "the number of frames", 0, 100_000) if len(words) > 2 else 1):
        target.bus.send(id, data)


# Faults of motors.


def _status(target: _Target, words: list[str]) -> None:
    arm = target.arm
    number = 0 if words[0] == "0" and 0 not in arm.numbers else _motor(target, words[0])
    arm.set_status(number, _int(words[1], "the status", 0, 0xFF, 16))


def _register(target: _Target, words: list[str]) -> None:
    target.arm.set_register(_motor(target, words[0]), words[1], read_number(words[2], 0.0, 1e9))


def _temperature(target: _Target, words: list[str]) -> None:
    degrees = [_int(word, "a temperature in deg C", 0, 127) for word in words[1:3]]
    target.arm.set_temperature(_motor(target, words[0]), degrees[0], degrees[1])


# Mechanics.


def _payload(target: _Target, words: list[str]) -> None:
    mass = read_number(words[0], 0.0, _MOST)
    place = [read_number(word, -_MOST, _MOST) for word in words[1:]]
    if len(place) not in (0, 3):
        raise IndexError
    target.arm.plant.load(payload=(mass, place or (0.0, 0.0, 0.0)))


def _place(target: _Target, words: list[str]) -> None:
    q = [read_number(word, -_MOST, _MOST) for word in words] or target.arm.plant.q.tolist()
    if len(q) != len(target.arm.plant.q):
        raise ValueError(f"takes {len(target.arm.plant.q)} positions in rad, or none for the present ones")
    target.arm.restart()
    target.arm.plant.place(q)
    target.arm.restart()


def _push(target: _Target, words: list[str]) -> None:
    joint = _int(words[0], "the joint", 1, len(target.arm.plant.push))
    target.arm.plant.push[joint - 1] = read_number(words[1], -_MOST, _MOST)


def _object(target: _Target, words: list[str]) -> None:
    if target.arm.world is not None:
        raise ValueError("the fingers meet the objects of the simulated world: use rig.world, or --no-world")
    target.arm.set_object(None if words[0] == "none" else read_number(words[0], 0.0, _MOST))


# Reports.


def _state(target: _Target, words: list[str]) -> dict[str, Any]:
    plant = target.arm.plant
    return {
        "t": time.monotonic(),
        "q": plant.q.tolist(),
        "dq": plant.dq.tolist(),
        "tau": plant.tau.tolist(),
        "held": plant.held,
        **target.arm.report(),
    }


def _stats(target: _Target, words: list[str]) -> dict[str, Any]:
    answer = {"peak_speed": list(target.arm.peak), "frames": target.bus.received, "steps_left_out": target.bus.late}
    if words[:1] == ["reset"]:
        target.arm.peak[:] = [0.0] * len(target.arm.peak)
        target.bus.received = target.bus.late = 0
    return answer


def _reset(target: _Target, words: list[str]) -> None:
    """Take every fault away; what was done to the motors' registers stays."""
    target.faults.reset()
    target.bus.cut_until = 0.0
    target.arm.plant.friction = 1.0
    target.arm.plant.load(mass_factor=1.0, payload=(0.0, (0.0, 0.0, 0.0)))
    target.arm.plant.push[:] = 0.0


COMMANDS = make_commands(
    Command("lose P | next N [MOTOR]", "lose that share of the replies, or exactly the next N", _lose),
    Command("late S", "send replies S seconds late", assign("faults.delay", between(0.0, _MOST))),
    Command("double on|off", "send every reply twice", assign("faults.copies", lambda word: 1 + read_switch(word))),
    Command("silent MOTOR|all S|on|off", "neither hear nor answer", _silent),
    Command("cut S|on|off", "let no frame pass, either way", assign("bus.cut_until", read_end)),
    Command("frame ID HEX [N]", "send a frame of your own, N times", _frame),
    Command("stall S", "stop the emulator itself", assign("bus.stall", between(0.0, _MOST))),
    Command(
        "status MOTOR CODE",
        "give a motor a status, hex: 8 to E; a PiPER: its joint's flags, with MOTOR 0 the arm's status",
        _status,
    ),
    Command("register MOTOR NAME VALUE", "change a register, as VMAX or TIMEOUT", _register),
    Command("temperature MOTOR C C", "report these: electronics, motor", _temperature),
    Command("power", "switch all motors off and on again", lambda target, _: target.arm.restart()),
    Command(
        "masses FACTOR",
        "multiply the masses of the arm",
        lambda target, words: target.arm.plant.load(mass_factor=read_number(words[0], 0.0, _MOST)),
    ),
    Command(
        "friction FACTOR",
        "multiply the Coulomb friction of the joints",
        assign("arm.plant.friction", between(0.0, _MOST)),
    ),
    Command("payload KG [X Y Z]", "fix a mass to the tool's link, m", _payload),
    Command("place [Q ...]", "switch off, and hold the arm there until its motors are on", _place),
    Command("push JOINT NM", "push a joint with this torque, until 0", _push),
    Command("object M|none", "put an object of this width between the fingers", _object),
    Command("state", "motion, motors, last commands", _state),
    Command("stats [reset]", "greatest speeds and counters", _stats),
    Command("reset", "end all faults of frames and mechanics", _reset),
)


def execute(emulator: CanEmulator, words: list[str]) -> dict[str, Any]:
    """Execute a command, and return its answer. Raises ValueError if it is invalid."""
    named = bool(words) and words[0] in emulator.arms
    arm = emulator.arms[words[0]] if named else next(iter(emulator.arms.values()))
    bus = emulator.bus_of(arm)
    with bus.lock:
        return run_command(COMMANDS, _Target(arm, bus, bus.faults[arm.name]), words[named:])
