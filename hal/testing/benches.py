"""What surrounds a driver while it is checked: its time, and a hand on its plugs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ..clock import Clock, RealClock
from ..driver import CameraDriver, GamepadDriver, GripperDriver, RobotDriver
from ..specs import Floats

__all__ = ["Bench", "CameraBench", "GripperBench", "PadBench", "RobotBench"]


def not_given(*_: Any) -> Any:
    """Stands for what a bench was not told how to do."""
    raise AssertionError("this bench cannot do that; a check that asks for it must say so with @needs")


def nothing() -> None:
    """Does nothing."""


@dataclass(kw_only=True)
class Bench:
    """What all benches have. Only ``driver`` must be given; every other field says what it is for."""

    driver: Any
    advance: Callable[[], None] = nothing
    """What happens in the device while one cycle passes, where a program plays the device."""
    real_time: bool = False
    """Does the device live by this computer's clock (hardware, a thread, a process)? Then the checks wait; otherwise
    they count up a time of their own, and a minute passes in a moment."""
    patience: float = 0.0
    """How long the driver may take to find out that the link is lost, or that it is there again, s. 0: at once."""
    lose: Callable[[], None] = not_given
    """Break the link: pull the plug, end the far end."""
    restore: Callable[[], None] = not_given
    """Mend the link that ``lose`` broke."""
    freeze: Callable[[], None] = not_given
    """Let the device fall silent while the link stays: nothing new comes any more."""
    dt: float = 0.01
    """Length of a cycle, s."""
    now: float = 1000.0
    """The host's clock, which never starts at zero."""

    def __post_init__(self) -> None:
        if self.real_time:
            self.now = time.monotonic()

    def has(self, ability: str) -> bool:
        """Can this bench, or its driver, do that?"""
        return getattr(self, ability) is not not_given

    def gave(self, ability: str) -> bool:
        """Was the bench told how to do that?"""
        return callable(getattr(self, ability, None)) and self.has(ability)

    def pass_time(self) -> float:
        """Let one cycle pass; the time after it."""
        if self.real_time:
            time.sleep(max(0.0, self.now + self.dt - time.monotonic()))
            self.now = time.monotonic()
        else:
            self.now += self.dt
        self.advance()
        return self.now

    def turns(self, seconds: float) -> range:
        """So many cycles are so many seconds."""
        return range(max(1, round(seconds / self.dt)))


@dataclass(kw_only=True)
class RobotBench(Bench):
    """An arm. Its cycle is that of its spec (``rate_hz``), or its own where the driver paces itself."""

    driver: RobotDriver
    dt: float = 0.0
    fail: Callable[[], str] = not_given
    """Make the device report a fault that ``recover()`` clears; returns a word that the fault's cause must contain."""
    joint: int = -1
    """The joint that the checks move, by 0.2 rad up and down; the fourth, or the last."""
    initial: Floats = field(default=())
    """Where the arm stands when the bench is made, rad; ``spec.initial``, unless it is given."""

    def __post_init__(self) -> None:
        spec = self.driver.spec
        self.dt = self.dt or 1.0 / spec.rate_hz
        self.joint = min(3, len(spec.joints) - 1) if self.joint < 0 else self.joint
        self.initial = self.initial or spec.initial
        self.real_time = self.real_time or self.driver.paces_itself
        super().__post_init__()

    def has(self, ability: str) -> bool:
        if ability == "torque":
            return "torque" in self.driver.modes
        return ability in ("rest", "returns") or super().has(ability)

    def pass_time(self) -> float:
        if not self.driver.paces_itself:
            return super().pass_time()
        self.advance()
        self.driver.wait()
        self.now = time.monotonic()
        return self.now


@dataclass(kw_only=True)
class GripperBench(Bench):
    """A gripper, open at the start."""

    driver: GripperDriver
    dt: float = 1 / 240
    put_object: Callable[[float], None] = not_given
    """Hold something rigid of this width (m) between the open fingers."""


@dataclass(kw_only=True)
class CameraBench(Bench):
    """A camera. It lives by this computer's clock, unless the bench is given another one.

    Where ``freeze`` is given, ``restore`` ends that, too.
    """

    driver: CameraDriver
    clock: Clock = field(default_factory=RealClock)
    """The clock that its frames are stamped by."""

    def __post_init__(self) -> None:
        self.real_time = isinstance(self.clock, RealClock)
        super().__post_init__()

    @property
    def paced(self) -> bool:
        """Does it take frames by itself, at its rate, whether somebody asks or not?"""
        return self.real_time and not self.driver.on_demand


@dataclass(kw_only=True)
class PadBench(Bench):
    """A gamepad, at rest, plugged in, nothing pressed. ``lose`` unplugs it, ``restore`` plugs it in again."""

    driver: GamepadDriver
    press: Callable[[], None] = not_given
    """Press the button ``south``, by place: Cross, A."""
    release: Callable[[], None] = not_given
    """Let go of it."""
