"""An arm: the driver's abstract class (small, talks to one device) and the public class (see below)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._moved import names_of
from .arguments import number, vector
from .control import Control, check_deadman
from .errors import CommandError, ConnectionLost, MotionStopped, StaleStateError
from .geometry import Pose, frozen, tcp_pose
from .types import RobotState, RobotStatus

if TYPE_CHECKING:
    from .clock import Clock
    from .control import StopLatch
    from .deadman import Deadman
    from .gripper import Gripper
    from .host.hosts import Host
    from .kinematics.arm import Kinematics
    from .specs import LimitsSpec, RobotSpec

__all__ = [
    "Robot",
    "move_to",
]

# [moving.py] ``move_to``: a session that goes to one place and ends there.


def move_to(
    robot: Robot,
    target: ArrayLike | Pose | None,
    position: ArrayLike | None,
    *,
    deadman: Deadman | None,
    unattended: bool,
    speed: float | None,
    tcp_speed: float | None,
    timeout: float | None,
    patience: float,
) -> RobotState:
    """See :meth:`hal.robot.Robot.move_to`."""
    if patience != math.inf:
        number("patience", patience, "s", least=0.0)
    if timeout is not None:
        number("timeout", timeout, "s", least=0.0, above=True)
    check_deadman(deadman)
    if (target is None) == (position is None):
        raise CommandError("pass move_to either a target (joint positions or a hal.Pose) or position=")
    if position is not None:
        target = Pose(vector("position", position, 3), robot.state().tcp_set.orientation)
    goal = robot.ik(target) if isinstance(target, Pose) else vector("target", target)
    if goal.size != robot.n:
        hint = "; for a position of the tcp pass position=" if goal.size == 3 else ""
        raise CommandError(f"{robot.name} has {robot.n} joints; the target has {goal.size}{hint}")
    limits = robot.limits
    outside = np.flatnonzero((goal < limits.lower) | (goal > limits.upper))
    if outside.size:
        names = ", ".join(robot.joints[k] for k in outside)
        raise CommandError(f"the target is outside the position limits of {names}")
    session = Control(
        robot,
        deadman=deadman,
        rate_hz=50.0,
        speed=speed,
        tcp_speed=tcp_speed,
        unattended=unattended,
        goal=tuple(goal.tolist()),
    )
    clock = robot.clock
    start = held = clock.now()
    with session:
        for _ in clock.rate(50.0):
            servo = session._peek()
            session._check_trip(servo, clock.now())
            if servo.refused and servo.session == session._id:
                raise CommandError(f"the way to the target leaves the workspace of {robot.name}")
            if servo.arrived and servo.session == session._id:
                break
            if deadman is None or deadman.held:
                held = clock.now()
            elif clock.now() - held > patience:
                raise MotionStopped(
                    f"the dead-man was not held for {patience:g} s", "call move_to again", code="deadman_released"
                )
            if timeout is not None and clock.now() - start > timeout:
                raise TimeoutError(f"{robot.name} did not reach the target within {timeout:g} s")
    return robot.state()


_NEWS = 0.2
"""Longest wait for a state after a recovery, s."""


class Robot:
    """One arm of a rig, the same whatever driver it ends in. Made by :func:`hal.open`."""

    def __init__(
        self, spec: RobotSpec, host: Host, clock: Clock, latch: StopLatch, gripper: Gripper | None = None
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
        self.gripper = gripper
        """The gripper on this arm, if the model has one."""

    # What it is.

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
        """The model's home position (n,), rad."""
        return frozen(self.spec.home)

    @property
    def base(self) -> Pose:
        """Where the arm's base frame stands in the world, as the rig's file says."""
        return Pose(self.spec.base_position, self.spec.base_orientation)

    @property
    def limits(self) -> LimitsSpec:
        """Joint limits that the servo keeps."""
        return self.spec.limits

    @property
    def kinematics(self) -> Kinematics:
        """Forward and inverse kinematics of this arm."""
        if self._kinematics is None:
            from .kinematics.arm import Kinematics

            self._kinematics = Kinematics(self.spec.kinematics)
        return self._kinematics

    # What it does.

    def state(self, max_age: float = 0.1) -> RobotState:
        """The newest state.

        Raises StaleStateError when it is older than ``max_age`` s, ConnectionLost when the arm, or the process that
        owns it, is gone.
        """
        self._host.check()
        state = self._mail.get_state()
        if state is None:
            raise StaleStateError(f"{self.name} has not reported a state yet")
        age = self.clock.now() - state.stamp.t
        if state.status is RobotStatus.LOST:
            reason = f": {state.fault.cause}; {state.fault.remedy}" if state.fault is not None else ""
            raise ConnectionLost(f"{self.name} does not answer{reason} (its last state is {age:.3f} s old)")
        if not age <= max_age:
            number("max_age", max_age, "s")
            raise StaleStateError(f"the newest state of {self.name} is {age:.3f} s old, more than {max_age:g} s")
        return state

    def state_at(self, t: float) -> RobotState:
        """The state at ``t`` (s on ``rig.clock``), a picture's stamp for example: interpolated between two samples.

        The last second is kept. Raises StaleStateError for a time that is older, or more than 50 ms in the future.
        """
        from .interpolation import robot_at

        self._host.check()
        return robot_at(self._mail.history, t, self.name)

    def states(self, after: float) -> list[RobotState]:
        """Every state that is newer than ``after`` (s on ``rig.clock``), oldest first.

        In real time one for each cycle of the last second, in lock-step one for each time that somebody waited.
        """
        self._host.check()
        return self._mail.history.since(after)

    def check(self) -> None:
        """Raise ConnectionLost when the process that owns the arm is gone: then nothing brings the arm back."""
        self._host.check()

    def fk(self, q: ArrayLike) -> Pose:
        """Pose of the tcp in the base frame at joint positions ``q`` (n,), rad."""
        return self.kinematics.pose(vector("q", q, self.n))

    def ik(self, pose: Pose, q_seed: ArrayLike | None = None) -> NDArray[np.float64]:
        """Joint positions (n,) in rad that bring the tcp to ``pose`` (base frame), near ``q_seed`` or the present.

        Raises Unreachable, with the residual in m and rad, where there are none.
        """
        pose = tcp_pose("pose", pose)
        seed = self.state().q if q_seed is None else vector("q_seed", q_seed, self.n)
        return self.kinematics.solve(pose, seed)

    def control(
        self,
        *,
        deadman: Deadman | None = None,
        rate_hz: float = 50.0,
        speed: float | None = None,
        tcp_speed: float | None = None,
        unattended: bool = False,
    ) -> Control:
        """A session in which this arm follows commands; use it in a ``with`` statement.

        ``deadman`` lets it move only while held, ``rate_hz`` says how often commands will come (and so, when they
        are late), ``speed`` is a share of the joint speed limits (the rig's own by default, which it cannot exceed),
        ``tcp_speed`` a speed in m/s. An arm that really moves needs a dead-man or ``unattended=True``.
        """
        from .control import Control

        return Control(self, deadman=deadman, rate_hz=rate_hz, speed=speed, tcp_speed=tcp_speed, unattended=unattended)

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
    ) -> RobotState:
        """Move to joint positions or to a tcp pose, straight in joint space; block until the arm is there.

        Args:
            target: Joint positions (n,) in rad, or a pose of the tcp in the base frame with an orientation.
            position: Position (3,) of the tcp in the base frame, m, instead of ``target``; its orientation stays as it
                is.
            deadman: The arm waits until it is held, and pauses while it is not.
            unattended: Move an arm that really moves without a dead-man.
            speed: Share of the joint speed limits, up to 1; the rig's ``move_speed`` (0.1) by default.
            tcp_speed: Greatest speed of the tcp, m/s; the rig's by default, which it cannot exceed.
            timeout: After so many seconds the motion ends with TimeoutError; None waits for ever.
            patience: For how long the dead-man may be released, s.

        Returns:
            The state on arrival.

        Raises:
            CommandError: For a target that makes no sense, or that is outside the limits or the workspace.
            Unreachable: For a pose without joint positions.
            MotionStopped: After a trip, or when the dead-man was released for longer than ``patience``.
            TimeoutError: After ``timeout``.
        """
        # FOLD: import dropped

        return move_to(
            self,
            target,
            position,
            deadman=deadman,
            unattended=unattended,
            speed=speed,
            tcp_speed=tcp_speed,
            timeout=timeout,
            patience=patience,
        )

    def recover(self) -> None:
        """Clear a fault of the device. It is always the user's own act. Afterwards :meth:`state` is newer than this."""
        self._host.request("recover", {"robot": self.name})
        if self._host.spec.clock == "real_time":
            asked = self.clock.now()
            while (now := self.clock.now()) < asked + _NEWS:
                state = self._mail.get_state()
                if state is not None and state.stamp.t >= asked:
                    return
                self.clock.sleep(min(0.001, asked + _NEWS - now))

    def inject(self, **knobs: object) -> None:
        """Switch faults of a simulated driver on or off, for tests; the driver's ``inject`` lists its knobs."""
        self._host.request("inject", {"robot": self.name, "knobs": knobs})

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {self.spec.model}, {self.n} joints, driver {self.spec.driver}>"


__getattr__ = names_of(__name__)
