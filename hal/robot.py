"""An arm of a rig: its state, its kinematics, and blocking motions.

:class:`Robot` is what research code uses, the same for every driver. Commands are streamed in a session
(:meth:`Robot.control`, :class:`hal.control.Control`); :meth:`Robot.move_to` needs none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._moved import names_of
from .arguments import number, vector
from .control import Control, check_deadman
from .errors import CommandError, ConnectionLost, MotionStopped, NotSupported, StaleStateError
from .geometry import Pose, frozen, tcp_pose
from .specs import CollisionSpec
from .types import RobotState, RobotStatus

if TYPE_CHECKING:
    from .clock import Clock
    from .deadman import Deadman, StopLatch
    from .dynamics import Dynamics
    from .gripper import Gripper
    from .host.hosts import Host
    from .kinematics.arm import Kinematics
    from .kinematics.collisions import Collisions
    from .servo.controllers import Controller
    from .specs import LimitsSpec, RobotSpec

__all__ = ["Robot"]

_MOVE_RATE = 50.0
"""Rate at which :meth:`Robot.move_to` checks its motion, Hz."""
_NOTHING = CollisionSpec(own=False, arms=False)
_FRESH_STATE = 0.2
"""Longest wait for a state after a recovery, s."""


class Robot:
    """One arm of a rig, the same for every driver; created by :func:`hal.open`.

    Args:
        spec: Record of the arm.
        host: Process, or thread, that runs the arm's servo.
        clock: The rig's clock.
        latch: The rig's latched stop.
        gripper: Gripper of this arm; None if it has none.
        collisions: What it must not touch.
        others: All arms of the rig, by name.
    """

    def __init__(
        self,
        spec: RobotSpec,
        host: Host,
        clock: Clock,
        latch: StopLatch,
        gripper: Gripper | None = None,
        collisions: CollisionSpec = _NOTHING,
        others: Mapping[str, Robot] | None = None,
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.clock = clock
        self._host = host
        self._mail = host.memory.robots[spec.name]
        self._latch = latch
        self._sessions = 0
        self._commands = 0
        self._open: Control | None = None
        self._kinematics: Kinematics | None = None
        self._collision_spec = collisions
        self._collisions: Collisions | None = None
        self._others = others or {}
        self._dynamics: Dynamics | None = None
        self.gripper = gripper
        """Gripper on this arm; None if the model has none."""

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
        return frozen(self.spec.home)

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

    def _check_collisions(self, goal: Sequence[float]) -> None:
        """Raise CollisionError if the way to ``goal`` (n,), rad, straight in joint space, would collide."""
        if not self._collision_spec.any:
            return
        try:
            collisions = self.collisions
        except NotSupported:
            return  # the rig's notes have it
        collisions.check_motion(np.array([self.state().q, goal]))

    def state(self, max_age: float = 0.1) -> RobotState:
        """Return the newest state; never waits.

        Args:
            max_age: Greatest age of the state, s.

        Raises:
            StaleStateError: The newest state is older than ``max_age``, or there is none yet (``code`` is
                ``no_state``).
            ConnectionLost: The arm, or the process that owns it, does not answer.
        """
        self._host.check()
        state = self._mail.get_state()
        if state is None:
            raise StaleStateError(f"{self.name} has not reported a state yet", code="no_state")
        age = self.clock.now() - state.stamp.t
        if state.status is RobotStatus.LOST:
            reason = f": {state.fault.cause}; {state.fault.remedy}" if state.fault is not None else ""
            raise ConnectionLost(f"{self.name} does not answer{reason} (its last state is {age:.3f} s old)")
        if not age <= max_age:
            number("max_age", max_age, "s")
            raise StaleStateError(f"the newest state of {self.name} is {age:.3f} s old, more than {max_age:g} s")
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
        return self._mail.history.since(after)

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
        deadman: Deadman | None = None,
        unattended: bool = False,
        speed: float | None = None,
        tcp_speed: float | None = None,
        timeout: float | None = None,
        patience: float = 60.0,
        controller: Controller | None = None,
    ) -> RobotState:
        """Move to joint positions or to a pose of the tcp, straight in joint space; block until the arm is there.

        Args:
            target: Joint positions (n,) in rad, or a pose of the tcp in the base frame with an orientation.
            position: Position (3,) of the tcp in the base frame, m, instead of ``target``; the orientation stays as it
                is.
            deadman: Switch that must be held; the arm waits for it and pauses while it is released.
            unattended: Move an arm that really moves without a dead-man.
            speed: Share of the joint speed limits, up to 1; the rig's ``move_speed`` (0.1) by default.
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
            Unreachable: No joint positions for the pose.
            MotionStopped: After a trip, or if the dead-man was released for longer than ``patience`` (``code`` is
                ``deadman_released``).
            TimeoutError: After ``timeout``.
        """
        if patience != math.inf:
            number("patience", patience, "s", least=0.0)
        if timeout is not None:
            number("timeout", timeout, "s", least=0.0, above=True)
        check_deadman(deadman)
        goal = self._goal(target, position)
        self._check_collisions(goal)
        session = Control(
            self,
            deadman=deadman,
            rate_hz=_MOVE_RATE,
            speed=speed,
            tcp_speed=tcp_speed,
            unattended=unattended,
            controller=controller,
            goal=goal,
        )
        clock = self.clock
        start = held = clock.now()
        with session:
            for _ in clock.rate(_MOVE_RATE):
                servo = session._peek()
                session._check_trip(servo, clock.now())
                if servo.refused and servo.session == session._id:
                    raise CommandError(
                        f"the way to the target leaves the workspace of {self.name}", code="outside_workspace"
                    )
                if servo.arrived and servo.session == session._id:
                    break
                if deadman is None or deadman.held:
                    held = clock.now()
                elif clock.now() - held > patience:
                    raise MotionStopped(
                        f"the dead-man was not held for {patience:g} s", "call move_to again", code="deadman_released"
                    )
                if timeout is not None and clock.now() - start > timeout:
                    raise TimeoutError(f"{self.name} did not reach the target within {timeout:g} s")
        return self.state()

    def _goal(self, target: ArrayLike | Pose | None, position: ArrayLike | None) -> tuple[float, ...]:
        """Return the joint positions (n,) in rad that ``move_to`` goes to, checked against the limits."""
        if (target is None) == (position is None):
            raise CommandError("pass move_to either a target (joint positions or a hal.Pose) or position=")
        if position is not None:
            target = Pose(vector("position", position, 3), self.state().tcp_set.orientation)
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
        if self._host.spec.clock == "real_time":
            start = self.clock.now()
            while (now := self.clock.now()) < start + _FRESH_STATE:
                state = self._mail.get_state()
                if state is not None and state.stamp.t >= start:
                    return
                self.clock.sleep(min(0.001, start + _FRESH_STATE - now))

    def inject(self, **faults: object) -> None:
        """Switch faults of a simulated driver on or off, for tests; see the driver's own ``inject``."""
        self._host.request("inject", {"robot": self.name, "faults": faults})

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {self.spec.model}, {self.n} joints, driver {self.spec.driver}>"


__getattr__ = names_of(__name__)
