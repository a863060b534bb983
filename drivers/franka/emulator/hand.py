"""A server that stands in for a Franka Hand: Franka's own client library talks to it as to the hand.

It answers on TCP 1338 and sends states by UDP, from a thread of its own that sleeps nearly all of the time, so it may
run beside the arm's loop. On its own: ``python -m hal.drivers.franka.emulator.hand --host 127.0.0.2``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from .hand_faults import COMMANDS, Faults, help_text, number, switch
from .hand_fingers import FULL_WIDTH, Fingers, Kind, Motion
from .hand_network import HandNetwork
from .hand_wire import PORT, VERSION, Code, HandState, Request, Status, response

__all__ = ["HandServer"]

_STEP = 0.01
"""s between two looks at the fingers while they move."""
_DOWN = "0.5"
"""s for which it is away when it restarts."""


class HandServer:
    """A hand on the address ``host``, in real time.

    Assumptions, for want of a real one: a motion goes on when its client is gone; a stop is answered at once; after
    switching on it must be homed; a thing between the fingers is rigid and stays in their middle.
    """

    def __init__(
        self,
        host: str,
        version: int = VERSION,
        object_width: float | None = None,
        period: float = 0.02,
        homed: bool = True,
        port: int = PORT,
    ) -> None:
        """``period`` is the time between two states, s; ``homed`` False is a hand that was just switched on."""
        self.period = period
        self.fingers = Fingers(object_width, homed)
        self.faults = Faults(version)
        self._requests = {code.name.lower(): 0 for code in Code}
        self._newest: dict[str, tuple[float, ...]] = {}
        self._network = HandNetwork((host, port))
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._running: Request | None = None
        """The motion that waits for its answer."""
        self._born = self._advanced = self._next_state = time.monotonic()
        self._back_at = 0.0
        self._thread = threading.Thread(target=self._run, name="franka-hand", daemon=True)

    # From outside, in any thread.

    def start(self) -> None:
        """Listen, and serve from a thread of its own. OSError where the address is taken."""
        self._network.listen()
        self._thread.start()

    def stop(self) -> None:
        """Hang up and end. Idempotent."""
        if not self._ending.is_set():
            self._ending.set()
            self._network.wake()
            if self._thread.ident is not None:
                self._thread.join(timeout=5.0)
            self._network.close()

    def command(self, words: list[str]) -> dict[str, Any]:
        """Do what ``words`` say (``help`` lists them), and say how everything is then. ValueError for other words."""
        if not words or words[0] == "help":
            return {"text": help_text()}
        usage = next((usage for usage in COMMANDS if usage.split()[0] == words[0]), None)
        if usage is None:
            raise ValueError(f"the hand knows no {words[0]!r}; it knows {', '.join(COMMANDS)}")
        action: Callable[..., None] = getattr(self, "_do_" + words[0].replace("-", "_"))
        with self._lock:
            try:
                action(*words[1:])
            except (TypeError, ValueError) as error:
                raise ValueError(f"{' '.join(words)!r} is not {usage!r}: {error}") from None
            state = self._state()
        self._network.wake()
        return state

    def _state(self) -> dict[str, Any]:
        fingers, motion = self.fingers, self.fingers.motion
        return {
            "width": fingers.width,
            "max_width": fingers.max_width,
            "is_grasped": fingers.is_grasped,
            "force": fingers.force,
            "object": fingers.object_width,
            "motion": None if motion is None else motion.kind.value,
            "client": self._network.client is not None,
            "listening": self._network.listening,
            "requests": dict(self._requests),  # how often each came
            "newest": {name: list(values) for name, values in self._newest.items()},  # the numbers that came with it
        }

    # Words.

    def _do_object(self, width: str) -> None:
        self.fingers.put(None if width == "none" else number(width, 1e-6, FULL_WIDTH))

    def _do_grasp_ends_at_width(self, word: str) -> None:
        self.fingers.grasp_ends_at_width = switch(word)

    def _do_unhome(self) -> None:
        self.fingers.homed = False

    def _do_stop_ignored(self, word: str) -> None:
        self.faults.stop_ignored = switch(word)

    def _do_stop_releases(self, word: str) -> None:
        self.faults.stop_releases = switch(word)

    def _do_silence(self, seconds: str) -> None:
        self.faults.silent_until = time.monotonic() + number(seconds)

    def _do_slow_reply(self, seconds: str) -> None:
        self.faults.slow_reply = number(seconds)

    def _do_fail(self, times: str = "1") -> None:
        self.faults.failures = int(number(times))

    def _do_version(self, version: str) -> None:
        self.faults.version = int(number(version, 0, 65535))

    def _do_temperature(self, degrees: str) -> None:
        self.faults.temperature = int(number(degrees, 0, 65535))

    def _do_drop(self) -> None:
        self._network.hang_up()

    def _do_restart(self, seconds: str = _DOWN) -> None:
        self._back_at = time.monotonic() + number(seconds)
        self._network.shut()
        self._running = None
        self.fingers.switch_off()

    def _do_state(self) -> None:
        """Every answer is the state."""

    # Its thread.

    def _run(self) -> None:
        while not self._ending.is_set():
            keys = self._network.wait(self._patience())
            with self._lock:
                for request in self._network.take(keys):
                    self._serve(request)
                self._turn()

    def _patience(self) -> float:
        """How long nothing can be due, s."""
        with self._lock:
            now, client = time.monotonic(), self._network.client
            due = [now + 1.0]
            if client is not None:
                due += [self._next_state, client.due]
            if self.fingers.motion is not None:
                due.append(self._advanced + _STEP)
            if not self._network.listening:
                due.append(self._back_at)
            return max(0.0, min(due) - now)

    def _turn(self) -> None:
        now = time.monotonic()
        if not self._network.listening and now >= self._back_at:
            self._network.listen()
        self._advance(now)
        if now >= self._next_state:
            self._next_state = max(now, self._next_state + self.period)
            if now >= self.faults.silent_until:
                self._network.send_state(self._report(now))
        self._network.send_answers(now)

    def _advance(self, now: float) -> None:
        status = self.fingers.advance(now - self._advanced)
        self._advanced = now
        if status is not None:
            self._end_motion(status)

    def _report(self, now: float) -> HandState:
        fingers = self.fingers
        clock = int((now - self._born) * 1e3)  # Franka's library takes the number of a message for milliseconds
        return HandState(clock, fingers.width, fingers.max_width, fingers.is_grasped, self.faults.temperature)

    # Requests.

    def _serve(self, request: Request) -> None:
        name = request.code.name.lower()
        self._requests[name] += 1
        self._newest[name] = request.values
        self._advance(time.monotonic())
        if request.code is Code.CONNECT:
            self._greet(request)
        elif request.code is Code.STOP:
            if not self.faults.stop_ignored:
                self.fingers.halt(self.faults.stop_releases)
                self._end_motion(Status.ABORTED)
            self._answer(request, Status.SUCCESS)
        else:
            self._begin(request)

    def _greet(self, request: Request) -> None:
        version, udp_port = map(int, request.values)
        fits = version == self.faults.version
        if fits and self._network.client is not None:
            self._network.client.udp_port = udp_port
            self._next_state = time.monotonic()
        self._answer(request, Status.SUCCESS if fits else Status.FAIL, self.faults.version)

    def _begin(self, request: Request) -> None:
        status: Status | None = Status.FAIL
        if self.faults.failures:
            self.faults.failures -= 1
        else:
            status = self.fingers.start(_motion(request))
        if status is None:
            self._running = request
        else:
            self._answer(request, status)

    def _end_motion(self, status: Status) -> None:
        running, self._running = self._running, None
        if running is not None:
            self._answer(running, status)

    def _answer(self, request: Request, status: Status, version: int | None = None) -> None:
        client = self._network.client
        if client is not None:
            client.answer(response(request, status, version), time.monotonic() + self.faults.slow_reply)


def _motion(request: Request) -> Motion:
    values = request.values
    if request.code is Code.MOVE:
        return Motion(Kind.MOVE, values[0], values[1])
    if request.code is Code.GRASP:
        width, inner, outer, speed, force = values
        return Motion(Kind.GRASP, width, speed, force, inner, outer)
    return Motion(Kind.HOMING)


if __name__ == "__main__":
    from .hand_program import main

    main()
