"""Following a leader arm or a hand: turns its states into targets for an arm, without a jump when it is engaged."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from .commands import CartesianTarget, JointTarget, JointVelocity
from .config.mapping import TeleopMapping
from .errors import CommandError, StaleStateError
from .geometry import Pose
from .kinematics.arm import Kinematics
from .leader import Leader, LeaderDriver
from .teleop import Teleop
from .types import PadState, RobotStatus

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from .commands import Command
    from .gamepad import Gamepad
    from .robot import Robot
    from .specs import LeaderSpec
    from .types import RobotState

Array = NDArray[np.float64]
_STILL, _SAME = 1e-3, 1e-9
"""Speed of every joint's set-point below which the arm counts as at rest, rad/s, if the set-point is the same, rad, as
in the state before: one that turns back is slow for a moment."""
_REACH = 0.999
"""Share of the arm's reach that a pose may have."""
STATE_AGE = 2.0
"""Greatest age of a state to start from, s."""
_FRESH = 0.1
"""Greatest age of a state whose torques the hand feels, s."""


class HandTeleop(Teleop):
    """Turns the states of a gamepad into commands, and those of a hand that is tracked, see :attr:`hal.PadState.pose`.

    While it is engaged, the arm follows what the hand moves from the moment of engaging on, so that engaging never
    moves the arm. It is engaged while the dead-man is held, from when the arm follows commands and its set-point is at
    rest. The tcp moves along the axes of its base, by :attr:`speed` m for each m of the hand's, and turns as the hand
    does.

    Args:
        robot: The arm.
        mapping: Name or path of a mapping.
        speed: Share of the mapping's speeds and of the hand's way, above 0, at most 1.

    Raises:
        ConfigError: The mapping is wrong.
        CommandError: The speed is out of range.
    """

    def __init__(self, robot: Robot, mapping: str | Path | TeleopMapping = "default", speed: float = 1.0) -> None:
        super().__init__(robot, mapping, speed)
        self.button = self.mapping.deadman
        """Button that engages it."""
        self._anchor: _Anchor | None = None
        self._before: RobotState | None = None
        """State of the turn before, while it is about to engage."""

    def reset(self) -> None:
        """Disengage: the arm stays where it is until it follows commands and is at rest, and the button is pressed."""
        super().reset()
        self._anchor = self._before = None

    def command(self, pad: PadState, dt: float) -> tuple[Command, float | None]:
        """Return the command for a state of the pad: where it has a pose, as :meth:`LeaderTeleop.command`."""
        if pad.pose:
            return self._follow(pad.pose, pad, dt)
        self._anchor = self._before = None
        return super().command(pad, dt)

    def _follow(self, where: tuple[float, ...], pad: PadState, dt: float) -> tuple[Command, float | None]:
        """Return the command for a hand or a leader that is there, and the grip."""
        grip = self._grip(pad)
        state = self.robot.state(STATE_AGE)
        if not (where and pad.pressed(self.button) and state.status is RobotStatus.FOLLOWING):
            self._anchor = self._before = None
        elif self._anchor is None and self._rests(state):
            self._anchor = self._make_anchor(where, state)
        if self._anchor is None:
            return JointVelocity(np.zeros(self.robot.n)), grip
        return self._anchor.follow(np.array(where), dt), grip

    def _rests(self, state: RobotState) -> bool:
        """Return whether the set-point is at rest, by this state and the newest one before it."""
        before, self._before = self._before, state
        if before is None or state.stamp.t <= before.stamp.t:
            return False
        return bool(np.abs(state.dq_set).max() < _STILL and np.abs(state.q_set - before.q_set).max() < _SAME)

    def _make_anchor(self, where: tuple[float, ...], state: RobotState) -> _Anchor:
        return _PoseAnchor(self.robot, _hand_pose, self.speed, np.array(where), state.tcp_set)

    def help(self, pad: Gamepad) -> list[str]:
        """Return what the controls of ``pad`` do, in lines of text."""
        hand, name = pad.driver.spec.hand, pad.control_name
        if not hand:
            return super().help(pad)
        lines = [f"hold {name(self.mapping.deadman)} to move as the {hand} hand moves; release it to stop"]
        gripper = self.mapping.gripper
        return [*lines, f"gripper: {name('r2')}"] if gripper is not None and "r2" in gripper.controls else lines


class LeaderTeleop(HandTeleop):
    """Turns the states of a leader into commands.

    It is engaged as :class:`HandTeleop`, and the arm follows what the leader moves from then on. An arm of the leader's
    own kind follows joint to joint, any other one by the pose of the leader's tcp: along the axes of both bases.

    Args:
        robot: The arm.
        leader: The leader.
        mapping: Name or path of a mapping, for the dead-man and the buttons.
        speed: Share of the arm's speed in coming to the leader (``engage: approach``), above 0, at most 1.

    Raises:
        ConfigError: The mapping is wrong.
        CommandError: The speed is out of range, or the leader cannot lead this arm (``code`` is ``cannot_lead``).
    """

    def __init__(
        self, robot: Robot, leader: Leader, mapping: str | Path | TeleopMapping = "leader", speed: float = 1.0
    ) -> None:
        super().__init__(robot, mapping, speed)
        self.leader, self.spec = leader, leader.spec
        self._driver = cast(LeaderDriver, leader.driver)
        self._kinematics: Kinematics | None = None
        if robot.spec.model not in self.spec.leads:
            if self.spec.kinematics is None:
                message = f"{leader.name} cannot lead {robot.name}: {explain_leads(self.spec)}"
                raise CommandError(message, code="cannot_lead")
            self._kinematics = Kinematics(self.spec.kinematics)
        elif len(self.spec.joints) != robot.n:
            message = f"{leader.name} has {len(self.spec.joints)} joints, {robot.name} {robot.n}"
            raise CommandError(message, code="cannot_lead")

    def prepare_takeover(self) -> None:
        """Engage by the mapping's ``take_over`` instead of the dead-man. Raises CommandError if there is none."""
        if self.mapping.take_over is None:
            raise CommandError("this mapping has no button take_over, with which a leader takes over", code="no_button")
        self.button = self.mapping.take_over

    def is_touched(self, pad: PadState) -> bool:
        """Return whether the button that engages it is pressed."""
        return pad.pressed(self.button)

    def watch(self) -> None:
        """Let a leader that may move follow an arm that it leads joint to joint."""
        self._driver.feel(None)
        if self._kinematics is None and self.spec.follow > 0.0:
            self._driver.follow(self.robot.state(STATE_AGE).q_set.tolist())

    def command(self, pad: PadState, dt: float) -> tuple[Command, float | None]:
        """Return the command for a state of the leader.

        Args:
            pad: The leader's state.
            dt: Time since the last step, s.

        Returns:
            The target for the arm, or a velocity of zero while it does not follow; and the grip from 0 (open) to 1
            (closed), or None to leave the gripper alone.

        Raises:
            StaleStateError: The arm's state is too old.
            ConnectionLost: The arm does not answer.
        """
        self._driver.follow(None)
        command = self._follow(pad.joints, pad, dt)
        self._driver.feel(self._find_feedback())
        return command

    def _find_feedback(self) -> list[float] | None:
        """Return the torques that the hand is to feel, Nm; None while the arm does not follow, or does not know any."""
        if self._anchor is None or self._kinematics is not None or self.spec.feedback == 0.0:
            return None
        with suppress(StaleStateError):
            state = self.robot.state(_FRESH)
            felt = state.tau_ext
            if state.status is RobotStatus.FOLLOWING and felt is not None and np.isfinite(felt).all():
                return [self.spec.feedback * torque for torque in felt.tolist()]
        return None

    def _make_anchor(self, where: tuple[float, ...], state: RobotState) -> _Anchor:
        joints = np.array(where)
        if self._kinematics is not None:
            return _PoseAnchor(self.robot, self._kinematics.pose, self.spec.pose_scale, joints, state.tcp_set)
        speed = self.speed * self.robot.spec.move_speed if self.spec.engage == "approach" else 0.0
        return _JointAnchor(joints, state.q_set, speed * np.array(self.robot.limits.velocity))

    def help(self, pad: Gamepad) -> list[str]:
        """Return how the arm follows, and what the controls do, in lines of text."""
        how = "by the pose of its tcp" if self._kinematics is not None else "joint to joint"
        return [f"{self.robot.name} follows {self.spec.title} {how}", *super().help(pad)]


class _JointAnchor:
    """Where leader and arm were when they engaged, and how far the arm has come to the leader since.

    Args:
        leader: Joint positions of the leader (n,), rad.
        arm: Set-point of the arm (n,), rad.
        speed: Greatest speed at which each joint comes to the leader (n,), rad/s; zeros for a clutch.
    """

    def __init__(self, leader: Array, arm: Array, speed: Array) -> None:
        self._leader, self._arm = leader, arm
        self._way = leader - arm
        self._rate = float(np.min(speed / np.maximum(np.abs(self._way), 1e-9)))
        self._share = 0.0

    def follow(self, joints: Array, dt: float) -> JointTarget:
        """Return the target for the present joint positions of the leader (n,), rad."""
        target = self._arm + (joints - self._leader) + self._share * self._way
        self._share = min(1.0, self._share + self._rate * dt)
        return JointTarget(target)


class _PoseAnchor:
    """Where the tcp of the leader, or the hand, and the arm were when they engaged.

    Args:
        robot: The arm.
        pose_of: Returns the pose of the leader for its joint positions.
        scale: Way of the arm's tcp for each m of the leader's.
        joints: Joint positions of the leader (n,), rad.
        tcp: Pose of the arm's set-point.
    """

    def __init__(self, robot: Robot, pose_of: Callable[[Array], Pose], scale: float, joints: Array, tcp: Pose) -> None:
        self._pose_of, self._scale, self._tcp = pose_of, scale, tcp
        self._leader = pose_of(joints)
        self._back = Pose((0.0, 0.0, 0.0), self._leader.orientation).inverse()
        self._farthest = _REACH * robot.kinematics.farthest()

    def follow(self, joints: Array, dt: float) -> CartesianTarget:
        """Return the target for the present joint positions of the leader (n,), rad."""
        here = self._pose_of(joints)
        position = self._tcp.position + self._scale * (here.position - self._leader.position)
        position *= min(1.0, self._farthest / max(float(np.linalg.norm(position)), 1e-9))
        turned = Pose((0.0, 0.0, 0.0), here.orientation) @ self._back
        return CartesianTarget(Pose(position, (turned @ self._tcp).orientation))


def _hand_pose(where: Array) -> Pose:
    return Pose(where[:3], where[3:])


_Anchor: TypeAlias = _JointAnchor | _PoseAnchor


def make_teleop(robot: Robot, pad: Gamepad, mapping: str | Path | TeleopMapping, speed: float = 1.0) -> Teleop:
    """Return what turns the states of a gamepad, or of a leader, into commands for an arm."""
    return LeaderTeleop(robot, pad, mapping, speed) if isinstance(pad, Leader) else HandTeleop(robot, mapping, speed)


def explain_leads(spec: LeaderSpec) -> str:
    """Return which arms a leader leads."""
    return (
        f"{spec.title} leads {', '.join(spec.leads)} joint to joint, and its model has no `arm` to lead others by poses"
    )
