"""Commands of the emulator, from its prompt or its control port."""

from __future__ import annotations

import time
from collections.abc import Callable
from operator import attrgetter
from typing import Any

from hal.drivers.franka.flags import flag_index
from hal_emulators.control import (
    Command,
    Run,
    assign,
    between,
    make_commands,
    read_switch,
    run_command,
    whole,
)

from .hand import HandServer
from .journal import Counters
from .server import ArmServer

Words = list[str]
Answer = dict[str, Any]

_MAX_DURATION = 600.0
"""Longest duration of a fault, s."""


class Executor:
    """Executes commands on a server and on its hand, if there is one."""

    def __init__(self, server: ArmServer, hand: HandServer | None) -> None:
        self.server, self.hand = server, hand
        self.arm, self.faults = server.arm, server.faults

    def execute_line(self, line: str) -> Answer:
        """Execute a command between two cycles of the server, and return its answer. Raises ValueError."""
        words = line.split()
        return self.server.call(lambda: self._execute(words))

    def _execute(self, words: Words) -> Answer:
        answer = run_command(COMMANDS, self, words)
        if words[0] in _NOTED:
            self.arm.journal.record("command", "command: " + " ".join(words))
        return answer


_seconds = between(0.0, _MAX_DURATION)


def _call(method: str, read: Callable[[str], Any]) -> Run:
    """Return what calls a method of the executor's parts, such as ``arm.guiding``, with a command's word."""
    return lambda executor, words: attrgetter(method)(executor)(read(words[0]))


def _spoil(executor: Executor, words: Words) -> None:
    field, value = words
    if value not in ("nan", "inf", "off"):
        raise ValueError("takes nan, inf or off")
    executor.arm.spoil(field, None if value == "off" else float(value))


def _place(executor: Executor, words: Words) -> None:
    arm = executor.arm
    q = [float(word) for word in words]
    limits = zip(q, arm.limits.lower, arm.limits.upper, strict=True) if q else ()
    if not all(lower <= position <= upper for position, lower, upper in limits):
        raise ValueError("beyond the arm's range")
    arm.place(q or None)


def _restart(executor: Executor, words: Words) -> None:
    away = _seconds(words[0]) if words else 0.0
    executor.server.restart(away)
    if executor.hand is not None:
        executor.hand.command(["restart", str(away)])


def _to_hand(executor: Executor, words: Words) -> Answer:
    if executor.hand is None:
        raise ValueError("this emulator has no hand")
    return executor.hand.command(words)


def _state(executor: Executor, words: Words) -> Answer:
    session = executor.server.session
    connected = session is not None and session.connected
    return {**executor.arm.report(), "connected": connected, "t": time.monotonic()}


def _stats(executor: Executor, words: Words) -> Answer:
    return {**executor.arm.counters.report(), "limits": executor.arm.checker.report()}


def _reset_stats(executor: Executor, words: Words) -> None:
    executor.arm.counters = Counters()
    executor.arm.checker.reset()


def _log(executor: Executor, words: Words) -> Answer:
    return {"events": executor.arm.journal.events(int(words[0]) if words else 100)}


_FAULTS = (
    Command(
        "silence S",
        "send no states for S seconds; the client's library gives up after 1 s",
        assign("faults.silent_until", lambda word: time.monotonic() + _seconds(word)),
    ),
    Command(
        "lose-states P | next N",
        "lose that share (0..1) of the states, or exactly the next N",
        lambda executor, words: executor.faults.states.set(words),
    ),
    Command(
        "lose-commands P | next N",
        "the same for the client's commands",
        lambda executor, words: executor.faults.commands.set(words),
    ),
    Command(
        "report-lag N", "report q_d, dq_d and ddq_d N cycles late (0 to 10)", assign("arm.reports.lag", whole(0, 10))
    ),
    Command(
        "report-noise S",
        "add noise to the reported q_d: normal, S rad",
        assign("arm.reports.noise", between(0.0, 1.0)),
    ),
    Command(
        "report-measured on|off",
        "report measured positions and speeds as q_d and dq_d",
        assign("arm.reports.measured", read_switch),
    ),
    Command("spoil FIELD nan|inf|off", "report that as the first number of a field of the state, as `tau_J`", _spoil),
    Command(
        "unrest SEED|off",
        "hold the arm 0.1 to 1 mrad off its set-points, chosen at random, swinging by up to 0.08 rad/s",
        _call("arm.unrest.set", lambda word: None if word == "off" else int(word)),
    ),
    Command("truncate on|off", "send states that are one byte too short", assign("faults.truncate", read_switch)),
    Command("stall S", "stop the emulator itself for S seconds", lambda _, words: time.sleep(_seconds(words[0]))),
    Command(
        "slow-reply S",
        "process requests S seconds after their arrival (0: at once)",
        assign("faults.slow_reply", _seconds),
    ),
    Command(
        "no-move-reply on|off",
        "never answer the end of a motion: the client's library then waits forever",
        assign("arm.no_move_reply", read_switch),
    ),
    Command(
        "version N",
        "claim to speak protocol N from the next connection on (0: the true one)",
        assign("faults.version", whole(0, 65535)),
    ),
    Command("restart [S]", "drop all connections, and return S seconds later (0) as after switching on", _restart),
)
_NOTED = frozenset(command.usage.split()[0] for command in _FAULTS)
"""Commands that the event log notes; others are visible in it by their effect, or change nothing."""

COMMANDS = make_commands(
    *_FAULTS,
    Command(
        "reflex NAME|INDEX",
        "raise an error flag: a running motion is aborted, and recovery is required",
        _call("arm.reflex", flag_index),
    ),
    Command("user-stop on|off", "press or release the user stop", _call("arm.user_stop", read_switch)),
    Command("emergency-stop on|off", "press or release the emergency stop", _call("arm.emergency_stop", read_switch)),
    Command("guiding on|off", "guide the arm by hand (not during a motion)", _call("arm.guiding", read_switch)),
    Command("place [Q1 ... Q7]", "put the arm there, rad, or at its start position (not during a motion)", _place),
    Command("hand ...", "a command of the hand; `hand help` lists them", _to_hand),
    Command("state", "present state of the arm", _state),
    Command("stats", "counters, times and the largest share of every limit since the last reset", _stats),
    Command("reset-stats", "reset the counters", _reset_stats),
    Command("settings", "settings sent by the client", lambda executor, _: {"settings": executor.arm.settings.given}),
    Command("log [N]", "the last N events (100)", _log),
)
