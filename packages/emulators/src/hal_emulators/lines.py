"""Lines of emulated devices that one thread serves: answers that are lost or late, lines that go away, and commands."""

from __future__ import annotations

import os
import random
import select
import threading
from collections.abc import Mapping
from contextlib import suppress
from time import monotonic
from typing import Any, ClassVar

from .control import Command, assign, read_end, read_number, run_command
from .shared_world import PRIORITY, raise_priority

STEP = 0.002
"""Step of the mechanics, s."""
LONGEST_GAP = 0.25
"""Time that the mechanics make up for after the machine had no time for them, s."""


class Losses:
    """Packets that are lost: a share of them, chosen by a seeded generator, or exactly the next ones of a sender."""

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self.clear()

    def clear(self) -> None:
        """Lose no packet any more."""
        self.share = 0.0
        self._next: dict[int, int] = {}
        """Sender, 0 for any -> how many of its next packets are lost."""

    def set(self, words: list[str]) -> None:
        """Set the loss by ``["0.05"]`` or ``["next", "3"]``, which may be followed by a sender. Raises ValueError."""
        if words[0] == "next":
            self._next[int(words[2], 0) if len(words) > 2 else 0] = int(read_number(words[1], 0, 1e6))
        else:
            self.share, self._next = read_number(words[0], 0.0, 1.0), {}

    def take(self, sender: int = 0) -> bool:
        """Return whether the next packet of a sender is lost."""
        for key in (sender, 0):
            if self._next.get(key, 0) > 0:
                self._next[key] -= 1
                return True
        return self.share > 0.0 and self._random.random() < self.share


class Line:
    """The device's end of a line. Times are on the monotonic clock, s.

    Attributes:
        losses: Which answers are lost.
        delay: By how much they are late, s.
        spoil_next: How many of the next ones have a wrong check.
        out_until: Time until which the line is away.
    """

    def __init__(self, seed: int = 0) -> None:
        self.losses = Losses(seed)
        self.out_until = 0.0
        self._waiting: list[tuple[float, int, bytes]] = []
        """Time at which an answer is due, its descriptor, and the answer."""
        self.reset()

    def reset(self) -> None:
        """End the faults of answers."""
        self.losses.clear()
        self.delay, self.spoil_next = 0.0, 0

    def open(self) -> None:
        """Offer the line. Raises OSError."""
        raise NotImplementedError

    def close(self) -> None:
        """Take the line away, as if it was unplugged."""
        raise NotImplementedError

    def descriptors(self) -> list[int]:
        """Return what to read from; none while the line is away."""
        raise NotImplementedError

    def serve(self, descriptor: int) -> object:
        """Take what has come."""
        raise NotImplementedError

    def answer(self, descriptor: int, frame: bytes, sender: int = 0, copies: int = 1) -> None:
        """Send an answer when it is due, unless it is lost."""
        if self.losses.take(sender):
            return
        if self.spoil_next:
            self.spoil_next -= 1
            frame = frame[:-1] + bytes((frame[-1] ^ 0x55,))
        self._waiting.append((monotonic() + self.delay, descriptor, frame * copies))

    def send_due(self, now: float) -> None:
        """Send the answers that are due, and let the line come back."""
        if (now < self.out_until) == bool(self.descriptors()):
            (self.close if self.descriptors() else self.open)()
        due: dict[int, bytes] = {}
        for t, descriptor, frame in self._waiting:
            if t <= now and descriptor in self.descriptors():
                due[descriptor] = due.get(descriptor, b"") + frame
        self._waiting = [one for one in self._waiting if one[0] > now]
        for descriptor, frames in due.items():
            with suppress(OSError):
                os.write(descriptor, frames)


class LineEmulator:
    """Emulated devices by name, each on its line, moved in real time and served by one thread.

    Attributes:
        lines: Their lines.
        lock: Held while the thread works.
    """

    COMMANDS: ClassVar[Mapping[str, Command]]
    """Their target is a line."""
    lines: Mapping[str, Any]

    def __init__(self, paced: bool, realtime: bool) -> None:
        """Create it.

        Args:
            paced: Whether the devices move in real time; otherwise only by :meth:`advance`.
            realtime: Give the thread the priority of a servo, for a process that does nothing else.
        """
        self._paced, self._realtime = paced, realtime
        self.lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="line-emulator", daemon=True)

    def step(self, dt: float) -> None:
        """Let ``dt`` s pass in all devices."""
        raise NotImplementedError

    def advance(self, seconds: float) -> None:
        """Take what has come, and move the devices by ``seconds`` at once."""
        with self.lock:
            owners = self._find_owners()
            self._take(select.select([*owners], [], [], 0.0)[0], owners)
            for _ in range(round(min(seconds, LONGEST_GAP) / STEP)):
                self.step(STEP)

    def _find_owners(self) -> dict[int, Line]:
        return {one: line for line in self.lines.values() for one in line.descriptors()}

    def _take(self, ready: list[int], owners: Mapping[int, Line]) -> None:
        for descriptor in ready:
            line = owners[descriptor]
            if descriptor in line.descriptors():  # no command took it away meanwhile
                line.serve(descriptor)
                line.send_due(monotonic())

    def _serve(self) -> None:
        if self._realtime:
            raise_priority(PRIORITY)  # a busy computer must not look like a silent device
        done = monotonic()
        """Time up to which the devices have moved."""
        while not self._ended.is_set():
            with self.lock:
                now = monotonic()
                done = max(done, now - LONGEST_GAP)
                if self._paced and now - done >= STEP:  # one step at a time: who asks meanwhile is answered
                    self.step(STEP)
                    done += STEP
                for line in self.lines.values():
                    line.send_due(now)
                owners = self._find_owners()
            behind = self._paced and now - done >= STEP
            ready, _, _ = select.select([*owners], [], [], STEP / 20 if behind else STEP / 2)
            with self.lock:
                self._take(ready, owners)

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command, and return its answer; with several devices the arm's name is its first word.

        Raises:
            ValueError: It is invalid.
        """
        words = line.split()
        name = words.pop(0) if words and words[0] in self.lines else next(iter(self.lines))
        with self.lock:
            return run_command(self.COMMANDS, self.lines[name], words)

    def __enter__(self) -> Any:
        for line in self.lines.values():
            line.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(5.0)
        for line in self.lines.values():
            line.close()


LINE_COMMANDS = (
    Command("late S", "send answers S seconds late", assign("delay", float)),
    Command("unplug S|on|off", "take the line away", assign("out_until", read_end)),
)
"""Commands of every such emulator."""
