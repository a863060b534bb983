"""Motion of the emulated hand's fingers. Pure: time passes only in :meth:`Fingers.advance`.

Not compared with a real hand. What its documentation leaves open follows reports by users of real hands; each such
place is marked as an assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from .hand_network import HandStatus

FULL_WIDTH = 0.08
"""Width of completely open fingers, m."""
_SPEED_MAX = 0.1  # m/s of the width: 50 mm/s for each finger
_OWN_SPEED = 0.1  # m/s, where no speed is given; assumption
_MOVE_FORCE = 20.0  # N
_BLOCKED = 100.0  # s until a Move that meets an object is answered, as users report (franka_ros, issue 281)


class FingerMotionKind(Enum):
    HOMING = "homing"
    GRASP = "grasp"
    MOVE = "move"


@dataclass
class FingerMotion:
    """A running motion. Widths in m, speed in m/s, force in N."""

    kind: FingerMotionKind
    width: float = 0.0
    speed: float = _OWN_SPEED
    force: float = 0.0
    inner: float = 0.0
    outer: float = 0.0
    goal: float = 0.0
    """Width at its end without an object, m."""
    blocked: float = 0.0
    """Time for which an object has blocked it, s."""
    closed: bool = False
    """For homing: whether the fingers have closed already."""


class Fingers:
    def __init__(self, object_width: float | None = None, homed: bool = True) -> None:
        self.width = FULL_WIDTH / 2.0
        self.homed = homed
        self.is_grasped = False
        self.force = 0.0
        """Pressing force, N."""
        self.object_width = object_width
        self.motion: FingerMotion | None = None
        self.grasp_ends_at_width = False
        """Whether a grasp that meets no object ends at its width. Assumption: it does not, and closes further."""

    @property
    def max_width(self) -> float:
        """Greatest width that the hand reports, m. Assumption: 0 before homing."""
        return FULL_WIDTH if self.homed else 0.0

    def start(self, motion: FingerMotion) -> HandStatus | None:
        """Start a motion; return its status if it ends at once.

        Assumption: impossible numbers, and a command while another one runs, fail.
        """
        numbers = (motion.width, motion.speed, motion.force, motion.inner, motion.outer)
        if self.motion is not None or not all(math.isfinite(x) and x >= 0.0 for x in numbers):
            return HandStatus.FAIL
        if motion.width > FULL_WIDTH or motion.speed == 0.0:
            return HandStatus.FAIL
        if motion.kind is FingerMotionKind.GRASP and self.is_grasped:
            self.release()  # as users report: it lets go and does not succeed (libfranka, issue 108; franka_ros, 130)
            return HandStatus.UNSUCCESSFUL
        motion.speed = min(motion.speed, _SPEED_MAX)
        closes = motion.kind is FingerMotionKind.GRASP and motion.width < self.width and not self.grasp_ends_at_width
        motion.goal = 0.0 if closes else motion.width
        self.motion = motion
        self.is_grasped, self.force = False, 0.0
        return None

    def switch_off(self) -> None:
        """Switch off: no motion, no force, not homed. Assumption: the fingers keep their position."""
        self.motion, self.homed = None, False
        self.release()

    def release(self) -> None:
        self.is_grasped, self.force = False, 0.0

    def put(self, object_width: float | None) -> None:
        """Put an object of this width, m, between the fingers; None removes it."""
        self.object_width = object_width

    def meet(self, object_width: float | None) -> None:
        """Take the width, m, at which an object in a simulated world stops the fingers; None for no object.

        The world is a few ms late, so the fingers may be too far.
        """
        if object_width is not None and (self._on_object() or self.width < object_width):
            self.width = object_width
        self.object_width = object_width

    @property
    def pressing(self) -> float:
        """Force on what is between the fingers, N. Assumption: a Move that meets an object presses with 20 N."""
        if self.motion is None or not self._on_object():
            return self.force
        return self.motion.force or _MOVE_FORCE

    def advance(self, dt: float) -> HandStatus | None:
        """Advance by ``dt`` s; return the status of a motion that ended."""
        motion = self.motion
        if motion is None:
            self._press(dt)
            return None
        if motion.kind is FingerMotionKind.MOVE:
            status = self._advance_move(motion, dt)
        elif motion.kind is FingerMotionKind.GRASP:
            status = self._advance_grasp(motion, dt)
        else:
            status = self._advance_homing(motion, dt)
        if status is not None:
            self.motion = None
        return status

    def _advance_move(self, motion: FingerMotion, dt: float) -> HandStatus | None:
        if self._move_towards(motion.goal, motion.speed, dt):
            return HandStatus.SUCCESS
        if self._on_object():
            motion.blocked += dt
        return HandStatus.UNSUCCESSFUL if motion.blocked > _BLOCKED else None

    def _advance_grasp(self, motion: FingerMotion, dt: float) -> HandStatus | None:
        if not self._move_towards(motion.goal, motion.speed, dt) and not self._on_object():
            return None
        self.is_grasped = motion.width - motion.inner < self.width < motion.width + motion.outer
        self.force = motion.force if self.is_grasped else 0.0
        return HandStatus.SUCCESS if self.is_grasped else HandStatus.UNSUCCESSFUL

    def _advance_homing(self, motion: FingerMotion, dt: float) -> HandStatus | None:
        """Close, then open. Assumption: it fails with an object in between."""
        if not motion.closed:
            motion.closed = self._move_towards(0.0, motion.speed, dt)
            return HandStatus.FAIL if self._on_object() else None
        if not self._move_towards(FULL_WIDTH, motion.speed, dt):
            return None
        self.homed = True
        return HandStatus.SUCCESS

    def _press(self, dt: float) -> None:
        """Fingers with a force close further once the object is removed, and have then lost it."""
        before = self.width
        if self.force and not self._move_towards(0.0, _OWN_SPEED, dt) and self.width != before:
            self.is_grasped = False

    def _move_towards(self, goal: float, speed: float, dt: float) -> bool:
        """Move towards ``goal`` (m), as far as the object allows; return whether it is reached."""
        size = self.object_width
        limit = goal if size is None or self.width < size else max(goal, size)
        rest = limit - self.width
        step = speed * dt
        self.width = limit if abs(rest) <= step else self.width + math.copysign(step, rest)
        return self.width == goal

    def _on_object(self) -> bool:
        return self.object_width is not None and self.width == self.object_width
