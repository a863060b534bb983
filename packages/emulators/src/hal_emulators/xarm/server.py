"""Sockets of the emulated control box: commands (502), reports (30001 to 30003) and faults (1339).

One thread serves everything, once per cycle of the controller. Frames: xarm-python-sdk 1.18.4, uxbus_cmd_tcp.py and
x3/base.py.
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import selectors
import socket
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

from hal_emulators.control import CONTROL_PORT, answer_line, read_number, read_switch
from hal_emulators.shared_world import PRIORITY, ArmInWorld, raise_priority

from .controller import DT, Controller

__all__ = ["COMMANDS", "ORDERS", "XArmServer"]

ORDERS, NORMAL, RICH, REAL = 502, 30001, 30002, 30003
"""Port of the commands, and of three kinds of report."""
_PERIODS = {NORMAL: 0.2, RICH: 0.2, REAL: 0.01}
"""Port -> time between two reports, s."""
_LONGEST = 1 << 16
"""Most bytes that a client may send without a whole frame."""
VERSION = "v2.5.0"

COMMANDS = {
    "error": ("NUMBER", "stop with an error of the controller, as 31 (collision)"),
    "warn": ("NUMBER", "a warning; 0 for none"),
    "estop": ("on|off", "press or release the emergency stop"),
    "state": ("NUMBER", "as another program: 3 pauses, 4 stops"),
    "mode": ("NUMBER", "as another program: take over in this mode, as 0 (position) or 2 (by hand)"),
    "power": ("on|off", "switch the motors on or off"),
    "jog": ("JOINT RAD", "move a joint (0 to 6) by hand"),
    "block": ("on|off", "hold the joints, as an obstacle would"),
    "nan": ("on|off", "report a joint as not a number"),
    "lose": ("SHARE", "leave out this share of the reports"),
    "mute": ("S", "answer no commands; reports go on"),
    "silence": ("S", "answer nothing and report nothing; the connections stay"),
    "cut": ("S", "close all connections, and accept none"),
    "refresh": ("", "end all faults, and put the arm back where it began"),
    "status": ("", "what the arm does, and the last events"),
    "help": ("", "this list"),
}


class _Client:
    """One connection."""

    def __init__(self, line: socket.socket, port: int) -> None:
        self.line, self.port, self.came = line, port, b""


class XArmServer:
    """The ports of the control box on one address.

    Args:
        host: Address to listen on.
        controller: The controller.
        seed: Of the losses.

    Raises:
        OSError: If a port is in use, or below 1024 and not allowed.
    """

    def __init__(self, host: str, controller: Controller, seed: int = 0) -> None:
        self.host, self.controller = host, controller
        self.world: ArmInWorld | None = None
        """The simulated world that the arm is in."""
        self._home = list(controller.q)
        self._random = random.Random(seed)
        self._selector = selectors.DefaultSelector()
        self._clients: list[_Client] = []
        self._listeners: list[socket.socket] = []
        self._calm()
        self._cycle = 0
        self._listen(CONTROL_PORT)
        self._listen_all()

    def _calm(self) -> None:
        self._lose = self._mute_until = self._silent_until = self._cut_until = 0.0

    def _listen(self, port: int) -> socket.socket:
        listener = socket.create_server((self.host, port))
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, port)
        return listener

    def _listen_all(self) -> None:
        self._listeners = [self._listen(port) for port in (ORDERS, *_PERIODS)]

    def run(self, ends: Sequence[object]) -> None:
        """Serve until something is in ``ends``."""
        raise_priority(PRIORITY)
        due = time.monotonic()
        while not ends:
            due += DT
            self._serve(max(0.0, due - time.monotonic()))
            if time.monotonic() - due > 0.1:  # a computer that slept: time is not made up for
                due = time.monotonic()
            self.controller.step()
            if self.world is not None:
                self.world.exchange(DT, self.controller.q)
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
            deaf = now < max(self._silent_until, self._mute_until)
            for key, _ in self._selector.select(max(0.0, end - now) if not deaf else 0.0):
                if isinstance(key.data, int):
                    self._accept(key.fileobj, key.data)  # type: ignore[arg-type]
                elif not deaf or key.data.port != ORDERS:
                    self._receive(key.data)
            if deaf and end > now:
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

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.line)
            client.line.close()

    def _send(self, client: _Client, data: bytes) -> None:
        try:
            client.line.send(data)
        except BlockingIOError:  # a client that reads nothing misses reports
            return
        except OSError:
            self._drop(client)

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
        elif client.port == ORDERS:
            self._take_frames(client)
        elif client.port == CONTROL_PORT:
            *lines, client.came = client.came.split(b"\n")
            for line in lines:
                answer = json.dumps(answer_line(self.execute, line.decode(errors="replace")))
                self._send(client, answer.encode() + b"\n")

    def _take_frames(self, client: _Client) -> None:
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
            self._send(client, struct.pack(">HHH", number, protocol, len(body)) + body)

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
        find: dict[int, Callable[[], bytes]] = {
            1: lambda: f"{c.axes},{c.arm.kind},XI1304,AC1304,{VERSION}".encode().ljust(40, b"\0"),
            13: lambda: bytes([c.state]),
            14: lambda: struct.pack(">H", 0),
            15: lambda: bytes([c.error, c.warning]),
            41: lambda: struct.pack("<6f", *c.forward(c.q)),
            42: lambda: struct.pack("<21f", *self._pad(c.q), *self._pad(c.dq), *[0.0] * 7)[: 28 * (data or b"\1")[0]],
        }
        return find[register]() if register in find else None

    @staticmethod
    def _pad(values: Sequence[float]) -> list[float]:
        """Return 7 numbers, whatever the arm's number of joints."""
        return [*values, *[0.0] * (7 - len(values))]

    # Output.

    def _publish(self) -> None:
        """Send the reports that are due."""
        self._cycle += 1
        if time.monotonic() < self._silent_until:
            return
        made: dict[int, bytes] = {}
        for client in list(self._clients):
            period = _PERIODS.get(client.port)
            if period is None or int(self._cycle * DT / period) == int((self._cycle - 1) * DT / period):
                continue
            if client.port not in made:
                lost = client.port == REAL and self._random.random() < self._lose
                made[client.port] = b"" if lost else self._report(client.port)
            if made[client.port]:
                self._send(client, made[client.port])

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
        c = self.controller
        act: dict[str, Callable[[], object]] = {
            "error": lambda: c.raise_error(int(read_number(values[0], 1, 255))),
            "warn": lambda: setattr(c, "warning", int(read_number(values[0], 0, 255))),
            "estop": lambda: c.press(read_switch(values[0])),
            "state": lambda: c.set_state(int(read_number(values[0], 0, 6))),
            "mode": lambda: c.take_over(int(read_number(values[0], 0, 11))),
            "power": lambda: c.enable(read_switch(values[0])),
            "jog": lambda: c.jog(int(read_number(values[0], 0, c.axes - 1)), read_number(values[1], -3.0, 3.0)),
            "block": lambda: setattr(c, "blocked", read_switch(values[0])),
            "nan": lambda: setattr(c, "blind", read_switch(values[0])),
            "lose": lambda: setattr(self, "_lose", read_number(values[0], 0.0, 1.0)),
            "mute": lambda: setattr(self, "_mute_until", time.monotonic() + read_number(values[0], 0.0, 1e9)),
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
        self._calm()
        self.controller = Controller(old.robot, self._home)
        self.controller.now = old.now

    def _describe(self) -> dict[str, Any]:
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
            "events": c.events,
            "now": c.now,
        }


def help_text() -> str:
    """Return the table of commands."""
    return "\n".join(f"  {name + ' ' + usage:16s} {meaning}" for name, (usage, meaning) in COMMANDS.items())
