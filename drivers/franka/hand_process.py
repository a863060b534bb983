"""The Franka Hand's client library in a process of its own, and the driver's side of the connection to it.

The library blocks in ways that threads do not protect from. Measured with panda-python 1.1 (libfranka 0.9): its
constructor and ``read_once`` hold the interpreter, the latter for up to a second when no states arrive, the former
forever when the hand accepts the connection and sends nothing. When the hand disconnects during a motion, the call
never returns and uses a whole core. The motions and ``stop`` release the interpreter.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn, TypeAlias

from hal.errors import ConnectionLost, Fault, HalError, NotSupported
from hal.host.process import Channel, Child, SharedMemory, unpack_error

from .faults import HAND_PORT, fault_of_exception, is_connection_lost
from .hand_motions import CallAnswer, HandState

_TARGET = "hal.drivers.franka.hand_process:main"
_OPEN_TIMEOUT = 8.0
"""Longest time for the first connection, including the start of the process, s."""
_STATE_TIMEOUT = 2.0
"""s without a state after which the connection counts as lost: the library does not notice a hand that disconnected."""
_PROCESS_TIMEOUT = 6.0
"""s without any message after which the process counts as hung."""
_RESTART_PAUSE = 1.0
"""s between the end of one process and the start of the next, and between two attempts to connect."""
_PARENT_CHECK = 0.5
"""s between two checks whether the driver still exists."""
_HUNG = 10
"""s without such a check after which the system ends the process."""
_READ_SHARE = 0.5
"""Part of the time between two states that is left to the other threads before the next ``read_once``."""
_PERIODS = 16
"""Number of state periods whose shortest counts."""
_MIN_PAUSE = 0.002
"""Shortest time for the other threads, s."""


# The driver's side.


class LinkLost(str):
    """Event: the connection is lost, with the reason."""


LinkEvent: TypeAlias = "HandState | CallAnswer | LinkLost"


class HandLink:
    """Connection to the hand through one client process after another. Never blocks, and reconnects by itself."""

    def __init__(self, name: str, host: str) -> None:
        self._name = name
        self._host = host
        self._child: Child | None = None
        self._connecting = False
        self._number = 0
        self._pending = 0
        """Number of the motion whose answer is pending; 0 for none."""
        self._t_message = 0.0
        self._t_state = 0.0
        self._t_next = 0.0
        """Earliest start of the next process."""
        self.reason = ""
        """Why there is no state, if known."""

    def open(self) -> None:
        """Connect, and wait until the connection is up.

        Raises ConnectionLost, which says what to do, and NotSupported for another protocol version than the library's.
        """
        self._start(retry=False)
        assert self._child is not None
        try:
            self._child.wait_ready(_OPEN_TIMEOUT)
        except ConnectionLost as error:
            self._end()
            text, code = str(error), error.code
            if code == "process_silent":  # the library hangs
                text = f"{self._host} accepts a connection to the hand but sends nothing; is another program using it?"
                code = "silent"
            raise ConnectionLost(f"{self._name}: {text}", code=code) from None
        except HalError as error:
            self._end()
            raise type(error)(f"{self._name}: {error}", code=error.code) from None
        self._connecting = False
        self._t_message = self._t_state = time.monotonic()

    @property
    def up(self) -> bool:
        return self._child is not None and not self._connecting

    def poll(self) -> Iterator[LinkEvent]:
        """Yield the events since the last call."""
        child, now = self._child, time.monotonic()
        if child is None:
            if now >= self._t_next:
                self._start(retry=True)
            return
        try:
            while (message := child.channel.poll()) is not None:
                self._t_message = now
                yield from self._events_of(message)
        except ConnectionLost:
            self.restart(self.reason or f"the client process for the hand at {self._host} ended")
        if now - self._t_message > _PROCESS_TIMEOUT:
            self.restart(f"the client library hangs; {self._host} accepts a connection to the hand but sends nothing")
        elif now - self._t_state > _STATE_TIMEOUT and not self._connecting:
            self.restart(self.reason)
        if self._child is None:
            yield LinkLost(self.reason)

    def _events_of(self, message: dict[str, Any]) -> Iterator[LinkEvent]:
        if "state" in message:
            self._t_state, self.reason = self._t_message, ""
            yield HandState(*message["state"])
        elif "answer" in message:
            number, answer = message["answer"]
            if number == self._pending:
                self._pending = 0
                yield answer if isinstance(answer, bool) else Fault(*answer)
        elif "silent" in message:
            self.reason = message["silent"]
        elif "ready" in message:
            self._connecting, self._t_state = False, self._t_message
        elif "error" in message:
            self.reason = str(unpack_error(message["error"]))

    def call(self, method: str, arguments: tuple[float, ...]) -> None:
        """Start a motion by the library's method; its answer arrives as an event."""
        self._number += 1
        self._pending = self._number
        self._send(method, arguments)

    def stop(self) -> None:
        """Stop the running motion. The motion's answer reports the end; the stop itself has none."""
        if self._pending:
            self._send("stop", ())

    def stop_stray(self) -> None:
        """Stop a motion that was begun on an earlier connection; while one of this connection runs, do nothing."""
        if not self._pending:
            self._send("stop", ())

    def _send(self, method: str, arguments: tuple[float, ...]) -> None:
        if self._child is not None:
            with contextlib.suppress(ConnectionLost):  # poll() notices it
                self._child.channel.send({"id": self._pending, "method": method, "params": arguments}, timeout=0.1)

    def restart(self, reason: str) -> None:
        self.reason = reason
        self._end()
        self._t_next = time.monotonic() + _RESTART_PAUSE

    def _start(self, retry: bool) -> None:
        self._connecting = True
        self._pending = 0
        self._t_next = time.monotonic() + _RESTART_PAUSE  # also if no process can be started
        self._child = Child(f"{self._name} client", _TARGET, {"host": self._host, "retry": retry})
        self._t_message = self._t_state = time.monotonic()

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.process.kill()  # it has nothing to clean up, and may not end otherwise
            child.close(timeout=1.0)

    def close(self) -> None:
        self._end()


# The client process.


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the client process. With ``retry`` in ``config``, a failed attempt to connect is repeated."""
    signal.alarm(_HUNG)
    parent = os.getppid()
    host, retry = config["host"], config["retry"]
    gripper = _connect(host)
    while retry and isinstance(gripper, str) and os.getppid() == parent:
        signal.alarm(_HUNG)
        channel.send({"silent": gripper})
        time.sleep(_RESTART_PAUSE)
        gripper = _connect(host)
    if isinstance(gripper, str):
        raise ConnectionLost(gripper)
    channel.send({"ready": gripper.server_version()})
    client = _HandThreads(channel, gripper, host)
    while os.getppid() == parent:
        signal.alarm(_HUNG)
        message = channel.receive(_PARENT_CHECK)
        if message is None:
            continue
        if message["method"] == "close":
            return
        client.request(message["id"], message["method"], message["params"])


def _connect(host: str) -> Any:
    """Return the library's object, or the reason for its absence. Raises NotSupported for another version."""
    from panda_py import libfranka

    try:
        return libfranka.Gripper(host)
    except RuntimeError as error:
        text = _explain(error, host)
        if fault_of_exception(error).code == "version":
            raise NotSupported(text, code="version") from None
        return text


def _explain(error: RuntimeError, host: str) -> str:
    fault = fault_of_exception(error, host=host, port=HAND_PORT)
    return f"{fault.cause}; {fault.remedy}"


class _HandThreads:
    """One connection, with a thread each for states, motions and stops; all report to the driver."""

    def __init__(self, channel: Channel, gripper: Any, host: str) -> None:
        self._output = Channel(channel.sock.dup())  # the main thread receives on the other, with its own time-outs
        self._gripper = gripper
        self._host = host
        self._motions: queue.SimpleQueue[tuple[int, str, list[float]]] = queue.SimpleQueue()
        self._stops: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._changed = threading.Condition()
        self._begun = 0
        """Number of the newest motion that has begun."""
        self._running = 0
        """Number of the running motion; 0 for none."""
        for target in (self._run_states, self._run_motions, self._run_stops):
            threading.Thread(target=target, daemon=True).start()

    def request(self, number: int, method: str, arguments: list[float]) -> None:
        """Start a motion, or stop the one with that number; 0 stands for one of an earlier connection."""
        if method == "stop":
            self._stops.put(number)
        else:
            self._motions.put((number, method, arguments))

    def _run_states(self) -> NoReturn:
        """Forward every state, and leave the interpreter to the other threads for a part of the time in between."""
        periods: deque[float] = deque(maxlen=_PERIODS)
        before = time.monotonic()
        while True:
            try:
                state = self._gripper.read_once()
            except RuntimeError as error:
                self._report({"silent": _explain(error, self._host)})
                time.sleep(_MIN_PAUSE)  # an error that returns at once must not use a whole core
                continue
            now = time.monotonic()
            values = [state.width, state.max_width, bool(state.is_grasped), state.temperature]
            self._report({"state": [now, state.time.to_sec(), *values]})
            periods.append(now - before)
            before = now
            time.sleep(max(_MIN_PAUSE, _READ_SHARE * min(periods)))

    def _run_motions(self) -> NoReturn:
        while True:
            number, method, arguments = self._motions.get()
            with self._changed:
                self._begun = self._running = number
                self._changed.notify()
            try:
                answer: Any = bool(getattr(self._gripper, method)(*arguments))
            except RuntimeError as error:
                if is_connection_lost(error):  # no answer of the hand: the motion may still run
                    self._report({"silent": _explain(error, self._host)})
                    os._exit(0)
                fault = fault_of_exception(error, host=self._host, port=HAND_PORT)
                answer = [fault.code, fault.cause, fault.remedy]
            self._running = 0
            self._report({"answer": [number, answer]})

    def _run_stops(self) -> NoReturn:
        """A stop must neither overtake its motion nor follow its end: then it would do nothing, or harm.

        Its answer is ignored: the states show the effect.
        """
        while True:
            number = self._stops.get()
            with self._changed:
                while self._begun < number:
                    self._changed.wait()
            time.sleep(_MIN_PAUSE)  # the motion's request has been sent by then
            if self._running == number:
                with contextlib.suppress(RuntimeError):
                    self._gripper.stop()

    def _report(self, message: dict[str, Any]) -> None:
        try:
            self._output.send(message)
        except ConnectionLost:
            os._exit(0)  # the driver is gone
