"""Does the robot accept what was commanded? Looks at backward differences over one cycle, as Franka's documents say.

How exact the real controller is about each limit is not documented: the tolerances are assumptions, in one place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from hal.drivers.franka.flags import flag_index
from hal.drivers.franka.limits import ArmLimits

from .samples import DT, Floats, Sample

__all__ = ["LimitChecker", "Tolerances", "Violation"]


@dataclass(frozen=True)
class Tolerances:
    """How far beyond a limit a command may be. All of them are assumptions."""

    start_pose: float = 1e-2
    """rad, between where the arm is and the first position that is commanded."""
    velocity: float = 1e-3
    """rad/s: what the client library's own limiter stays below the limit by."""
    acceleration: float = 0.5
    """rad/s2. A state in single precision resolves 2.4e-7 rad near pi, which are 0.24 rad/s2 in second differences."""
    jerk: float = 0.02
    """Share of the limit."""
    torque: float = 1e-3
    """Nm"""
    torque_rate: float = 1.0
    """Nm/s"""


class Violation(NamedTuple):
    """The first limit that a command breaks."""

    flag: int
    """Index of the error flag that the robot raises."""
    text: str
    """Joint, value and limit in words."""


_START = flag_index("joint_position_motion_generator_start_pose_invalid")
_POSITION = flag_index("joint_motion_generator_position_limits_violation")
_VELOCITY = flag_index("joint_motion_generator_velocity_limits_violation")
_ACCELERATION = flag_index("joint_motion_generator_velocity_discontinuity")
_JERK = flag_index("joint_motion_generator_acceleration_discontinuity")
_TORQUE = flag_index("tau_j_range_violation")
_TORQUE_RATE = flag_index("controller_torque_discontinuity")
_MEASURED_POSITION = flag_index("joint_position_limits_violation")
_MEASURED_VELOCITY = flag_index("joint_velocity_violation")


class Worst:
    """The greatest share of one limit, with its tolerance, that was used so far. More than 1 is a violation."""

    __slots__ = ("joint", "limit", "share", "unit", "value")

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.share, self.joint, self.value, self.limit = 0.0, 0, 0.0, 0.0

    def report(self) -> dict[str, object]:
        """For statistics; the joint counts from 1."""
        return {
            "share": self.share,
            "joint": self.joint + 1,
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
        }


class LimitChecker:
    """Compares samples and torques with the limits of one model, and keeps how near to each limit they came."""

    def __init__(self, limits: ArmLimits, tolerances: Tolerances | None = None) -> None:
        self.limits = limits
        self.tolerances = tolerances or Tolerances()
        self.worst: dict[str, Worst] = {}
        self.reset()

    def reset(self) -> None:
        """Forget the statistics."""
        units = {
            "start_pose": "rad",
            "position": "rad",
            "velocity": "rad/s",
            "acceleration": "rad/s2",
            "jerk": "rad/s3",
            "torque": "Nm",
            "torque_rate": "Nm/s",
        }
        self.worst = {name: Worst(unit) for name, unit in units.items()}

    def report(self) -> dict[str, dict[str, object]]:
        """The worst of every limit so far. ``position`` is a share of the way from the middle to the stop."""
        return {name: worst.report() for name, worst in self.worst.items()}

    def start(self, q: Floats, q_commanded: Floats) -> Violation | None:
        """Is the first position that is commanded where the arm is? Both (7,), rad."""
        allowed = self.tolerances.start_pose
        for k, (measured, commanded) in enumerate(zip(q, q_commanded, strict=True)):
            if self._over("start_pose", k, commanded - measured, allowed, 0.0):
                return self._violation(
                    _START, "start_pose", k, "first position is off by", commanded - measured, allowed
                )
        return None

    def joints(self, before: Sample, after: Sample) -> Violation | None:
        """May ``after`` follow ``before``? Looks at position, velocity, acceleration and jerk, in this order."""
        limits, tolerances = self.limits, self.tolerances
        for k, position in enumerate(after.q):
            middle = 0.5 * (limits.lower[k] + limits.upper[k])
            if self._over("position", k, position - middle, limits.upper[k] - middle, 0.0):
                bound = limits.lower[k] if position < middle else limits.upper[k]
                return self._violation(_POSITION, "position", k, "position", position, bound)
        lowest, highest = limits.velocity_range(before.q)
        for k, velocity in enumerate(after.dq):
            allowed = highest[k] if velocity > 0.0 else -lowest[k]
            if self._over("velocity", k, velocity, allowed, tolerances.velocity):
                return self._violation(_VELOCITY, "velocity", k, "velocity", velocity, allowed)
        for k, acceleration in enumerate(after.ddq):
            allowed = limits.acceleration[k]
            if self._over("acceleration", k, acceleration, allowed, tolerances.acceleration):
                return self._violation(_ACCELERATION, "acceleration", k, "acceleration", acceleration, allowed)
        for k, (new, old) in enumerate(zip(after.ddq, before.ddq, strict=True)):
            allowed = limits.jerk[k]
            if self._over("jerk", k, (new - old) / DT, allowed, tolerances.jerk * allowed):
                return self._violation(_JERK, "jerk", k, "jerk", (new - old) / DT, allowed)
        return None

    def torques(self, before: Floats, after: Floats) -> Violation | None:
        """May these commanded torques (7,), Nm, follow those? The documents only recommend the range."""
        limits, tolerances = self.limits, self.tolerances
        for k, (new, old) in enumerate(zip(after, before, strict=True)):
            if self._over("torque", k, new, limits.torque[k], tolerances.torque):
                return self._violation(_TORQUE, "torque", k, "torque", new, limits.torque[k])
            rate = (new - old) / DT
            if self._over("torque_rate", k, rate, limits.torque_rate[k], tolerances.torque_rate):
                return self._violation(_TORQUE_RATE, "torque_rate", k, "torque changes by", rate, limits.torque_rate[k])
        return None

    def measured(self, q: Floats, dq: Floats) -> Violation | None:
        """Is an arm under torque control still inside its range (7,), rad, and speed (7,), rad/s?"""
        limits = self.limits
        for k, position in enumerate(q):
            if not limits.lower[k] <= position <= limits.upper[k]:
                bound = limits.lower[k] if position < limits.lower[k] else limits.upper[k]
                return self._violation(_MEASURED_POSITION, "position", k, "measured position", position, bound)
            if abs(dq[k]) > limits.velocity[k]:
                return self._violation(
                    _MEASURED_VELOCITY, "velocity", k, "measured velocity", dq[k], limits.velocity[k]
                )
        return None

    def _over(self, name: str, joint: int, value: float, allowed: float, tolerance: float) -> bool:
        share = abs(value) / (allowed + tolerance)
        worst = self.worst[name]
        if share > worst.share:
            worst.share, worst.joint, worst.value, worst.limit = share, joint, value, allowed
        return share > 1.0

    def _violation(self, flag: int, name: str, joint: int, what: str, value: float, limit: float) -> Violation:
        unit = self.worst[name].unit
        return Violation(flag, f"joint {joint + 1}: {what} {value:.6g} {unit}, limit {limit:.6g} {unit}")
