"""Client of a running emulator's control port, for shells and tests.

python -m hal_emulators.franka.control --host 127.0.0.2 reflex joint_reflex
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
from typing import Any

from .faults import help_text

__all__ = ["CONTROL_PORT", "EmulatorControl", "main"]

CONTROL_PORT = 1339
"""TCP"""


class EmulatorControl:
    """A connection to an emulator's control port, also as a context manager."""

    def __init__(self, host: str, timeout: float = 10.0) -> None:
        """Connect to the emulator at ``host``; ``timeout`` (s) is for each answer. Raises OSError if there is none."""
        self._socket = socket.create_connection((host, CONTROL_PORT), timeout)
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
        self._socket.sendall(json.dumps({"command": command}).encode() + b"\n")
        line = self._reader.readline()
        if not line and command == ["kill"]:
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


def main(arguments: list[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m hal_emulators.franka.control",
        description="Send one command to a running emulator, and print its answer as JSON.",
        epilog="commands:\n" + help_text(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--host", default="127.0.0.2", help="address of the emulator (%(default)s)")
    parser.add_argument("command", nargs="+", help="the command and its arguments")
    options = parser.parse_args(arguments)
    try:
        with EmulatorControl(options.host) as control:
            answer = control.send(*options.command)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(answer.get("text") or json.dumps(answer, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
