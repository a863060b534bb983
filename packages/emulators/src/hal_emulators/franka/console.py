"""What each command of the emulator does, from its prompt or its control port; their table is in :mod:`.faults`."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any, Protocol

from hal.drivers.franka.flags import flag_index
from hal_emulators.control import read_number, read_switch, read_words

from .faults import COMMANDS, help_text
from .journal import Counters
from .server import ArmServer

Words = list[str]
Answer = dict[str, Any]

_MAX_DURATION = 600.0
"""Longest duration of a fault, s."""
_NOTED = frozenset(command.usage.split()[0] for command in COMMANDS if command.noted)


class HandCommands(Protocol):
    """Interface of the hand's server to the console."""

    def command(self, words: list[str]) -> dict[str, Any]:
        """Execute a command of the hand; ``error`` in the answer reports a failure."""


class Executor:
    """Executes commands on a server and on its hand, if there is one."""

    def __init__(self, server: ArmServer, hand: HandCommands | None) -> None:
        self._server = server
        self._hand = hand
        self._verbs: dict[str, Callable[[Words], Answer | None]] = {
            "silence": self._silence,
            "lose-states": lambda words: server.faults.states.set(words),
            "lose-commands": lambda words: server.faults.commands.set(words),
            "report-lag": self._report_lag,
            "report-noise": self._report_noise,
            "report-measured": self._report_measured,
            "spoil": self._spoil,
            "unrest": lambda words: server.arm.unrest.set(None if words == ["off"] else int(*_exactly(words, 1))),
            "truncate": self._truncate,
            "reflex": self._reflex,
            "user-stop": lambda words: server.arm.user_stop(read_switch(*_exactly(words, 1))),
            "emergency-stop": lambda words: server.arm.emergency_stop(read_switch(*_exactly(words, 1))),
            "guiding": lambda words: server.arm.guiding(read_switch(*_exactly(words, 1))),
            "place": self._place,
            "stall": lambda words: time.sleep(_seconds(words)),
            "slow-reply": self._slow_reply,
            "no-move-reply": self._no_move_reply,
            "version": self._version,
            "kill": lambda words: os.kill(os.getpid(), signal.SIGKILL),
            "restart": self._restart,
            "hand": self._to_hand,
            "state": self._state,
            "stats": self._stats,
            "reset-stats": self._reset_stats,
            "settings": lambda words: {"settings": server.arm.settings.given},
            "log": self._log,
            "help": lambda words: {"text": help_text()},
        }

    def execute_line(self, line: str) -> Answer:
        """Execute a command between two cycles of the server, and return its answer. Raises ValueError."""
        words = read_words(line)
        return self._server.call(lambda: self.execute(words))

    def execute(self, words: Words) -> Answer:
        """Execute a command, and return its answer. Raises ValueError if it is invalid."""
        verb, *rest = words or [""]
        if verb not in self._verbs:
            raise ValueError(f"no command {verb!r}; help lists them")
        try:
            answer = self._verbs[verb](rest) or {}
        except (ValueError, IndexError) as error:
            raise ValueError(f"{verb}: {error}") from None
        if verb in _NOTED:
            self._server.arm.journal.record("command", "command: " + " ".join(words))
        return answer

    def _silence(self, words: Words) -> None:
        self._server.faults.silent_until = time.monotonic() + _seconds(words)

    def _report_lag(self, words: Words) -> None:
        reports = self._server.arm.reports
        (word,) = _exactly(words, 1)
        if not 0 <= int(word) <= reports.MAX_LAG:
            raise ValueError(f"takes 0 to {reports.MAX_LAG} cycles")
        reports.lag = int(word)

    def _report_noise(self, words: Words) -> None:
        self._server.arm.reports.noise = read_number(_exactly(words, 1)[0], 0.0, 1.0)

    def _report_measured(self, words: Words) -> None:
        self._server.arm.reports.measured = read_switch(*_exactly(words, 1))

    def _spoil(self, words: Words) -> None:
        field, value = _exactly(words, 2)
        if value not in ("nan", "inf", "off"):
            raise ValueError("takes nan, inf or off")
        self._server.arm.spoil(field, None if value == "off" else float(value))

    def _truncate(self, words: Words) -> None:
        self._server.faults.truncate = read_switch(*_exactly(words, 1))

    def _reflex(self, words: Words) -> None:
        (name,) = _exactly(words, 1)
        self._server.arm.reflex(flag_index(name))

    def _place(self, words: Words) -> None:
        arm = self._server.arm
        q = [float(word) for word in words]
        limits = zip(q, arm.limits.lower, arm.limits.upper, strict=True) if q else ()
        if not all(lower <= position <= upper for position, lower, upper in limits):
            raise ValueError("beyond the arm's range")
        arm.place(q or None)

    def _slow_reply(self, words: Words) -> None:
        self._server.faults.slow_reply = _seconds(words)

    def _no_move_reply(self, words: Words) -> None:
        self._server.arm.no_move_reply = read_switch(*_exactly(words, 1))

    def _version(self, words: Words) -> None:
        (number,) = _exactly(words, 1)
        version = int(number)
        if not 0 <= version < 65536:
            raise ValueError("a version is from 0 to 65535")
        self._server.faults.version = version

    def _restart(self, words: Words) -> None:
        away = _seconds(words) if words else 0.0
        self._server.restart(away)
        if self._hand is not None:
            self._to_hand(["restart", str(away)])

    def _to_hand(self, words: Words) -> Answer:
        if self._hand is None:
            raise ValueError("this emulator has no hand")
        answer = self._hand.command(words)
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer

    def _state(self, words: Words) -> Answer:
        session = self._server.session
        connected = session is not None and session.connected
        return {**self._server.arm.report(), "connected": connected, "t": time.monotonic()}

    def _stats(self, words: Words) -> Answer:
        arm = self._server.arm
        return {**arm.counters.report(), "limits": arm.checker.report()}

    def _reset_stats(self, words: Words) -> None:
        self._server.arm.counters = Counters()
        self._server.arm.checker.reset()

    def _log(self, words: Words) -> Answer:
        return {"events": self._server.arm.journal.events(int(words[0]) if words else 100)}


def _exactly(words: Words, count: int) -> Words:
    if len(words) != count:
        raise ValueError(f"takes {count} argument{'s' if count > 1 else ''}")
    return words


def _seconds(words: Words) -> float:
    return read_number(_exactly(words, 1)[0], 0.0, _MAX_DURATION)
