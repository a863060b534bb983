"""What a rig sees at one moment: every camera's newest picture, and the arms as they were when it was taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .arguments import number, whole
from .errors import CommandError, DeviceNotFound, StaleStateError
from .types import Frame, GripperState, RobotState

if TYPE_CHECKING:
    from collections.abc import Collection

    from .rig import Rig

__all__ = ["Moment", "Observation", "Observer"]

# [interpolation.py] What a device's state was between two of its samples.

Array = NDArray[np.float64]


_NONE: Mapping[str, RobotState] = MappingProxyType({})
_FRESH = 0.2
"""s; a picture that is older is waited for."""
_NEXT = 0.02
"""s that a state may be waited for that is as new as the newest picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One picture, and every arm and gripper interpolated to its stamp."""

    frame: Frame
    robots: Mapping[str, RobotState]
    grippers: Mapping[str, GripperState]
    """By the name of the arm."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """All of a rig at one moment, ``t``: ``cameras`` by name, each with the states of its own stamp; ``robots`` and
    ``grippers`` by the arm's name, interpolated to ``t``; ``history``, the last observations that were *asked for*.
    """

    t: float
    """The stamp of the newest picture; without cameras, that of the newest state. s on ``rig.clock``."""
    cameras: Mapping[str, Moment]
    robots: Mapping[str, RobotState]
    """Interpolated to ``t``."""
    grippers: Mapping[str, GripperState]
    """By the name of the arm, interpolated to ``t``."""
    history: tuple[Observation, ...] = field(default=())
    """This one and those of the calls before, oldest first: as many as were asked for. What was not there yet is the
    oldest one again."""

    def __repr__(self) -> str:
        return f"<Observation of {self.t:.3f} s: cameras {', '.join(self.cameras) or 'none'}; {', '.join(self.robots)}>"


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
        whole("history", history, least=1)
        number("timeout", timeout, "s", least=0.0)
        if after is not None:
            ahead = number("after", after, "s on rig.clock") - self._rig.clock.now()
            if ahead > timeout:
                raise CommandError(f"after is {ahead:g} s in the future, and the timeout is {timeout:g} s")
        if isinstance(cameras, str):
            raise CommandError(f"cameras must be a list of names: cameras=[{cameras!r}]")
        names = tuple(self._rig.cameras) if cameras is None else tuple(cameras)
        if unknown := [name for name in names if name not in self._rig.cameras]:
            there = ", ".join(self._rig.cameras) or "none"
            raise DeviceNotFound(f"this rig has no camera {', '.join(unknown)}; it has: {there}")
        frames = {name: self._frame(name, after, timeout) for name in names}
        if frames:
            t, known = max(frame.stamp.t for frame in frames.values()), _NONE
            self._await_states(t)
        else:
            t, known = self._newest_states(after, timeout)
        moments = {name: Moment(frame, *self._states(frame.stamp.t)) for name, frame in frames.items()}
        seen = (t, MappingProxyType(moments), *self._states(t, known))
        now = Observation(*seen)
        if self._past.maxlen != history - 1:
            self._past = deque(self._past, maxlen=history - 1)
        past = (*self._past, now)
        padded = (past[0],) * (history - len(past)) + past
        self._past.append(now)
        return Observation(*seen, history=padded)

    def _frame(self, name: str, after: float | None, timeout: float) -> Frame:
        camera = self._rig.cameras[name]
        if after is not None:
            return camera.read(timeout, after=after)
        try:
            return camera.latest(max_age=_FRESH)
        except StaleStateError:
            return camera.read(timeout)

    def _await_states(self, t: float) -> None:
        """A picture may be some ms newer than the newest state: wait for the next one, but not for long."""
        if self._rig.lock_step:
            return
        deadline = self._rig.clock.now() + _NEXT
        for robot in self._rig.robots.values():
            while robot.state().stamp.t < t and self._rig.clock.now() < deadline:
                self._rig.clock.sleep(0.0005)

    def _newest_states(self, after: float | None, timeout: float) -> tuple[float, Mapping[str, RobotState]]:
        """The newest states of all arms, waiting for ones that are not older than ``after``, and the oldest's time."""
        clock = self._rig.clock
        deadline = clock.now() + timeout
        while True:
            states = {robot.name: robot.state() for robot in self._rig.robots.values()}
            t = min((state.stamp.t for state in states.values()), default=clock.now())
            if after is None or t >= after:
                return t, states
            if clock.now() > deadline:
                raise StaleStateError(f"no state newer than {after:.3f} s came within {timeout:g} s")
            clock.sleep(0.001)

    def _states(
        self, t: float, known: Mapping[str, RobotState] = _NONE
    ) -> tuple[Mapping[str, RobotState], Mapping[str, GripperState]]:
        """Those of ``t``. The newest ones are mostly just these, and need no search in what is kept."""
        robots: dict[str, RobotState] = {}
        grippers: dict[str, GripperState] = {}
        for robot in self._rig.robots.values():
            state = known.get(robot.name)
            robots[robot.name] = state if state is not None and state.stamp.t == t else robot.state_at(t)
            if robot.gripper is not None:
                grip = robot.gripper.newest()
                if grip is None or grip.stamp.t != t:
                    grip = robot.gripper.state_at(t)
                grippers[robot.name] = grip
        return MappingProxyType(robots), MappingProxyType(grippers)
