"""What a servo reports about its last tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..types import ControlMode, Limited, RobotStatus, Trip

Floats = Sequence[float]


@dataclass(slots=True)
class ServoReport:
    """State of a servo after its last tick."""

    status: RobotStatus = RobotStatus.IDLE
    trip: Trip = Trip.NONE
    limited: Limited = Limited.NONE
    target_seq: int = 0
    """Number of the command that the set-point follows; 0 before the first one of a session."""
    refused: int = 0
    """Number of the newest command of this session that was refused; 0 for none."""
    q_set: Floats = ()
    """Joint set-point (n,), rad."""
    dq_set: Floats = ()
    ddq_set: Floats = ()
    reanchored: int = 0
    """Number of set-points that the device did not take, since the servo was made."""
    arrived: bool = False
    """Whether the motion of the session (``move_to`` and its kin) has reached its goal."""
    progress: float = 0.0
    """Share of the session's motion that is done, from 0 to 1."""
    held_back: Limited = Limited.NONE
    """Limits by which the servo reduced the motion of the session, since it was opened."""
    off_path: bool = False
    """Whether the arm cannot continue on the path of its session: it was moved too far off, no plan leads on, or it
    made no progress for 10 s."""
    overrun: Limited = Limited.NONE
    """Limit that the arm reached when ``Trip.LIMIT`` was latched; ``NONE`` if it could not be braked."""
    t_trip: float = 0.0
    """Time at which the stop was latched, s."""
    t_stop: float = 0.0
    """Time at which the last braking began, s."""
    controller: ControlMode = ControlMode.POSITION
    """What makes the arm follow its set-point."""
    tau_set: Floats = ()
    """Torques (n,) of the last set-point, Nm; empty if it has none."""
