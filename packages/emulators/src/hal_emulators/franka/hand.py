"""Emulated Franka Hand: Franka's own client library talks to it as to the hand.

It answers on TCP 1338 and sends states by UDP, from a thread of its own that sleeps nearly all of the time, so it can
run beside the arm's loop.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from hal_emulators.control import Command, assign, between, make_commands, read_number, read_switch, run_command, whole
from hal_emulators.shared_world import ArmInWorld

from .hand_fingers import FULL_WIDTH, FingerMotion, FingerMotionKind, Fingers
from .hand_network import (
    HAND_PORT,
    HAND_VERSION,
    HandCode,
    HandNetwork,
    HandRequest,
    HandStatePacket,
    HandStatus,
    hand_response,
)


@dataclass
class HandFaults:
    """Faults of the hand that are injected at present."""

    version: int
    """Protocol that it claims to speak."""
    stop_ignored: bool = False
    silent_until: float = 0.0
    """End of a silence on the monotonic clock, s."""
    slow_reply: float = 0.0
    """Delay of every answer, s."""
    failures: int = 0
    """Number of motions that fail from now on."""


# The hand.

_TEMPERATURE = 30
"""That it reports, deg C."""
_PERIOD = 0.02
"""Time between two states, s."""
_STEP = 0.01
"""s between two steps of moving fingers."""
_WORLD_STEP = 0.004
"""The same in a simulated world, in all states."""


class HandServer:
    """A hand at the address ``host``, in real time.

    Assumptions: a motion continues when its client disconnects; a stop is answered at once; after switching on the
    hand must be homed; an object between the fingers is rigid and stays in their middle.
    """

    def __init__(
        self, host: str, version: int = HAND_VERSION, homed: bool = True, world: ArmInWorld | None = None
    ) -> None:
        """Build it; one that is not ``homed`` was just switched on. ``world`` is the simulated world of its arm."""
        self.world = world
        self.fingers = Fingers(homed=homed)
        self.faults = HandFaults(version)
        self._requests = {code.name.lower(): 0 for code in HandCode}
        self._newest: dict[str, tuple[float, ...]] = {}
        self.network = HandNetwork((host, HAND_PORT))
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._running: HandRequest | None = None
        """Running motion, whose answer is pending."""
        self._born = self._next_state = time.monotonic()
        self._advanced = self._fingers_time()
        self._waiting: deque[tuple[float, HandRequest]] = deque()
        """Requests that the fingers have not reached yet, with the time at which each came, s."""
        self._back_at = 0.0
        self._thread = threading.Thread(target=self._run, name="franka-hand", daemon=True)

    # For other threads.

    def start(self) -> None:
        """Listen, and serve from a thread of its own. Raises OSError if the address is in use."""
        self.network.listen()
        self._thread.start()

    def stop(self) -> None:
        """Disconnect the client and end. Idempotent."""
        if not self._ending.is_set():
            self._ending.set()
            self.network.wake()
            if self._thread.ident is not None:
                self._thread.join(timeout=5.0)
            self.network.close()

    def command(self, words: list[str]) -> dict[str, Any]:
        """Execute a command (``help`` lists them); return the state after it. Raises ValueError if it is invalid."""
        with self._lock:
            answer = run_command(HAND_COMMANDS, self, words or ["help"]) or self._state()
        self.network.wake()
        return answer

    def _state(self) -> dict[str, Any]:
        fingers, motion = self.fingers, self.fingers.motion
        return {
            "width": fingers.width,
            "max_width": fingers.max_width,
            "is_grasped": fingers.is_grasped,
            "force": fingers.force,
            "object": fingers.object_width,
            "motion": None if motion is None else motion.kind.value,
            "client": self.network.client is not None,
            "listening": self.network.listening,
            "requests": dict(self._requests),  # number of each
            "newest": {name: list(values) for name, values in self._newest.items()},  # their latest arguments
        }

    def restart(self, seconds: float) -> None:
        """Switch off, and on again after a time, s."""
        self._back_at = time.monotonic() + seconds
        self.network.shut()
        self._running = None
        self.fingers.switch_off()

    # The thread.

    def _run(self) -> None:
        while not self._ending.is_set():
            keys = self.network.wait(self._time_to_next())
            with self._lock:
                came = time.monotonic() if self.world is None else self.world.now
                self._waiting.extend((came, request) for request in self.network.receive(keys))
                while self._waiting and self._waiting[0][0] <= self._fingers_time():
                    self._serve(self._waiting.popleft()[1])
                self._step()

    def _fingers_time(self) -> float:
        """Return the time of the fingers, s: in a simulated world, the time up to which that is known."""
        return time.monotonic() if self.world is None else self.world.now_of_fingers

    def _time_to_next(self) -> float:
        """Return the time until the next step is due, s."""
        with self._lock:
            now, client = time.monotonic(), self.network.client
            due = [now + 1.0]
            if client is not None:
                due += [self._next_state, client.due]
            if self.world is not None:
                due.append(now + _WORLD_STEP)
            elif self.fingers.motion is not None:
                due.append(self._advanced + _STEP)
            if not self.network.listening:
                due.append(self._back_at)
            return max(0.0, min(due) - now)

    def _step(self) -> None:
        now = time.monotonic()
        if not self.network.listening and now >= self._back_at:
            self.network.listen()
        self._advance()
        if now >= self._next_state:
            self._next_state = max(now, self._next_state + _PERIOD)
            if now >= self.faults.silent_until:
                self.network.send_state(self._report(now))
        self.network.send_answers(now)

    def _advance(self) -> None:
        now = max(self._advanced, self._fingers_time())
        if self.world is not None:
            self.fingers.meet(self.world.object_width)
            self.world.fingers = self._advanced, self.fingers.width, self.fingers.pressing
        status = self.fingers.advance(now - self._advanced)
        self._advanced = now
        if status is not None:
            self._end_motion(status)

    def _report(self, now: float) -> HandStatePacket:
        fingers = self.fingers
        clock = int((now - self._born) * 1e3)  # Franka's library interprets the number of a message as milliseconds
        return HandStatePacket(clock, fingers.width, fingers.max_width, fingers.is_grasped, _TEMPERATURE)

    # Requests.

    def _serve(self, request: HandRequest) -> None:
        name = request.code.name.lower()
        self._requests[name] += 1
        self._newest[name] = request.values
        self._advance()
        if request.code is HandCode.CONNECT:
            self._connect(request)
        elif request.code is HandCode.STOP:
            if not self.faults.stop_ignored:
                self.fingers.motion = None
                self._end_motion(HandStatus.ABORTED)
            self._answer(request, HandStatus.SUCCESS)
        else:
            self._begin(request)

    def _connect(self, request: HandRequest) -> None:
        version, udp_port = map(int, request.values)
        fits = version == self.faults.version
        if fits and self.network.client is not None:
            self.network.client.udp_port = udp_port
            self._next_state = time.monotonic()
        self._answer(request, HandStatus.SUCCESS if fits else HandStatus.FAIL, self.faults.version)

    def _begin(self, request: HandRequest) -> None:
        status: HandStatus | None = HandStatus.FAIL
        if self.faults.failures:
            self.faults.failures -= 1
        else:
            status = self.fingers.start(_motion(request))
        if status is None:
            self._running = request
        else:
            self._answer(request, status)

    def _end_motion(self, status: HandStatus) -> None:
        running, self._running = self._running, None
        if running is not None:
            self._answer(running, status)

    def _answer(self, request: HandRequest, status: HandStatus, version: int | None = None) -> None:
        client = self.network.client
        if client is not None:
            client.answer(hand_response(request, status, version), time.monotonic() + self.faults.slow_reply)


def _put(hand: HandServer, words: list[str]) -> None:
    if hand.world is not None:
        raise ValueError("the fingers meet the objects of the simulated world: use rig.world")
    hand.fingers.put(None if words[0] == "none" else read_number(words[0], 1e-6, FULL_WIDTH))


_seconds = between(0.0, 1e6)

HAND_COMMANDS = make_commands(
    Command("object W|none", "put an object of W m between the fingers, or remove it", _put),
    Command(
        "stop-ignored on|off",
        "Stop is answered, but has no effect (libfranka, issue 18)",
        assign("faults.stop_ignored", read_switch),
    ),
    Command(
        "silence S",
        "send no states for S seconds",
        assign("faults.silent_until", lambda word: time.monotonic() + _seconds(word)),
    ),
    Command("slow-reply S", "answer everything S seconds later (0: at once)", assign("faults.slow_reply", _seconds)),
    Command(
        "fail [N]",
        "fail the next N motions at once (1)",
        lambda hand, words: setattr(hand.faults, "failures", int(read_number((words or ["1"])[0], 0, 1e6))),
    ),
    Command("version N", "claim to speak this protocol", assign("faults.version", whole(0, 65535))),
    Command("drop", "close the connection", lambda hand, _: hand.network.disconnect()),
    Command(
        "restart [S]",
        "switch off, and on again S seconds later (0.5)",
        lambda hand, words: hand.restart(_seconds((words or ["0.5"])[0])),
    ),
    Command("state", "present state of the hand", lambda _, __: None),
)


def _motion(request: HandRequest) -> FingerMotion:
    values = request.values
    if request.code is HandCode.MOVE:
        return FingerMotion(FingerMotionKind.MOVE, values[0], values[1])
    if request.code is HandCode.GRASP:
        width, inner, outer, speed, force = values
        return FingerMotion(FingerMotionKind.GRASP, width, speed, force, inner, outer)
    return FingerMotion(FingerMotionKind.HOMING)
