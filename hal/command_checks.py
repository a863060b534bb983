"""What an app's command must be before it is sent: of the right size, possible for this arm, and not far away."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from . import registry
from .commands import (
    CHUNK_AHEAD,
    CartesianTarget,
    Command,
    JointChunk,
    JointTarget,
    JointTorque,
    JointVelocity,
    Twist,
)
from .errors import CommandError, NotSupported, Unreachable
from .pose import Pose

if TYPE_CHECKING:
    from .robot import Robot

__all__ = ["FIRST_STEP_ANGLE", "FIRST_STEP_DISTANCE", "FIRST_STEP_TURN", "CommandChecks"]

FIRST_STEP_ANGLE = 0.1
"""Farthest that a first joint target may be from the set-point, rad per joint."""
FIRST_STEP_DISTANCE = 0.05
FIRST_STEP_TURN = 0.2
"""Farthest that a first pose may be from the set-point, m and rad. The servo keeps the same bounds by itself."""
_JOINTS = {JointTarget: "q", JointVelocity: "dq", JointTorque: "tau"}
_MEANT: dict[type, str] = {
    Pose: "hal.CartesianTarget(pose)",
    np.ndarray: "hal.JointTarget(q)",
    list: "hal.JointTarget(q)",
    tuple: "hal.JointTarget(q)",
}
"""The command that was probably meant by something that is not a command."""


class CommandChecks:
    """Those of one arm."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._lower, self._upper = np.array(robot.limits.lower), np.array(robot.limits.upper)
        self._takes_torques = False
        """Is it known that the arm takes torques?"""

    def checked(self, command: Command, now: float, reasons: list[str]) -> Command:
        """The command as it may be sent at ``now`` (s); why it differs from what was asked is added to ``reasons``.

        Raises CommandError, NotSupported, Unreachable.
        """
        if isinstance(command, JointTorque):
            self._check_torques()
        self._check_kind(command)
        if isinstance(command, CartesianTarget):
            self._check_reach(command)
        elif isinstance(command, JointTarget):
            q = self._in_limits(command.q, reasons)
            return command if q is command.q else JointTarget(q, command.dq)
        elif isinstance(command, JointChunk):
            self._check_times(command, now)
            q = self._in_limits(command.q, reasons)
            return command if q is command.q else JointChunk(command.t, q)
        elif isinstance(command, JointTorque):
            return self._within_torques(command, reasons)
        return command

    def check_first(self, command: Command, now: float, q_set: Sequence[float]) -> None:
        """A first target far from ``q_set`` (n,), rad, where the arm stands, would make it leap: CommandError."""
        if isinstance(command, (JointTarget, JointChunk)):
            first = command.q if isinstance(command, JointTarget) else _at(command, now)
            step = np.abs(first - np.asarray(q_set))
            worst = int(np.argmax(step))
            if step[worst] > FIRST_STEP_ANGLE:
                raise CommandError(
                    f"the first target is {step[worst]:.3f} rad from the set-point at {self._robot.joints[worst]}, "
                    f"more than {FIRST_STEP_ANGLE} rad: use move_to first"
                )
        elif isinstance(command, CartesianTarget):
            distance, turn = self._robot.fk(q_set).distance(command.pose)
            if distance > FIRST_STEP_DISTANCE or turn > FIRST_STEP_TURN:
                raise CommandError(
                    f"the first pose is {distance:.3f} m and {turn:.3f} rad from the set-point, more than "
                    f"{FIRST_STEP_DISTANCE} m or {FIRST_STEP_TURN} rad: use move_to first"
                )

    def _check_kind(self, command: Command) -> None:
        robot, n = self._robot, self._robot.n
        if isinstance(command, JointChunk):
            count = command.q.shape[1]
        elif (size := _JOINTS.get(type(command))) is not None:
            count = getattr(command, size).size
        elif isinstance(command, (CartesianTarget, Twist)):
            return
        else:
            meant = _MEANT.get(type(command))
            hint = f"; did you mean {meant}?" if meant else ""
            raise CommandError(f"{type(command).__name__} is not a command{hint}")
        if count != n:
            raise CommandError(f"{robot.name} has {n} joints; {type(command).__name__} has {count}")

    def _check_reach(self, command: CartesianTarget) -> None:
        farthest = self._robot.kinematics.farthest()
        away = float(np.linalg.norm(command.pose.position)) - farthest
        if away > 0.0:
            raise Unreachable(
                f"{self._robot.name} reaches {farthest:.2f} m from its base", position_error=away, rotation_error=0.0
            )

    @staticmethod
    def _check_times(command: JointChunk, now: float) -> None:
        end = float(command.t[-1]) - now
        if end <= 0.0:
            raise CommandError(f"the chunk's last target was due {-end:.3f} s ago: its times are on rig.clock")
        if end > CHUNK_AHEAD:
            raise CommandError(f"the chunk reaches {end:.3f} s into the future; at most {CHUNK_AHEAD:g} s are allowed")

    def _in_limits(self, q: NDArray[np.float64], reasons: list[str]) -> NDArray[np.float64]:
        """``q`` (n,) or (k, n) cut to the position limits; the very same array where that changes nothing."""
        inside: NDArray[np.float64] = np.minimum(np.maximum(q, self._lower), self._upper)
        over = (inside != q).any(axis=0) if q.ndim > 1 else inside != q
        if not over.any():
            return q
        names = [name for name, is_over in zip(self._robot.joints, over, strict=True) if is_over]
        reasons.append(f"position limit of {', '.join(names)}")
        return inside

    def _check_torques(self) -> None:
        """NotSupported for an arm that takes no torques. Its driver's class says so, and is looked at once."""
        spec = self._robot.spec
        if self._takes_torques:
            return
        modes: frozenset[str] = registry.load(spec.driver, "robot").modes
        if "torque" not in modes:
            raise NotSupported(f"{spec.name}: driver {spec.driver} takes no torques, only: {', '.join(sorted(modes))}")
        if spec.limits.torque is None:
            raise NotSupported(f"{spec.name}: model {spec.model} takes no torques without limits.torque, Nm per joint")
        self._takes_torques = True

    def _within_torques(self, command: JointTorque, reasons: list[str]) -> JointTorque:
        most = self._robot.limits.torque
        if most is None:
            return command
        wanted = zip(command.tau.tolist(), most, self._robot.joints, strict=True)
        over = [name for x, limit, name in wanted if abs(x) > limit]
        if not over:
            return command
        reasons.append(f"torque limit of {', '.join(over)}")
        return JointTorque(np.clip(command.tau, np.negative(most), most))


def _at(chunk: JointChunk, t: float) -> NDArray[np.float64]:
    """Where a chunk wants the arm (n,) at ``t``, rad; before its first time, its first target."""
    k = int(np.searchsorted(chunk.t, t, side="right"))
    due: NDArray[np.float64] = chunk.q[min(k, len(chunk.t) - 1)]
    if 0 < k < len(chunk.t):
        share = (t - chunk.t[k - 1]) / (chunk.t[k] - chunk.t[k - 1])
        due = chunk.q[k - 1] + share * (due - chunk.q[k - 1])
    return due
