"""Server of the emulated arm: one client at a time, requests over TCP, states and commands over UDP, in one thread.

In every cycle the server gathers the client's command, advances the arm and sends the state.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

from hal_emulators.shared_world import ArmInWorld

from .arm import ArmReply, EmulatedArm, RequestHandler, RobotFiles
from .faults import InjectedFaults
from .journal import Counters
from .motion import DT
from .protocol import HEADER, PORT, CommandPacket, RequestOutcome, read_command

T = TypeVar("T")

# Timing.


@dataclass(frozen=True)
class Pacing:
    """When the next cycle begins.

    In real time a state is sent every millisecond, answered or not. In lock-step, during a motion, the emulator waits
    for the answer to each state, so nothing is lost however slow either side is: for tests, and for running faster
    than real time. Without a motion, a state is sent every millisecond in both cases.
    """

    lockstep: bool = False
    paced: bool = True
    """Lock-step only: no cycle is shorter than a millisecond."""
    patience: float = 5.0
    """Lock-step only: time after which an answer counts as lost, s."""

    def describe(self) -> str:
        if not self.lockstep:
            return "real time"
        return "lock-step, paced" if self.paced else "lock-step"


class CyclePacer:
    """Absolute deadlines, a millisecond apart.

    A cycle that is more than a millisecond late shifts all later ones, so the client always has its millisecond.
    """

    def __init__(self) -> None:
        self._due = time.monotonic()

    def wait(self, counters: Counters | None) -> None:
        """Sleep until the next deadline, and record the lateness in ``counters``, if given."""
        self._due += DT
        left = self._due - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        now = time.monotonic()
        late = now - self._due
        if counters is not None:
            counters.late(self._due, late)
        if late > DT:
            self._due = now

    def skip(self) -> None:
        """Set the next deadline to a millisecond from now."""
        self._due = time.monotonic()


# The connection.

_MAX_REQUEST = 65536
"""Largest size of a request, bytes."""
_MAX_COMMANDS = 64
"""Commands that are read at once, so that a flood of them does not delay the arm."""
_CONNECT_TIMEOUT = 2.0
"""s after which a connection without a Connect request is replaced by the next one."""
_SEND_TIMEOUT = 1.0
"""Longest time until a client accepts a response, s."""


class ArmRequest(NamedTuple):
    code: int
    number: int
    payload: bytes


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket. Raises OSError that names host and port."""
    try:
        listener = socket.create_server((host, port))
    except OSError as error:
        raise OSError(error.errno, f"cannot listen on {host}:{port}: {os.strerror(error.errno or 0)}") from None
    listener.setblocking(False)
    return listener


class ArmClient:
    def __init__(self, connection: socket.socket, host: str) -> None:
        self.tcp = connection
        self.tcp.settimeout(_SEND_TIMEOUT)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.peer: str = connection.getpeername()[0]
        self.name = "{}:{}".format(*connection.getpeername())
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind((host, 0))
        self.udp.setblocking(False)
        self.connected = False
        """Whether a Connect request was accepted."""
        self._since = time.monotonic()
        self._port = 0
        self._received = bytearray()

    def open_udp(self, port: int) -> None:
        """Send states to the client's port from now on."""
        self._port = port
        self.connected = True

    def requests(self) -> list[ArmRequest]:
        """Return the requests that arrived. Raises ConnectionError at the end, and for invalid data."""
        data = self.tcp.recv(_MAX_REQUEST)
        if not data:
            raise ConnectionError("the client closed the connection")
        self._received += data
        found = []
        while len(self._received) >= HEADER.size:
            code, number, size = HEADER.unpack_from(self._received)
            if not HEADER.size <= size <= _MAX_REQUEST:
                raise ConnectionError(f"a request of {size} bytes")
            if len(self._received) < size:
                break
            found.append(ArmRequest(code, number, bytes(self._received[HEADER.size : size])))
            del self._received[:size]
        return found

    def gone(self) -> bool:
        """Return whether the client has disconnected, with nothing left to read, or never sent Connect."""
        if not self.connected and time.monotonic() > self._since + _CONNECT_TIMEOUT:
            return True
        try:
            readable = select.select([self.tcp], [], [], 0.0)[0]
            return bool(readable) and not self.tcp.recv(1, socket.MSG_PEEK)
        except OSError:
            return True

    def reply(self, code: int, number: int, body: bytes) -> None:
        """Answer a request. Raises OSError if the client does not accept it."""
        self.tcp.sendall(HEADER.pack(code, number, HEADER.size + len(body)) + body)

    def send_state(self, packet: bytes | bytearray | memoryview) -> None:
        """Send a state; one that cannot be sent is lost, as on a network."""
        with contextlib.suppress(OSError):
            self.udp.sendto(packet, (self.peer, self._port))

    def commands(self) -> list[bytes]:
        found: list[bytes] = []
        with contextlib.suppress(OSError):
            while len(found) < _MAX_COMMANDS:
                found.append(self.udp.recv(2048))
        return found

    def close(self) -> None:
        self.tcp.close()
        self.udp.close()


# The server.

_IDLE = 0.05
"""Cycle time while there is no client, s."""
_SLICE = 0.05
"""Longest uninterrupted wait for an answer, s, so that signals are noticed."""
_FIRST_PATIENCE = 0.1
"""Time between states in lock-step before a motion's first command, s. The client's library reads up to two states
before its caller can command anything."""
_STATES_BEFORE = 2
_HUNG_PATIENCE = 0.01
"""Time for each further answer once one is overdue, s."""


class ArmServer:
    """Serves one client at a time on port 1337 of one address."""

    def __init__(self, host: str, arm: EmulatedArm, files: RobotFiles, pacing: Pacing, seed: int = 0) -> None:
        """Raises OSError if the port is not available."""
        self.host = host
        self.arm = arm
        self.pacing = pacing
        self.faults = InjectedFaults(seed)
        self.poller = select.epoll()
        self.session: ArmClient | None = None
        arm.send = self._send_reply
        self._handler = RequestHandler(arm, files)
        self._pacer = CyclePacer()
        self._listener = listen(host, PORT)
        self.poller.register(self._listener, select.EPOLLIN)
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        self._called = os.eventfd(0)
        self.poller.register(self._called, select.EPOLLIN)
        self._requests: deque[tuple[float, ArmRequest]] = deque()
        self._replies: list[ArmReply] = []
        self._command: CommandPacket | None = None
        self._answered = False
        self._state_sent = False
        self._sent_at = 0.0
        self._hung = False
        self._away_until = 0.0
        self._ends: Sequence[object] = ()
        self.world: ArmInWorld | None = None
        """The simulated world that the arm is in."""

    def call(self, function: Callable[[], T]) -> T:
        """Call a function between two cycles, and return what it does; not from the thread that serves."""
        future: Future[T] = Future()
        self._calls.put((function, future))
        os.eventfd_write(self._called, 1)
        return future.result()

    def run(self, ends: Sequence[object]) -> None:
        self._ends = ends
        while not ends:
            self._gather()
            packet = self.arm.tick(self._command)
            if self.session is not None and self.session.connected:
                self._send_state(self.session, packet)
            self._flush()
            if self.world is not None:
                self.world.exchange(DT, self.arm.plant.q)

    def close(self) -> None:
        if self.session is not None:
            self._end_session("the emulator ends")
        self._listener.close()
        self.poller.close()
        os.close(self._called)

    def restart(self, away: float) -> None:
        """Restart as if switched off and on: drop the client, reset, and stay unreachable for ``away`` s."""
        if self.session is not None:
            self._end_session("restart")
        self.faults.clear()
        self.arm.no_move_reply = False
        self.arm.reports.clear()
        self.arm.restart()
        if away > 0.0:
            self.poller.unregister(self._listener)
            self._listener.close()
            self._away_until = time.monotonic() + away

    # The command of a cycle.

    def _gather(self) -> None:
        self._command = None
        self._answered = False
        if self._away_until and time.monotonic() >= self._away_until:
            self._listener = listen(self.host, PORT)
            self.poller.register(self._listener, select.EPOLLIN)
            self._away_until = 0.0
        if self._waits_for_answers():
            self._await_answer()
            if self.pacing.paced or time.monotonic() < self.faults.silent_until:
                self._pacer.wait(None)
            else:
                self._pacer.skip()
        elif self.session is None and self.arm.at_rest:
            self._serve(_IDLE)
            self._pacer.skip()
        else:
            self._pacer.wait(self.arm.counters)
            self._serve(0.0)

    def _waits_for_answers(self) -> bool:
        motion = self.arm.motion
        if not self.pacing.lockstep or motion is None:
            return False
        return not motion.waiting or motion.states_shown >= _STATES_BEFORE

    def _await_answer(self) -> None:
        """Wait for the answer to the last state (lock-step), unless that state was not sent."""
        motion = self.arm.motion
        assert motion is not None
        if motion.waiting:
            patience = _FIRST_PATIENCE
        else:
            patience = _HUNG_PATIENCE if self._hung else self.pacing.patience
        deadline = time.monotonic() + patience if self._state_sent else 0.0
        while True:
            left = deadline - time.monotonic()
            self._serve(max(0.0, min(left, _SLICE)))
            if self._answered:
                self._hung = False
                self.arm.counters.answers.add(time.monotonic() - self._sent_at)
                return
            if self.arm.motion is not motion or self._ends:
                return
            if left <= 0.0:
                self._hung = not motion.waiting and self._state_sent
                return

    def _serve(self, timeout: float) -> None:
        """Wait up to ``timeout`` s for input, and process it."""
        for descriptor, _ in self.poller.poll(timeout):
            session = self.session
            if session is not None and descriptor == session.udp.fileno():
                self._receive(session)
            elif session is not None and descriptor == session.tcp.fileno():
                self._read_requests(session)
            elif descriptor == self._listener.fileno():
                self._accept()
            elif descriptor == self._called:
                self._answer_call()
        while self._requests and self._requests[0][0] <= time.monotonic():
            self._handle(self._requests.popleft()[1])

    def _answer_call(self) -> None:
        for _ in range(os.eventfd_read(self._called)):
            function, future = self._calls.get()
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)

    def _receive(self, session: ArmClient) -> None:
        counters, motion = self.arm.counters, self.arm.motion
        for data in session.commands():
            counters.commands += 1
            if motion is not None and self.faults.commands.take():
                counters.thrown_away += 1
                self._answered = True
                continue
            command = read_command(data, self.arm.protocol.version)
            if command is None:
                counters.malformed += 1
                if counters.malformed == 1:
                    self.arm.journal.record("malformed", f"commands of {len(data)} bytes are ignored")
            elif motion is None:
                continue
            elif self._counts(command):
                self._command = command
                self._answered = True
                counters.accepted += 1
            else:
                counters.stale += 1

    def _counts(self, command: CommandPacket) -> bool:
        """Return whether a command answers the last state; a motion's first command may answer any of its states."""
        motion = self.arm.motion
        assert motion is not None
        if motion.waiting:
            return command.message_id > motion.begun_at
        return command.message_id == self.arm.message_id

    # The connection.

    def _accept(self) -> None:
        try:
            connection, (peer, port) = self._listener.accept()
        except OSError:
            return
        if self.session is not None and self.session.gone():
            self._end_session("replaced by the next one")
        if self.session is not None:
            connection.close()
            self.arm.journal.record("second client", f"a second client, {peer}:{port}, is refused")
            return
        try:
            self.session = ArmClient(connection, self.host)
        except OSError:
            connection.close()
            return
        self.poller.register(self.session.tcp, select.EPOLLIN)
        self.poller.register(self.session.udp, select.EPOLLIN)

    def _read_requests(self, session: ArmClient) -> None:
        try:
            requests = session.requests()
        except OSError as error:
            self._end_session(str(error))
            return
        due = time.monotonic() + self.faults.slow_reply
        self._requests.extend((due, request) for request in requests)

    def _handle(self, request: ArmRequest) -> None:
        session, protocol = self.session, self.arm.protocol
        if session is None:
            return
        kind = protocol.requests.get(request.code)
        if kind is None or session.connected == (kind.name == "Connect"):
            self._end_session(f"unexpected request, code {request.code}")
        elif kind.name == "Connect":
            self._connect(session, request)
        elif len(request.payload) != kind.size - HEADER.size:
            self.arm.journal.record(
                "malformed", f"{kind.name} of {len(request.payload) + HEADER.size} bytes, not {kind.size}"
            )
            status = protocol.status(kind.name, RequestOutcome.INVALID)
            self._send_reply(ArmReply(kind.name, request.number, bytes((status,)), after_state=True))
        else:
            self._handler.handle(kind.name, request.number, request.payload)

    def _connect(self, session: ArmClient, request: ArmRequest) -> None:
        """Answer with the emulator's version; a client of another version is refused."""
        if len(request.payload) != 4:
            self._end_session("a malformed Connect")
            return
        version, port = struct.unpack("<HH", request.payload)
        ours = self.faults.version or self.arm.protocol.version
        good = version == ours
        if good:
            session.open_udp(port)
            self.arm.journal.record("client", f"client {session.name} connected, protocol {version}")
        else:
            self.arm.journal.record("client", f"client {session.name} refused: protocol {version}, not {ours}")
        status = self.arm.protocol.status("Connect", RequestOutcome.SUCCESS if good else RequestOutcome.NOT_POSSIBLE)
        body = struct.pack("<BH", status, ours)
        self._send_reply(ArmReply("Connect", request.number, body, after_state=False))

    def _end_session(self, why: str) -> None:
        session, self.session = self.session, None
        assert session is not None
        session.close()
        self._requests.clear()
        self._replies.clear()
        self.arm.client_gone()
        self._replies.clear()  # no client is left for the answer about the end of the motion
        self.arm.journal.record("client gone", f"client {session.name} disconnected: {why}")

    # Output.

    def _send_state(self, session: ArmClient, packet: bytearray) -> None:
        faults, counters, motion = self.faults, self.arm.counters, self.arm.motion
        self._sent_at = time.monotonic()
        if self._sent_at < faults.silent_until or faults.states.take():
            self._state_sent = False
            counters.states_lost += 1
            return
        session.send_state(memoryview(packet)[:-1] if faults.truncate else packet)
        self._state_sent = True
        counters.states += 1
        if motion is not None:
            motion.states_shown += 1

    def _send_reply(self, reply: ArmReply) -> None:
        if reply.after_state:
            self._replies.append(reply)
        else:
            self._write(reply)

    def _flush(self) -> None:
        while self._replies:
            self._write(self._replies.pop(0))

    def _write(self, reply: ArmReply) -> None:
        session = self.session
        if session is None:
            return
        with contextlib.suppress(OSError):  # the next read reports the end
            session.reply(self.arm.protocol.codes[reply.name], reply.number, reply.body)
