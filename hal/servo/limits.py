"""Jerk-limited stopping of one joint: how far, how fast at most, and where it ends. Plain floats, no state.

``v`` is a speed in rad/s, ``a`` an acceleration in rad/s2, ``A`` and ``J`` the limits of acceleration and jerk
(rad/s2, rad/s3, both > 0). "Stop" always means the time-optimal stop: jerk J until the braking reaches A (or until it
is time to release it), constant braking A, jerk J until rest. Every formula follows from integrating that profile, and
the tests compare each with Ruckig, which computes the same profiles numerically.
"""

from __future__ import annotations

from math import sqrt

__all__ = ["speed_for", "stop_displacement", "stop_distance", "stop_peak", "stop_phases", "stop_step"]


def stop_distance(v: float, A: float, J: float) -> float:
    """Distance (rad) of a stop from speed ``v >= 0`` and no acceleration.

    The profile is symmetric in time, so the distance is the mean speed v/2 times its duration: 2 sqrt(v/J) when the
    braking never reaches A (v J <= A^2), else v/A + A/J.
    """
    if v * J <= A * A:
        return v * sqrt(v / J)
    return 0.5 * v * (v / A + A / J)


def speed_for(d: float, A: float, J: float) -> float:
    """Greatest speed (rad/s), with no acceleration, that can still stop within ``d`` rad: inverts `stop_distance`."""
    if d <= 0.0:
        return 0.0
    if d * J * J <= A * A * A:
        return float((d * d * J) ** (1.0 / 3.0))
    c = 0.5 * A * A / J
    return sqrt(c * c + 2.0 * A * d) - c


def stop_displacement(v: float, a: float, A: float, J: float) -> float:
    """Where a stop from speed ``v`` and acceleration ``a`` ends, relative to where it begins, rad.

    Releasing ``a`` at jerk J leaves the speed s = v + a |a| / (2 J); its sign tells which way the stop must brake. For
    s > 0 the profile is part of the one that brakes from v1 = v + a^2 / (2 J) with no acceleration: that began t = a/J
    from now (in the past when a < 0) and t (v + a t / 3) away. For s < 0 the same holds mirrored.
    """
    if v + 0.5 * a * abs(a) / J < 0.0:
        return -stop_displacement(-v, -a, A, J)
    t = a / J
    return t * (v + a * t / 3.0) + stop_distance(max(0.0, v + 0.5 * a * t), A, J)


def stop_peak(v: float, a: float, A: float, J: float) -> float:
    """How far in the positive direction (>= 0, rad) a stop from speed ``v`` and acceleration ``a`` gets at most.

    Mirror with (-v, -a) for the negative direction. A joint that is braked harder than its speed needs
    (s = v + a |a| / (2 J) < 0) turns back while it releases the brake, at the first root of v + a s + J s^2 / 2 = 0.
    """
    if v <= 0.0 and a <= 0.0:
        return 0.0
    if a < 0.0 and v * J < 0.5 * a * a:
        s = (-a - sqrt(a * a - 2.0 * J * v)) / J
        return s * (v + s * (0.5 * a + s * J / 6.0))
    if v + 0.5 * a * abs(a) / J <= 0.0:  # a > 0, and the joint goes on backwards all the same
        return 0.0
    return max(0.0, stop_displacement(v, a, A, J))


def stop_phases(v: float, a: float, A: float, J: float) -> tuple[float, float, float, float]:
    """Jerk of the first phase of the stop from speed ``v`` and acceleration ``a``, and when each of its phases ends.

    Returns:
        The first phase's jerk, rad/s3 (the second phase has none, the third the opposite one), and the times after
        which the first, the second and the third phase are over, s.
    """
    jerk = -J
    if v + 0.5 * a * abs(a) / J < 0.0:
        v, a, jerk = -v, -a, J
    build, constant, release = _phases(v, a, A, J)
    return jerk, build, build + constant, build + constant + release


def stop_step(q: float, v: float, a: float, A: float, J: float, dt: float) -> tuple[float, float, float]:
    """Position, speed and acceleration ``dt`` seconds into the stop from (q, v, a); |a| <= A.

    What Ruckig's velocity interface with target 0 answers, by hand: the servo falls back on it should Ruckig refuse.
    """
    if v + 0.5 * a * abs(a) / J < 0.0:
        q, v, a = stop_step(-q, -v, -a, A, J, dt)
        return -q, -v, -a
    build, constant, release = _phases(v, a, A, J)
    for jerk, duration in ((-J, build), (0.0, constant), (J, release)):
        step = min(dt, duration)
        q += step * (v + step * (0.5 * a + step * jerk / 6.0))
        v += step * (a + 0.5 * step * jerk)
        a += step * jerk
        dt -= step
        if dt <= 0.0:
            return q, v, a
    return q, 0.0, 0.0


def _phases(v: float, a: float, A: float, J: float) -> tuple[float, float, float]:
    """Durations (s) of the three phases of a stop that brakes against the positive direction."""
    brake = min(A, sqrt(max(0.0, v * J + 0.5 * a * a)))
    brake = max(brake, -a)
    release = brake / J
    # What the two ramps do not take away is braked at the constant rate; rounding must not make that time negative.
    constant = max(0.0, (v + 0.5 * a * a / J) / brake - release) if brake > 0.0 else 0.0
    return (a + brake) / J, constant, release
