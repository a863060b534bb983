"""Published limits of Franka's arms: the joints of the FR3 and of the Panda (FER), with sources.

Sources, all in the repository frankarobotics/docs, as of 2026-05: the page "Robot and interface specifications"
(``source/control_parameters.rst``: conditions, the formula for the FR3's joint speeds) and its tables
``control-parameters-joint-fr3.csv`` and ``control-parameters-joint-fer.csv``. A command beyond one of them ends a
motion with a reflex.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

Seven = tuple[float, float, float, float, float, float, float]

ELBOW_FLIP = -0.467002423653011
"""Angle of joint 4 at which the arm is fully stretched, rad; the sign of the elbow changes there."""


@dataclass(frozen=True)
class ArmLimits:
    """Limits of one model, one number per joint from the base to the flange, in rad, s and Nm."""

    model: str
    lower: Seven
    upper: Seven
    velocity: Seven
    acceleration: Seven
    jerk: Seven
    torque: Seven
    torque_rate: Seven
    """Nm/s"""
    velocity_offset: Seven | None = None
    """Speed limit near the stops, together with ``deceleration`` (rad/s2); None for an arm without that rule."""
    deceleration: Seven | None = None

    def velocity_range(self, q: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return the lowest (7,) and highest (7,) joint velocity at joint positions ``q`` (7,), rad/s.

        The lowest is never above 0. The FR3's limits depend on the position: next to a stop the arm may move away from
        it but not towards it.
        """
        if self.velocity_offset is None or self.deceleration is None:
            return [-value for value in self.velocity], list(self.velocity)
        lowest, highest = [], []
        for k, position in enumerate(q):
            most, offset, twice = self.velocity[k], self.velocity_offset[k], 2.0 * self.deceleration[k]
            up = sqrt(max(0.0, twice * (self.upper[k] - position))) - offset
            down = sqrt(max(0.0, twice * (position - self.lower[k]))) - offset
            highest.append(min(most, max(0.0, up)))
            lowest.append(-min(most, max(0.0, down)))
        return lowest, highest


_TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
_TORQUE_RATE = (1000.0,) * 7

FR3 = ArmLimits(
    model="fr3",
    lower=(-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508),
    upper=(2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508),
    velocity=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    acceleration=(10.0,) * 7,
    jerk=(5000.0,) * 7,
    torque=_TORQUE,
    torque_rate=_TORQUE_RATE,
    velocity_offset=(0.6599, 0.2517, 0.2000, 0.3533, 0.5757, 0.4878, 0.4628),
    deceleration=(6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0),
)
"""Franka Research 3 with system version 5.9.0 or later."""

FER = ArmLimits(
    model="fer",
    lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity=(2.1750, 2.1750, 2.1750, 2.1750, 2.6100, 2.6100, 2.6100),
    acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
    torque=_TORQUE,
    torque_rate=_TORQUE_RATE,
)
"""Franka Emika Robot: the Panda."""

LIMITS: dict[str, ArmLimits] = {"fr3": FR3, "fer": FER}
"""Limits by model."""
