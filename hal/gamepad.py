"""A gamepad: the driver's abstract class and the public class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, NamedTuple

if TYPE_CHECKING:
    from .specs import PadSpec

__all__ = ["GamepadDriver", "PadReading"]


class PadReading(NamedTuple):
    """What a gamepad driver reports. Canonical names (``hal.types.AXES``, ``BUTTONS``), no dead zone applied yet."""

    t: float
    """Time of the newest event, on the host's clock, s."""
    t_alive: float
    """When the driver last had proof that the pad is there and speaking, s. The dead-man's watchdog looks at this."""
    t_device: float
    seq: int
    """Counts events."""
    axes: Mapping[str, float]
    """Sticks -1..1, right and up positive; triggers 0..1."""
    buttons: frozenset[str]
    connected: bool


class GamepadDriver(ABC):
    """One pad. ``poll`` is called for as long as the rig is open, from one thread; a pad that is not plugged in is
    not an error but a reading with ``connected=False``, and comes back by itself when it is plugged in again.
    """

    simulated: ClassVar[bool] = False
    proves_liveness: ClassVar[bool] = False
    """True where silence means that the pad is gone (unplugging is seen, or the pad streams), so that its buttons
    may serve as a dead-man on a real arm."""

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        self.spec = spec
        self.source = source
        """Where a pad that lives in another process gets its record from; for ``playback``, the rig's clock."""

    @abstractmethod
    def open(self) -> None:
        """Look for the pad."""

    @abstractmethod
    def poll(self, now: float, timeout: float) -> PadReading:
        """The present reading; waits up to ``timeout`` s for news. ``now`` is the time on ``rig.clock``."""

    def describe(self) -> str:
        """What drives, in words, for the banner."""
        return type(self).__name__

    @abstractmethod
    def close(self) -> None:
        """Let go of the device. Idempotent."""
