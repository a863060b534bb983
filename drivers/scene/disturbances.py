"""Latency and noise of the devices of a simulated world, as ``rig.world.randomize`` draws them.

They are in the drivers, behind the servo: its limits and its watchdog are as without them, and an arm that is stopped
stops as much later as its commands take.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

T = TypeVar("T")


class Randomized(NamedTuple):
    """What a world was randomized with."""

    values: Mapping[str, Any]
    """Drawn values by their keys, see :mod:`hal.randomization`; empty for the world of the rig file."""
    seed: int
    """Seed of the noise."""

    def get(self, section: str, key: str) -> float:
        """Return a latency or a standard deviation; 0 where none was drawn."""
        return float(self.values.get(f"{section}.{key}", 0.0))

    @classmethod
    def take(cls, values: Mapping[str, Any], seed: int) -> Randomized:
        """Return what an edit says; :data:`UNCHANGED` without values."""
        return cls(dict(values), seed) if values else UNCHANGED


UNCHANGED = Randomized({}, 0)
"""The world of the rig file."""


class Delay(Generic[T]):
    """A queue in which everything stays for the same number of steps."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._waiting: deque[tuple[int, T]] = deque()
        self._out: T | None = None

    def put(self, step: int, item: T) -> None:
        """Put something in at a step, in place of what was put in at the same one."""
        if self._waiting and self._waiting[-1][0] == step + self.steps:
            self._waiting.pop()
        self._waiting.append((step + self.steps, item))

    def take(self, step: int) -> T | None:
        """Return the newest that has come out until this step; None if nothing new has."""
        found = None
        while self._waiting and self._waiting[0][0] <= step:
            found = self._waiting.popleft()[1]
        return found

    def read(self, step: int) -> T | None:
        """Return the newest that has come out until this step, or the first one while it is inside; None if empty."""
        found = self.take(step)
        if found is not None:
            self._out = found
        elif self._out is None and self._waiting:
            self._out = self._waiting[0][1]
        return self._out

    def clear(self) -> None:
        """Forget everything."""
        self._waiting.clear()
        self._out = None


class Disturbances:
    """Latency and noise of one device: of its measurements, and of its commands.

    Args:
        world: The simulated world: its ``randomized``, ``steps`` and ``dt``.
        section: Key of the device, such as ``robots.panda``.
        noise: Key of the noise of each part of a measurement.
    """

    def __init__(self, world: Any, section: str, noise: Sequence[str]) -> None:
        self._world, self._section, self._keys = world, section, noise
        self._known = UNCHANGED
        self.sensed: Delay[tuple[float, tuple[Any, ...]]] = Delay(0)
        self.commands: Delay[Callable[[], None]] = Delay(0)
        self._deviations = [0.0] * len(noise)
        self._command_noise = 0.0
        self._random = np.random.default_rng(0)
        self._measured = -1
        """The step at which was measured last."""
        self.active = False
        """Whether anything is disturbed."""

    def update(self) -> None:
        """Follow a new randomization of the world, and carry out the newest command that has arrived.

        To be called after every step.
        """
        drawn: Randomized = self._world.randomized
        if drawn is not self._known:
            self._prepare(drawn)
        arrived = self.commands.take(self._world.steps) if self.active else None
        if arrived is not None:
            arrived()

    def _prepare(self, drawn: Randomized) -> None:
        late = self.commands.take(1 << 62)
        if late is not None:
            late()  # the newest command is not lost
        self._known, self._measured = drawn, -1
        dt = self._world.dt
        self.sensed = Delay(round(drawn.get(self._section, "state_latency_s") / dt))
        self.commands = Delay(round(drawn.get(self._section, "command_latency_s") / dt))
        self._deviations = [drawn.get(self._section, key) for key in self._keys]
        self._command_noise = drawn.get(self._section, "command_noise")
        self._random = np.random.default_rng([drawn.seed, zlib.crc32(self._section.encode())])
        self.active = any((self.sensed.steps, self.commands.steps, self._command_noise, *self._deviations))

    def measure(self, *parts: Any) -> tuple[float, tuple[Any, ...]]:
        """Return what the device reports now of a measurement: its time, s of the world, and its parts.

        The parts are numbers or sequences of them, in the order of the keys of the noise; further ones have none.
        """
        if not self.active:
            return self._world.t, parts
        step = self._world.steps
        if step != self._measured:  # however often it is read
            self._measured = step
            noisy = list(parts)
            for k, deviation in enumerate(self._deviations):
                noisy[k] = self._blur(parts[k], deviation) if deviation else parts[k]
            self.sensed.put(step, (self._world.t, tuple(noisy)))
        found = self.sensed.read(step)
        assert found is not None
        return found

    def blur_command(self, q: Sequence[float]) -> Sequence[float]:
        """Return what the motors get of positions (n,)."""
        return self._blur(q, self._command_noise) if self._command_noise else q

    def _blur(self, part: Any, deviation: float) -> Any:
        if isinstance(part, float):
            return part + deviation * float(self._random.standard_normal())
        return (np.asarray(part) + deviation * self._random.standard_normal(len(part))).tolist()

    def send(self, command: Callable[[], None]) -> None:
        """Call a function when a command that is given now arrives; at once without latency."""
        if self.commands.steps:
            self.commands.put(self._world.steps, command)
        else:
            command()

    def forget(self) -> None:
        """Forget measurements and commands that are under way, after a reset or at a stop of the device's own."""
        self.sensed.clear()
        self.commands.clear()
        self._measured = -1
