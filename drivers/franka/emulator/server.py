"""The emulator's loop: gathers the command of a cycle, lets the arm go on, and sends the state. One thread, one arm."""

from __future__ import annotations

import contextlib
import select
import struct
import time
from collections import deque

from .arm import Arm, Reply
from .console import Console
from .faults import Faults
from .layouts import CommandPacket, read_command
from .link import Incoming, Session, listen
from .pacing import Pacer, Pacing
from .protocol import HEADER, PORT, Outcome
from .requests import Files, Requests

__all__ = ["ArmServer"]

_IDLE = 0.05
"""s between two looks around while there is no client."""
_SLICE = 0.05
"""s: a signal is noticed within this time, however long an answer is waited for."""
_FIRST_PATIENCE = 0.1
"""s that each state is held back in lock-step until a motion's first command; the client's library takes up to two
states before it lets its caller command anything."""
_TAKEN_BEFORE = 2
_HUNG_PATIENCE = 0.01
"""s for each further answer once one did not come at all."""


class ArmServer:
    """Port 1337 of one address: accepts one client at a time and serves it until :meth:`stop`."""

    def __init__(self, host: str, arm: Arm, files: Files, pacing: Pacing, seed: int = 0) -> None:
        """Raises OSError when the port cannot be had."""
        self.host = host
        self.arm = arm
        self.pacing = pacing
        self.faults = Faults(seed)
        self.poller = select.epoll()
        self.session: Session | None = None
        arm.send = self._send_reply
        self._answers = Requests(arm, files)
        self._pacer = Pacer()
        self._listener = listen(host, PORT)
        self.poller.register(self._listener, select.EPOLLIN)
        self._console: Console | None = None
        self._requests: deque[tuple[float, Incoming]] = deque()
        self._replies: list[Reply] = []
        self._command: CommandPacket | None = None
        self._answered = False
        self._state_went = False
        self._sent_at = 0.0
        self._hung = False
        self._away_until = 0.0
        self._stopping = False

    def attach(self, console: Console) -> None:
        """Serve this console's descriptors as well."""
        self._console = console

    def run(self) -> None:
        """Until :meth:`stop`."""
        while not self._stopping:
            self._gather()
            packet = self.arm.tick(self._command)
            if self.session is not None and self.session.connected:
                self._send_state(self.session, packet)
            self._flush()

    def stop(self) -> None:
        """End the loop soon; for signal handlers."""
        self._stopping = True

    def close(self) -> None:
        """Let go of every socket."""
        if self.session is not None:
            self._end_session("the emulator ends")
        self._listener.close()
        self.poller.close()

    def restart(self, away: float) -> None:
        """Drop the client, forget everything, and be away for so long, s."""
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
            self._pacer.wait(self.arm.figures)
            self._serve(0.0)

    def _waits_for_answers(self) -> bool:
        motion = self.arm.motion
        if not self.pacing.lockstep or motion is None or motion.options.asynchronous:
            return False
        return not motion.waiting or motion.states_shown >= _TAKEN_BEFORE

    def _await_answer(self) -> None:
        """Lock-step: wait for the answer to the last state, unless that did not go out."""
        motion = self.arm.motion
        assert motion is not None
        if motion.waiting:
            patience = _FIRST_PATIENCE
        else:
            patience = _HUNG_PATIENCE if self._hung else self.pacing.patience
        deadline = time.monotonic() + patience if self._state_went else 0.0
        while True:
            left = deadline - time.monotonic()
            self._serve(max(0.0, min(left, _SLICE)))
            if self._answered:
                self._hung = False
                self.arm.figures.answers.add(time.monotonic() - self._sent_at)
                return
            if self.arm.motion is not motion or self._stopping:
                return
            if left <= 0.0:
                self._hung = not motion.waiting and self._state_went
                return

    def _serve(self, timeout: float) -> None:
        """Wait up to ``timeout`` s for something to come in, and see to it."""
        for descriptor, _ in self.poller.poll(timeout):
            session = self.session
            if session is not None and descriptor == session.udp.fileno():
                self._receive(session)
            elif session is not None and descriptor == session.tcp.fileno():
                self._converse(session)
            elif descriptor == self._listener.fileno():
                self._accept()
            elif self._console is not None:
                self._console.serve(descriptor)
        while self._requests and self._requests[0][0] <= time.monotonic():
            self._handle(self._requests.popleft()[1])

    def _receive(self, session: Session) -> None:
        figures, motion = self.arm.figures, self.arm.motion
        for data in session.commands():
            figures.commands += 1
            if motion is not None and self.faults.commands.strikes():
                figures.thrown_away += 1
                self._answered = True
                continue
            command = read_command(data, self.arm.protocol.version)
            if command is None:
                figures.malformed += 1
                if figures.malformed == 1:
                    self.arm.journal.say("malformed", f"commands of {len(data)} bytes are ignored")
            elif motion is None:
                continue
            elif self._counts(command):
                self._command = command
                self._answered = True
                figures.accepted += 1
            else:
                figures.stale += 1

    def _counts(self, command: CommandPacket) -> bool:
        """Only the answer to the last state does; a motion's first command may answer any of its states."""
        motion = self.arm.motion
        assert motion is not None
        if motion.waiting or motion.options.asynchronous:
            return command.message_id > motion.begun_at
        return command.message_id == self.arm.message_id

    # The connection.

    def _accept(self) -> None:
        try:
            connection, (peer, port) = self._listener.accept()
        except OSError:
            return
        if self.session is not None and self.session.gone():
            self._end_session("it makes room for the next one")
        if self.session is not None:
            connection.close()
            self.arm.journal.say("second client", f"a second client, {peer}:{port}, is turned away")
            return
        try:
            self.session = Session(connection, self.host)
        except OSError:
            connection.close()
            return
        self.poller.register(self.session.tcp, select.EPOLLIN)
        self.poller.register(self.session.udp, select.EPOLLIN)

    def _converse(self, session: Session) -> None:
        try:
            requests = session.requests()
        except OSError as error:
            self._end_session(str(error))
            return
        due = time.monotonic() + self.faults.slow_reply
        self._requests.extend((due, request) for request in requests)

    def _handle(self, request: Incoming) -> None:
        session, protocol = self.session, self.arm.protocol
        if session is None:
            return
        kind = protocol.requests.get(request.code)
        if kind is None or session.connected == (kind.name == "Connect"):
            self._end_session(f"unexpected request, code {request.code}")
        elif kind.name == "Connect":
            self._connect(session, request)
        elif len(request.payload) != kind.size - HEADER.size:
            self.arm.journal.say(
                "malformed", f"{kind.name} of {len(request.payload) + HEADER.size} bytes, not {kind.size}"
            )
            status = protocol.status(kind.name, Outcome.INVALID)
            self._send_reply(Reply(kind.name, request.number, bytes((status,)), after_state=True))
        else:
            self._answers.take(kind.name, request.number, request.payload)

    def _connect(self, session: Session, request: Incoming) -> None:
        """Answered with the version that the emulator speaks; another version of the client is refused."""
        if len(request.payload) != 4:
            self._end_session("a malformed Connect")
            return
        version, port = struct.unpack("<HH", request.payload)
        ours = self.faults.version or self.arm.protocol.version
        good = version == ours
        if good:
            session.open_udp(port)
            self.arm.journal.say("client", f"client {session.name} connected, protocol {version}")
        else:
            self.arm.journal.say("client", f"client {session.name} refused: it speaks {version}, this arm {ours}")
        status = self.arm.protocol.status("Connect", Outcome.SUCCESS if good else Outcome.NOT_POSSIBLE)
        body = struct.pack("<BH", status, ours)
        self._send_reply(Reply("Connect", request.number, body, after_state=False))

    def _end_session(self, why: str) -> None:
        session, self.session = self.session, None
        assert session is not None
        session.close()
        self._requests.clear()
        self._replies.clear()
        self.arm.client_gone()
        self._replies.clear()  # nobody is left who could hear the end of the motion
        self.arm.journal.say("client gone", f"client {session.name} is gone: {why}")

    # What goes out.

    def _send_state(self, session: Session, packet: bytearray) -> None:
        faults, figures, motion = self.faults, self.arm.figures, self.arm.motion
        self._sent_at = time.monotonic()
        if self._sent_at < faults.silent_until or faults.states.strikes():
            self._state_went = False
            figures.states_lost += 1
            return
        session.send_state(memoryview(packet)[:-1] if faults.truncate else packet)
        self._state_went = True
        figures.states += 1
        if motion is not None:
            motion.states_shown += 1

    def _send_reply(self, reply: Reply) -> None:
        if reply.after_state:
            self._replies.append(reply)
        else:
            self._write(reply)

    def _flush(self) -> None:
        while self._replies:
            self._write(self._replies.pop(0))

    def _write(self, reply: Reply) -> None:
        session = self.session
        if session is None:
            return
        with contextlib.suppress(OSError):  # its end is told by the next read
            session.reply(self.arm.protocol.codes[reply.name], reply.number, reply.body)
