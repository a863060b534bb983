"""The emulator at work: one thread moves the grippers of a rig in real time, and answers; commands inject faults.

with RobotiqEmulator("fr3_robotiq") as emulator:
    emulator.execute("object 0.03")           # from any thread
"""

from __future__ import annotations

import select
import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

from hal.config.loader import load
from hal.specs import GripperSpec
from hal_emulators.control import Command, assign, make_commands, read_end, read_switch, run_command
from hal_emulators.shared_world import PRIORITY, ArmInWorld, raise_priority

from .gripper import EmulatedGripper
from .ports import Port, SerialPort, TextPort

_STEP = 0.002
"""Longest step of the fingers, s."""
_LONGEST_GAP = 0.25
"""Time that the fingers make up for after the machine had no time for them, s."""


def find_grippers(config: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> list[GripperSpec]:
    """Return the grippers of a rig that this emulator can play. Raises ConfigError and ValueError."""
    robots = load(config, sim=False, overrides=overrides).resolve().robots
    found = [robot.gripper for robot in robots if robot.gripper is not None and robot.gripper.driver == "robotiq"]
    if not found:
        raise ValueError("this rig has no Robotiq gripper that is not simulated")
    return found


def _advance_in(world: ArmInWorld, port: Port) -> None:
    """Move the fingers up to the time that the world has reached, where its arm has come to the object as well."""
    port.gripper.meet(world.object_width)
    t = max(port.t, world.now_of_fingers)
    port.gripper.advance(min(max(0.0, t - max(port.t, port.asked)), _LONGEST_GAP))
    port.t = t
    world.fingers = (t, port.gripper.width, port.gripper.force)


class RobotiqEmulator:
    """Emulated grippers, each on its line, by the name of the arm.

    Unless it is ``paced``, the fingers move only by :meth:`advance`.
    """

    def __init__(
        self, grippers: Iterable[GripperSpec], seed: int = 0, paced: bool = True, realtime: bool = False
    ) -> None:
        made = [EmulatedGripper(spec) for spec in grippers]
        self.ports: dict[str, Port] = {
            one.spec.arm: (SerialPort if one.settings.port is not None else TextPort)(one, seed) for one in made
        }
        self.paced, self._realtime = paced, realtime
        self.worlds: dict[str, ArmInWorld] = {}
        """Places in the simulated world that the emulators of the rig share, by the name of the arm."""
        self.lock = threading.Lock()
        self.read_end = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="robotiq-emulator", daemon=True)

    def advance(self, seconds: float) -> None:
        """Move the fingers by ``seconds`` at once."""
        with self.lock:
            self._advance(seconds)

    def _advance(self, seconds: float) -> None:
        left = min(seconds, _LONGEST_GAP)
        while left > 1e-9:
            dt = min(left, _STEP)
            left -= dt
            for name, port in self.ports.items():
                world = self.worlds.get(name)
                if world is None:
                    port.gripper.advance(dt)
                else:
                    world.exchange(dt, ())
                    _advance_in(world, port)

    def _serve(self) -> None:
        if self._realtime:
            raise_priority(PRIORITY)  # a busy computer must not look like a silent gripper
        before = monotonic()
        while not self.read_end.is_set():
            with self.lock:
                now = monotonic()
                if self.paced:
                    self._advance(now - before)
                before = now
                for port in self.ports.values():
                    port.send_due(now)
                owners = {line: port for port in self.ports.values() for line in port.descriptors()}
            ready, _, _ = select.select(list(owners), [], [], _STEP)
            with self.lock:
                for descriptor in ready:
                    if descriptor in owners[descriptor].descriptors():  # no command took it away meanwhile
                        owners[descriptor].serve(descriptor)
                for port in self.ports.values():
                    port.send_due(monotonic())

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command, which may begin with the arm's name, and return its answer. Raises ValueError."""
        words = line.split()
        port = self.ports[words.pop(0)] if words and words[0] in self.ports else next(iter(self.ports.values()))
        with self.lock:
            return run_command(COMMANDS, port, words)

    def start(self) -> None:
        """Offer all lines. Raises OSError."""
        for port in self.ports.values():
            port.open()
        self._thread.start()

    def stop(self) -> None:
        self.read_end.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        for port in self.ports.values():
            port.close()

    def __enter__(self) -> RobotiqEmulator:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


# Commands.


def _put(port: Port, words: list[str]) -> None:
    if port.gripper.in_world:
        raise ValueError("the fingers meet the objects of the simulated world: use rig.world, or --no-world")
    port.gripper.put(None if words[0] == "none" else float(words[0]))


def _lose(port: Port, words: list[str]) -> None:
    if words[0] == "next":
        port.lose_next = int(words[1])
    else:
        port.lost_share = float(words[0])


def _power(port: Port, words: list[str]) -> None:
    port.gripper.powered = False
    port.gripper.on_at = read_end(words[0] if words else "0.5")


def _state(port: Port, _: list[str]) -> dict[str, Any]:
    gripper = port.gripper
    names = ("ACT", "GTO", "STA", "OBJ", "FLT", "PRE", "POS")
    return {**dict(zip(names, gripper.read(), strict=True)), "width": gripper.width, "force": gripper.force}


def _reset(port: Port, _: list[str]) -> None:
    port.silent_until = port.out_until = port.delay = port.lost_share = 0.0
    port.lose_next = port.garble_next = 0
    port.gripper.blocked = False


COMMANDS = make_commands(
    Command("object M|none", "put an object of this width between the fingers", _put),
    Command("fault CODE", "raise a fault, hex: 8 to F; 0 ends it", lambda p, w: p.gripper.fail(int(w[0], 16))),
    Command("block on|off", "hold the fingers, so that an activation fails", assign("gripper.blocked", read_switch)),
    Command("power [S|on|off]", "switch its power off for 0.5 s, for S, for good, or on again", _power),
    Command("unplug S|on|off", "take the line away", assign("out_until", read_end)),
    Command("silent S|on|off", "neither hear nor answer", assign("silent_until", read_end)),
    Command("late S", "send answers S seconds late", assign("delay", float)),
    Command("lose P | next N", "lose that share of the answers, or exactly the next N", _lose),
    Command("garble N", "spoil the check of the next N answers", assign("garble_next", int)),
    Command("state", "registers, width (m), force (N)", _state),
    Command("reset", "end all faults of the line, and `block`", _reset),
)
