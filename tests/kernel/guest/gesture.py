"""What a hand does to a pad, and what every synthetic pad makes of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol


class Gesture(NamedTuple):
    """Names as in ``hal.types``: sticks and d-pad -1..1, right and up positive; triggers 0..1."""

    axes: Mapping[str, float] = MappingProxyType({})
    buttons: frozenset[str] = frozenset()

    def axis(self, name: str) -> float:
        """One that is not named is let go of."""
        return self.axes.get(name, 0.0)

    def bits(self, *names: str) -> int:
        """The named buttons as bits, the first one lowest; empty names are left out."""
        return sum(1 << place for place, name in enumerate(names) if name in self.buttons)


class Output(NamedTuple):
    """A report that the kernel's driver sent to a pad."""

    t: float
    """s, monotonic."""
    data: bytes


class Motors(NamedTuple):
    """What the kernel's driver wants of the motors, in the pad's own numbers."""

    strong: int
    weak: int


class Device(Protocol):
    """What the kernel takes for hardware."""

    t_plugged: float
    """s, monotonic."""
    listening: bool
    """Does the kernel want reports?"""
    outputs: list[Output]
    """What the kernel's driver sent, oldest first."""

    def fileno(self) -> int:
        """Readable when the kernel wants something."""

    def serve(self) -> None:
        """Do what the kernel asks for."""

    def send(self, report: Any) -> None:
        """Give it a report."""

    def unplug(self) -> float:
        """Pull the cable; returns when, s on the monotonic clock."""


class Make(ABC):
    """One kind of pad: what it says of itself, and its reports."""

    @abstractmethod
    def plug(self, number: int) -> Device:
        """Plug one in; ``number`` counts all that were."""

    @abstractmethod
    def reports(self, gesture: Gesture, count: int) -> list[Any]:
        """What it sends for a gesture; ``count`` counts the reports so far."""

    def period(self, gesture: Gesture) -> float | None:
        """s between two reports while a pad is held like this; None: it speaks when something changes."""
        return None

    def motors(self, output: bytes) -> Motors | None:
        """What an output report asks of the motors; None for a report about something else."""
        return None
