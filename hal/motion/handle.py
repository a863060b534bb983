"""A motion of an arm that runs in the background, and the blocking form of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..arguments import number
from ..commands import PATIENCE
from ..errors import MotionStopped
from ..types import Limited, MotionOutcome, RobotState, RobotStatus, Trip

if TYPE_CHECKING:
    from ..control import Control
    from ..host.records import ServoRecord
    from ..robot import Robot

CHECK_HZ = 50.0
"""Rate at which a motion is checked while it is waited for, Hz."""
_FAULTY = (RobotStatus.FAULT, RobotStatus.LOST)


@dataclass(frozen=True, slots=True)
class ArmMotionResult:
    """Result of a motion that is over. It is true if the arm arrived."""

    outcome: MotionOutcome
    progress: float
    """Share of the way that is done, from 0 to 1."""
    state: RobotState
    """State of the arm when the end was first seen."""
    held_back: Limited
    """Limits by which the servo reduced the motion underway."""
    trip: Trip
    """Reason of the stop; ``Trip.NONE`` if there was none."""

    def __bool__(self) -> bool:
        return self.outcome is MotionOutcome.ARRIVED

    def __repr__(self) -> str:
        reasons = [f"held back by {self.held_back}"] if self.held_back else []
        reasons += [self.trip.text] if self.trip else []
        return f"<ArmMotionResult: {', '.join([f'{self.outcome} at {100.0 * self.progress:.0f} %', *reasons])}>"


class ArmMotion:
    """A motion that was started by ``arm.start_move_to`` or ``arm.start_move_along``.

    It has control of the arm until it is over; the servo carries it on by itself. A trip ends it; a released dead-man
    only pauses it. The next motion or session of the arm can begin once it is over.
    """

    def __init__(self, robot: Robot, session: Control) -> None:
        self._robot = robot
        self._session = session
        self._id = 0
        self._result: ArmMotionResult | None = None
        self._cancelled = False

    # In the background.

    @property
    def progress(self) -> float:
        """Share of the way that is done, from 0 to 1; never waits."""
        self._find_result()
        return self._result.progress if self._result is not None else self._peek().progress

    @property
    def done(self) -> bool:
        """Whether the motion is over, with any outcome; never waits.

        Raises:
            ConnectionLost: The process that owns the arm is gone.
        """
        return self._find_result() is not None

    @property
    def result(self) -> ArmMotionResult | None:
        """The result; None while the motion runs. Never waits."""
        return self._find_result()

    def cancel(self) -> None:
        """Begin to brake, on the path; :meth:`wait` for the rest. No effect on a motion that is over. Idempotent."""
        if self._find_result() is None:
            self._cancelled = True
            self._session.brake()

    def wait(self, timeout: float = math.inf) -> ArmMotionResult:
        """Wait until the motion is over; in lock-step this advances time.

        Args:
            timeout: Longest time to wait, s.

        Returns:
            The result; a stop is one, too.

        Raises:
            TimeoutError: After ``timeout``; the motion continues.
            ConnectionLost: The arm does not answer.
        """
        if timeout != math.inf:
            number("timeout", timeout, "s", least=0.0)
        clock = self._robot.clock
        deadline = clock.now() + timeout
        for _ in clock.rate(CHECK_HZ):
            result = self._find_result()
            if result is not None:
                self._session.close()
                return result
            if clock.now() >= deadline:
                raise TimeoutError(f"{self._robot.name} is still moving after {timeout:g} s: {self!r}")
        raise AssertionError("a clock's turns do not end")

    def release(self) -> bool:
        """Give up the control of the arm, if the motion is over or cancelled; waits until the arm is at rest.

        Returns:
            Whether it is given up: False for a motion that is still running.
        """
        if self._find_result() is None and not self._cancelled:
            return False
        self._session.close()
        self._find_result()
        return True

    def _start(self) -> ArmMotion:
        self._session.__enter__()
        self._id = self._session._id
        self._robot._motion = self
        return self

    def _peek(self) -> ServoRecord:
        return self._session._peek()

    def _find_result(self) -> ArmMotionResult | None:
        """Return the result, or None while the motion runs or brakes."""
        if self._result is not None:
            return self._result
        servo = self._peek()
        outcome = self._find_outcome(servo)
        if outcome is None:
            return None
        state = self._robot._mail.get_state()
        assert state is not None
        progress = 1.0 if outcome is MotionOutcome.ARRIVED else servo.progress
        trip = servo.trip if servo.session == self._id else Trip.NONE
        self._result = ArmMotionResult(outcome, progress, state, servo.held_back, trip)
        if trip or servo.status in _FAULTY:
            self._session._report_stop()
        self._session.brake()
        return self._result

    def _find_outcome(self, servo: ServoRecord) -> MotionOutcome | None:
        """Return how the motion ended; None while it runs or brakes."""
        if servo.session != self._id:
            if self._robot._mail.state.seq() <= self._session._opened:
                return None
            return MotionOutcome.CANCELLED if self._cancelled else MotionOutcome.STOPPED
        if servo.arrived:
            return MotionOutcome.ARRIVED
        ended = servo.trip or servo.off_path or servo.status in _FAULTY
        rests = servo.status is RobotStatus.LOST or not any(servo.dq_set)
        return MotionOutcome.STOPPED if ended and rests else None

    # The blocking form.

    def _run(self, timeout: float | None, patience: float) -> RobotState:
        """Make the motion, and return the state on arrival; see :meth:`hal.robot.Robot.move_to`."""
        if patience != math.inf:
            number("patience", patience, "s", least=0.0)
        if timeout is not None:
            number("timeout", timeout, "s", least=0.0, above=True)
        robot, session = self._robot, self._session
        clock, deadman = robot.clock, session.deadman
        start = held = clock.now()
        with session:
            for _ in clock.rate(CHECK_HZ):
                servo = session._peek()
                session._check_trip(servo)
                if servo.session == session._id:
                    if servo.off_path:
                        raise MotionStopped(
                            f"{robot.name} cannot continue on its path: it was moved away from it, no plan leads on, "
                            f"or it made no progress for {PATIENCE:g} s",
                            "plan a new motion",
                            code="off_path",
                        )
                    if servo.arrived:
                        break
                if deadman is None or deadman.held:
                    held = clock.now()
                elif clock.now() - held > patience:
                    raise MotionStopped(
                        f"the dead-man was not held for {patience:g} s", "call move_to again", code="deadman_released"
                    )
                if timeout is not None and clock.now() - start > timeout:
                    raise TimeoutError(f"{robot.name} did not reach the target within {timeout:g} s")
        return robot.state()

    def __repr__(self) -> str:
        if self._result is not None:
            return f"<ArmMotion of {self._robot.name}: {self._result.outcome}>"
        return f"<ArmMotion of {self._robot.name}: running when last checked>"
