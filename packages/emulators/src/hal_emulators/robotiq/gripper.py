"""The emulated gripper: its registers and the motion of its fingers. Pure: time passes only in :meth:`advance`.

What the manual leaves open is assumed: the way and the time of the activation, and that fingers without power stay.
"""

from __future__ import annotations

from hal.drivers.robotiq.link import Request
from hal.drivers.robotiq.settings import MODELS, RobotiqSettings
from hal.specs import GripperSpec

__all__ = ["EmulatedGripper"]

_ACTIVATION_SPEED = 0.5
"""Share of the greatest speed; assumption."""
_MAJOR = 0x0A
"""Lowest fault that ends the activation."""


class EmulatedGripper:
    """A gripper of a rig, and at most one object between its fingers."""

    def __init__(self, spec: GripperSpec) -> None:
        self.spec = spec
        self.settings = RobotiqSettings.of(spec)
        self._figures = MODELS[self.settings.model]
        self.opened, self.closed = map(float, self.settings.counts)
        self.position = self.opened
        """Present count."""
        self.object_count: float | None = None
        self.blocked = False
        """Whether something outside holds the fingers, so that an activation fails."""
        self.in_world = False
        """Whether it meets the objects of a simulated world."""
        self.powered = True
        self.on_at = 0.0
        """When the power comes back, s on the monotonic clock."""
        self.switch_on()

    def switch_on(self) -> None:
        """Switch on, or off and on again: not activated, the fingers stay where they are."""
        self.request = Request(0)
        self.state = self.fault = 0
        self.object = 0
        self._way: list[float] = []
        """Counts that an activation has yet to reach."""

    @property
    def width(self) -> float:
        return self.spec.width_at((self.closed - self.position) / (self.closed - self.opened))

    @property
    def force(self) -> float:
        """Force on an object between the fingers, N."""
        if self.object != 2:
            return 0.0
        least, most = self._figures.force
        return least + self.request.fr / 255 * (most - least)

    def put(self, width: float | None) -> None:
        """Put an object of this width, m, between the fingers; None removes it."""
        before, self.object_count = self.object_count, None
        if width is not None:
            self.object_count = self.closed - self.spec.travel_at(width) * (self.closed - self.opened)
            if before is not None and self.position == before:
                self.position = self.object_count  # fingers on an object that is measured anew

    def meet(self, width: float | None) -> None:
        """Take the width, m, at which an object in a simulated world stops the fingers; None for no object.

        The world is a few ms late, so the fingers may be too far.
        """
        self.put(width)
        if self.object_count is not None and self.position > self.object_count:
            self.position = self.object_count

    def take(self, request: Request) -> None:
        before, self.request = self.request, request
        if not request.act:
            self.state, self.object, self._way = 0, 0, []
        elif not before.act:
            self.state, self.fault, self.object = 1, 0, 0
            self._way = [self.closed, self.opened]
        elif request != before and request.gto and self.state == 3 and request.pr != before.pr:
            self.object = 0

    def fail(self, fault: int) -> None:
        self.fault = fault
        if fault >= _MAJOR:
            self.state, self.object, self._way = 0, 0, []

    def read(self) -> tuple[int, int, int, int, int, int, int]:
        """Return gACT, gGTO, gSTA, gOBJ, gFLT, gPR and gPO."""
        request = self.request
        return request.act, request.gto, self.state, self.object, self.fault, request.pr, round(self.position)

    def advance(self, dt: float) -> None:
        if not self.powered:
            return
        if self._way:
            if self.blocked:
                self.fail(0x0D)
            elif self._move_towards(self._way[0], _ACTIVATION_SPEED * self._figures.speed[1] * dt) or self.object:
                self._way.pop(0)
                self.object, self.state = 0, 1 if self._way else 3
        elif self.state == 3 and self.request.gto:
            goal = min(max(float(self.request.pr), self.opened), self.closed)
            least, most = self._figures.speed
            before = self.position
            if self._move_towards(goal, (least + self.request.sp / 255 * (most - least)) * dt):
                self.object = 3
            elif self.object == 2 and self.position > before:
                self.object = 0  # what was held is gone

    def _move_towards(self, goal: float, way: float) -> bool:
        """Move by at most ``way`` m, as far as the object allows; return whether the count ``goal`` is reached."""
        step = way / self.spec.width_max * (self.closed - self.opened)
        limit = goal
        if self.object_count is not None and self.position <= self.object_count < goal:
            limit = self.object_count
        rest = limit - self.position
        self.position = limit if abs(rest) <= step else self.position + (step if rest > 0.0 else -step)
        if limit != goal and self.position == limit:
            self.object = 2
        return self.position == goal
