"""What the emulated hand's fingers do. Pure: time is only what :meth:`Fingers.advance` is told.

No real hand was at hand. What its documents leave open follows what users of real hands report; each such place is
marked as an assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from .hand_wire import Status

__all__ = ["FULL_WIDTH", "Fingers", "Kind", "Motion"]

FULL_WIDTH = 0.08
"""m between the fingers when they are open all the way."""
_SPEED_MAX = 0.1  # m/s of the width: 50 mm/s for each finger
_OWN_SPEED = 0.1  # m/s, where nobody said how fast; assumption
_SPRING = 0.002  # m that fingers give when a stop takes their force away; assumption
_BLOCKED = 100.0  # s until a Move that meets something is answered: what users report (franka_ros, issue 281)


class Kind(Enum):
    """The three motions."""

    HOMING = "homing"
    GRASP = "grasp"
    MOVE = "move"


@dataclass
class Motion:
    """A motion on its way. Widths in m, speed in m/s, force in N."""

    kind: Kind
    width: float = 0.0
    speed: float = _OWN_SPEED
    force: float = 0.0
    inner: float = 0.0
    outer: float = 0.0
    goal: float = 0.0
    """Where it ends when nothing is in the way, m."""
    blocked: float = 0.0
    """How long something has been in its way, s."""
    closed: bool = False
    """Of a homing: was it closed already?"""


class Fingers:
    """Two coupled fingers, and at most one thing between them."""

    def __init__(self, object_width: float | None = None, homed: bool = True) -> None:
        self.width = FULL_WIDTH / 2.0
        self.homed = homed
        self.is_grasped = False
        self.force = 0.0
        """With which they press, N."""
        self.object_width = object_width
        self.motion: Motion | None = None
        self.grasp_ends_at_width = False
        """Does a grasp end at its width where nothing is met? Assumption: it does not, and closes on whatever comes."""

    @property
    def max_width(self) -> float:
        """What the hand says of itself. Assumption: 0 before homing."""
        return FULL_WIDTH if self.homed else 0.0

    def start(self, motion: Motion) -> Status | None:
        """Begin; a status where it is over at once.

        Assumption: numbers that cannot be, and a command while another one runs, fail.
        """
        numbers = (motion.width, motion.speed, motion.force, motion.inner, motion.outer)
        if self.motion is not None or not all(math.isfinite(x) and x >= 0.0 for x in numbers):
            return Status.FAIL
        if motion.width > FULL_WIDTH or motion.speed == 0.0:
            return Status.FAIL
        if motion.kind is Kind.GRASP and self.is_grasped:
            self.let_go()  # as users report: it lets go and does not succeed (libfranka, issue 108; franka_ros, 130)
            return Status.UNSUCCESSFUL
        motion.speed = min(motion.speed, _SPEED_MAX)
        closes = motion.kind is Kind.GRASP and motion.width < self.width and not self.grasp_ends_at_width
        motion.goal = 0.0 if closes else motion.width
        self.motion = motion
        self.is_grasped, self.force = False, 0.0
        return None

    def switch_off(self) -> None:
        """No power: no motion, no force, and homing is forgotten. Assumption: the fingers stay where they are."""
        self.motion, self.homed = None, False
        self.let_go()

    def halt(self, release: bool) -> None:
        """Stay; with ``release`` the force goes, and the fingers spring back a little."""
        self.motion = None
        if release and self.is_grasped:
            self.let_go()
            self.width = min(FULL_WIDTH, self.width + _SPRING)

    def let_go(self) -> None:
        """No force any more."""
        self.is_grasped, self.force = False, 0.0

    def put(self, object_width: float | None) -> None:
        """Put a thing of so many m between the fingers, or take away what is there."""
        self.object_width = object_width

    def advance(self, dt: float) -> Status | None:
        """Let ``dt`` s pass; the status of the motion that ended in them."""
        motion = self.motion
        if motion is None:
            self._press(dt)
            return None
        if motion.kind is Kind.MOVE:
            status = self._advance_move(motion, dt)
        elif motion.kind is Kind.GRASP:
            status = self._advance_grasp(motion, dt)
        else:
            status = self._advance_homing(motion, dt)
        if status is not None:
            self.motion = None
        return status

    def _advance_move(self, motion: Motion, dt: float) -> Status | None:
        if self._go(motion.goal, motion.speed, dt):
            return Status.SUCCESS
        if self._on_object():
            motion.blocked += dt
        return Status.UNSUCCESSFUL if motion.blocked > _BLOCKED else None

    def _advance_grasp(self, motion: Motion, dt: float) -> Status | None:
        if not self._go(motion.goal, motion.speed, dt) and not self._on_object():
            return None
        self.is_grasped = motion.width - motion.inner < self.width < motion.width + motion.outer
        self.force = motion.force if self.is_grasped else 0.0
        return Status.SUCCESS if self.is_grasped else Status.UNSUCCESSFUL

    def _advance_homing(self, motion: Motion, dt: float) -> Status | None:
        """Close, then open. Assumption: a thing in between spoils it."""
        if not motion.closed:
            motion.closed = self._go(0.0, motion.speed, dt)
            return Status.FAIL if self._on_object() else None
        if not self._go(FULL_WIDTH, motion.speed, dt):
            return None
        self.homed = True
        return Status.SUCCESS

    def _press(self, dt: float) -> None:
        """Fingers with a force close further where nothing is between them any more, and have lost it."""
        before = self.width
        if self.force and not self._go(0.0, _OWN_SPEED, dt) and self.width != before:
            self.is_grasped = False

    def _go(self, goal: float, speed: float, dt: float) -> bool:
        """Towards ``goal``, as far as what is between the fingers lets them. Are they there?"""
        thing = self.object_width
        limit = goal if thing is None or self.width < thing else max(goal, thing)
        rest = limit - self.width
        step = speed * dt
        self.width = limit if abs(rest) <= step else self.width + math.copysign(step, rest)
        return self.width == goal

    def _on_object(self) -> bool:
        return self.object_width is not None and self.width == self.object_width
