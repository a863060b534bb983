"""What a rig sees at one moment: every camera's newest picture, and the arms as they were when it was taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

from .errors import CommandError, DeviceNotFound, StaleStateError
from .types import Frame, GripperState, RobotState

if TYPE_CHECKING:
    from collections.abc import Collection

    from .rig import Rig

__all__ = ["Moment", "Observation", "Observer"]

_FRESH = 0.2
"""s; a picture that is older is waited for."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One picture, and every arm and gripper interpolated to its stamp."""

    frame: Frame
    robots: Mapping[str, RobotState]
    grippers: Mapping[str, GripperState]
    """By the name of the arm."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """All of a rig."""

    t: float
    """The stamp of the newest picture; without cameras, that of the newest state. s on ``rig.clock``."""
    cameras: Mapping[str, Moment]
    robots: Mapping[str, RobotState]
    """Interpolated to ``t``."""
    grippers: Mapping[str, GripperState]
    """By the name of the arm, interpolated to ``t``."""
    history: tuple[Observation, ...] = field(default=())
    """This one and those before it, oldest first: as many as were asked for. What was not there yet is the oldest one
    again."""


class Observer:
    """Observations of one rig, and the last ones before them."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._past: deque[Observation] = deque(maxlen=1)

    def forget(self) -> None:
        """A new episode begins: what came before is no part of its history."""
        self._past.clear()

    def observe(
        self, after: float | None, timeout: float, history: int, cameras: Collection[str] | None
    ) -> Observation:
        """See :meth:`hal.rig.Rig.observe`."""
        if history < 1:
            raise CommandError(f"history must be at least 1, not {history}")
        names = tuple(self._rig.cameras) if cameras is None else tuple(cameras)
        if unknown := [name for name in names if name not in self._rig.cameras]:
            there = ", ".join(self._rig.cameras) or "none"
            raise DeviceNotFound(f"this rig has no camera {', '.join(unknown)}; it has: {there}")
        frames = {name: self._frame(name, after, timeout) for name in names}
        newest = max((frame.stamp.t for frame in frames.values()), default=None)
        t = self._newest_state(after, timeout) if newest is None else newest
        moments = {name: Moment(frame, *self._states(frame.stamp.t)) for name, frame in frames.items()}
        now = Observation(t, MappingProxyType(moments), *self._states(t))
        if self._past.maxlen != history - 1:
            self._past = deque(self._past, maxlen=history - 1)
        past = (*self._past, now)
        padded = (past[0],) * (history - len(past)) + past
        self._past.append(now)
        return replace(now, history=padded)

    def _frame(self, name: str, after: float | None, timeout: float) -> Frame:
        camera = self._rig.cameras[name]
        if after is not None:
            return camera.read(timeout, after=after)
        try:
            return camera.latest(max_age=_FRESH)
        except StaleStateError:
            return camera.read(timeout)

    def _newest_state(self, after: float | None, timeout: float) -> float:
        """Time of the newest state of all arms, waiting for one that is not older than ``after``."""
        clock = self._rig.clock
        deadline = clock.now() + timeout
        while True:
            stamps = [robot.state().stamp.t for robot in self._rig.robots.values()]
            t = min(stamps, default=clock.now())
            if after is None or t >= after:
                return t
            if clock.now() > deadline:
                raise StaleStateError(f"no state newer than {after:.3f} s came within {timeout:g} s")
            clock.sleep(0.001)

    def _states(self, t: float) -> tuple[Mapping[str, RobotState], Mapping[str, GripperState]]:
        robots = self._rig.robots.values()
        grippers = {robot.name: robot.gripper.state_at(t) for robot in robots if robot.gripper is not None}
        return MappingProxyType({robot.name: robot.state_at(t) for robot in robots}), MappingProxyType(grippers)
