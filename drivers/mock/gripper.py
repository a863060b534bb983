"""A parallel gripper in memory: it moves at its speed, and may find an object between its fingers."""

from __future__ import annotations

from typing import ClassVar

from hal.driver import GripperDriver, GripperReading
from hal.errors import ConnectionLost
from hal.specs import GripperSpec
from hal.types import Fault, GripperOutcome

from .knobs import GripperKnobs, turned

__all__ = ["MockGripper"]


class MockGripper(GripperDriver):
    """A gripper in memory, open at the start. Time is only the ``now`` of ``read``.

    Widths beyond the gripper's range and speeds above its greatest are brought into range, as a gripper's own
    controller does. Faults, and an object to hold: :class:`~hal.drivers.mock.knobs.GripperKnobs`.
    """

    simulated: ClassVar[bool] = True

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.knobs = GripperKnobs()
        self.log: list[tuple[float, float, float]] = []
        """Every ``move`` and ``grasp``: width in m, speed in m/s, force in N."""
        self.homed = 0
        """Counts calls of ``home``."""
        self.is_open = False
        self._width = self._target = self._aim = spec.width_max
        self._speed = 0.0
        self._force = 0.0
        self._stopped = True
        self._fault: Fault | None = None
        self._t: float | None = None
        self._t_first: float | None = None
        self._reading: GripperReading | None = None
        self._seq = 0

    def open(self) -> None:
        self._answer()
        self.is_open = True

    def read(self, now: float) -> GripperReading:
        self._expect_open()
        if self._t is None or self._t_first is None:
            self._t = self._t_first = now
        self._advance(now - self._t)
        self._t = now
        if self.knobs.freeze and self._reading is not None:
            return self._reading
        self._seq += 1
        grasped = self._pressing()
        self._reading = GripperReading(
            t=now,
            t_device=now - self._t_first,
            seq=self._seq,
            width=self._width if self.knobs.garbage is None else float(self.knobs.garbage),
            width_target=self._target,
            moving=not self._stopped and self._width != self._goal() and not self.knobs.stuck,
            grasped=grasped,
            force=self._force if grasped else 0.0,
            outcome=None if self._fault is None else GripperOutcome.FAILED,
            fault=self._fault,
        )
        return self._reading

    def _goal(self) -> float:
        """Where the fingers end: where they are driven to, or before it on an object that they close on."""
        thing = self.knobs.object_width
        return max(self._aim, thing) if thing is not None and self._width >= thing else self._aim

    def _pressing(self) -> bool:
        return self.knobs.object_width is not None and self._aim < self.knobs.object_width == self._width

    def _advance(self, dt: float) -> None:
        if self._stopped or self.knobs.stuck:
            return
        rest = self._goal() - self._width
        step = self._speed * dt
        self._width = self._goal() if abs(rest) <= step else self._width + (step if rest > 0 else -step)

    def move(self, width: float, speed: float, force: float) -> None:
        self._expect_open()
        self.log.append((width, speed, force))
        width = min(max(width, 0.0), self.spec.width_max)
        self._start(width, width, speed, force)

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Close until something, or the other finger, stops the fingers."""
        self._expect_open()
        self.log.append((width, speed, force))
        self._start(min(max(width, 0.0), self.spec.width_max), 0.0, speed, force)

    def home(self) -> None:
        """Open all the way."""
        self._expect_open()
        self.homed += 1
        self._start(self.spec.width_max, self.spec.width_max, self.spec.speed, self.spec.force)

    def _start(self, target: float, aim: float, speed: float, force: float) -> None:
        failure = self.knobs.fail
        self._fault = None if failure is None else Fault("mock", failure, "turn the knob 'fail' back to None")
        if failure is not None:
            self._stopped = True
            return
        self._target, self._aim = target, aim
        self._speed = min(speed, self.spec.speed)
        self._force = force
        self._stopped = False

    def stop(self) -> None:
        self._expect_open()
        self._stopped = True

    def inject(self, **knobs: object) -> None:
        """Turn knobs (:class:`~hal.drivers.mock.knobs.GripperKnobs`); those not named stay as they are.

        Raises CommandError for a knob that does not exist, or a value that it cannot have.
        """
        self.knobs = turned(self.knobs, knobs)

    def clear(self) -> None:
        """Turn every knob back to harmless, and take the object away."""
        self.knobs = GripperKnobs()

    def close(self) -> None:
        self._stopped = True
        self.is_open = False

    def _answer(self) -> None:
        if self.knobs.disconnect:
            raise ConnectionLost(f"gripper {self.spec.name!r} does not answer (the mock's knob 'disconnect')")

    def _expect_open(self) -> None:
        self._answer()
        if not self.is_open:
            raise ConnectionLost(f"gripper {self.spec.name!r} is not open")
