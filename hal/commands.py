"""Commands to an arm: frozen records in SI units, checked when they are created.

A program sends one of the six commands with :meth:`hal.control.Control.send`. Poses and twists are in the arm's base
frame unless stated otherwise. The second half of this file holds the records in which commands, sessions and dead-man
switches reach the servo.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import frozen, vector
from .errors import CommandError
from .geometry import Pose, tcp_pose

__all__ = [
    "CartesianTarget",
    "Command",
    "CommandRecord",
    "DeadmanRecord",
    "Inbox",
    "JointChunk",
    "JointTarget",
    "JointTorque",
    "JointVelocity",
    "Kind",
    "NO_INBOX",
    "Sent",
    "Session",
    "Twist",
    "encode",
]

Array = NDArray[np.float64]
_set = object.__setattr__  # the commands are frozen, also for their own constructors
CHUNK_POINTS = 256
"""Greatest number of targets in one chunk."""
CHUNK_AHEAD = 3.0
"""Farthest that a chunk may reach into the future, s: for so long the arm may follow an old decision."""
FIRST_STEP_ANGLE = 0.1
"""Greatest distance of a first joint target from the set-point, rad per joint."""
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
            points = frozen(q)
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
    stops: int = 0
    """Number of calls of ``rig.stop()`` that had been acknowledged when the session was opened."""


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


NO_INBOX = Inbox(None, None, 0, 0, 0.0)
