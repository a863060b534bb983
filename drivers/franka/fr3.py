"""Link to an FR3 through Franka's own Python binding, ``pylibfranka``, with one call per state and per set-point.

None of its calls releases Python's global lock, and its constructor raises the calling thread to the highest permitted
real-time priority: one more reason why an arm has a process of its own.
"""

from __future__ import annotations

from typing import Any

import pylibfranka

from .link import ArmLink, ArmSample, Floats, StreamKind

_NOISE = 4e-6
"""Noise of the reported positions, rad: within it, the servo's own set-point is more exact than the report."""


class Fr3Link(ArmLink):
    protocol = 10
    library_errors = (RuntimeError, pylibfranka.FrankaException)

    def __init__(self) -> None:
        super().__init__()
        self._control: Any = None
        """Handle of the running motion."""

    def connect(self, host: str) -> None:
        # kIgnore: the arm can be tried out without a real-time kernel; the pre-flight check reports what is missing.
        self.robot = pylibfranka.Robot(host, pylibfranka.RealtimeConfig.kIgnore)

    def read(self) -> ArmSample:
        if self._control is None:
            return self.sample(self.robot.read_once())
        return self.sample(self._control.readOnce()[0])

    def start(self, kind: StreamKind) -> None:
        robot, stiff = self.robot, pylibfranka.ControllerMode.JointImpedance
        if kind is StreamKind.POSITION:
            self._control = robot.start_joint_position_control(stiff)
        elif kind is StreamKind.VELOCITY:
            self._control = robot.start_joint_velocity_control(stiff)
        else:
            self._control = robot.start_torque_control()
        self.motion = kind
        # A handle must be read before its first command; this command changes nothing.
        self.sample(self._control.readOnce()[0])
        self.send(self._still())

    def _still(self) -> Floats:
        """Return the set-point that changes nothing."""
        if self.motion is not StreamKind.POSITION:
            return (0.0,) * 7
        q_d: Floats = self.state.q_d
        if self.still is None or max([abs(a - b) for a, b in zip(self.still, q_d, strict=True)]) > _NOISE:
            return q_d
        return self.still

    def send(self, values: Floats) -> None:
        self.still = values
        self._control.writeOnce(self._command(values))

    def _command(self, values: Floats) -> Any:
        if self.motion is StreamKind.POSITION:
            return pylibfranka.JointPositions(values)
        if self.motion is StreamKind.VELOCITY:
            return pylibfranka.JointVelocities(values)
        return pylibfranka.Torques(values)

    def finish(self) -> None:
        command = self._command(self._still())
        command.motion_finished = True
        self._control.writeOnce(command)  # returns when the robot has ended the motion
        self.abandon()

    def abandon(self) -> None:
        self._control = None  # the library cancels a motion when its handle is deleted
        super().abandon()
