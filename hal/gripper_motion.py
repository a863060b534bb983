"""A motion of a gripper that was started: is it over, and how did it end?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .types import Fault, GripperOutcome, GripperState

if TYPE_CHECKING:
    from .gripper import Gripper

__all__ = ["GripperMotion", "GripperResult"]

_SHORTEST_LOOK = 0.01
_PATIENCE = 2.0
"""A gripper that is busy may say nothing new for so long, s."""
_ON_ITS_WAY = (GripperOutcome.NONE, GripperOutcome.RUNNING)


@dataclass(frozen=True, slots=True)
class GripperResult:
    """How a motion ended. True where the fingers did what they were told."""

    outcome: GripperOutcome
    state: GripperState
    """The gripper when the end was first seen."""
    fault: Fault | None
    """Why it failed, where it did."""

    def __bool__(self) -> bool:
        return self.outcome is GripperOutcome.DONE


class GripperMotion:
    """A motion under way. Made by :meth:`hal.gripper.Gripper.start` and its siblings; nothing depends on keeping it."""

    def __init__(self, gripper: Gripper, seq: int) -> None:
        self._gripper = gripper
        self._seq = seq
        self._result: GripperResult | None = None

    @property
    def done(self) -> bool:
        """Is it over, however it ended? Never waits; raises ConnectionLost or StaleStateError when nobody can tell."""
        if self._look() is None:
            self._gripper.state(_PATIENCE)
        return self._result is not None

    def wait(self, timeout: float = 10.0) -> GripperResult:
        """Wait until it is over; in lock-step this makes time go on.

        A motion that a newer command or a stop ended is ``STOPPED``. Raises TimeoutError after ``timeout`` s,
        ConnectionLost when the gripper does not answer, StaleStateError when it says nothing new for 2 s.
        """
        gripper = self._gripper
        clock = gripper.clock
        deadline = clock.now() + timeout
        period = max(_SHORTEST_LOOK, gripper.period)
        while (result := self._look()) is None:
            state = gripper.state(_PATIENCE)
            if clock.now() >= deadline:
                raise TimeoutError(f"{gripper.name} is still moving after {timeout:g} s: {state}")
            clock.sleep(period)
        return result

    def _look(self) -> GripperResult | None:
        """The result, once there is one."""
        state = self._gripper.newest() if self._result is None else None
        if self._result is None and state is not None:
            if state.target_seq > self._seq:
                self._result = GripperResult(GripperOutcome.STOPPED, state, None)
            elif state.target_seq == self._seq and state.outcome not in _ON_ITS_WAY:
                failed = state.outcome is GripperOutcome.FAILED
                self._result = GripperResult(state.outcome, state, state.fault if failed else None)
        return self._result

    def __repr__(self) -> str:
        how = self._result.outcome if self._result is not None else "not over when it was looked at last"
        return f"<GripperMotion {self._seq} of {self._gripper.name}: {how}>"
