"""What can be asked of an arm. Frozen, checked when made, SI units; frames are the arm's base frame unless said."""

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


class Kind(IntEnum):
    """How a command travels to the servo."""

    NONE = 0
    JOINT_TARGET = 1
    JOINT_VELOCITY = 2
    JOINT_TORQUE = 3
    CARTESIAN_TARGET = 4
    TWIST = 5
    JOINT_CHUNK = 6


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointTarget:
    """Be at joint positions ``q`` (n,) in rad, moving at ``dq`` (n,) in rad/s (zero when left out).

    Between two commands the servo extrapolates along ``dq``.
    """

    q: Array
    dq: Array | None

    def __init__(self, q: ArrayLike, dq: ArrayLike | None = None) -> None:
        _set(self, "q", vector("q", q))
        _set(self, "dq", None if dq is None else vector("dq", dq, self.q.size))


CHUNK_POINTS = 256
"""At most so many targets in one chunk."""
CHUNK_AHEAD = 3.0
"""s; a chunk may reach no farther into the future: for so long the arm may move by what was decided before."""


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointChunk:
    """Be at joint positions ``q`` (k, n) in rad at the times ``t`` (k,), s on ``rig.clock``: what policies that predict
    action chunks put out.

    The servo interpolates, without overshoot. A new chunk replaces what is left of the one before from its own first
    time on; targets whose time has passed only lead to those that follow. The end of the last one is the deadline: who
    sends nothing more until then is late, and trips.
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
    """Move the joints at ``dq`` (n,), rad/s."""

    dq: Array

    def __init__(self, dq: ArrayLike) -> None:
        _set(self, "dq", vector("dq", dq))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class JointTorque:
    """Apply joint torques ``tau`` (n,), Nm, on top of those with which the arm carries its own weight.

    They are followed as fast as 990 Nm/s, and only as far as the arm could still be kept below the session's speeds
    when what it presses against gives way. Commands of another kind must wait until the arm is at rest and no torque is
    left, and torques until it rests.
    """

    tau: Array

    def __init__(self, tau: ArrayLike) -> None:
        _set(self, "tau", vector("tau", tau))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class CartesianTarget:
    """Bring the tcp to ``pose``, which needs an orientation; inverse kinematics runs in the servo."""

    pose: Pose

    def __init__(self, pose: Pose) -> None:
        _set(self, "pose", tcp_pose("pose", pose))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Twist:
    """Move the tcp at ``linear`` (3,) m/s while it turns at ``angular`` (3,) rad/s.

    Along the base's axes, or with ``frame="tcp"`` along the tcp's own.
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


def encode(command: Command, now: float) -> tuple[Kind, tuple[float, ...]]:
    """A command as it travels from ``now`` on; see :class:`hal.commands.CommandRecord`."""
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


class Sent(NamedTuple):
    """What ``Control.send`` really sent, and why it differs from what was asked, if it does."""

    command: Command | None
    reasons: tuple[str, ...] = ()


# [inbox.py] What reaches an arm's servo from outside, once per tick: the newest of everything, never a queue.


class Session(NamedTuple):
    """The terms of one control session; they do not change while it lasts."""

    id: int
    speed: float
    """Share of the joint speed limits."""
    tcp_speed: float
    """Greatest speed of the tcp, m/s."""
    deadman: bool
    """Motion only while a dead-man is held."""
    move_to: tuple[float, ...] | None = None
    """Go to these joint positions (rad) and stay; None for a session that follows streamed commands."""
    stops: int = 0
    """Calls of ``rig.stop()`` that the app knew of, and had acknowledged, when it opened the session."""


class CommandRecord(NamedTuple):
    """One command as it travels: see :mod:`hal.commands` for what the values mean."""

    seq: int
    session: int
    """The session that sent it; a command of another one is ignored."""
    t: float
    """When it was sent, on the host's clock, s."""
    deadline: float
    """When the next one must have come, s."""
    kind: Kind
    values: tuple[float, ...]
    """JOINT_TARGET: q then dq; JOINT_VELOCITY: dq; JOINT_TORQUE: tau; CARTESIAN_TARGET: position and quaternion;
    TWIST: linear, angular, then 1.0 where they are given along the tcp's axes and 0.0 where along the base's;
    JOINT_CHUNK: k times, counted from ``t``, then k times q."""
    t_event: float = 0.0
    """When the pad event behind it happened, s; 0 where there is none. Only latency is computed from it."""


class DeadmanRecord(NamedTuple):
    """A dead-man switch."""

    held: bool
    connected: bool
    presses: int
    """Counts presses, so that a release between two ticks is not missed."""
    t_alive: float
    """Last proof that the pad is alive, on the host's clock, s."""


class Inbox(NamedTuple):
    """Everything that the servo looks at besides the reading."""

    command: CommandRecord | None
    deadman: DeadmanRecord | None
    stops: int
    """Counts calls of ``rig.stop()``."""
    rearms: int
    """Counts calls of ``control.rearm()``."""
    t_app: float
    """The app's heartbeat, on the host's clock, s."""


NO_INBOX = Inbox(None, None, 0, 0, 0.0)
