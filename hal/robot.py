"""An arm of a rig: its state, its kinematics, and blocking motions.

:class:`Robot` is what research code uses, the same for every driver. Commands are streamed in a session
(:meth:`Robot.control`, :class:`hal.control.Control`); :meth:`Robot.move_to` needs none.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import freeze, number, vector
from .clock import describe_load
from .control import Control, check_deadman
from .errors import CommandError, ConnectionLost, NotSupported, StaleStateError
from .geometry import Pose, tcp_pose
from .motion.handle import CHECK_HZ, ArmMotion
from .specs import CollisionSpec
from .types import RobotState, RobotStatus

if TYPE_CHECKING:
    from .clock import Clock
    from .deadman import Deadman
    from .dynamics import Dynamics
    from .gripper import Gripper
    from .host.hosts import Host
    from .kinematics.arm import Kinematics
    from .kinematics.collisions import Collisions
    from .motion.planning import MotionPlan, PathPlanner
    from .servo.controllers import Controller
    from .specs import LimitsSpec, RobotSpec

_MOVED = 0.02
"""A set-point at rest that is farther than this from the arm is an old one, rad: the arm was moved by hand."""
_NOTHING = CollisionSpec(own=False, arms=False)
_FRESH_STATE = 0.2
"""Longest wait for a state after a recovery, s."""


class Robot:
    """One arm of a rig, the same for every driver; created by :func:`hal.open`.

    Args:
        spec: Record of the arm.
        host: Process, or thread, that runs the arm's servo.
        clock: The rig's clock.
        gripper: Gripper of this arm; None if it has none.
        collisions: What it must not touch.
        others: All arms of the rig, by name.
    """

    def __init__(
        self,
        spec: RobotSpec,
        host: Host,
        clock: Clock,
        gripper: Gripper | None = None,
        collisions: CollisionSpec = _NOTHING,
        others: Mapping[str, Robot] | None = None,
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.clock = clock
        self._host = host
        self._mail = host.memory.robots[spec.name]
        self._latch = host.latch
        # A host at another computer has had sessions of other programs, and has the last command of one.
        self._sessions = 0 if spec.at is None else random.getrandbits(32)
        self._commands = 0
        self._open: Control | None = None
        self._motion: ArmMotion | None = None
        """The newest motion that was started in the background."""
        self._kinematics: Kinematics | None = None
        self._collision_spec = collisions
        self._collisions: Collisions | None = None
        self._others = {} if others is None else others
        self._dynamics: Dynamics | None = None
        self.gripper = gripper
        """Gripper on this arm; None if the model has none."""
        self.recorded = False
        """Whether a recorder records an episode: motions then keep the speed of streams, so that it can be replayed."""

    # The arm itself.

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.spec.joints)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from base to tip."""
        return self.spec.joints

    @property
    def home(self) -> NDArray[np.float64]:
        """Home position (n,) of the model, rad."""
        return freeze(self.spec.home)

    @property
    def base(self) -> Pose:
        """Pose of the base frame in the world, from the rig file."""
        return Pose(self.spec.base_position, self.spec.base_orientation)

    @property
    def limits(self) -> LimitsSpec:
        """Joint limits that the servo enforces."""
        return self.spec.limits

    @property
    def kinematics(self) -> Kinematics:
        """Forward and inverse kinematics of this arm."""
        if self._kinematics is None:
            from .kinematics.arm import Kinematics

            self._kinematics = Kinematics(self.spec.kinematics)
        return self._kinematics

    @property
    def collisions(self) -> Collisions:
        """Collisions of this arm with itself, with the rig's boxes and with the other arms.

        Raises:
            NotSupported: The arm has no collision shapes, or a mesh that cannot be read.
        """
        if self._collisions is None:
            from .kinematics.collisions import Collisions

            seen = self._others.values() if self._collision_spec.arms else ()
            others = [(robot.spec, partial(robot._position, math.inf)) for robot in seen if robot is not self]
            self._collisions = Collisions(self.spec, self._collision_spec, others)
        return self._collisions

    @property
    def dynamics(self) -> Dynamics:
        """Gravity, inertia and torques of this arm, with its payload and its gripper open.

        Raises:
            NotSupported: The URDF lacks masses, or has impossible ones; the message names the links.
        """
        if self._dynamics is None:
            from .dynamics import Dynamics

            self._dynamics = Dynamics.of(self.spec)
        return self._dynamics

    # State and kinematics.

    def _position(self, max_age: float) -> NDArray[np.float64]:
        """Return the measured joint positions (n,), rad."""
        return self.state(max_age).q

    def _check_collisions(self, samples: NDArray[np.float64]) -> None:
        """Raise CollisionError if a motion along joint positions (k, n), rad, straight between two, would collide."""
        if not self._collision_spec.any:
            return
        try:
            collisions = self.collisions
        except NotSupported:
            return  # the rig's notes have it
        collisions.check_motion(samples)

    def state(self, max_age: float = 0.1) -> RobotState:
        """Return the newest state; never waits.

        Args:
            max_age: Greatest age of the state, s.

        Raises:
            StaleStateError: The newest state is older than ``max_age``, or there is none yet (``code`` is
                ``no_state``).
            ConnectionLost: The arm, or the process that owns it, does not answer; ``code`` is that of the arm's fault.
        """
        self._host.check()
        state = self._mail.get_state()
        if state is None:
            raise StaleStateError(f"{self.name} has not reported a state yet", code="no_state")
        age = self.clock.now() - state.stamp.t
        if state.status is RobotStatus.LOST:
            fault = state.fault
            reason, code = ("", None) if fault is None else (f": {fault.cause}; {fault.remedy}", fault.code)
            raise ConnectionLost(f"{self.name} does not answer{reason} (its last state is {age:.3f} s old)", code=code)
        if not age <= max_age:
            number("max_age", max_age, "s")
            text = f"the newest state of {self.name} is {age:.3f} s old, more than {max_age:g} s"
            raise StaleStateError(text + describe_load())
        return state

    def state_at(self, t: float) -> RobotState:
        """Return the state at a given time, for example a frame's stamp, interpolated between two samples.

        Args:
            t: Time on ``rig.clock``, s. The states of the last second are kept.

        Raises:
            StaleStateError: ``t`` is older than that, or more than 50 ms in the future.
            ConnectionLost: The process that owns the arm is gone.
        """
        from .interpolation import robot_at

        self._host.check()
        return robot_at(self._mail.history, t, self.name)

    def states(self, after: float) -> list[RobotState]:
        """Return all kept states that are newer than ``after`` (s on ``rig.clock``), oldest first.

        The last second is kept: in real time one state per cycle, in lock-step one per wait of the program.
        """
        self._host.check()
        return self._mail.history.read_since(after)

    def check(self) -> None:
        """Raise ConnectionLost if the process that owns the arm is gone; the arm cannot come back then."""
        self._host.check()

    def fk(self, q: ArrayLike) -> Pose:
        """Return the pose of the tcp in the base frame at joint positions ``q`` (n,), rad."""
        return self.kinematics.pose(vector("q", q, self.n))

    def ik(self, pose: Pose, q_seed: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return joint positions that bring the tcp to a pose.

        Args:
            pose: Pose of the tcp in the base frame, with an orientation.
            q_seed: Joint positions (n,), rad, near which to search; the present ones by default.

        Returns:
            Joint positions (n,), rad.

        Raises:
            Unreachable: No joint positions within the limits were found; carries the residual.
        """
        pose = tcp_pose("pose", pose)
        seed = self.state().q if q_seed is None else vector("q_seed", q_seed, self.n)
        return self.kinematics.solve(pose, seed)

    # Motion.

    def control(
        self,
        *,
        deadman: Deadman | None = None,
        rate_hz: float = 50.0,
        speed: float | None = None,
        tcp_speed: float | None = None,
        unattended: bool = False,
        controller: Controller | None = None,
    ) -> Control:
        """Return a control session, in which this arm follows commands; use it in a ``with`` statement.

        Args:
            deadman: Switch that must be held for the arm to move, for example ``pad.hold("l2")``. An arm that really
                moves needs one, or ``unattended=True``.
            rate_hz: Rate at which commands will be sent; later ones trip the session.
            speed: Share of the joint speed limits, up to the rig's own share, which is the default.
            tcp_speed: Greatest speed of the tcp, m/s, up to the rig's own, which is the default.
            unattended: Move an arm that really moves without a dead-man.
            controller: What follows the set-point: :class:`hal.Position` (the default), :class:`hal.JointImpedance` or
                :class:`hal.OperationalSpace`.

        Raises:
            CommandError: An invalid argument, or neither ``deadman`` nor ``unattended`` for an arm that really moves
                (``code`` is ``deadman_required``); gains that do not suit the arm (``bad_controller``).
            NotSupported: The dead-man's pad is not safe enough for a real arm. Or a controller, for a driver without
                torques (``code`` is ``no_torque_mode``), or an arm whose URDF lacks inertias (``wrong_inertials``).
        """
        return Control(
            self,
            deadman=deadman,
            rate_hz=rate_hz,
            speed=speed,
            tcp_speed=tcp_speed,
            unattended=unattended,
            controller=controller,
        )

    def move_to(
        self,
        target: ArrayLike | Pose | None = None,
        *,
        position: ArrayLike | None = None,
        straight: bool = False,
        deadman: Deadman | None = None,
        unattended: bool = False,
        speed: float | None = None,
        tcp_speed: float | None = None,
        timeout: float | None = None,
        patience: float = 60.0,
        controller: Controller | None = None,
    ) -> RobotState:
        """Move to joint positions or to a pose of the tcp, and block until the arm is there.

        The way is straight in joint space; with ``straight`` it is a straight line of the tcp, on which the orientation
        turns about one axis (slerp). Lines and waypoints are checked whole before anything moves.

        Args:
            target: Joint positions (n,) in rad, waypoints (k, n) in rad, or a pose of the tcp in the base frame with an
                orientation. The arm rests at each waypoint where its way turns.
            position: Position (3,) of the tcp in the base frame, m, instead of ``target``; the orientation stays as it
                is.
            straight: Move the tcp on a straight line; only for a pose or a position.
            deadman: Switch that must be held; the arm waits for it and pauses while it is released.
            unattended: Move an arm that really moves without a dead-man.
            speed: Share of the joint speed limits, up to 1; the rig's ``move_speed`` (0.1) by default. In an episode
                that is recorded, up to the rig's ``speed``, with a warning.
            tcp_speed: Greatest speed of the tcp, m/s, up to the rig's own, which is the default.
            timeout: Longest duration, s; None for no limit.
            patience: Longest time for which the dead-man may be released, s.
            controller: What follows the set-point, as for :meth:`control`.

        Returns:
            The state on arrival.

        Raises:
            CommandError: An invalid target (``code`` is ``outside_limits`` or ``outside_workspace`` for one that the
                arm must not reach).
            CollisionError: The arm would touch itself, a box of the rig or another arm on the way.
            Unreachable: No joint positions for the pose, or the way to it cannot be followed; nothing has moved.
            MotionStopped: After a trip, or if the dead-man was released for longer than ``patience`` (``code`` is
                ``deadman_released``).
            TimeoutError: After ``timeout``.
        """
        motion = self._prepare(target, position, straight, _terms(deadman, unattended, speed, tcp_speed, controller))
        return motion._run(timeout, patience)

    def move_along(
        self,
        poses: Sequence[Pose],
        *,
        blend: float = 0.01,
        deadman: Deadman | None = None,
        unattended: bool = False,
        speed: float | None = None,
        tcp_speed: float | None = None,
        timeout: float | None = None,
        patience: float = 60.0,
        controller: Controller | None = None,
    ) -> RobotState:
        """Move the tcp along poses on straight lines with rounded corners; block until the arm is at the last one.

        Args:
            poses: Poses of the tcp in the base frame, with orientations.
            blend: Distance before and behind a pose from which on its corner is rounded, m, at most half of a line. The
                tcp passes the pose at no more than 0.38 of it. With 0, and where the way leads back, the arm rests
                there.
            deadman: As for :meth:`move_to`; the others, too.
            unattended: Likewise.
            speed: Likewise.
            tcp_speed: Likewise.
            timeout: Likewise.
            patience: Likewise.
            controller: Likewise.

        Returns:
            The state on arrival.

        Raises:
            HalError: As for :meth:`move_to`.
        """
        motion = self._prepare_along(poses, blend, _terms(deadman, unattended, speed, tcp_speed, controller))
        return motion._run(timeout, patience)

    def start_move_to(
        self,
        target: ArrayLike | Pose | None = None,
        *,
        position: ArrayLike | None = None,
        straight: bool = False,
        deadman: Deadman | None = None,
        unattended: bool = False,
        speed: float | None = None,
        tcp_speed: float | None = None,
        controller: Controller | None = None,
    ) -> ArmMotion:
        """Start the motion of :meth:`move_to` and return at once; it continues while other code runs.

        In lock-step it moves while the program waits, for example with ``rig.clock.sleep``.

        Returns:
            The motion, which has control of the arm until it is over or cancelled.

        Raises:
            HalError: As for :meth:`move_to`, for what can be known before anything moves.
        """
        terms = _terms(deadman, unattended, speed, tcp_speed, controller)
        return self._prepare(target, position, straight, terms)._start()

    def start_move_along(
        self,
        poses: Sequence[Pose],
        *,
        blend: float = 0.01,
        deadman: Deadman | None = None,
        unattended: bool = False,
        speed: float | None = None,
        tcp_speed: float | None = None,
        controller: Controller | None = None,
    ) -> ArmMotion:
        """Start the motion of :meth:`move_along` and return at once, as :meth:`start_move_to` does."""
        terms = _terms(deadman, unattended, speed, tcp_speed, controller)
        return self._prepare_along(poses, blend, terms)._start()

    def _prepare(
        self, target: ArrayLike | Pose | None, position: ArrayLike | None, straight: bool, terms: dict[str, Any]
    ) -> ArmMotion:
        """Return the motion of ``move_to``, checked and not yet started."""
        if (target is None) == (position is None):
            raise CommandError("pass move_to either a target (joint positions or a hal.Pose) or position=")
        if position is not None:
            target = Pose(vector("position", position, 3), self.state().tcp_set.orientation)
        if straight:
            return self._plan_along([tcp_pose("a straight motion's target", target)], 0.0, terms)
        if not isinstance(target, Pose) and (points := _waypoints(target)) is not None:
            goals = [self._goal(point) for point in points]
            return self._make_motion(self._planner().plan_joints(self._start_position(), goals), terms)
        assert target is not None
        goal = self._goal(target)
        self._check_collisions(np.array([self._start_position(), goal]))
        return ArmMotion(self, Control(self, goal=goal, **terms))

    def _prepare_along(self, poses: Sequence[Pose], blend: float, terms: dict[str, Any]) -> ArmMotion:
        """Return the motion of ``move_along``, checked and not yet started."""
        number("blend", blend, "m", least=0.0)
        if isinstance(poses, Pose) or not len(poses):
            raise CommandError("pass move_along a sequence of poses, at least one")
        return self._plan_along([tcp_pose(f"poses[{k}]", pose) for k, pose in enumerate(poses)], blend, terms)

    def _plan_along(self, poses: Sequence[Pose], blend: float, terms: dict[str, Any]) -> ArmMotion:
        values = [(*pose.position.tolist(), *pose.orientation.tolist()) for pose in poses]
        return self._make_motion(self._planner().plan_poses(self._start_position(), values, blend), terms)

    def _make_motion(self, plan: MotionPlan, terms: dict[str, Any]) -> ArmMotion:
        if plan.sections:
            return ArmMotion(self, Control(self, path=plan.sections, **terms))
        return ArmMotion(self, Control(self, goal=tuple(self._start_position()), **terms))  # it is there already

    def _planner(self) -> PathPlanner:
        from .motion.planning import PathPlanner

        return PathPlanner(
            self.kinematics, self.limits.lower, self.limits.upper, self.spec.workspace, self._check_collisions
        )

    def _start_position(self) -> list[float]:
        """Return the joint positions (n,) from which a motion starts, rad: the set-point, if the arm still is there.

        A simulated arm that something holds back keeps its set-point; a real one was moved by hand.
        """
        state = self.state()
        moved = self.spec.attended and float(np.abs(state.q - state.q_set).max()) > _MOVED
        q: list[float] = (state.q if moved else state.q_set).tolist()
        return q

    def _goal(self, target: ArrayLike | Pose) -> tuple[float, ...]:
        """Return the joint positions (n,) in rad that ``move_to`` goes to, checked against the limits."""
        goal = self.ik(target) if isinstance(target, Pose) else vector("target", target)
        if goal.size != self.n:
            hint = "; for a position of the tcp pass position=" if goal.size == 3 else ""
            raise CommandError(
                f"{self.name} has {self.n} joints; the target has {goal.size}{hint}", code="wrong_joint_count"
            )
        outside = np.flatnonzero((goal < self.limits.lower) | (goal > self.limits.upper))
        if outside.size:
            names = ", ".join(self.joints[k] for k in outside)
            raise CommandError(f"the target is outside the position limits of {names}", code="outside_limits")
        return tuple(goal.tolist())

    def recover(self) -> None:
        """Clear a fault of the device; only the user decides on it. :meth:`state` returns a newer state afterwards."""
        self._host.request("recover", {"robot": self.name})
        start = self.clock.now()
        while (now := self.clock.now()) < start + _FRESH_STATE:
            state = self._mail.get_state()
            if state is not None and state.stamp.t > start:
                return
            self.clock.sleep(min(0.001, start + _FRESH_STATE - now))

    def inject(self, **faults: object) -> None:
        """Switch faults of a simulated driver on or off, for tests; see the driver's own ``inject``."""
        self._host.request("inject", {"robot": self.name, "faults": faults})

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {self.spec.model}, {self.n} joints, driver {self.spec.driver}>"


def _terms(
    deadman: Deadman | None,
    unattended: bool,
    speed: float | None,
    tcp_speed: float | None,
    controller: Controller | None,
) -> dict[str, Any]:
    """Return these arguments of a motion as those of its session."""
    check_deadman(deadman)
    return {
        "deadman": deadman,
        "rate_hz": CHECK_HZ,
        "speed": speed,
        "tcp_speed": tcp_speed,
        "unattended": unattended,
        "controller": controller,
    }


def _waypoints(target: object) -> list[Any] | None:
    """Return the waypoints (k, n) of a target; None if it is a single position."""
    try:
        points = np.asarray(target, float)
    except (TypeError, ValueError, OverflowError):
        return None
    return list(points) if points.ndim == 2 and len(points) else None
