"""Sockets of the emulated control box: commands (502) and reports (30001 to 30003).

Frames: xarm-python-sdk 1.18.4, uxbus_cmd_tcp.py and x3/base.py.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from hal_emulators import network_arm
from hal_emulators.control import Command, Run, assign, between, make_commands, read_number, read_switch, whole
from hal_emulators.network_arm import Client, NetworkArm
from hal_emulators.shared_world import ArmInWorld

from .controller import DT, Controller

__all__ = ["COMMANDS", "ORDERS", "XArmServer"]

ORDERS, NORMAL, RICH, REAL = 502, 30001, 30002, 30003
"""Port of the commands, and of three kinds of report."""
_PERIODS = {NORMAL: 0.2, RICH: 0.2, REAL: 0.01}
"""Port -> time between two reports, s."""
VERSION = "v2.5.0"
FORCE = 30.0
"""Of the gripper, N."""


def _call(method: str, read: Callable[[str], object]) -> Run:
    return lambda arm, words: getattr(arm.controller, method)(read(words[0]))


def _jog(arm: XArmServer, words: list[str]) -> None:
    c = arm.controller
    c.jog(int(read_number(words[0], 0, c.axes - 1)), read_number(words[1], -3.0, 3.0))


def _disturb(arm: XArmServer, words: list[str]) -> None:
    gripper, word = arm.controller.gripper, words[0]
    if word == "block":
        gripper.blocked = True
    elif word in ("on", "off"):
        gripper.connected, gripper.blocked = word == "on", False
    else:
        gripper.fail(int(read_number(word, 0, 255)))


COMMANDS = make_commands(
    Command(
        "error NUMBER", "stop with an error of the controller, as 31 (collision)", _call("raise_error", whole(1, 255))
    ),
    Command("warn NUMBER", "a warning; 0 for none", assign("controller.warning", whole(0, 255))),
    Command("jump RAD", "take the next set-point so far away", assign("controller.jump", between(-3.0, 3.0))),
    Command("estop on|off", "press or release the emergency stop", _call("press", read_switch)),
    Command("state NUMBER", "as another program: 3 pauses, 4 stops", _call("set_state", whole(0, 6))),
    Command(
        "mode NUMBER",
        "as another program: take over in this mode, as 0 (position) or 2 (by hand)",
        _call("take_over", whole(0, 11)),
    ),
    Command("power on|off", "switch the motors on or off", _call("enable", read_switch)),
    Command("jog JOINT RAD", "move a joint (0 to 6) by hand", _jog),
    Command(
        "object M|none",
        "put an object of this width between the gripper's fingers",
        assign("controller.gripper.object_width", lambda word: None if word == "none" else float(word)),
    ),
    Command(
        "gripper NUMBER|on|off|block", "an error of the gripper, 0 for none; unplug it; hold its fingers", _disturb
    ),
    Command("block on|off", "hold the joints, as an obstacle would", assign("controller.blocked", read_switch)),
    Command("nan on|off", "report a joint as not a number", assign("controller.blind", read_switch)),
    *network_arm.COMMANDS,
)


class XArmServer(NetworkArm):
    PORTS: ClassVar = (ORDERS, *_PERIODS)
    COMMANDS: ClassVar = COMMANDS
    controller: Controller

    def __init__(self, host: str, controller: Controller, seed: int = 0) -> None:
        self._home = list(controller.q)
        self._cycle = 0
        super().__init__(host, controller, seed)

    def take(self, client: Client) -> None:
        while len(client.came) >= 7:
            number, protocol, size = struct.unpack(">HHH", client.came[:6])
            if len(client.came) < 6 + size or size < 1:
                return
            register, data, client.came = client.came[6], client.came[7 : 6 + size], client.came[6 + size :]
            if protocol not in (2, 3):  # 0: the heartbeat of old versions of the SDK, and standard Modbus
                continue
            answer = self._answer(register, data)
            controller = self.controller
            flags = 0x40 * bool(controller.error) | 0x20 * bool(controller.warning)
            flags |= 0x10 * (not controller.ready) | 0x08 * (answer is None)
            body = bytes([register, flags]) + (answer or b"")
            self.send(client, struct.pack(">HHH", number, protocol, len(body)) + body)

    def _answer(self, register: int, data: bytes) -> bytes | None:
        """Execute a command; return the data of its answer, None if it is not known or not possible."""
        c = self.controller
        if register in (23, 29):  # MOVE_JOINT, MOVE_SERVOJ
            *q, speed, acceleration, _ = struct.unpack_from("<10f", data)
            q = q[: c.axes]
            done = c.servo(q) if register == 29 else c.move(q, speed, acceleration)
            return b"" if done or not c.ready else None
        act: dict[int, Callable[[], object]] = {
            11: lambda: c.enable(bool(data[1])),
            12: lambda: c.set_state(data[0]),
            16: c.clean_error,
            17: lambda: setattr(c, "warning", 0),
            19: lambda: c.set_mode(data[0]),
            36: lambda: c.set_load(struct.unpack_from("<4f", data)),
        }
        if register in act:
            act[register]()
            return b""
        if register == 124:  # RS485_RTU: of the line at the flange
            reply = c.gripper.answer(data[1:])
            if reply is None:
                c.raise_error(19)
            return data[:1] + reply if reply is not None else None
        find: dict[int, Callable[[], bytes]] = {
            1: lambda: f"{c.axes},{c.arm.kind},XI1304,AC1304,{VERSION}".encode().ljust(40, b"\0"),
            13: lambda: bytes([c.state]),
            14: lambda: struct.pack(">H", 0),
            15: lambda: bytes([c.error, c.warning]),
            41: lambda: struct.pack("<6f", *c.forward(c.q)),
            128: lambda: struct.pack(">i", 11 if data[1:3] == b"\x0a\x0b" else 0),  # rate of that line: 2 Mbit/s
            42: lambda: struct.pack("<21f", *self._pad(c.q), *self._pad(c.dq), *[0.0] * 7)[: 28 * (data or b"\1")[0]],
        }
        return find[register]() if register in find else None

    @staticmethod
    def _pad(values: Sequence[float]) -> list[float]:
        """Return 7 numbers, whatever the arm's number of joints."""
        return [*values, *[0.0] * (7 - len(values))]

    # Output.

    def publish(self) -> None:
        self._cycle += 1
        made: dict[int, bytes] = {}
        for client in list(self.clients):
            period = _PERIODS.get(client.port)
            if period is None or int(self._cycle * DT / period) == int((self._cycle - 1) * DT / period):
                continue
            if client.port not in made:
                made[client.port] = self._report(client.port)
            self.send_state(client, made[client.port])

    def _report(self, port: int) -> bytes:
        c = self.controller
        q = self._pad(c.q)
        if c.blind:
            q[0] = math.nan
        body = bytes([c.mode << 4 | c.state]) + struct.pack(">H", 0)
        body += struct.pack("<20f", *q, *c.forward(c.q), *[0.0] * 7)
        if port != REAL:
            motors = (1 << c.axes) - 1 if c.enabled else 0
            body += bytes([motors, motors, c.error, c.warning])
            body += struct.pack("<10f", *[0.0] * 6, *c.load) + bytes([3, 3]) + struct.pack("<3f", 0.0, 0.0, -1.0)
        if port == RICH:
            body += bytes([c.arm.kind, c.axes, 0, 0, 0, 0]) + VERSION.encode().ljust(30, b"\0")
            body += struct.pack("<12f", 1e3, 1.0, 5e4, 0.1, 1e3, 20.0, 0.01, 20.0, 1e-4, math.pi, 2.3, 2.7) + bytes(16)
        return struct.pack(">I", 4 + len(body)) + body

    def exchange(self, world: ArmInWorld) -> None:
        gripper = self.controller.gripper
        if self.has_gripper:
            gripper.object_width = world.object_width
            world.fingers = (world.now_of_fingers, gripper.width, FORCE if gripper.holds else 0.0)
        super().exchange(world)

    def renew(self) -> Controller:
        new = Controller(self.controller.robot, self._home)
        new.now = self.controller.now
        return new

    def describe(self) -> dict[str, Any]:
        c = self.controller
        return {
            "q": c.q,
            "dq": c.dq,
            "target_q": c.target,
            "mode": c.mode,
            "state": c.state,
            "error": c.error,
            "enabled": c.enabled,
            "load": c.load,
            "set_points": c.set_points,
            "width": c.gripper.width,
            "speed": c.gripper.speed,
            "gripper_on": c.gripper.enabled,
        }
