"""The emulator at work: the lines of a rig's grippers, which answer; commands inject faults.

with RobotiqEmulator("fr3_robotiq") as emulator:
    emulator.execute("object 0.03")           # from any thread
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hal.specs import GripperSpec
from hal_emulators.control import Command, assign, make_commands, read_end, read_switch
from hal_emulators.lines import LINE_COMMANDS, LONGEST_GAP, LineEmulator
from hal_emulators.shared_world import ArmInWorld, load_real

from .gripper import EmulatedGripper
from .ports import Port, SerialPort, TextPort


def find_grippers(config: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> list[GripperSpec]:
    """Return the grippers of a rig that this emulator can play. Raises ConfigError and ValueError."""
    robots = load_real(config, overrides).robots
    found = [robot.gripper for robot in robots if robot.gripper is not None and robot.gripper.driver == "robotiq"]
    if not found:
        raise ValueError("this rig has no Robotiq gripper that is not simulated")
    return found


def _advance_in(world: ArmInWorld, port: Port) -> None:
    """Move the fingers up to the time that the world has reached, where its arm has come to the object as well."""
    port.gripper.meet(world.object_width)
    t = max(port.t, world.now_of_fingers)
    port.gripper.advance(min(max(0.0, t - max(port.t, port.asked)), LONGEST_GAP))
    port.t = t
    world.fingers = (t, port.gripper.width, port.gripper.force)


class RobotiqEmulator(LineEmulator):
    """Emulated grippers, each on its line, by the name of the arm; the arguments are those of LineEmulator."""

    lines: dict[str, Port]

    def __init__(
        self, grippers: Iterable[GripperSpec], seed: int = 0, paced: bool = True, realtime: bool = False
    ) -> None:
        super().__init__(paced, realtime)
        made = [EmulatedGripper(spec) for spec in grippers]
        self.lines = {
            one.spec.arm: (SerialPort if one.settings.port is not None else TextPort)(one, seed) for one in made
        }
        self.worlds: dict[str, ArmInWorld] = {}
        """Places in the simulated world that the emulators of the rig share, by the name of the arm."""

    def step(self, dt: float) -> None:
        for name, port in self.lines.items():
            world = self.worlds.get(name)
            if world is None:
                port.gripper.advance(dt)
            else:
                world.exchange(dt, ())
                _advance_in(world, port)


# Commands.


def _put(port: Port, words: list[str]) -> None:
    if port.gripper.in_world:
        raise ValueError("the fingers meet the objects of the simulated world: use rig.world, or --no-world")
    port.gripper.put(None if words[0] == "none" else float(words[0]))


def _power(port: Port, words: list[str]) -> None:
    port.gripper.powered = False
    port.gripper.on_at = read_end(words[0] if words else "0.5")


def _state(port: Port, _: list[str]) -> dict[str, Any]:
    gripper = port.gripper
    names = ("ACT", "GTO", "STA", "OBJ", "FLT", "PRE", "POS")
    return {**dict(zip(names, gripper.read(), strict=True)), "width": gripper.width, "force": gripper.force}


def _reset(port: Port, _: list[str]) -> None:
    port.reset()
    port.out_until = 0.0
    port.gripper.blocked = False


COMMANDS = make_commands(
    Command("object M|none", "put an object of this width between the fingers", _put),
    Command("fault CODE", "raise a fault, hex: 8 to F; 0 ends it", lambda p, w: p.gripper.fail(int(w[0], 16))),
    Command("block on|off", "hold the fingers, so that an activation fails", assign("gripper.blocked", read_switch)),
    Command("power [S|on|off]", "switch its power off for 0.5 s, for S, for good, or on again", _power),
    Command("silent S|on|off", "neither hear nor answer", assign("silent_until", read_end)),
    Command(
        "lose P | next N",
        "lose that share of the answers, or exactly the next N",
        lambda port, words: port.losses.set(words),
    ),
    Command("garble N", "spoil the check of the next N answers", assign("spoil_next", int)),
    Command("state", "registers, width (m), force (N)", _state),
    Command("reset", "end all faults of the line, and `block`", _reset),
    *LINE_COMMANDS,
)
RobotiqEmulator.COMMANDS = COMMANDS
