"""Client of a running emulator's control port."""

from __future__ import annotations

import json
import socket
from typing import Any

CONTROL_PORT = 1339
"""TCP port of a Franka's emulator; that of emulated buses is a free one, which it prints."""


class EmulatorControl:
    """A connection to the control port of a running emulator, also as a context manager."""

    def __init__(self, host: str, port: int = CONTROL_PORT, timeout: float = 10.0) -> None:
        """Connect to the emulator at ``host``; ``timeout`` (s) is for each answer. Raises OSError if there is none."""
        self._socket = socket.create_connection((host, port), timeout)
        self._reader = self._socket.makefile("r", encoding="utf-8")

    def send(self, *words: object) -> dict[str, Any]:
        """Execute one command, given as one text or as words: ``send("silence 0.5")``, ``send("silence", 0.5)``.

        Returns:
            The answer; empty after ``kill``.

        Raises:
            ValueError: With the emulator's message, if it refuses the command.
            ConnectionError: If the emulator has ended.
        """
        command = " ".join(str(word) for word in words).split()
        if not command:
            raise ValueError("no command; help lists them")
        self._socket.sendall(" ".join(command).encode() + b"\n")
        try:
            line = self._reader.readline()
        except ConnectionError:
            line = ""
        if not line and command[-1:] == ["kill"]:
            return {}
        if not line:
            raise ConnectionError("the emulator has ended")
        answer: dict[str, Any] = json.loads(line)
        if not answer.pop("ok"):
            raise ValueError(answer["error"])
        return answer

    def close(self) -> None:
        """Disconnect."""
        self._reader.close()
        self._socket.close()

    def __enter__(self) -> EmulatorControl:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
