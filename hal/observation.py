"""Observations of a rig: every camera's newest frame, with the states of the arms at its time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from .arguments import integer, number
from .errors import CommandError, DeviceNotFound, StaleStateError
from .types import Frame, GripperState, RobotState

if TYPE_CHECKING:
    from collections.abc import Collection

    from .gripper import Gripper
    from .rig import Rig

_NONE: Mapping[str, RobotState] = MappingProxyType({})
_FRESH = 0.2
"""Age from which a frame is too old, so that the next one is waited for, s."""
_NEXT = 0.02
"""Longest wait for a state that is as new as the newest frame, s."""
_LATE = 0.2
"""Longest wait for a gripper's state, after the time that it is for, s."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """All of a rig at one time ``t``."""

    t: float
    """Time of the newest frame, or of the newest states if there are no cameras; s on ``rig.clock``."""
    cameras: Mapping[str, Moment]
    """By name; each with the states at the time of its own frame."""
    robots: Mapping[str, RobotState]
    """By name, interpolated to ``t``."""
    grippers: Mapping[str, GripperState]
    """By the name of the arm, interpolated to ``t``."""
    history: tuple[Observation, ...] = field(default=())
    """The last requested observations, oldest first, this one included; padded with the oldest where there were fewer.
    """

    def __repr__(self) -> str:
        return f"<Observation of {self.t:.3f} s: cameras {', '.join(self.cameras) or 'none'}; {', '.join(self.robots)}>"


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame, with every arm and gripper interpolated to its time."""

    frame: Frame
    robots: Mapping[str, RobotState]
    grippers: Mapping[str, GripperState]
    """By the name of the arm."""


class Observer:
    """Takes the observations of one rig, and keeps the last ones for their history."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._past: deque[Observation] = deque(maxlen=1)

    def forget(self) -> None:
        """Forget all observations, because a new episode begins."""
        self._past.clear()

    def observe(
        self, after: float | None, timeout: float, history: int, cameras: Collection[str] | None
    ) -> Observation:
        """Take an observation; see :meth:`hal.rig.Rig.observe`."""
        integer("history", history, least=1)
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
        begin = self._find_begin()
        try:
            frame = camera.read_latest(max_age=_FRESH)
            if frame.stamp.t >= begin:
                return frame
        except StaleStateError:
            pass
        return camera.read(timeout, after=begin)

    def _find_begin(self) -> float:
        """Return the time from which on all states are known, s: a camera may be there before an arm."""
        arms = self._rig.robots.values()
        mails = [device._mail for arm in arms for device in (arm, arm.gripper) if device is not None]
        return max((mail.history.begin() for mail in mails), default=-math.inf)

    def _await_states(self, t: float) -> None:
        """Wait briefly for states as new as the newest frame, which may be some ms newer."""
        if self._rig.lock_step:
            return
        deadline = self._rig.clock.now() + _NEXT
        for robot in self._rig.robots.values():
            while robot.state().stamp.t < t and self._rig.clock.now() < deadline:
                self._rig.clock.sleep(0.0005)

    def _newest_states(self, after: float | None, timeout: float) -> tuple[float, Mapping[str, RobotState]]:
        """Return the newest states of all arms, not older than ``after``, and the time of the oldest of them."""
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
        """Return all states at ``t``; ``known`` ones of that very time need no search in the history."""
        robots: dict[str, RobotState] = {}
        grippers: dict[str, GripperState] = {}
        for robot in self._rig.robots.values():
            state = known.get(robot.name)
            robots[robot.name] = state if state is not None and state.stamp.t == t else robot.state_at(t)
            if robot.gripper is not None:
                grip = robot.gripper.peek()
                if grip is None or grip.stamp.t != t:
                    grip = self._gripper_at(robot.gripper, t)
                grippers[robot.name] = grip
        return MappingProxyType(robots), MappingProxyType(grippers)

    def _gripper_at(self, gripper: Gripper, t: float) -> GripperState:
        """Return a gripper's state at ``t``; one that is late, as those of a slow process may be, is waited for."""
        while True:
            try:
                return gripper.state_at(t)
            except StaleStateError:
                if self._rig.lock_step or self._rig.clock.now() > t + _LATE:
                    raise
            self._rig.clock.sleep(0.002)
