"""FR3: Franka's own Python binding, ``pylibfranka``, whose set-points are read and written one by one.

None of its calls releases Python's lock, and its constructor gives the calling thread the highest real-time priority
that it may have: one more reason why an arm has a process of its own.
"""

from __future__ import annotations

from typing import Any

import pylibfranka

from .link import Floats, Kind, Link, Sample

__all__ = ["Fr3Link"]


_NOISE = 4e-6
"""Set-points that differ less from what the robot reports are better known to the servo, rad: reports have noise."""


class Fr3Link(Link):
    """An FR3 (protocol 10)."""

    protocol = 10
    troubles = (RuntimeError, pylibfranka.FrankaException)

    def __init__(self) -> None:
        super().__init__()
        self._control: Any = None
        """The library's handle of the motion under way."""

    def connect(self, host: str) -> None:
        # kIgnore: without a real-time kernel the arm may still be tried out; the pre-flight check says what is missing.
        self.robot = pylibfranka.Robot(host, pylibfranka.RealtimeConfig.kIgnore)

    def read(self) -> Sample:
        if self._control is None:
            return self.sample(self.robot.read_once())
        return self.sample(self._control.readOnce()[0])

    def start(self, kind: Kind) -> None:
        robot, stiff = self.robot, pylibfranka.ControllerMode.JointImpedance
        if kind is Kind.POSITION:
            self._control = robot.start_joint_position_control(stiff)
        elif kind is Kind.VELOCITY:
            self._control = robot.start_joint_velocity_control(stiff)
        else:
            self._control = robot.start_torque_control()
        self.motion = kind
        # A handle must be read before it takes its first command; that one changes nothing.
        self.sample(self._control.readOnce()[0])
        self.send(self._still())

    def _still(self) -> Floats:
        """The set-point that changes nothing."""
        if self.motion is not Kind.POSITION:
            return (0.0,) * 7
        q_d: Floats = self.state.q_d
        if self.still is None or max([abs(a - b) for a, b in zip(self.still, q_d, strict=True)]) > _NOISE:
            return q_d
        return self.still

    def send(self, values: Floats) -> None:
        self.still = values
        self._control.writeOnce(self._command(values))

    def _command(self, values: Floats) -> Any:
        if self.motion is Kind.POSITION:
            return pylibfranka.JointPositions(values)
        if self.motion is Kind.VELOCITY:
            return pylibfranka.JointVelocities(values)
        return pylibfranka.Torques(values)

    def finish(self) -> None:
        command = self._command(self._still())
        command.motion_finished = True
        try:
            self._control.writeOnce(command)  # answers when the robot has ended the motion
        finally:
            self.abandon()

    def abandon(self) -> None:
        self._control = None  # the library cancels a motion whose handle goes
        super().abandon()
