"""What each fault command does (the table is in :mod:`.faults`)."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any, Protocol

from hal.drivers.franka.flags import flag_index

from .faults import help_text
from .journal import Figures
from .server import ArmServer

__all__ = ["Executor", "HandCommands"]

_LONGEST = 600.0
"""s: no fault lasts longer."""

Words = list[str]
Answer = dict[str, Any]


class HandCommands(Protocol):
    """What the hand's server offers to the console."""

    def command(self, words: list[str]) -> dict[str, Any]:
        """Execute a fault command of the hand; with ``error`` in the answer when that cannot be."""


class Executor:
    """Executes commands on a server and, where there is one, on its hand."""

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
            "truncate": self._truncate,
            "reflex": self._reflex,
            "user-stop": lambda words: server.arm.user_stop(_switch(words)),
            "emergency-stop": lambda words: server.arm.emergency_stop(_switch(words)),
            "guiding": lambda words: server.arm.guiding(_switch(words)),
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

    def execute(self, words: Words) -> Answer:
        """Do it, and give the answer. Raises ValueError for what is not a command."""
        verb, *rest = words or [""]
        if verb not in self._verbs:
            raise ValueError(f"no command {verb!r}; help lists them")
        try:
            answer = self._verbs[verb](rest) or {}
        except (ValueError, IndexError) as error:
            raise ValueError(f"{verb}: {error}") from None
        if verb in _FAULTS:
            self._server.arm.journal.say("command", "command: " + " ".join(words))
        return answer

    def _silence(self, words: Words) -> None:
        self._server.faults.silent_until = time.monotonic() + _seconds(words)

    def _report_lag(self, words: Words) -> None:
        reports = self._server.arm.reports
        (word,) = _exactly(words, 1)
        if not 0 <= int(word) <= reports.LATEST:
            raise ValueError(f"takes 0 to {reports.LATEST} cycles")
        reports.lag = int(word)

    def _report_noise(self, words: Words) -> None:
        (word,) = _exactly(words, 1)
        if not 0.0 <= float(word) <= 1.0:
            raise ValueError("takes 0 to 1 rad")
        self._server.arm.reports.noise = float(word)

    def _report_measured(self, words: Words) -> None:
        self._server.arm.reports.measured = _switch(words)

    def _truncate(self, words: Words) -> None:
        self._server.faults.truncate = _switch(words)

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
        self._server.arm.no_move_reply = _switch(words)

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
        return {**arm.figures.report(), "limits": arm.checker.report()}

    def _reset_stats(self, words: Words) -> None:
        self._server.arm.figures = Figures()
        self._server.arm.checker.reset()

    def _log(self, words: Words) -> Answer:
        return {"events": self._server.arm.journal.events(int(words[0]) if words else 100)}


_FAULTS = frozenset(
    [
        "silence",
        "lose-states",
        "lose-commands",
        "report-lag",
        "report-noise",
        "report-measured",
        "truncate",
        "stall",
        "slow-reply",
        "no-move-reply",
        "version",
        "restart",
    ],
)
"""Commands that are worth an event of their own; the others are seen by what they do, or change nothing."""


def _exactly(words: Words, count: int) -> Words:
    if len(words) != count:
        raise ValueError(f"takes {count} argument{'s' if count > 1 else ''}")
    return words


def _switch(words: Words) -> bool:
    (word,) = _exactly(words, 1)
    if word not in ("on", "off"):
        raise ValueError("takes on or off")
    return word == "on"


def _seconds(words: Words) -> float:
    (word,) = _exactly(words, 1)
    seconds = float(word)
    if not 0.0 <= seconds <= _LONGEST:
        raise ValueError(f"takes 0 to {_LONGEST:g} seconds")
    return seconds
