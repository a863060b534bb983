"""What the driver needs of a vendor's client library, so that one driver does for both arms."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import Enum, IntEnum
from typing import Any, NamedTuple

from .settings import ArmSettings

__all__ = ["Kind", "Link", "Mode", "Sample"]

Floats = Sequence[float]


class Mode(IntEnum):
    """What the robot says that it is doing; the numbers are those of the state packets."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERING = 6


_MODES = tuple(Mode)


class Kind(Enum):
    """What a motion streams."""

    POSITION = "position"
    VELOCITY = "velocity"
    TORQUE = "torque"


class Sample(NamedTuple):
    """One state packet, the part that every cycle needs. SI units."""

    t: float
    """The robot's clock, s."""
    mode: Mode
    q: Floats
    dq: Floats
    tau: Floats
    q_d: Floats
    """The joint positions that the controller took last, rad."""
    dq_d: Floats
    tau_d: Floats
    """The torques that the controller took last, Nm."""
    tau_ext: Floats
    wrench_ext: Floats
    success_rate: float
    """Share of the last 100 cycles in which a command came in time; 0 outside a motion."""


class Link(ABC):
    """A connection to one arm. Every call may raise whatever the library raises; :mod:`.faults` puts it in words."""

    protocol: int
    """Version of Franka's protocol that the library speaks."""
    owns_loop = False
    """Does the library call back for every set-point, rather than take them?"""
    troubles: tuple[type[Exception], ...] = (RuntimeError,)
    """What the library raises of its own."""

    def __init__(self) -> None:
        self.robot: Any = None
        self.motion: Kind | None = None
        """What is being streamed."""
        self.state: Any = None
        """The library's record of the newest state."""
        self.still: Floats | None = None
        """Where the arm holds by what its servo knows, rad; None: where the robot says."""

    @abstractmethod
    def connect(self, host: str) -> None:
        """Connect, and wait for a first state."""

    @abstractmethod
    def read(self) -> Sample:
        """Block until the next state, for a second at most."""

    @abstractmethod
    def start(self, kind: Kind) -> None:
        """Begin a motion."""

    @abstractmethod
    def send(self, values: Floats) -> None:
        """The set-point for this cycle: rad, rad/s or Nm, as the motion's kind says."""

    @abstractmethod
    def finish(self) -> None:
        """End the motion in order; the arm is at rest."""

    def run(self, turn: Callable[[], None]) -> None:
        """The motion that was started, from the library's own loop; ``turn`` is called for every state."""
        raise NotImplementedError

    def abandon(self) -> None:
        """Forget a motion that has ended by itself, or that cannot be ended in order."""
        self.motion = self.still = None

    def disconnect(self) -> None:
        """Let go of the robot. Idempotent; a motion under way is cancelled."""
        self.abandon()
        self.robot = self.state = None

    def recover(self) -> None:
        """Automatic error recovery."""
        self.robot.automatic_error_recovery()

    def configure(self, settings: ArmSettings) -> None:
        """Tell the robot what the rig says of collisions, stiffness, load and frames."""
        robot = self.robot
        behavior = settings.collision_behavior
        if behavior is not None:
            robot.set_collision_behavior(*behavior.arguments())
        if settings.joint_impedance is not None:
            robot.set_joint_impedance(list(settings.joint_impedance))
        if settings.cartesian_impedance is not None:
            robot.set_cartesian_impedance(list(settings.cartesian_impedance))
        if settings.load is not None:
            robot.set_load(*settings.load.arguments())
        if settings.end_effector is not None:
            self._set_end_effector(settings.end_effector.matrix())
        if settings.stiffness_frame is not None:
            self._set_stiffness_frame(settings.stiffness_frame.matrix())

    def _set_end_effector(self, matrix: list[float]) -> None:
        self.robot.set_EE(matrix)

    def _set_stiffness_frame(self, matrix: list[float]) -> None:
        self.robot.set_K(matrix)

    def errors(self, names: Sequence[str]) -> list[str]:
        """Which of the flags called ``names`` are set in the newest state, or ended the last motion."""
        found = []
        for flags in (self.state.current_errors, self.state.last_motion_errors):
            found += [name for name in names if getattr(flags, name, False) and name not in found]
        return found

    def tcp(self) -> list[float]:
        """O_T_EE of the newest state: 4x4 by columns, the end effector in the base frame."""
        return list(self.state.O_T_EE)

    def sample(self, state: Any) -> Sample:
        """The part of a library's state that every cycle needs."""
        self.state = state
        return Sample(
            state.time.to_sec(),
            _MODES[int(state.robot_mode)],
            state.q,
            state.dq,
            state.tau_J,
            state.q_d,
            state.dq_d,
            state.tau_J_d,
            state.tau_ext_hat_filtered,
            state.O_F_ext_hat_K,
            state.control_command_success_rate,
        )
