"""Fault commands: what can go wrong with a robot and its network, at will. ``help`` prints the table below.

They are typed into the emulator's standard input, or sent to its control port (see :mod:`.control`).
"""

from __future__ import annotations

import random
from collections import deque
from typing import NamedTuple

from .samples import Floats, Sample

__all__ = ["COMMANDS", "Faults", "Loss", "Reports", "help_text"]


class Command(NamedTuple):
    """One line of the table."""

    usage: str
    meaning: str


COMMANDS = (
    Command("silence S", "send no states for S seconds; the client's library gives up after 1 s"),
    Command("lose-states P | next N", "throw away that share (0..1) of the states, or exactly the next N"),
    Command("lose-commands P | next N", "the same with the commands that come in"),
    Command("report-lag N", "report q_d, dq_d and ddq_d N cycles late (0 to 10)"),
    Command("report-noise S", "add noise to the reported q_d: normal, S rad"),
    Command("report-measured on|off", "report measured positions and speeds as q_d and dq_d"),
    Command("truncate on|off", "send states that are one byte too short"),
    Command("reflex NAME|INDEX", "raise an error flag: a running motion is aborted, recovery is needed"),
    Command("user-stop on|off", "press or release the user stop"),
    Command("emergency-stop on|off", "press or release the emergency stop"),
    Command("guiding on|off", "lead the arm by hand (not while a motion runs)"),
    Command("place [Q1 ... Q7]", "put the arm there, rad, or where it stood at the start (not while a motion runs)"),
    Command("stall S", "the emulator itself sleeps for S seconds"),
    Command("slow-reply S", "look at requests only S seconds after they came (0: at once)"),
    Command("no-move-reply on|off", "never tell the end of a motion: the client's library then waits for ever"),
    Command("version N", "claim to speak protocol N from the next connection on (0: the true one)"),
    Command("kill", "the process ends at once, without a word"),
    Command("restart [S]", "drop all connections and come back S seconds later (0) as if switched on anew"),
    Command("hand ...", "a fault of the hand; `hand help` lists them"),
    Command("state", "what the arm is and does now"),
    Command("stats", "counters, times and the worst share of every limit since the last reset"),
    Command("reset-stats", "start counting anew"),
    Command("settings", "what the client has set"),
    Command("log [N]", "the last N events (100)"),
    Command("help", "this table"),
)


def help_text() -> str:
    """The table, for people."""
    width = max(len(command.usage) for command in COMMANDS)
    return "\n".join(f"{command.usage:<{width}}  {command.meaning}" for command in COMMANDS)


class Loss:
    """Throws some packets away: a share of them, chosen by a seeded generator, or exactly the next few."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self.share = 0.0
        self.next = 0

    def set(self, words: list[str]) -> None:
        """``["0.05"]`` or ``["next", "3"]``. Raises ValueError."""
        if words[:1] == ["next"] and len(words) == 2:
            self.next = int(words[1])
            return
        (text,) = words
        share = float(text)
        if not 0.0 <= share <= 1.0:
            raise ValueError("a share is from 0 to 1")
        self.share, self.next = share, 0

    def strikes(self) -> bool:
        """Is this packet lost?"""
        if self.next > 0:
            self.next -= 1
            return True
        return self.share > 0.0 and self._random.random() < self.share


class Reports:
    """How the arm reports what it was commanded: truthfully, unless a fault is switched on."""

    LATEST = 10
    """Cycles."""

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self._samples: deque[Sample] = deque(maxlen=self.LATEST + 1)
        self.clear()

    def clear(self) -> None:
        """Report the truth."""
        self.lag = 0
        self.noise = 0.0
        self.measured = False

    def shown(self, sample: Sample, q: Floats, dq: Floats) -> Sample:
        """What the state says of this cycle's ``sample``, while the arm is measured at ``q`` (7,), rad, and ``dq``."""
        self._samples.appendleft(sample)
        if self.measured:
            sample = Sample(q, dq, sample.ddq)
        elif self.lag:
            sample = self._samples[min(self.lag, len(self._samples) - 1)]
        if self.noise:
            sample = sample._replace(q=[x + self._random.gauss(0.0, self.noise) for x in sample.q])
        return sample


class Faults:
    """What is switched on."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.clear()

    def clear(self) -> None:
        """Everything works again."""
        self.states = Loss(self.seed)
        self.commands = Loss(self.seed + 1)
        self.silent_until = 0.0
        """Monotonic clock, s."""
        self.truncate = False
        self.slow_reply = 0.0
        self.version = 0
