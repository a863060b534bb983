"""What a servo tells about its last tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..types import Limited, RobotStatus, Trip

__all__ = ["ServoReport"]

Floats = Sequence[float]


@dataclass(slots=True)
class ServoReport:
    """What the servo did in its last tick."""

    status: RobotStatus = RobotStatus.IDLE
    trip: Trip = Trip.NONE
    limited: Limited = Limited.NONE
    target_seq: int = 0
    """Number of the command that the set-point follows; 0 before the first one of a session."""
    refused: int = 0
    """Number of the newest command of this session that was refused; 0 for none."""
    q_set: Floats = ()
    """rad"""
    dq_set: Floats = ()
    ddq_set: Floats = ()
    reanchored: int = 0
    """How often the device had not taken a set-point, since the servo was made."""
    arrived: bool = False
    """Is ``move_to`` done?"""
    t_trip: float = 0.0
    """When the stop was latched, s."""
    t_stop: float = 0.0
    """When the last braking began, s."""
