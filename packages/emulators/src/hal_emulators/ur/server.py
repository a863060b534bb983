"""Sockets of the emulated controller: RTDE (30004), dashboard (29999), scripts (30001 to 30003) and faults (1339).

One thread serves everything, once per cycle of the controller.
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import selectors
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from hal_emulators.control import CONTROL_PORT, answer_line, read_number, read_switch
from hal_emulators.shared_world import PRIORITY, ArmInWorld, raise_priority

from .controller import POWER_OFF, RUNNING, Controller

__all__ = ["COMMANDS", "UrServer"]

RTDE, DASHBOARD, PRIMARY, SCRIPTS = 30004, 29999, 30001, (30001, 30002, 30003)
_LONGEST = 1 << 20
"""Most bytes that a client may send without a whole message."""
_FORMATS = {"VECTOR6D": "6d", "DOUBLE": "d", "UINT32": "I", "INT32": "i", "UINT64": "Q"}
_FORMATS |= {"VECTOR6INT32": "6i", "VECTOR3D": "3d", "UINT8": "B", "BOOL": "?"}
_VECTORS = re.compile(
    "(target|actual)_(q|qd|qdd|current|moment|TCP_pose|TCP_speed|TCP_force|joint_voltage)|joint_control_output|"
    "joint_temperatures|ft_raw_wrench|payload_inertia|external_force_torque|tcp_offset"
)
_UNSIGNED = re.compile("(robot|safety)_status_bits|runtime_state|output_bit_registers.*|speed_slider_mask")
_UNSET = {"6d": (0.0,) * 6, "3d": (0.0,) * 3, "6i": (0,) * 6}

COMMANDS = {
    "protective": ("", "protective stop"),
    "estop": ("on|off", "press or release the emergency stop; then: power"),
    "safeguard": ("on|off", "interrupt or close the safeguard input"),
    "power": ("on|off", "switch the arm on and release its brakes, or off"),
    "remote": ("on|off", "remote or local control"),
    "slider": ("SHARE", "the speed slider, 0 to 1"),
    "limit": ("SHARE", "scale the speed, 0.01 to 1, as near a safety limit"),
    "stuck": ("on|off", "ignore set-points"),
    "jog": ("JOINT RAD", "move a joint (0 to 5) by hand, while no program runs"),
    "push": ("FX FY FZ", "push the arm, N in the controller's base"),
    "pause": ("on|off", "pause the program, or let it go on"),
    "program": ("[NAME]", "run another program, or stop the one that is running"),
    "lose": ("SHARE", "leave out this share of the states"),
    "late": ("S", "send states so much later"),
    "silence": ("S", "answer nothing and read nothing; the connections stay"),
    "cut": ("S", "close all connections, and accept none"),
    "refresh": ("", "end all faults and programs, and put the arm back where it began"),
    "status": ("", "what the arm does, and the last events"),
    "help": ("", "this list"),
}


def _type_of(name: str) -> str:
    """Return the type of an RTDE variable."""
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
    """The variables of one kind of packet."""

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


class _Client:
    """One connection."""

    def __init__(self, line: socket.socket, port: int) -> None:
        self.line, self.port, self.came = line, port, b""
        self.output: _Recipe | None = None
        self.inputs: list[_Recipe] = []
        self.every, self.started = 1, False


class UrServer:
    """The controller's ports on one address.

    The control port is one of them: a ``CommandPort``'s threads would change the controller within a cycle.

    Args:
        host: Address to listen on.
        controller: The controller.
        seed: Of the losses.

    Raises:
        OSError: If a port is in use.
    """

    def __init__(self, host: str, controller: Controller, seed: int = 0) -> None:
        self.host, self.controller = host, controller
        self.world: ArmInWorld | None = None
        """The simulated world that the arm is in."""
        self._home = list(controller.motion.q)
        self._random = random.Random(seed)
        self._selector = selectors.DefaultSelector()
        self._clients: list[_Client] = []
        self._late: deque[tuple[float, _Client, bytes]] = deque()
        self._lose = self._delay = 0.0
        self._silent_until = self._cut_until = 0.0
        self._cycle = self._lost = 0
        self._listeners: list[socket.socket] = []
        self._control = self._listen(CONTROL_PORT)
        self._listen_all()

    def _listen(self, port: int) -> socket.socket:
        listener = socket.create_server((self.host, port))
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, port)
        return listener

    def _listen_all(self) -> None:
        self._listeners = [self._listen(port) for port in (RTDE, DASHBOARD, *SCRIPTS)]

    def run(self, ends: Sequence[object]) -> None:
        """Serve until something is in ``ends``."""
        raise_priority(PRIORITY)
        due = time.monotonic()
        while not ends:
            due += self.controller.dt
            self._serve(max(0.0, due - time.monotonic()))
            if time.monotonic() - due > 0.1:  # a computer that slept: time is not made up for
                due = time.monotonic()
            self.controller.step()
            if self.world is not None:
                self.world.exchange(self.controller.dt, self.controller.motion.actual_q)
            self._publish()

    def close(self) -> None:
        """Close all sockets."""
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()

    # Input.

    def _serve(self, wait: float) -> None:
        """Handle what comes within ``wait`` s."""
        end = time.monotonic() + wait
        while True:
            now = time.monotonic()
            if not self._listeners and now >= self._cut_until:
                self._listen_all()
            silent = now < self._silent_until
            for key, _ in self._selector.select(max(0.0, end - now) if not silent else 0.0):
                if isinstance(key.data, int):
                    self._accept(key.fileobj, key.data)  # type: ignore[arg-type]
                elif not silent or key.data.port == CONTROL_PORT:
                    self._receive(key.data)
            if silent and end > now:
                time.sleep(end - now)
            if time.monotonic() >= end:
                return

    def _accept(self, listener: socket.socket, port: int) -> None:
        with contextlib.suppress(OSError):
            line, _ = listener.accept()
            line.setblocking(False)
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = _Client(line, port)
            self._clients.append(client)
            self._selector.register(line, selectors.EVENT_READ, client)
            if port == DASHBOARD:
                self._send(client, b"Connected: Universal Robots Dashboard Server\n")
            elif port == PRIMARY:
                self._send(client, self.controller.pack_kinematics())

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.line)
            client.line.close()

    def _receive(self, client: _Client) -> None:
        try:
            news = client.line.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            news = b""
        client.came += news
        if not news or len(client.came) > _LONGEST:
            self._drop(client)
        elif client.port == RTDE:
            self._take_packets(client)
        elif client.port in SCRIPTS:
            self._take_script(client)
        else:
            *lines, client.came = client.came.split(b"\n")
            for line in lines:
                self._answer(client, line.decode(errors="replace").strip())

    def _answer(self, client: _Client, line: str) -> None:
        if client.port == DASHBOARD:
            answer = self.controller.answer_dashboard(line.lower())
        else:
            answer = json.dumps(answer_line(self.execute, line))
        self._send(client, answer.encode() + b"\n")

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
            taken = {x for other in self._clients if other is not client for r in other.inputs for x in r.names}
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
            self._send(client, struct.pack(">HB", 3 + len(reply), ord(kind)) + reply)

    # Output.

    def _send(self, client: _Client, data: bytes) -> None:
        try:
            client.line.send(data)
        except BlockingIOError:  # a client that reads nothing misses states
            return
        except OSError:
            self._drop(client)

    def _publish(self) -> None:
        """Send the state to every client that asked for it."""
        now, self._cycle = time.monotonic(), self._cycle + 1
        if now < self._silent_until:
            return
        while self._late and self._late[0][0] <= now:
            _, client, packet = self._late.popleft()
            self._send(client, packet)
        state = None
        for client in list(self._clients):
            if not client.started or client.output is None or self._cycle % client.every:
                continue
            if self._lose and self._random.random() < self._lose:
                self._lost += 1
                continue
            state = state or self.controller.read_state()
            data = b"\1" + client.output.pack(state)
            packet = struct.pack(">HB", 3 + len(data), ord("U")) + data
            if self._delay or self._late:
                self._late.append((now + self._delay, client, packet))
            else:
                self._send(client, packet)

    # Faults.

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of :data:`COMMANDS`. Raises ValueError for a wrong one."""
        name, *values = line.split() or [""]
        if name not in COMMANDS:
            raise ValueError(f"there is no command {name!r}; help lists them")
        if name == "help":
            return {"text": help_text()}
        if name == "status":
            return self._describe()
        controller = self.controller
        act: dict[str, Callable[[], object]] = {
            "protective": lambda: controller.stop_protective("C153: requested here"),
            "estop": lambda: controller.stop_emergency(read_switch(values[0])),
            "safeguard": lambda: controller.set_safeguard(read_switch(values[0])),
            "power": lambda: controller.set_power(RUNNING if read_switch(values[0]) else POWER_OFF),
            "remote": lambda: controller.set_remote(read_switch(values[0])),
            "slider": lambda: setattr(controller.motion, "scale", read_number(values[0], 0.01, 1.0)),
            "limit": lambda: setattr(controller.motion, "limit", read_number(values[0], 0.01, 1.0)),
            "stuck": lambda: setattr(controller, "stuck", read_switch(values[0])),
            "jog": lambda: controller.jog(int(read_number(values[0], 0, 5)), read_number(values[1], -3.0, 3.0)),
            "push": lambda: controller.push([read_number(values[k], -1e3, 1e3) for k in range(3)]),
            "pause": lambda: controller.pause(read_switch(values[0])),
            "program": lambda: (
                controller.upload(f"def {values[0]}():") if values else controller.stop_program("pendant")
            ),
            "lose": lambda: setattr(self, "_lose", read_number(values[0], 0.0, 1.0)),
            "late": lambda: setattr(self, "_delay", read_number(values[0], 0.0, 10.0)),
            "silence": lambda: setattr(self, "_silent_until", time.monotonic() + read_number(values[0], 0.0, 1e9)),
            "cut": lambda: self._cut(read_number(values[0], 0.0, 1e9)),
            "refresh": self._refresh,
        }
        try:
            act[name]()
        except (ValueError, IndexError) as error:
            raise ValueError(f"{error}; usage: {name} {COMMANDS[name][0]}".rstrip()) from None
        return {}

    def _cut(self, seconds: float) -> None:
        self._cut_until = time.monotonic() + seconds
        for listener in self._listeners:
            self._selector.unregister(listener)
            listener.close()
        self._listeners = []
        for client in [client for client in self._clients if client.port != CONTROL_PORT]:
            self._drop(client)

    def _refresh(self) -> None:
        old = self.controller
        self._lose = self._delay = self._silent_until = self._cut_until = 0.0
        self.controller = Controller(old.robot, self._home, old.payload, old.tcp)
        self.controller.cog, self.controller.dh, self.controller.now = old.cog, old.dh, old.now

    def _describe(self) -> dict[str, Any]:
        controller, motion = self.controller, self.controller.motion
        return {
            "q": motion.actual_q,
            "dq": motion.actual_dq,
            "target_q": motion.q,
            "program": controller.program,
            "safety_mode": controller.safety_mode,
            "payload": controller.payload,
            "tcp": controller.tcp,
            "events": controller.events,
            "lost": self._lost,
            "now": controller.now,
        }


def help_text() -> str:
    """Return the table of commands."""
    return "\n".join(f"  {name + ' ' + usage:18s} {meaning}" for name, (usage, meaning) in COMMANDS.items())
