"""Link to a Panda (FER) through ``panda-python`` (libfranka 0.9), which calls back for every set-point."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from panda_py import libfranka

from .link import ArmLink, ArmSample, Floats, StreamKind

_NO_FILTER = 1000.0
"""Cut-off that disables the library's low-pass filter, Hz: the servo's set-points are smooth already."""


class PandaLink(ArmLink):
    protocol = 5
    owns_loop = True

    def __init__(self) -> None:
        super().__init__()
        self._fresh: Any = None
        """State of the last callback, until it is read."""
        self._answer: Floats | None = None
        self._finished = False

    def connect(self, host: str) -> None:
        self.robot = libfranka.Robot(host, libfranka.RealtimeConfig.kIgnore)

    def read(self) -> ArmSample:
        if self._fresh is not None:
            state, self._fresh = self._fresh, None
            return self.sample(state)
        return self.sample(self.robot.read_once())

    def start(self, kind: StreamKind) -> None:
        self.motion = kind  # the motion itself starts in run()
        self._answer = None
        self._finished = False

    def send(self, values: Floats) -> None:
        self._answer = values

    def finish(self) -> None:
        self._finished = True

    def run(self, turn: Callable[[], None]) -> None:
        kind = self.motion

        def callback(state: Any, _: Any) -> Any:
            self._fresh = state
            turn()
            return self._command(kind, state)

        robot, stiff = self.robot, libfranka.ControllerMode.kJointImpedance
        try:
            if kind is StreamKind.POSITION:
                robot.control_joint_position(callback, stiff, False, _NO_FILTER)
            elif kind is StreamKind.VELOCITY:
                robot.control_joint_velocity(callback, stiff, False, _NO_FILTER)
            else:
                robot.control(callback, False, _NO_FILTER)
        finally:
            self._fresh = None
            self.abandon()

    def _command(self, kind: StreamKind | None, state: Any) -> Any:
        """Return the command of this turn; without one, hold the position, with no speed or torque."""
        command: Any
        if kind is StreamKind.POSITION:
            command = libfranka.JointPositions(state.q_d if self._answer is None else self._answer)
        else:
            values = (0.0,) * 7 if self._answer is None or self._finished else self._answer
            command = libfranka.JointVelocities(values) if kind is StreamKind.VELOCITY else libfranka.Torques(values)
        command.motion_finished = self._finished
        return command

    def _set_end_effector(self, matrix: list[float]) -> None:
        self.robot.set_ee(matrix)

    def _set_stiffness_frame(self, matrix: list[float]) -> None:
        self.robot.set_k(matrix)
