"""How joints are driven: one gain, one rule, for holding and for following."""

from __future__ import annotations

from collections.abc import Mapping

from .body import Body
from .library import Client

__all__ = ["hold", "position_gain"]

STIFFNESS = 72.0
"""1/s: a position error dies away at this rate. At 240 Hz that is a gain of 0.3 per step. A loaded arm follows best
with it: from 0.5 on, the solver's remaining errors are fed back and grow."""


def position_gain(dt: float) -> float:
    """Share of the position error that a motor takes away in one physics step of ``dt`` seconds."""
    return min(1.0, STIFFNESS * dt)


def hold(client: Client, body: Body, targets: Mapping[int, float], dt: float) -> None:
    """Drive joints to positions (rad or m) and keep them there, within their speed and effort.

    The speed limit stays with each motor: it bounds every later set-point of that joint as well.
    """
    for joint, position in targets.items():
        client.setJointMotorControl2(
            body.id,
            joint,
            client.POSITION_CONTROL,
            targetPosition=position,
            targetVelocity=0.0,
            force=body.efforts[joint],
            positionGain=position_gain(dt),
            velocityGain=1.0,
            maxVelocity=body.speeds[joint],
        )
