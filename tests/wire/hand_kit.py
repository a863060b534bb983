"""An emulated Franka Hand and its driver, with Franka's own client library in between, for tests."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from hal.driver import GripperReading
from hal.drivers.franka.hand import FrankaHand
from hal.errors import ConnectionLost
from hal.specs import GripperSpec
from hal.types import GripperOutcome
from hal_emulators.franka.hand import HandServer

from .franka_kit import free_host

LIMIT = 15.0
"""Longest wait for any condition, on a busy machine, s."""
_TURN = 0.005


class HandBench:
    """A hand (``server``) and its driver (``hand``); use it in a ``with`` statement."""

    def __init__(self, connect: bool = True, **options: Any) -> None:
        """``options`` are those of the server; ``connect`` False leaves opening the driver to the test."""
        self.host = free_host()
        self.server = HandServer(self.host, **options)
        self.server.start()
        spec = GripperSpec("panda.gripper", "franka", 0.08, 0.1, 40.0, options={"host": self.host})
        self.hand = FrankaHand(spec)
        self.slowest = 0.0
        """The longest time that a call of ``read`` took, s."""
        if connect:
            try:
                self.hand.open()
            except BaseException:
                self.close()
                raise

    def command(self, words: str) -> dict[str, Any]:
        """Send a command to the emulated hand, and return its state after it."""
        return self.server.command(words.split())

    @property
    def requests(self) -> dict[str, int]:
        """Number of requests of each kind that the hand received."""
        return dict(self.command("state")["requests"])

    def read(self) -> GripperReading:
        """Read as the gripper's process does."""
        began = time.monotonic()
        try:
            return self.hand.read(began)
        finally:
            self.slowest = max(self.slowest, time.monotonic() - began)

    def wait(self, what: Callable[[GripperReading], bool], limit: float = LIMIT) -> GripperReading:
        """Read until a reading meets a condition."""
        deadline = time.monotonic() + limit
        while True:
            reading = self.read()
            if what(reading):
                return reading
            assert time.monotonic() < deadline, f"not within {limit:g} s; the last reading: {reading}"
            time.sleep(_TURN)

    def do(self, command: str, *arguments: float) -> GripperReading:
        """Give a command, and read until it has ended."""
        getattr(self.hand, command)(*arguments)
        return self.finish()

    def finish(self) -> GripperReading:
        """Read until the newest command has ended."""
        return self.wait(lambda reading: reading.outcome is not GripperOutcome.RUNNING)

    def wait_server(self, what: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Read until the emulated hand's state meets a condition."""
        deadline = time.monotonic() + LIMIT
        while True:
            state = self.command("state")
            if what(state):
                return state
            assert time.monotonic() < deadline, state
            self.hand.read(0.0)
            time.sleep(_TURN)

    def wait_lost(self) -> ConnectionLost:
        """Read until the driver reports that the hand is lost, and return its error."""
        deadline = time.monotonic() + LIMIT
        while True:
            try:
                self.read()
            except ConnectionLost as error:
                return error
            assert time.monotonic() < deadline, "never lost"
            time.sleep(_TURN)

    def wait_back(self, connections: int) -> GripperReading:
        """Read until the hand answers again, over connection number ``connections``."""
        deadline = time.monotonic() + LIMIT
        while True:
            with contextlib.suppress(ConnectionLost):
                connected = self.requests["connect"]
                t_connected = time.monotonic()
                reading = self.read()
                while connected == connections and reading.t < t_connected:
                    reading = self.read()
                if connected == connections:
                    return reading
            assert time.monotonic() < deadline, "never back"
            time.sleep(_TURN)

    def close(self) -> None:
        """End both."""
        self.hand.close()
        self.server.stop()

    def __enter__(self) -> HandBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
