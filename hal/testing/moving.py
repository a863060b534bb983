"""What a servo does with an arm, for the checks: cycles, smooth set-points, torques."""

from __future__ import annotations

import numpy as np

from ..driver import Reading, Setpoint
from .benches import RobotBench

__all__ = ["MIDDLE", "RISE", "STEEPEST", "STILL", "cycles", "drive", "ramp", "settle"]

RISE, SECONDS = 0.2, 0.5
"""How far the checks move a joint, rad, and how long that takes, s."""
STEEPEST = 1.875 * RISE / SECONDS
"""Speed in the middle of that, rad/s."""
MIDDLE = 0.1
"""How much the speed in the middle may differ from it."""
STILL = 2e-3
"""rad; an arm that nobody moves may settle by this."""
_SETTLING = 0.05
"""s in which an arm that lags a little comes to where its last set-point says."""


def cycles(bench: RobotBench, count: int) -> list[Reading]:
    """What the driver reads in so many cycles, without a new set-point."""
    return [bench.driver.read(bench.pass_time()) for _ in range(count)]


def ramp(bench: RobotBench, rise: float) -> list[Reading]:
    """Raise one joint by ``rise`` rad along a smooth curve, as a servo would: from rest to rest within half a second.

    It begins where the device says that its set-point is, as every control session does.
    """
    first = bench.driver.read(bench.pass_time())
    start = np.array(first.q if first.q_commanded is None else first.q_commanded)
    readings = []
    steps = round(SECONDS / bench.dt)
    for k in range(1, steps + 1):
        s = k / steps
        q, dq, ddq = start.copy(), np.zeros_like(start), np.zeros_like(start)
        q[bench.joint] += rise * s**3 * (10 - 15 * s + 6 * s**2)
        dq[bench.joint] = rise * 30 * s**2 * (1 - s) ** 2 / SECONDS
        ddq[bench.joint] = rise * 60 * s * (1 - 3 * s + 2 * s**2) / SECONDS**2
        bench.driver.write(Setpoint(tuple(q.tolist()), tuple(dq.tolist()), tuple(ddq.tolist())))
        readings += cycles(bench, 1)
    return readings


def settle(bench: RobotBench) -> Reading:
    """Let an arm come to rest that was told to hold; its last reading."""
    return cycles(bench, round(_SETTLING / bench.dt) + 1)[-1]


def drive(bench: RobotBench, joint: int, tau: float, seconds: float) -> list[Reading]:
    """One torque, and none on the other joints, with set-points that say what was measured, as a servo's do."""
    readings = cycles(bench, 1)
    still = (0.0,) * len(readings[0].q)
    for _ in bench.turns(seconds):
        torques = tuple(tau if k == joint else 0.0 for k in range(len(still)))
        bench.driver.write(Setpoint(readings[-1].q, readings[-1].dq, still, torques))
        readings += cycles(bench, 1)
    return readings
