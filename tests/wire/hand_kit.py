"""An emulated Franka Hand and the driver that talks to it, through Franka's own client library, for tests."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from hal.driver import GripperReading
from hal.drivers.franka.emulator.hand import HandServer
from hal.drivers.franka.hand import FrankaHand
from hal.errors import ConnectionLost
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .franka_kit import free_host

__all__ = ["LIMIT", "HandBench"]

LIMIT = 15.0
"""s within which whatever a test waits for must happen, on a busy machine."""
_TURN = 0.005


class HandBench:
    """A hand (``server``) and its driver (``hand``); use it in a ``with`` statement."""

    def __init__(self, connect: bool = True, **options: Any) -> None:
        """``options`` are those of the server; ``connect`` False leaves opening the driver to the test."""
        self.host = free_host(2)
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
        """A word to the emulated hand, and how it is then."""
        return self.server.command(words.split())

    @property
    def requests(self) -> dict[str, int]:
        """How often each command came to the hand."""
        return dict(self.command("state")["requests"])

    def read(self) -> GripperReading:
        """As the process that owns a gripper does."""
        began = time.monotonic()
        try:
            return self.hand.read(began)
        finally:
            self.slowest = max(self.slowest, time.monotonic() - began)

    def wait(self, what: Callable[[GripperReading], bool], limit: float = LIMIT) -> GripperReading:
        """Read until a reading is as it should be."""
        deadline = time.monotonic() + limit
        while True:
            reading = self.read()
            if what(reading):
                return reading
            assert time.monotonic() < deadline, f"not within {limit:g} s; the last reading: {reading}"
            time.sleep(_TURN)

    def finish(self) -> GripperReading:
        """Until the newest command is over."""
        return self.wait(lambda reading: reading.outcome is not GripperOutcome.RUNNING)

    def wait_server(self, what: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Read until the emulated hand is as it should be."""
        deadline = time.monotonic() + LIMIT
        while True:
            state = self.command("state")
            if what(state):
                return state
            assert time.monotonic() < deadline, state
            self.hand.read(0.0)
            time.sleep(_TURN)

    def wait_lost(self) -> str:
        """Read until the driver says that the hand is lost, and what it says."""
        deadline = time.monotonic() + LIMIT
        while True:
            try:
                self.read()
            except ConnectionLost as error:
                return str(error)
            assert time.monotonic() < deadline, "never lost"
            time.sleep(_TURN)

    def wait_back(self, connections: int) -> GripperReading:
        """Read until the hand answers again, over its so-manieth connection."""
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
