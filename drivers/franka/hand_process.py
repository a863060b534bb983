"""The process in which a Franka Hand's client library lives, and can be ended with it.

The library blocks in ways that no thread is safe from. Measured with panda-python 1.1 (libfranka 0.9): its constructor
and ``read_once`` hold the interpreter, the second for up to a second when no states come, the first for ever when the
hand takes the connection and says nothing. When the hand hangs up during a motion, the call never returns, and takes
a whole core. The motions and ``stop`` let other threads run.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, NoReturn

from hal.errors import ConnectionLost, NotSupported
from hal.host.process import Channel, SharedMemory

from .faults import fault_of_exception

__all__ = ["main"]

_PORT = 1338
_LOOK = 0.5
"""s between two looks whether the driver is still there."""
_HUNG = 10
"""s after which a process that does not even look is ended by the system."""
_SHARE = 0.5
"""Part of the time between two states in which ``read_once`` does not keep the other threads waiting."""
_PERIODS = 16
"""So many of the last periods count; the shortest is the one."""
_BREATH = 0.002
"""s that the other threads have at least."""
_PAUSE = 1.0
"""s between two attempts to connect."""


class _Hand:
    """One connection. States, answers and a word for every silence go to the driver as they come."""

    def __init__(self, channel: Channel, gripper: Any, host: str) -> None:
        self._news = Channel(channel.sock.dup())  # the other one listens, with time limits of its own
        self._gripper = gripper
        self._host = host
        self._motions: queue.SimpleQueue[tuple[int, str, list[float]]] = queue.SimpleQueue()
        self._stops: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._changed = threading.Condition()
        self._begun = 0
        """Number of the newest motion that has begun."""
        self._running = 0
        """Number of the motion that is on its way; 0 for none."""
        for target in (self._read, self._move, self._stop):
            threading.Thread(target=target, daemon=True).start()

    def take(self, number: int, method: str, arguments: list[float]) -> None:
        """Begin a motion, or stop the one of that number."""
        if method == "stop":
            self._stops.put(number)
        else:
            self._motions.put((number, method, arguments))

    def _read(self) -> NoReturn:
        """Pass every state on. In between, for a part of the time until the next one, the other threads have a turn."""
        periods: deque[float] = deque(maxlen=_PERIODS)
        before = time.monotonic()
        while True:
            try:
                state = self._gripper.read_once()
            except RuntimeError as error:
                self._tell({"silent": _words(error, self._host)})
                time.sleep(_BREATH)  # an error that comes at once must not take a whole core
                continue
            now = time.monotonic()
            values = [state.width, state.max_width, bool(state.is_grasped), state.temperature]
            self._tell({"state": [now, state.time.to_sec(), *values]})
            periods.append(now - before)
            before = now
            time.sleep(max(_BREATH, _SHARE * min(periods)))

    def _move(self) -> NoReturn:
        while True:
            number, method, arguments = self._motions.get()
            with self._changed:
                self._begun = self._running = number
                self._changed.notify()
            try:
                answer: Any = bool(getattr(self._gripper, method)(*arguments))
            except RuntimeError as error:
                fault = fault_of_exception(error, host=self._host, port=_PORT)
                answer = [fault.code, fault.cause, fault.remedy]
            self._running = 0
            self._tell({"answer": [number, answer]})

    def _stop(self) -> NoReturn:
        """A stop must neither overtake its motion nor come when that is over: then it would do nothing, or harm.

        What it answers is worth nothing: the states tell.
        """
        while True:
            number = self._stops.get()
            with self._changed:
                while self._begun < number:
                    self._changed.wait()
            time.sleep(_BREATH)  # the motion's request is on its way by then
            if self._running == number:
                with contextlib.suppress(RuntimeError):
                    self._gripper.stop()

    def _tell(self, message: dict[str, Any]) -> None:
        try:
            self._news.send(message)
        except ConnectionLost:
            os._exit(0)  # the driver is gone


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process. ``patient``: try to connect again and again, rather than fail."""
    signal.alarm(_HUNG)
    parent = os.getppid()
    host, patient = config["host"], config["patient"]
    gripper = _connect(host)
    while patient and isinstance(gripper, str) and os.getppid() == parent:
        signal.alarm(_HUNG)
        channel.send({"silent": gripper})
        time.sleep(_PAUSE)
        gripper = _connect(host)
    if isinstance(gripper, str):
        raise ConnectionLost(gripper)
    channel.send({"ready": gripper.server_version()})
    hand = _Hand(channel, gripper, host)
    while os.getppid() == parent:
        signal.alarm(_HUNG)
        message = channel.receive(_LOOK)
        if message is None:
            continue
        if message["method"] == "close":
            return
        hand.take(message["id"], message["method"], message["params"])


def _connect(host: str) -> Any:
    """The library's object, or why there is none. Raises NotSupported where the versions do not fit."""
    from panda_py import libfranka

    try:
        return libfranka.Gripper(host)
    except RuntimeError as error:
        text = _words(error, host)
        if fault_of_exception(error).code == "version":
            raise NotSupported(text) from None
        return text


def _words(error: RuntimeError, host: str) -> str:
    fault = fault_of_exception(error, host=host, port=_PORT)
    return f"{fault.cause}; {fault.remedy}"
