"""Commands to an arm: frozen records in SI units, checked when they are created.

A program sends one of the six commands with :meth:`hal.control.Control.send`. Poses and twists are in the arm's base
frame unless stated otherwise. After them come the records in which commands, sessions and dead-man switches reach the
servo, and the checks that every command passes before it is sent (:class:`CommandChecks`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import registry
from .arguments import freeze, vector
from .errors import CommandError, MotionStopped, NotSupported, Unreachable
from .geometry import Pose, tcp_pose
from .types import Trip

if TYPE_CHECKING:
    from .specs import LimitsSpec, RobotSpec

__all__ = [
    "CartesianTarget",
    "Command",
    "CommandChecks",
    "CommandRecord",
    "DeadmanRecord",
    "Inbox",
    "JointChunk",
    "JointTarget",
    "JointTorque",
    "JointVelocity",
    "Kind",
    "NO_INBOX",
    "NO_SESSION",
    "PathSection",
    "Sent",
    "Session",
    "SessionRecord",
    "StopLatch",
    "Twist",
    "encode",
]

Array = NDArray[np.float64]
_set = object.__setattr__  # the commands are frozen, also for their own constructors
CHUNK_POINTS = 256
"""Greatest number of targets in one chunk."""
CHUNK_AHEAD = 3.0
"""Farthest that a chunk may reach into the future, s: for so long the arm may follow an old decision."""
PATH_KNOTS = 1000
"""Greatest number of knots in a planned path: the servo's process takes some milliseconds to check so many."""
FIRST_STEP_ANGLE = 0.1
"""Greatest distance of a first joint target from the set-point, rad per joint."""
PATIENCE = 10.0
"""A motion that is allowed to move, and makes no progress for so long, is given up, s."""
FIRST_STEP_DISTANCE = 0.05
"""Greatest distance of a first pose from the set-point, m."""
FIRST_STEP_TURN = 0.2
"""Greatest angle between a first pose and the set-point, rad."""


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointTarget:
    """Go to joint positions; between two commands the servo extrapolates along ``dq``.

    Args:
        q: Joint positions (n,), rad.
        dq: Joint velocities (n,) at that moment, rad/s; zero by default.
    """

    q: Array
    dq: Array | None

    def __init__(self, q: ArrayLike, dq: ArrayLike | None = None) -> None:
        _set(self, "q", vector("q", q))
        _set(self, "dq", None if dq is None else vector("dq", dq, self.q.size))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointChunk:
    """Follow joint positions at given times: the output of policies that predict chunks of actions.

    The servo interpolates without overshoot. A new chunk replaces the rest of the one before from its own first time
    on; targets in the past only lead to the following ones. The end of the last chunk is the deadline of the next
    command.

    Args:
        t: Times (k,), increasing, s on ``rig.clock``.
        q: Joint positions (k, n), rad.
    """

    t: Array
    q: Array

    def __init__(self, t: ArrayLike, q: ArrayLike) -> None:
        times = vector("t", t)
        try:
            points = freeze(q)
        except (TypeError, ValueError, OverflowError) as error:
            raise CommandError(f"q must be numbers: {error}") from None
        if not 1 <= times.size <= CHUNK_POINTS:
            raise CommandError(f"a chunk has 1 to {CHUNK_POINTS} targets, not {times.size}")
        if points.ndim != 2 or len(points) != times.size:
            raise CommandError(
                f"q must have shape ({times.size}, n), as there are {times.size} times, not {points.shape}"
            )
        if not np.isfinite(points).all():
            raise CommandError("q holds a number that is not finite")
        if not (np.diff(times) > 0.0).all():
            raise CommandError("the times of a chunk must increase")
        _set(self, "t", times)
        _set(self, "q", points)


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointVelocity:
    """Move the joints at a velocity.

    Args:
        dq: Joint velocities (n,), rad/s.
    """

    dq: Array

    def __init__(self, dq: ArrayLike) -> None:
        _set(self, "dq", vector("dq", dq))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointTorque:
    """Apply joint torques on top of those that carry the arm's own weight.

    They change by at most 990 Nm/s, and are reduced so far that the arm stays below the session's speeds if the object
    that it presses against gives way. Other commands are refused until the arm is at rest without torques, and torques
    until it is at rest.

    Args:
        tau: Joint torques (n,), Nm.
    """

    tau: Array

    def __init__(self, tau: ArrayLike) -> None:
        _set(self, "tau", vector("tau", tau))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class CartesianTarget:
    """Bring the tcp to a pose; inverse kinematics runs in the servo.

    Args:
        pose: Pose of the tcp in the base frame, with an orientation.
    """

    pose: Pose

    def __init__(self, pose: Pose) -> None:
        _set(self, "pose", tcp_pose("pose", pose))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Twist:
    """Move and rotate the tcp at a velocity.

    Args:
        linear: Linear velocity (3,), m/s.
        angular: Angular velocity (3,), rad/s.
        frame: Axes of both: those of the arm's ``base``, or of the ``tcp`` itself.
    """

    linear: Array
    angular: Array
    frame: str

    def __init__(self, linear: ArrayLike, angular: ArrayLike = (0.0, 0.0, 0.0), frame: str = "base") -> None:
        if frame not in ("base", "tcp"):
            raise CommandError(f"frame must be 'base' or 'tcp', not {frame!r}")
        _set(self, "linear", vector("linear", linear, 3))
        _set(self, "angular", vector("angular", angular, 3))
        _set(self, "frame", frame)


Command: TypeAlias = JointTarget | JointChunk | JointVelocity | JointTorque | CartesianTarget | Twist


class Sent(NamedTuple):
    """Result of ``Control.send``."""

    command: Command | None
    """The command that was sent, for example cut to the limits; None if there was none."""
    reasons: tuple[str, ...] = ()
    """Reasons why it differs from the one that was passed, or why the arm does not follow it."""


# What reaches the servo


class Kind(IntEnum):
    """Kind of a command on its way to the servo."""

    NONE = 0
    JOINT_TARGET = 1
    JOINT_VELOCITY = 2
    JOINT_TORQUE = 3
    CARTESIAN_TARGET = 4
    TWIST = 5
    JOINT_CHUNK = 6


def encode(command: Command, now: float) -> tuple[Kind, tuple[float, ...]]:
    """Return the kind and the values with which a command travels at ``now`` (s); see :class:`CommandRecord`."""
    if isinstance(command, JointChunk):
        return Kind.JOINT_CHUNK, (*(command.t - now).tolist(), *command.q.ravel().tolist())
    if isinstance(command, JointTarget):
        q = command.q.tolist()
        return Kind.JOINT_TARGET, (*q, *(command.dq.tolist() if command.dq is not None else [0.0] * len(q)))
    if isinstance(command, JointVelocity):
        return Kind.JOINT_VELOCITY, tuple(command.dq.tolist())
    if isinstance(command, JointTorque):
        return Kind.JOINT_TORQUE, tuple(command.tau.tolist())
    if isinstance(command, CartesianTarget):
        return Kind.CARTESIAN_TARGET, (*command.pose.position.tolist(), *command.pose.orientation.tolist())
    assert isinstance(command, Twist)
    return Kind.TWIST, (*command.linear.tolist(), *command.angular.tolist(), 1.0 if command.frame == "tcp" else 0.0)


class PathSection(NamedTuple):
    """Knots of a smooth section of a planned path; the arm rests at its ends."""

    s: tuple[float, ...]
    """Parameter of each knot (k,), increasing from 0; m, or rad for a path in joint space."""
    q: tuple[tuple[float, ...], ...]
    """Joint positions at each knot (k, n), rad."""


class Session(NamedTuple):
    """Terms of one control session, which stay the same until it ends."""

    id: int
    speed: float
    """Share of the joint speed limits, 0..1."""
    tcp_speed: float
    """Greatest speed of the tcp, m/s."""
    deadman: bool
    """Whether the arm moves only while a dead-man is held."""
    move_to: tuple[float, ...] | None = None
    """Joint positions (n,) to go to and stay, rad; None for a session that follows streamed commands."""
    controller: dict[str, Any] | None = None
    """Controller that follows the set-point, as :func:`hal.servo.controllers.controller_data` describes it; None for
    the arm's own position controller."""
    path: tuple[PathSection, ...] | None = None
    """Path to follow to its end instead, where the arm stays; at most :data:`PATH_KNOTS` knots."""

    @property
    def is_motion(self) -> bool:
        """Whether the session makes one motion, known from the start, and takes no commands."""
        return self.move_to is not None or self.path is not None

    @classmethod
    def unpack(cls, values: Sequence[Any]) -> Session:
        """Return the session of such values, whose tuples have become lists on their way to another process."""
        session = cls(*values)
        goal, path = session.move_to, session.path
        if goal is not None:
            session = session._replace(move_to=tuple(goal))
        if path is not None:
            path = tuple(PathSection(tuple(s), tuple(map(tuple, q))) for s, q in path)
            session = session._replace(path=path)
        return session


class SessionRecord(NamedTuple):
    """State of the app's control session, for the servo. The notice of its end waits for no answer."""

    session: int
    """The session that the app has open; 0 for none."""
    acknowledged: int
    """Number of calls of ``rig.stop()`` that its opening, or its last rearm, acknowledged."""
    rearms: int
    """Number of calls of ``control.rearm()``."""


class StopLatch:
    """Counts the calls of ``rig.stop()``, and holds them until they are acknowledged. Any thread may call it."""

    def __init__(self) -> None:
        self.stops = 0
        """Number of calls of :meth:`stop`."""
        self.acknowledged = 0
        """Number of those that are acknowledged, for all arms or for one."""
        self.rearmed = 0
        """Number of those that :meth:`rearm` acknowledged for all arms."""
        self._lock = threading.RLock()  # a signal handler may call stop() in the middle of stop()

    @property
    def stopped(self) -> bool:
        """Whether the newest stop is not acknowledged."""
        return self.acknowledged < self.stops

    def stop(self) -> None:
        """Latch a stop."""
        with self._lock:
            self.stops += 1

    def acknowledge(self, stops: int) -> None:
        """Acknowledge the first ``stops`` of all stops in the session of one arm; a later one stays latched."""
        with self._lock:
            self.acknowledged = max(self.acknowledged, stops)

    def rearm(self) -> None:
        """Acknowledge every stop so far, for all arms."""
        with self._lock:
            self.acknowledged = self.rearmed = self.stops

    def check(self) -> None:
        """Raise MotionStopped while the stop is not acknowledged."""
        if self.stopped:
            raise MotionStopped(
                "rig.stop() was called", "call rig.rearm() when it is safe to move again", code=Trip.STOP.code
            )


class CommandRecord(NamedTuple):
    """One command on its way to the servo."""

    seq: int
    session: int
    """Session that sent it; commands of other sessions are ignored."""
    t: float
    """Time of sending on the host's clock, s."""
    deadline: float
    """Time by which the next command must arrive, s."""
    kind: Kind
    values: tuple[float, ...]
    """By kind. JOINT_TARGET: q, then dq; JOINT_VELOCITY: dq; JOINT_TORQUE: tau; CARTESIAN_TARGET: position and
    quaternion; TWIST: linear, angular, then 1.0 for the axes of the tcp and 0.0 for those of the base; JOINT_CHUNK: k
    times relative to ``t``, then k times q."""
    t_event: float = 0.0
    """Time of the pad event behind the command, s; 0 without one. Used for latency figures only."""


class DeadmanRecord(NamedTuple):
    """State of a dead-man switch."""

    held: bool
    connected: bool
    presses: int
    """Number of presses so far, so that a release between two ticks is not missed."""
    t_alive: float
    """Time of the last proof that the pad is connected, on the host's clock, s."""


class Inbox(NamedTuple):
    """Everything that the servo gets in one tick besides the reading: always the newest values, never a queue."""

    command: CommandRecord | None
    deadman: DeadmanRecord | None
    stops: int
    """Number of calls of ``rig.stop()``."""
    rearms: int
    """Number of calls of ``control.rearm()``."""
    t_app: float
    """Time of the program's last heartbeat on the host's clock, s."""
    acknowledged: int = 0
    """Number of those stops that the session's opening, or its last rearm, acknowledged."""


NO_SESSION = SessionRecord(0, 0, 0)
NO_INBOX = Inbox(None, None, 0, 0, 0.0)


class CheckedArm(Protocol):
    """What :class:`CommandChecks` needs of an arm: a part of :class:`hal.robot.Robot`."""

    name: str
    spec: RobotSpec

    @property
    def n(self) -> int: ...
    @property
    def joints(self) -> tuple[str, ...]: ...
    @property
    def limits(self) -> LimitsSpec: ...
    @property
    def kinematics(self) -> Any: ...


class CommandChecks:
    """Checks of the commands for one arm: size, limits, reach, and distance of the first target.

    Args:
        robot: The arm.
    """

    def __init__(self, robot: CheckedArm) -> None:
        self._robot = robot
        self._n = robot.n
        self._lower, self._upper = np.array(robot.limits.lower), np.array(robot.limits.upper)
        self._takes_torques = False
        """Whether the driver is known to take torques."""

    def check_command(self, command: Command, now: float, reasons: list[str]) -> Command:
        """Return the command to send: the same one, or one cut to the limits.

        Args:
            command: The command.
            now: Time on the rig's clock, s.
            reasons: List to which the reasons for every change are appended.

        Raises:
            CommandError: Not a command, or one of the wrong size (``code`` is ``not_a_command``, ``wrong_joint_count``,
                ``chunk_in_the_past`` or ``chunk_too_long``).
            NotSupported: Torques, for an arm that takes none.
            Unreachable: A pose beyond the arm's reach.
        """
        if isinstance(command, JointTorque):
            self.check_torques()
        self._check_kind(command)
        if isinstance(command, CartesianTarget):
            self._check_reach(command)
        elif isinstance(command, JointTarget):
            q = self._clip_to_limits(command.q, reasons)
            return command if q is command.q else JointTarget(q, command.dq)
        elif isinstance(command, JointChunk):
            self._check_times(command, now)
            q = self._clip_to_limits(command.q, reasons)
            return command if q is command.q else JointChunk(command.t, q)
        elif isinstance(command, JointTorque):
            return self._limit_torques(command, reasons)
        return command

    def check_first(self, command: Command, now: float, q_set: Sequence[float]) -> None:
        """Refuse a first target that is far from the set-point, so that the arm does not leap to it.

        Args:
            command: The command.
            now: Time on the rig's clock, s.
            q_set: Joint set-point (n,), rad.

        Raises:
            CommandError: The target is too far away (``code`` is ``first_step_too_far``).
        """
        if isinstance(command, (JointTarget, JointChunk)):
            first = command.q if isinstance(command, JointTarget) else _find_target(command, now)
            step = np.abs(first - np.asarray(q_set))
            worst = int(np.argmax(step))
            if step[worst] > FIRST_STEP_ANGLE:
                raise CommandError(
                    f"the first target is {step[worst]:.3f} rad from the set-point at {self._robot.joints[worst]}, "
                    f"more than {FIRST_STEP_ANGLE} rad: use move_to first",
                    code="first_step_too_far",
                )
        elif isinstance(command, CartesianTarget):
            distance, turn = self._robot.kinematics.pose(q_set).distance(command.pose)
            if distance > FIRST_STEP_DISTANCE or turn > FIRST_STEP_TURN:
                raise CommandError(
                    f"the first pose is {distance:.3f} m and {turn:.3f} rad from the set-point, more than "
                    f"{FIRST_STEP_DISTANCE} m or {FIRST_STEP_TURN} rad: use move_to first",
                    code="first_step_too_far",
                )

    def _check_kind(self, command: Command) -> None:
        if isinstance(command, JointChunk):
            count = command.q.shape[1]
        elif (size := _JOINTS.get(type(command))) is not None:
            count = getattr(command, size).size
        elif isinstance(command, (CartesianTarget, Twist)):
            return
        else:
            meant = _MEANT.get(type(command))
            hint = f"; did you mean {meant}?" if meant else ""
            raise CommandError(f"{type(command).__name__} is not a command{hint}", code="not_a_command")
        if count != self._n:
            raise CommandError(
                f"{self._robot.name} has {self._n} joints; {type(command).__name__} has {count}",
                code="wrong_joint_count",
            )

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
            raise CommandError(
                f"the chunk's last target was due {-end:.3f} s ago: its times are on rig.clock",
                code="chunk_in_the_past",
            )
        if end > CHUNK_AHEAD:
            raise CommandError(
                f"the chunk reaches {end:.3f} s into the future; at most {CHUNK_AHEAD:g} s are allowed",
                code="chunk_too_long",
            )

    def _clip_to_limits(self, q: NDArray[np.float64], reasons: list[str]) -> NDArray[np.float64]:
        """Return ``q`` (n,) or (k, n) cut to the position limits; the same array if that changes nothing."""
        inside: NDArray[np.float64] = np.minimum(np.maximum(q, self._lower), self._upper)
        over = (inside != q).any(axis=0) if q.ndim > 1 else inside != q
        if not over.any():
            return q
        names = [name for name, is_over in zip(self._robot.joints, over, strict=True) if is_over]
        reasons.append(f"position limit of {', '.join(names)}")
        return inside

    def check_torques(self) -> None:
        """Raise NotSupported for an arm that takes no torques. The driver's class is checked once."""
        spec = self._robot.spec
        if self._takes_torques:
            return
        modes: frozenset[str] = registry.load(spec.driver, "robot").modes
        if "torque" not in modes:
            raise NotSupported(
                f"{spec.name}: driver {spec.driver} takes no torques, only: {', '.join(sorted(modes))}",
                code="no_torque_mode",
            )
        if spec.limits.torque is None:
            raise NotSupported(
                f"{spec.name}: model {spec.model} takes no torques without limits.torque, Nm per joint",
                code="no_torque_limits",
            )
        self._takes_torques = True

    def _limit_torques(self, command: JointTorque, reasons: list[str]) -> JointTorque:
        most = self._robot.limits.torque
        if most is None:
            return command
        wanted = zip(command.tau.tolist(), most, self._robot.joints, strict=True)
        over = [name for x, limit, name in wanted if abs(x) > limit]
        if not over:
            return command
        reasons.append(f"torque limit of {', '.join(over)}")
        return JointTorque(np.clip(command.tau, np.negative(most), most))


def _find_target(chunk: JointChunk, t: float) -> NDArray[np.float64]:
    """Return the joint positions (n,) of a chunk at time ``t``, rad; its first target before its first time."""
    k = int(np.searchsorted(chunk.t, t, side="right"))
    due: NDArray[np.float64] = chunk.q[min(k, len(chunk.t) - 1)]
    if 0 < k < len(chunk.t):
        share = (t - chunk.t[k - 1]) / (chunk.t[k] - chunk.t[k - 1])
        due = chunk.q[k - 1] + share * (due - chunk.q[k - 1])
    return due


_JOINTS = {JointTarget: "q", JointVelocity: "dq", JointTorque: "tau"}


_MEANT: dict[type, str] = {
    Pose: "hal.CartesianTarget(pose)",
    np.ndarray: "hal.JointTarget(q)",
    list: "hal.JointTarget(q)",
    tuple: "hal.JointTarget(q)",
}
"""Type that is not a command -> the command that was probably intended."""
