"""States at a given time, interpolated between the states of a history."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import StaleStateError
from .geometry import Pose, apply_rotation, difference
from .host.memory import History
from .types import GripperState, RobotState, Stamp

Array = NDArray[np.float64]
AnyState = TypeVar("AnyState", RobotState, GripperState)


NEWER = 0.05
"""Time by which a request may be newer than the newest state, which then stands for it, s."""


def robot_at(history: History[RobotState], t: float, name: str) -> RobotState:
    """Return an arm's state at a time: numbers interpolated linearly, everything else from the state before.

    Raises:
        StaleStateError: ``t`` is older than the history, or newer than the newest state by more than 50 ms.
    """
    before, after, share = _neighbours(history, t, name)
    if share == 0.0:
        return before

    def mix_known(a: Array | None, b: Array | None) -> Array | None:
        return None if a is None or b is None else a + share * (b - a)

    def mix(a: Array, b: Array) -> Array:
        return a + share * (b - a)

    return replace(
        before,
        stamp=_stamp(before.stamp, after.stamp, share),
        q=mix(before.q, after.q),
        dq=mix(before.dq, after.dq),
        tau=mix_known(before.tau, after.tau),
        q_set=mix(before.q_set, after.q_set),
        dq_set=mix(before.dq_set, after.dq_set),
        tcp=_pose(before.tcp, after.tcp, share),
        tcp_set=_pose(before.tcp_set, after.tcp_set, share),
        tcp_twist=mix(before.tcp_twist, after.tcp_twist),
        tau_ext=mix_known(before.tau_ext, after.tau_ext),
        wrench_ext=mix_known(before.wrench_ext, after.wrench_ext),
    )


def gripper_at(history: History[GripperState], t: float, name: str) -> GripperState:
    """Return a gripper's state at a time: its width interpolated, everything else from the state before.

    Raises:
        StaleStateError: As for :func:`robot_at`.
    """
    before, after, share = _neighbours(history, t, name)
    if share == 0.0:
        return before
    width = before.width + share * (after.width - before.width)
    return replace(before, stamp=_stamp(before.stamp, after.stamp, share), width=width)


def _neighbours(history: History[AnyState], t: float, name: str) -> tuple[AnyState, AnyState, float]:
    """Return the states before and after ``t``, and the position of ``t`` between them, 0..1."""
    found = history.find_around(t)
    if found is None:
        raise StaleStateError(f"{name}: its state of {t:.3f} s is not known, or not any more")
    before, after = found
    span = after.stamp.t - before.stamp.t
    if span <= 0.0:  # nothing came after it
        if t - before.stamp.t > NEWER:
            raise StaleStateError(f"{name}: its newest state is {t - before.stamp.t:.3f} s older than {t:.3f} s")
        return before, after, 0.0
    return before, after, (t - before.stamp.t) / span


def _stamp(a: Stamp, b: Stamp, share: float) -> Stamp:
    return Stamp(a.t + share * (b.t - a.t), a.t_device + share * (b.t_device - a.t_device), a.seq)


def _pose(a: Pose, b: Pose, share: float) -> Pose:
    twist = difference((*a.position, *a.orientation), (*b.position, *b.orientation))
    turned = apply_rotation(a.orientation.tolist(), [share * value for value in twist[3:]])
    return Pose(a.position + share * (b.position - a.position), turned)
