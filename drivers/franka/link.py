"""Common interface to the vendor's client libraries, so that one driver serves both arms."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import Enum, IntEnum
from typing import Any, NamedTuple

from .settings import ArmSettings

Floats = Sequence[float]


class ArmMode(IntEnum):
    """Mode of the robot, by its number in a state packet."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERING = 6


_MODES = tuple(ArmMode)


class StreamKind(Enum):
    """Quantity that a motion streams."""

    POSITION = "position"
    VELOCITY = "velocity"
    TORQUE = "torque"


class ArmSample(NamedTuple):
    """The part of a state packet that every cycle needs. SI units; vectors of joints are (7,)."""

    t: float
    """The robot's clock, s."""
    mode: ArmMode
    q: Floats
    dq: Floats
    tau: Floats
    q_d: Floats
    """Joint positions that the controller accepted last, rad."""
    dq_d: Floats
    tau_d: Floats
    """Torques that the controller accepted last, Nm."""
    tau_ext: Floats
    wrench_ext: Floats
    success_rate: float
    """Share of the last 100 cycles in which a command arrived in time; 0 outside a motion."""


class ArmLink(ABC):
    """A connection to one arm. Every call may raise whatever the library raises; :mod:`.faults` interprets it."""

    protocol: int
    """Version of Franka's protocol that the library speaks."""
    owns_loop = False
    """Whether the library calls back for every set-point."""
    library_errors: tuple[type[Exception], ...] = (RuntimeError,)
    """Exception classes that the library raises."""

    def __init__(self) -> None:
        self.robot: Any = None
        self.motion: StreamKind | None = None
        """Quantity that is being streamed; None outside a motion."""
        self.state: Any = None
        """Newest state, as the library's record."""
        self.still: Floats | None = None
        """Position at which the servo holds the arm (7,), rad; None: the position that the robot reports."""

    @abstractmethod
    def connect(self, host: str) -> None:
        """Connect, and wait for a first state."""

    @abstractmethod
    def read(self) -> ArmSample:
        """Block until the next state, for 1 s at most."""

    @abstractmethod
    def start(self, kind: StreamKind) -> None:
        """Start a motion."""

    @abstractmethod
    def send(self, values: Floats) -> None:
        """Send the set-point of this cycle (7,): rad, rad/s or Nm, depending on the motion's kind."""

    @abstractmethod
    def finish(self) -> None:
        """End the motion regularly; the arm is at rest."""

    def run(self, turn: Callable[[], None]) -> None:
        """Run the motion that was started in the library's own loop, which calls ``turn`` for every state."""
        raise NotImplementedError

    def abandon(self) -> None:
        """Forget a motion that the robot has ended, or that cannot be ended regularly."""
        self.motion = self.still = None

    def disconnect(self) -> None:
        self.abandon()
        self.robot = self.state = None

    def recover(self) -> None:
        self.robot.automatic_error_recovery()

    def configure(self, settings: ArmSettings) -> None:
        """Send the collision thresholds, stiffness, load and frames of ``settings`` to the robot."""
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
        """Return those of the flags ``names`` that are set in the newest state, or that ended the last motion."""
        found = []
        for flags in (self.state.current_errors, self.state.last_motion_errors):
            found += [name for name in names if getattr(flags, name, False) and name not in found]
        return found

    def tcp(self) -> list[float]:
        """Return O_T_EE of the newest state: the end effector in the base frame, 4x4 by columns, m."""
        return list(self.state.O_T_EE)

    def sample(self, state: Any) -> ArmSample:
        """Keep a library's state record, and return the part of it that every cycle needs."""
        self.state = state
        return ArmSample(
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
