"""A mock arm whose drives must be switched on before it follows, as an arm on a CAN bus."""

from __future__ import annotations

from hal.driver import Reading, Setpoint
from hal.drivers.mock.robot import MockRobot
from hal.errors import ConnectionLost, RobotFault
from hal.specs import RobotSpec


class ArmWithDrives(MockRobot):
    """One more of its drives is on after each call of :meth:`engage`; a fault or a lost link switches all of them off.

    While they are off it reports no commanded position, and a set-point is a mistake of the host.
    """

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.engaged = False
        self.drives_on = 0
        self.broken: int | None = None
        """Number of a drive that does not switch on, from 1."""

    def engage(self) -> None:
        self._expect_open()
        if self.faults.fault is not None:
            raise RobotFault(self.faults.fault, "call recover() on the arm")
        if self.broken == self.drives_on + 1:
            raise RobotFault(f"drive {self.broken} does not switch on", "check its cable", code="drive_off")
        self._hold()
        self.drives_on += 1
        self.engaged = self.drives_on >= len(self.spec.joints)

    def read(self, now: float) -> Reading:
        if self.faults.fault is not None or self.faults.disconnect:
            self._switch_off()
        reading = super().read(now)
        return reading if self.engaged else reading._replace(q_commanded=None, dq_commanded=None)

    def write(self, setpoint: Setpoint) -> None:
        self._expect_open()
        if not self.engaged:
            raise ConnectionLost("a set-point for an arm whose drives are off")
        super().write(setpoint)

    def _switch_off(self) -> None:
        self.engaged, self.drives_on = False, 0

    def close(self) -> None:
        self._switch_off()
        super().close()
