"""How an episode begins where a person drives: everything goes back to where it starts, and a real arm drives home."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from hal.apps.driving import AGAIN, LET_GO, Driving
from hal.errors import HalError, MotionStopped

__all__ = ["Beginning"]


class Beginning:
    """The arm moves only for a press of the dead-man that was made for this.

    Neither the one that drove the episode before, nor one that is still held after a stop, drives it home.
    """

    def __init__(self, driving: Driving) -> None:
        from hal.learning.episode import stands_in_world

        self._driving = driving
        self._rig, self._robot = driving.rig, driving.robot
        self.drives_home = not stands_in_world(self._rig, self._robot)
        """Has the arm to drive? A simulated one is put there."""

    def put_back(self, seed: int, goes_on: Callable[[], bool]) -> bool:
        """Until it is done, or ``goes_on()``, asked again and again, says no. ``seed``: of where things go."""
        presses = self._driving.deadman.record.presses
        while goes_on():
            record = self._driving.deadman.record
            if not self.drives_home or (record.held and record.presses > presses):
                if self._driving.guarded(partial(self._reset, seed, presses)):
                    self._open_hand()
                    return True
                presses = self._driving.deadman.record.presses  # whatever stopped it: a new press, then
            else:
                self._driving.take_other_pad()
                self._rig.clock.sleep(AGAIN)
        return False

    def _reset(self, seed: int, since: int) -> bool:
        """Was everything put back? Not where the dead-man was let go of."""
        import numpy as np

        from hal.learning.episode import put_back

        deadman = self._driving.deadman
        options: dict[str, Any] = {"deadman": deadman, "since": since, "patience": LET_GO, "hand": False}
        try:
            put_back(self._rig, self._robot, random=np.random.default_rng(seed), **options)
        except MotionStopped:
            if deadman.held or not deadman.connected or not self.drives_home:
                raise
            return False
        return True

    def _open_hand(self) -> None:
        """At home. The arm goes on without one that cannot."""
        if self.drives_home and self._robot.gripper is not None:
            try:
                self._robot.gripper.open()
            except (HalError, OSError) as trouble:
                self._driving.event(f"GRIPPER: {trouble}")
