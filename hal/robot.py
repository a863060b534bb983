"""An arm: the driver's abstract class (small, talks to one device) and the public class (see below)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import number, vector
from .errors import ConnectionLost, NotSupported, StaleStateError
from .pose import Pose, frozen, tcp_pose
from .types import Fault, RobotState, RobotStatus

if TYPE_CHECKING:
    from .clock import Clock
    from .control import Control
    from .deadman import Deadman
    from .gripper import Gripper
    from .host.hosts import Host
    from .kinematics import Kinematics
    from .specs import LimitsSpec, RobotSpec
    from .stops import StopLatch

__all__ = ["Reading", "Robot", "RobotDriver", "Setpoint"]

Floats = Sequence[float]

_NEWS = 0.2
"""Longest wait for a state after a recovery, s."""


class Reading(NamedTuple):
    """What a robot driver reports once per cycle. Plain floats: this is the hot path."""

    t: float
    """When it was measured, on the host's clock, s."""
    t_device: float
    """The same on the device's own clock, s."""
    seq: int
    """Counts the device's samples; gaps are lost samples."""
    q: Floats
    """Joint positions, rad."""
    dq: Floats
    """Joint velocities, rad/s."""
    tau: Floats | None = None
    """Joint torques, Nm."""
    q_commanded: Floats | None = None
    """The set-point that the device says it took last, rad: how the servo notices that one was lost. None where the
    device cannot say."""
    dq_commanded: Floats | None = None
    tau_ext: Floats | None = None
    wrench_ext: Floats | None = None
    fault: Fault | None = None
    """A fault stops and latches the arm."""
    tau_commanded: Floats | None = None
    """In torque mode: the torques that the device says it took last, Nm; none at all before it has changed its mode.
    The servo goes on from these, as it does from ``q_commanded``."""


class Setpoint(NamedTuple):
    """What the servo writes to a driver once per cycle; every value lies inside the limits, continuously.

    A driver may keep the numbers, and report them as ``q_commanded``, but must not change them.
    """

    q: Floats
    """rad"""
    dq: Floats
    """rad/s"""
    ddq: Floats
    """rad/s2"""
    tau: Floats | None = None
    """Nm, in torque mode only: what to apply on top of what carries the arm's own weight. ``q`` and ``dq`` are then
    what was measured."""
    q_from: Floats | None = None
    """Where the device is now, by what the servo knows: the set-point before this one, rad. Only in position mode."""


class RobotDriver(ABC):
    """One arm. It only talks to its device: limits, smoothing, time-outs and stopping stand above it.

    Made by the registry with the arm's :class:`~hal.specs.RobotSpec` and, for a simulated arm, the world it stands
    in. The calls come from one thread. ``open`` connects and reads; it never moves anything. ``close`` is idempotent
    and stops safely first. A device that does not answer raises :class:`~hal.errors.ConnectionLost`.
    """

    modes: ClassVar[frozenset[str]] = frozenset({"position"})
    """Kinds of set-point the device takes: ``position``, ``velocity``, ``torque``."""
    paces_itself: ClassVar[bool] = False
    """True where the device sets the pace: :meth:`wait` blocks until its next cycle (a Franka's state packets)."""
    simulated: ClassVar[bool] = False
    """True where nothing real can move."""
    repeats: ClassVar[bool] = False
    """What the device does when a set-point is lost: True where it repeats the last one, False where it extrapolates at
    constant acceleration (a Franka), or where none can be lost. Only what was extrapolated differs from a late
    report, and is corrected."""

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        self.spec = spec
        self.world = world

    @abstractmethod
    def open(self) -> None:
        """Connect. Nothing moves."""

    def wait(self) -> None:
        """Block until the device's next cycle, for a bounded time. Only of drivers that pace themselves.

        Raises nothing: what went wrong is for :meth:`read` to say.
        """
        raise NotSupported(f"driver {type(self).__name__} does not pace itself")

    @abstractmethod
    def read(self, now: float) -> Reading:
        """The newest state; ``now`` is the host's clock, for devices without one. Does not block."""

    @abstractmethod
    def write(self, setpoint: Setpoint) -> bool | None:
        """Hand over the next set-point.

        Returns:
            False when it was not passed on to the device, for example because a motion has to be started first. The
            servo then starts from where the next reading says that the device is. Anything else means that it was.
        """

    @abstractmethod
    def halt(self) -> None:
        """End streaming: the device stops and holds by its own means. Idempotent."""

    def recover(self) -> None:  # noqa: B027  # most have nothing to do
        """Clear a fault, as the user's own act. A driver without faults has nothing to do."""

    @property
    def wants_loop(self) -> bool:
        """Does the device's library want to own the loop from now on (see :meth:`loop`)?"""
        return False

    def loop(self, turn: Callable[[], None]) -> None:
        """Let the library call ``turn`` (one whole cycle of the group) until the motion is over.

        For libraries that stream set-points only out of a callback of their own: inside a turn, ``wait`` does not
        block, ``read`` gives the state that the callback was called with and ``write`` keeps what it is to return.
        """
        raise NotSupported(f"driver {type(self).__name__} does not own a loop")

    def mass_matrix(self, q: Floats) -> Any:
        """Joint-space inertia (n, n), kg m2, at joint positions ``q``, rad: numbers in rows, or an array.

        Of drivers that take torques: the servo brakes by it, and bounds what it lets through. Three times too much or
        too little is still good enough; that of a URDF whose inertias are invented is not.
        """
        raise NotSupported(f"driver {type(self).__name__} does not know the arm's inertia")

    def own_tcp(self) -> Floats | None:
        """Where the device itself says that its tcp was in the last reading: 4x4 by columns, in the base frame, m.

        None where it does not know. It is compared with ours when the arm is opened, and a mismatch is refused.
        """
        return None

    def statistics(self) -> dict[str, Any]:
        """What the driver knows of its connection, as plain numbers and texts, for reports."""
        return {}

    def reset_statistics(self) -> None:  # noqa: B027
        """Count from zero."""

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Stop safely and let go of the device. Idempotent."""


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
            from .kinematics import Kinematics

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
        from .moving import move_to

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
