"""Emulated UFACTORY controller: modes, states, errors, and the arm.

Registers, states and errors are those that xarm-python-sdk 1.18.4 names. UFACTORY publishes that servo mode executes
the newest set-point at once, and stops above 180 degrees/s and 1 m/s; how it measures speeds is chosen here.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hal_emulators.network_arm import NetworkController

from .gripper import Gripper

__all__ = ["DT", "ROBOTS", "Controller", "Robot"]

Floats = list[float]

DT = 0.004
"""Cycle of the controller, s."""
MOVING, READY, PAUSED, STOPPED, CHANGED = 1, 2, 3, 4, 5
"""States."""
POSITION, SERVO = 0, 1
"""Modes."""
TOP_SPEED, TOP_TCP_SPEED = 1.1 * math.pi, 1.1
"""Speeds of set-points above which the arm stops with C24 and C60, rad/s and m/s: the limits and a tenth."""
_LAG = 0.02
"""Lag of the arm behind its target, s; chosen."""
_SHORTEST, _LONGEST = 0.004, 0.02
"""A set-point counts as coming this long after the one before, s."""


_BEYOND = math.radians(0.1)
"""How far set-points may be beyond a limit, rad, as in the SDK."""


class Robot(NamedTuple):
    kind: int
    """Its number in the SDK."""
    rows: tuple[tuple[float, float, float, float], ...]
    """Modified DH parameters of each joint: a (m), alpha (rad), d (m), offset (rad)."""
    limits: tuple[tuple[float, float], ...]
    """Of each joint, rad."""


_R, _T, _ROUND = math.pi / 2, 1.3849179, (-2 * math.pi, 2 * math.pi)
ROBOTS = {
    "xarm7": Robot(
        7,
        (
            (0.0, 0.0, 0.267, 0.0),
            (0.0, -_R, 0.0, 0.0),
            (0.0, _R, 0.293, 0.0),
            (0.0525, _R, 0.0, 0.0),
            (0.0775, _R, 0.3425, 0.0),
            (0.0, _R, 0.0, 0.0),
            (0.076, -_R, 0.097, 0.0),
        ),
        (_ROUND, (-2.059488, 2.094395), _ROUND, (-0.191986, 3.92699), _ROUND, (-1.692969, math.pi), _ROUND),
    ),
    "xarm6": Robot(
        6,
        (
            (0.0, 0.0, 0.267, 0.0),
            (0.0, -_R, 0.0, -_T),
            (0.28948866, 0.0, 0.0, _T),
            (0.0775, -_R, 0.3425, 0.0),
            (0.0, _R, 0.0, 0.0),
            (0.076, -_R, 0.097, 0.0),
        ),
        (_ROUND, (-2.059488, 2.094395), (-3.92699, 0.191986), _ROUND, (-1.692969, math.pi), _ROUND),
    ),
    "xarm5": Robot(
        5,
        (
            (0.0, 0.0, 0.267, 0.0),
            (0.0, -_R, 0.0, -_T),
            (0.28948866, 0.0, 0.0, 2.7331843),
            (0.351158796, 0.0, 0.0, -1.3482664),
            (0.076, -_R, 0.097, 0.0),
        ),
        (_ROUND, (-2.059488, 2.094395), (-3.92699, 0.191986), (-1.692969, math.pi), _ROUND),
    ),
    "lite6": Robot(
        9,
        (
            (0.0, 0.0, 0.2433, 0.0),
            (0.0, -_R, 0.0, -_R),
            (0.2, 2 * _R, 0.0, -_R),
            (0.087, _R, 0.2276, 0.0),
            (0.0, _R, 0.0, 0.0),
            (0.0, -_R, 0.0615, 0.0),
        ),
        (_ROUND, (-2.617994, 2.617994), (-0.061087, 5.235988), _ROUND, (-2.164208, 2.164208), _ROUND),
    ),
}
"""UFACTORY's "Kinematic and Dynamic Parameters" (ufactory_docs), and the SDK's ``XCONF.Robot``."""


class Controller(NetworkController):
    """One controller with its arm. ``step`` lets a cycle pass. Joint positions are of the arm's joints, rad."""

    def __init__(self, robot: str, q: Sequence[float]) -> None:
        super().__init__(DT)
        self.robot, self.arm = robot, ROBOTS[robot]
        self.axes = len(self.arm.rows)
        if len(q) != self.axes:
            raise ValueError(f"an {robot} has {self.axes} joints, not {len(q)}")
        self.mode, self.error, self.warning = POSITION, 0, 0
        self.gripper = Gripper()
        self.enabled = False
        """Whether the motors are switched on."""
        self.pressed = False
        """Whether the emergency stop is pressed."""
        self.load = [0.0] * 4
        """Mass, kg, and its centre, mm."""
        self.blind = False
        """Whether the first joint is reported as not a number."""
        self.jump = 0.0
        """By how much the next set-point is off, rad."""
        self.blocked = False
        """Whether something holds the joints."""
        self.set_points = 0
        """Number of set-points that were executed."""
        self._halted = STOPPED
        """A state in which nothing moves; 0 if the arm takes commands."""
        self.q, self.dq = list(q), [0.0] * self.axes
        self.hold()

    @property
    def joints(self) -> Sequence[float]:
        return self.q

    @property
    def state(self) -> int:
        return self._halted or (MOVING if max(map(abs, self.dq)) > 1e-3 else READY)

    @property
    def ready(self) -> bool:
        return self.enabled and not self.error and not self._halted

    # Commands.

    def hold(self) -> None:
        self.target = list(self.q)
        self._course: deque[tuple[float, Floats]] = deque([(_LONGEST, self.target)] * 4, 4)
        self._t_set = 0.0
        self._goal: Floats | None = None

    def set_mode(self, mode: int) -> None:
        """Choose a mode; then it takes commands after ``set_state(0)``."""
        if mode != self.mode:
            self.mode = mode
            self._halt(CHANGED)

    def take_over(self, mode: int) -> None:
        self.set_mode(mode)
        self.set_state(0)

    def set_load(self, load: Sequence[float]) -> None:
        """Set mass, kg, and its centre, mm; only while it takes motions, as whose it counts."""
        if self.ready:
            self.load = list(load)

    def set_state(self, state: int) -> None:
        """Let it take commands (0), pause (3) or stop (4, 6)."""
        if state in (PAUSED, STOPPED, 6):
            self._halt(STOPPED if state == 6 else state)
        elif state == 0 and self.enabled and not self.error:
            if self._halted:
                self.hold()
            self._halted = 0

    def _halt(self, state: int) -> None:
        self._halted = state
        self.hold()

    def enable(self, on: bool) -> None:
        """Switch the motors on or off. Not while there is an error."""
        if on and not self.error:
            self.enabled = True
        elif not on:
            self.enabled = False
            self._halt(STOPPED)

    def raise_error(self, number: int) -> None:
        """Stop with an error; those of the power and of the motors switch them off."""
        self.error = number
        self.note(f"error {number}")
        self.enabled = self.enabled and number > 17
        self._halt(STOPPED)

    def clean_error(self) -> None:
        self.error = 1 if self.pressed else 0

    def press(self, pressed: bool) -> None:
        """Press or release the emergency stop."""
        self.pressed = pressed
        if pressed:
            self.raise_error(1)

    def jog(self, joint: int, angle: float) -> None:
        self.q[joint] += angle
        self.hold()

    def move(self, q: Sequence[float], speed: float, acceleration: float) -> bool:
        """Move to a position in mode 0; returns whether that is possible."""
        if not self.ready or self.mode != POSITION:
            return False
        if not self._is_inside(q):
            self.raise_error(23)
            return True
        self._from, self._goal = list(self.target), list(q)
        self._way = max(max(abs(b - a) for a, b in zip(self.target, q, strict=True)), 1e-9)
        self._done = self._pace = 0.0
        self._top, self._most = max(speed, 1e-3), max(acceleration, 1e-3)
        return True

    def servo(self, q: Sequence[float]) -> bool:
        """Execute a set-point of mode 1; returns whether it was ready for it."""
        if not self.ready or self.mode != SERVO:
            return False
        now = time.monotonic()
        q, self.jump = [value + self.jump for value in q], 0.0
        self._course.append((min(max(now - self._t_set, _SHORTEST), _LONGEST), list(q)))
        self._t_set = now
        took = sum(dt for dt, _ in list(self._course)[1:])
        first = self._course[0][1]
        speed = max(abs(b - a) for a, b in zip(first, q, strict=True)) / took
        if not self._is_inside(q):
            self.raise_error(23)
        elif not speed <= TOP_SPEED:
            self.raise_error(24)
        elif math.dist(self.forward(first)[:3], self.forward(q)[:3]) / took > 1e3 * TOP_TCP_SPEED:
            self.raise_error(60)
        else:
            self.target = list(q)
            self.set_points += 1
        return True

    def _is_inside(self, q: Sequence[float]) -> bool:
        return all(low - _BEYOND <= x <= high + _BEYOND for x, (low, high) in zip(q, self.arm.limits, strict=True))

    # Each cycle.

    def step(self) -> None:
        self.now += DT
        self.gripper.step(DT)
        if self._goal is not None:
            self._plan()
        share, most = 0.0 if self.blocked else 1.0 - math.exp(-DT / _LAG), math.pi * DT
        steps = [min(max(share * (b - a), -most), most) for a, b in zip(self.q, self.target, strict=True)]
        self.q = [a + step for a, step in zip(self.q, steps, strict=True)]
        self.dq = [step / DT for step in steps]

    def _plan(self) -> None:
        """Move the target by a cycle along a motion with a trapezoid of speed."""
        goal = self._goal
        assert goal is not None
        brake = math.sqrt(max(0.0, 2.0 * self._most * (self._way - self._done)))
        self._pace = min(self._pace + self._most * DT, self._top, brake)
        self._done += max(self._pace, 1e-4) * DT
        share = min(1.0, self._done / self._way)
        self.target = [a + share * (b - a) for a, b in zip(self._from, goal, strict=True)]
        if share == 1.0:
            self._goal = None

    def forward(self, q: Sequence[float]) -> Floats:
        """Return the pose of the flange: mm, and roll, pitch and yaw, rad."""
        pose = np.eye(4)
        for angle, (a, alpha, d, offset) in zip(q, self.arm.rows, strict=True):
            c, s, ca, sa = math.cos(angle + offset), math.sin(angle + offset), math.cos(alpha), math.sin(alpha)
            pose = pose @ np.array(
                [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1.0]]
            )
        r: Any = pose.tolist()
        roll, yaw = math.atan2(r[2][1], r[2][2]), math.atan2(r[1][0], r[0][0])
        return [*(1e3 * row[3] for row in r[:3]), roll, math.atan2(-r[2][0], math.hypot(r[0][0], r[1][0])), yaw]
