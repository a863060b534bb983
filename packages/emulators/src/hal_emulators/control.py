"""The control port and the prompt of an emulator, and the client of a running one."""

from __future__ import annotations

import argparse
import contextlib
import gc
import ipaddress
import json
import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

from hal.errors import HalError

Execute = Callable[[str], "dict[str, Any]"]
"""Executes a command and returns its answer. Raises ValueError if it is invalid."""
CONTROL_PORT = 1339
"""TCP port of a Franka's emulator; that of emulated buses is a free one, which it prints."""


class Started(NamedTuple):
    execute: Execute
    places: str
    """Where its devices are."""
    check: Callable[[], None] = lambda: None
    """Called from time to time; raises what ends the emulator."""


def run_emulator(
    kind: str,
    description: str,
    commands: str,
    arguments: Sequence[str] | None,
    start: Callable[[argparse.Namespace, contextlib.ExitStack], Started],
) -> int:
    """Run an emulator of every device of its kind in a rig until it is asked to end; return its exit status.

    ``description`` is what it plays; what it proves is added. ``start`` starts it; the stack is closed at the end.
    """
    parser = make_parser(kind, description, commands, "; with several devices, the arm's name first")
    _add_rig_options(parser)
    options = parser.parse_args(arguments)
    ends = note_signals()
    try:
        with contextlib.ExitStack() as stack:
            started = start(options, stack)
            gc.collect()
            gc.freeze()  # a collection of all objects takes longer than a driver waits for an arm
            port = CommandPort(started.execute, options.port)
            print(f"ready: {started.places}; control port {port.number}; help lists the commands", flush=True)
            serve_prompt(started.execute)
            while not ends:
                time.sleep(0.1)
                started.check()
            port.close()
    except (HalError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def make_parser(kind: str, description: str, commands: str, more: str = "") -> argparse.ArgumentParser:
    """Return the command line of an emulator; the arguments are those of :func:`run_emulator`."""
    return argparse.ArgumentParser(
        prog=f"hal emulate {kind}",
        description=f"{description} What the manuals leave open is assumed; it proves nothing about a real one.",
        epilog=f"commands, typed here or sent to the control port{more}:\n{commands}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _add_rig_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", required=True, help="the rig: a name in config/, or a path")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    parser.add_argument("--port", type=int, default=0, help="control port (a free one)")
    parser.add_argument("--seed", type=int, default=0, help="seed of random losses (%(default)s)")
    parser.add_argument(
        "--no-world",
        action="store_true",
        help="leave out the rig's simulated world: the fingers meet only what the command `object` names",
    )


def note_signals() -> list[int]:
    """Return a list to which the signals that ask this program to end are appended.

    It is no Event: a second signal within its ``set`` would wait for ever.
    """
    ends: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: ends.append(number))
    return ends


class EmulatorControl:
    """A connection to the control port of a running emulator, also as a context manager."""

    def __init__(self, host: str, port: int = CONTROL_PORT, timeout: float = 10.0) -> None:
        """Connect to the emulator at ``host``; ``timeout`` (s) is for each answer. Raises OSError if there is none."""
        self._socket = socket.create_connection((host, port), timeout)
        self._reader = self._socket.makefile("r", encoding="utf-8")

    def send(self, *words: object) -> dict[str, Any]:
        """Execute one command, given as one text or as words: ``send("silence 0.5")``, ``send("silence", 0.5)``.

        Returns the answer, which is empty after ``kill``. Raises ValueError with the emulator's message if it refuses
        the command, ConnectionError if the emulator has ended.
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
        self._reader.close()
        self._socket.close()

    def __enter__(self) -> EmulatorControl:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve_prompt(execute: Execute) -> None:
    """Execute the lines of standard input, in a thread, until it ends. Answers are for a reader: text, or JSON."""

    def serve() -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in sys.stdin:
                if line.strip():
                    answer = answer_line(execute, line)
                    report = {key: value for key, value in answer.items() if key != "ok"}
                    print(
                        answer.get("text") or answer.get("error") or (json.dumps(report) if report else "ok"),
                        flush=True,
                    )

    signal.signal(signal.SIGTTIN, signal.SIG_IGN)  # in the background: reading a terminal would stop this program
    threading.Thread(target=serve, name="prompt", daemon=True).start()


class CommandPort:
    """The control port: TCP on this computer, one thread for each client. Its ``number`` is the port."""

    def __init__(self, execute: Execute, number: int = 0, host: str = "127.0.0.1") -> None:
        """Listen on a port, 0 for a free one. Raises OSError if it is taken."""
        self._execute = execute
        self._listener = socket.create_server((host, number))
        self.number: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, name="control-port", daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection, connection.makefile("r", encoding="utf-8") as lines:
            for line in lines:
                connection.sendall(json.dumps(answer_line(self._execute, line)).encode() + b"\n")

    def close(self) -> None:
        self._listener.close()


def answer_line(execute: Execute, line: str) -> dict[str, Any]:
    """Execute a line, and return its answer with ``ok``, and ``error`` where that is false."""
    try:
        return {"ok": True, **execute(line)}
    except (ValueError, TypeError, IndexError) as error:
        return {"ok": False, "error": str(error)}


Run = Callable[[Any, "list[str]"], "Mapping[str, Any] | None"]
"""Executes a command on a target with its words, and returns its answer. Raises ValueError and IndexError."""


class Command(NamedTuple):
    """A command of an emulator: how it is written, what it does, and how."""

    usage: str
    meaning: str
    run: Run


def make_commands(*commands: Command) -> dict[str, Command]:
    """Return a table of commands by their names; ``kill`` and ``help`` are added."""
    more = (
        Command("kill", "end this program at once", lambda _, __: os.kill(os.getpid(), signal.SIGKILL)),
        Command("help", "this table", lambda _, __: {"text": help_text(table)}),
    )
    table = {command.usage.split()[0]: command for command in (*commands, *more)}
    return table


def help_text(table: Mapping[str, Command]) -> str:
    """Return a table of commands as text."""
    width = max(len(command.usage) for command in table.values())
    return "\n".join(f"  {command.usage:{width}}  {command.meaning}" for command in table.values())


def run_command(table: Mapping[str, Command], target: object, words: Sequence[str]) -> dict[str, Any]:
    """Execute a command, and return its answer. Raises ValueError if it is invalid."""
    command = table.get(words[0] if words else "")
    if command is None:
        raise ValueError(f"there is no command {' '.join(words[:1])!r}; help lists them")
    try:
        if len(words) > len(command.usage.split()) and "..." not in command.usage:
            raise ValueError("too many words")
        return dict(command.run(target, list(words[1:])) or {})
    except (ValueError, IndexError, KeyError) as error:
        raise ValueError(f"{words[0]}: {error}; usage: {command.usage}") from None


def assign(place: str, read: Callable[[str], Any]) -> Run:
    """Return what puts a command's word, once it is read, at an attribute of the target, as ``faults.delay``."""
    owner, _, name = place.rpartition(".")
    find: Callable[[Any], Any] = attrgetter(owner) if owner else lambda target: target
    return lambda target, words: setattr(find(target), name, read(words[0]))


def read_switch(word: str) -> bool:
    """Return whether a word is on. Raises ValueError unless it is on or off."""
    if word not in ("on", "off"):
        raise ValueError(f"takes on or off, not {word!r}")
    return word == "on"


def read_number(word: str, least: float, most: float) -> float:
    """Return a number in a range. Raises ValueError."""
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise ValueError(f"must be {least:g} to {most:g}, not {word}")
    return value


def between(least: float, most: float) -> Callable[[str], float]:
    """Return the reader of a number in a range; see :func:`read_number`."""
    return lambda word: read_number(word, least, most)


def whole(least: int, most: int) -> Callable[[str], int]:
    """Return the reader of a whole number in a range."""
    return lambda word: int(read_number(word, least, most))


def read_end(word: str) -> float:
    """Return the monotonic time at which a fault of so many s ends; "on" is never, "off" is now. Raises ValueError."""
    known = {"on": 1e9, "off": 0.0}
    return time.monotonic() + (known[word] if word in known else read_number(word, 0.0, 1e9))


def read_loopback(text: str) -> str:
    """Return an address, if it is one of this computer alone. Raises ArgumentTypeError."""
    with contextlib.suppress(ValueError):
        if ipaddress.IPv4Address(text).is_loopback:
            return text
    raise argparse.ArgumentTypeError(f"{text!r} is no address in 127.0.0.0/8")
