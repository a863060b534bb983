"""Driver of an imaginary arm on TCP that sends its STATE 250 times a second. Its other end is ``fake_arm.py``."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import suppress

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import ConnectionLost, Fault
from hal.registry import DriverSpec
from hal.specs import RobotSpec

STATE = struct.Struct("<III18d")
"""Number, ms since power-on, fault; q (rad), dq (rad/s) and the last set-point that it took (rad)."""
COMMAND = struct.Struct("<c12d")
"""P and a set-point (q, dq); H: stop and hold; C: clear the fault. H and C have zeros."""
FAULTS = {7: Fault("7", "a motor is too hot", "let it cool down, then call recover()")}
SILENCE = 0.5
"""A pulled cable sends nothing, not even an end: after so long without a state the arm counts as lost, s."""

DRIVER = DriverSpec(name="tcp_arm", robot="tcp_arm:TcpArm", checks={"robot": "tcp_arm:check_arm"})


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str]]:
    """Yield the mistakes in a rig's ``real:``: before anything is opened, by key."""
    if not isinstance(spec.options.get("host"), str):
        yield "real.host", "the arm's address is missing, for example 192.168.0.10"
    if len(spec.joints) != 6:
        yield "model", f"this arm has 6 joints, not {len(spec.joints)}"


def set_nonblocking(line: socket.socket) -> None:
    line.setblocking(False)  # no call waits for the network
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class TcpArm(RobotDriver):
    """An arm at the address of its options ``host`` and ``port``."""

    line: socket.socket | None = None  # the connection, also one that is being made; None while closed
    last: Reading | None = None  # the newest state; None until the first one of a connection has come

    def open(self) -> None:
        self.close()
        self.place = self.spec.options["host"], self.spec.options.get("port", 4777)
        self.came, self.t_heard, self.t_tried = b"", float("inf"), float("inf")
        try:
            self.line = socket.create_connection(self.place, timeout=2.0)
            self.place = self.line.getpeername()[:2]  # read() must not wait for a name to be looked up
            if not self.line.recv(1, socket.MSG_PEEK):  # it answers: its first state is left for read()
                raise OSError("it hung up")
        except OSError as error:
            self.close()
            raise ConnectionLost(f"no arm at {self.place}: {error}; switch it on, and check real.host") from error
        set_nonblocking(self.line)

    def read(self, now: float) -> Reading:
        if self.line is None:
            raise ConnectionLost(f"{self.spec.name} is not open")
        why, self.t_tried = self.receive(self.line), min(self.t_tried, now)
        end = len(self.came) // STATE.size * STATE.size
        if end:  # at least one whole state: use the newest
            seq, ms, number, *x = STATE.unpack(self.came[end - STATE.size : end])
            self.came, self.t_heard = self.came[end:], now
            fault = FAULTS.get(number, Fault(str(number), f"fault {number}", "see its manual")) if number else None
            self.last = Reading(now, ms / 1e3, seq, x[:6], x[6:12], q_commanded=x[12:], fault=fault)
        elif now - self.t_heard > SILENCE:
            why = "it is silent"
        if why or self.last is None:
            raise self.lost(now, why or "connecting")
        return self.last  # also an old one: its age shows that nothing comes

    def write(self, setpoint: Setpoint) -> None:
        self.send(b"P", *setpoint.q, *setpoint.dq)

    def halt(self) -> None:
        self.send(b"H")

    def recover(self) -> None:
        self.send(b"C")

    def close(self) -> None:
        with suppress(ConnectionLost):  # a lost link takes no command; the arm holds by itself
            self.halt()
        if self.line is not None:
            self.line.close()
        self.line = self.last = None

    def receive(self, line: socket.socket) -> str:
        """Take all that has come; return why the connection is lost, or nothing."""
        try:
            while news := line.recv(1 << 16):
                self.came += news
        except BlockingIOError:
            return ""
        except OSError as error:
            return str(error)
        return "it hung up"

    def send(self, what: bytes, *numbers: float) -> None:
        if self.line is None or self.last is None:
            raise ConnectionLost(f"{self.spec.name} is not connected")
        try:
            sent = self.line.send(COMMAND.pack(what, *numbers or [0.0] * 12))
        except OSError as error:
            raise ConnectionLost(f"{self.spec.name}: {error}") from error
        if sent < COMMAND.size:
            raise ConnectionLost(f"{self.spec.name} takes no more commands")

    def lost(self, now: float, why: str) -> ConnectionLost:
        """Begin to connect again, at most once in SILENCE; read() continues with the new connection."""
        self.last = None
        if now - self.t_tried > SILENCE and self.line is not None:
            self.line.close()
            self.line, self.came, self.t_heard, self.t_tried = socket.socket(self.line.family), b"", now, now
            set_nonblocking(self.line)
            self.line.connect_ex(self.place)  # returns at once
        return ConnectionLost(f"{self.spec.name} at {self.place}: {why}")
