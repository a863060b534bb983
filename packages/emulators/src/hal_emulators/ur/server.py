"""Sockets of the emulated controller: RTDE (30004), dashboard (29999) and scripts (30001 to 30003)."""

from __future__ import annotations

import re
import struct
from typing import Any, ClassVar

from hal_emulators import network_arm
from hal_emulators.control import Command, Run, assign, between, make_commands, read_number, read_switch
from hal_emulators.network_arm import Client, NetworkArm, take_lines

from .controller import POWER_OFF, RUNNING, Controller

__all__ = ["COMMANDS", "UrServer"]

RTDE, DASHBOARD, PRIMARY, SCRIPTS = 30004, 29999, 30001, (30001, 30002, 30003)
_FORMATS = {"VECTOR6D": "6d", "DOUBLE": "d", "UINT32": "I", "INT32": "i", "UINT64": "Q"}
_FORMATS |= {"VECTOR6INT32": "6i", "VECTOR3D": "3d", "UINT8": "B", "BOOL": "?"}
_VECTORS = re.compile(
    "(target|actual)_(q|qd|qdd|current|moment|TCP_pose|TCP_speed|TCP_force|joint_voltage)|joint_control_output|"
    "joint_temperatures|ft_raw_wrench|payload_inertia|external_force_torque|tcp_offset"
)
_UNSIGNED = re.compile("(robot|safety)_status_bits|runtime_state|output_bit_registers.*|speed_slider_mask")
_UNSET = {"6d": (0.0,) * 6, "3d": (0.0,) * 3, "6i": (0,) * 6}


def _push(arm: UrServer, words: list[str]) -> None:
    arm.controller.push([read_number(words[k], -1e3, 1e3) for k in range(3)])


def _jog(arm: UrServer, words: list[str]) -> None:
    arm.controller.jog(int(read_number(words[0], 0, 5)), read_number(words[1], -3.0, 3.0))


def _program(arm: UrServer, words: list[str]) -> None:
    if words:
        arm.controller.upload(f"def {words[0]}():")
    else:
        arm.controller.stop_program("pendant")


def _switch(method: str) -> Run:
    return lambda arm, words: getattr(arm.controller, method)(read_switch(words[0]))


COMMANDS = make_commands(
    Command("protective", "protective stop", lambda arm, _: arm.controller.stop_protective("C153: requested here")),
    Command("estop on|off", "press or release the emergency stop; then: power", _switch("stop_emergency")),
    Command("safeguard on|off", "interrupt or close the safeguard input", _switch("set_safeguard")),
    Command(
        "safety MODE",
        "mode of the safety system: 1 normal, 4 recovery, 6 stop of the system, 8 violation, 9 fault",
        lambda arm, words: arm.controller.set_safety(int(read_number(words[0], 1, 9))),
    ),
    Command("jump RAD", "take the next set-point so far away", assign("controller.jump", between(-3.0, 3.0))),
    Command(
        "power on|off",
        "switch the arm on and release its brakes, or off",
        lambda arm, words: arm.controller.set_power(RUNNING if read_switch(words[0]) else POWER_OFF),
    ),
    Command("remote on|off", "remote or local control", _switch("set_remote")),
    Command("slider SHARE", "the speed slider, 0 to 1", assign("controller.motion.scale", between(0.01, 1.0))),
    Command(
        "limit SHARE", "scale the speed, as near a safety limit", assign("controller.motion.limit", between(0.01, 1.0))
    ),
    Command("stuck on|off", "ignore set-points", assign("controller.stuck", read_switch)),
    Command("jog JOINT RAD", "move a joint (0 to 5) by hand, while no program runs", _jog),
    Command("push FX FY FZ", "push the arm, N in the controller's base", _push),
    Command("pause on|off", "pause the program, or let it go on", _switch("pause")),
    Command("program [NAME]", "run another program, or stop the one that is running", _program),
    *network_arm.COMMANDS,
)


def _type_of(name: str) -> str:
    if _VECTORS.fullmatch(name):
        return "VECTOR6D"
    if name == "joint_mode":
        return "VECTOR6INT32"
    if name in ("actual_tool_accelerometer", "payload_cog"):
        return "VECTOR3D"
    if _UNSIGNED.fullmatch(name):
        return "UINT32"
    if name in ("actual_digital_input_bits", "actual_digital_output_bits"):
        return "UINT64"
    if name in ("robot_mode", "safety_mode", "safety_status") or "int_register" in name:
        return "INT32"
    if "digital_output" in name or name in ("standard_analog_output_mask", "standard_analog_output_type"):
        return "UINT8"
    return "BOOL" if "bit_register" in name else "DOUBLE"


class _Recipe:
    def __init__(self, names: list[str]) -> None:
        self.names = names
        self.formats = [_FORMATS[_type_of(name)] for name in names]
        self.packing = struct.Struct(">" + "".join(self.formats))

    def pack(self, state: dict[str, Any]) -> bytes:
        values: list[Any] = []
        for name, kind in zip(self.names, self.formats, strict=True):
            value = state.get(name)
            if kind in _UNSET:
                values += _UNSET[kind] if value is None else value
            else:
                values.append(value or 0)
        return self.packing.pack(*values)

    def unpack(self, data: bytes) -> dict[str, float]:
        values = iter(self.packing.unpack(data[: self.packing.size]))
        found = {}
        for name, kind in zip(self.names, self.formats, strict=True):
            found[name] = next(values)
            for _ in range(int(kind[0]) - 1 if kind[0].isdigit() else 0):
                next(values)
        return found


class _Client(Client):
    output: _Recipe | None = None
    every, started = 1, False

    def __init__(self, *line: Any) -> None:
        super().__init__(*line)
        self.inputs: list[_Recipe] = []


class UrServer(NetworkArm):
    PORTS: ClassVar = (RTDE, DASHBOARD, *SCRIPTS)
    COMMANDS: ClassVar = COMMANDS
    client: ClassVar = _Client
    controller: Controller

    def __init__(self, host: str, controller: Controller, seed: int = 0) -> None:
        self._home = list(controller.motion.q)
        self._cycle = 0
        super().__init__(host, controller, seed)

    def greet(self, client: Client) -> None:
        if client.port == DASHBOARD:
            self.send(client, b"Connected: Universal Robots Dashboard Server\n")
        elif client.port == PRIMARY:
            self.send(client, self.controller.pack_kinematics())

    def take(self, client: _Client) -> None:
        if client.port == RTDE:
            self._take_packets(client)
        elif client.port in SCRIPTS:
            self._take_script(client)
        else:
            for line in take_lines(client):
                self.send(client, self.controller.answer_dashboard(line.lower()).encode() + b"\n")

    def _take_script(self, client: _Client) -> None:
        """Run a script once its last line has come."""
        text = client.came.decode(errors="replace")
        if text.rstrip("\n \t").endswith("\nend"):
            client.came = b""
            self.controller.upload(text)

    def _take_packets(self, client: _Client) -> None:
        while len(client.came) >= 3:
            size, kind = struct.unpack(">HB", client.came[:3])
            if len(client.came) < size or size < 3:
                return
            data, client.came = client.came[3:size], client.came[size:]
            self._take_packet(client, chr(kind), data)

    def _take_packet(self, client: _Client, kind: str, data: bytes) -> None:
        reply: bytes | None = None
        if kind == "V":
            reply = b"\1"
        elif kind == "v":
            reply = struct.pack(">4I", *self.controller.version)
        elif kind == "O":
            names = [name for name in data[8:].decode().split(",") if name]
            client.output = _Recipe(names)
            client.every = max(1, round(self.controller.rate / max(1.0, struct.unpack(">d", data[:8])[0])))
            reply = b"\1" + ",".join(map(_type_of, names)).encode()
        elif kind == "I":
            names = [name for name in data.decode().split(",") if name]
            taken = {x for other in self.clients if other is not client for r in other.inputs for x in r.names}
            client.inputs.append(_Recipe(names))
            kinds = ["IN_USE" if name in taken else _type_of(name) for name in names]
            reply = bytes([len(client.inputs)]) + ",".join(kinds).encode()
            if "IN_USE" in kinds:
                client.inputs.pop()
        elif kind in "SP":
            client.started, reply = kind == "S", b"\1"
        elif kind == "U" and data and 0 < data[0] <= len(client.inputs):
            recipe = client.inputs[data[0] - 1]
            if len(data) > recipe.packing.size:
                self.controller.write_inputs(recipe.unpack(data[1:]))
        if reply is not None:
            self.send(client, struct.pack(">HB", 3 + len(reply), ord(kind)) + reply)

    def publish(self) -> None:
        self._cycle += 1
        state = None
        for client in list(self.clients):
            if client.started and client.output is not None and self._cycle % client.every == 0:
                state = state or self.controller.read_state()
                data = b"\1" + client.output.pack(state)
                self.send_state(client, struct.pack(">HB", 3 + len(data), ord("U")) + data)

    def renew(self) -> Controller:
        old = self.controller
        new = Controller(old.robot, self._home)
        new.payload, new.cog, new.tcp, new.dh, new.now = old.payload, old.cog, old.tcp, old.dh, old.now
        return new

    def describe(self) -> dict[str, Any]:
        controller, motion = self.controller, self.controller.motion
        return {
            "q": motion.actual_q,
            "dq": motion.actual_dq,
            "target_q": motion.q,
            "program": controller.program,
            "safety_mode": controller.safety_mode,
            "payload": controller.payload,
            "tcp": controller.tcp,
        }
