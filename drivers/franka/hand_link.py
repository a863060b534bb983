"""The driver's side of the connection to a Franka Hand: never waits, and begins anew by itself when it is lost."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any, TypeAlias

from hal.errors import ConnectionLost, HalError
from hal.host.process import Child, unpack_error
from hal.types import Fault

from .hand_calls import Answer, Seen

__all__ = ["Event", "HandLink", "Lost"]

_TARGET = "hal.drivers.franka.hand_process:main"
_OPEN = 8.0
"""s that the first connection may take, with the start of the process."""
_SILENT = 2.0
"""s without a state after which the connection counts as dead: the library does not notice a hand that hung up."""
_DEAF = 6.0
"""s without any word of the process after which it counts as hung."""
_PAUSE = 1.0
"""s between the end of one process and the start of the next."""


class Lost(str):
    """The connection is gone, and why."""


Event: TypeAlias = "Seen | Answer | Lost"


class HandLink:
    """One process with the client library in it after the other (:mod:`.hand_process`)."""

    def __init__(self, name: str, host: str) -> None:
        self._name = name
        self._host = host
        self._child: Child | None = None
        self._connecting = False
        self._number = 0
        self._asked = 0
        """Number of the motion whose answer is waited for."""
        self._t_heard = 0.0
        self._t_state = 0.0
        self._t_next = 0.0
        """When the next process may start."""
        self.why = ""
        """Why there is no state, as far as it is known."""

    def open(self) -> None:
        """Connect, and wait for it. Raises ConnectionLost and NotSupported, with what to do."""
        self._start(patient=False)
        assert self._child is not None
        try:
            self._child.wait_ready(_OPEN)
        except ConnectionLost as error:
            self._end()
            text = str(error)
            if "did not get ready" in text:
                text = (
                    f"{self._host} takes a connection to the hand and says nothing; see that no other program uses it"
                )
            raise ConnectionLost(f"{self._name}: {text}") from None
        except HalError as error:
            self._end()
            raise type(error)(f"{self._name}: {error}") from None
        self._connecting = False
        self._t_heard = self._t_state = time.monotonic()

    @property
    def up(self) -> bool:
        """Does it take calls?"""
        return self._child is not None and not self._connecting

    def poll(self) -> Iterator[Event]:
        """What came since the last call."""
        child, now = self._child, time.monotonic()
        if child is None:
            if now >= self._t_next:
                self._start(patient=True)
            return
        try:
            while (message := child.channel.poll()) is not None:
                self._t_heard = now
                yield from self._understand(message)
        except ConnectionLost:
            self.restart(self.why or f"the process that talks to the hand at {self._host} ended")
        if now - self._t_heard > _DEAF:
            self.restart(f"the client library hangs; {self._host} takes a connection to the hand and says nothing")
        elif now - self._t_state > _SILENT and not self._connecting:
            self.restart(self.why)
        if self._child is None:
            yield Lost(self.why)

    def _understand(self, message: dict[str, Any]) -> Iterator[Event]:
        if "state" in message:
            self._t_state, self.why = self._t_heard, ""
            yield Seen(*message["state"])
        elif "answer" in message:
            number, answer = message["answer"]
            if number == self._asked:
                self._asked = 0
                yield answer if isinstance(answer, bool) else Fault(*answer)
        elif "silent" in message:
            self.why = message["silent"]
        elif "ready" in message:
            self._connecting, self._t_state = False, self._t_heard
        elif "error" in message:
            self.why = str(unpack_error(message["error"]))

    def call(self, method: str, arguments: tuple[float, ...]) -> None:
        """Have a motion of the library called; its answer comes as an event."""
        self._number += 1
        self._asked = self._number
        self._send(method, arguments)

    def stop(self) -> None:
        """Stop the motion that is on its way. That is what its answer tells; the stop itself has none."""
        if self._asked:
            self._send("stop", ())

    def _send(self, method: str, arguments: tuple[float, ...]) -> None:
        if self._child is not None:
            with contextlib.suppress(ConnectionLost):  # poll() finds out
                self._child.channel.send({"id": self._asked, "method": method, "params": arguments}, timeout=0.1)

    def restart(self, why: str) -> None:
        """Give this connection up; the next one begins by itself."""
        self.why = why
        self._end()
        self._t_next = time.monotonic() + _PAUSE

    def _start(self, patient: bool) -> None:
        self._connecting = True
        self._asked = 0
        self._t_next = time.monotonic() + _PAUSE  # also where no process can be started
        self._child = Child(f"{self._name} client", _TARGET, {"host": self._host, "patient": patient})
        self._t_heard = self._t_state = time.monotonic()

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.process.kill()  # it holds nothing that could be damaged, and may never end by itself
            child.close(timeout=1.0)

    def close(self) -> None:
        """Hang up. Idempotent."""
        self._end()
