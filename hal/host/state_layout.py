"""How an arm's state lies in memory: a stamp, one run of doubles, then what the servo and a fault say.

A reader takes only what it needs: the servo's part for every ``send``, or the whole state, whose arrays are read-only
views of the record's own bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import isnan, nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..driver import Reading
from ..geometry import Pose
from ..types import Limited, RobotState, RobotStatus, Stamp, Trip
from . import fault_layout

__all__ = ["ServoRecord", "StateLayout"]

_STAMP = struct.Struct("<ddQ")
_SERVO = struct.Struct("<iiiQQ?Qdd")
_STATUSES = {int(status): status for status in RobotStatus}
_TRIPS = {int(trip): trip for trip in Trip}


class ServoRecord(NamedTuple):
    """What the servo adds to a reading."""

    status: RobotStatus
    trip: Trip
    limited: Limited
    target_seq: int
    session: int
    arrived: bool
    refused: int
    """Number of the newest command that the servo refused, 0 for none."""
    t_written: float
    """When the set-point was handed to the driver, s."""
    t_stop: float
    """When the last braking began, s."""
    q_set: Sequence[float]
    dq_set: Sequence[float]


class StateLayout:
    """The record of an arm with ``n`` joints.

    The doubles, in this order: q, dq, tau, q_set, dq_set (n each); tcp, tcp_set (7 each), tcp_twist (6); tau_ext (n),
    wrench_ext (6).
    """

    def __init__(self, n: int) -> None:
        self.n = n
        self._count = 6 * n + 26
        self._servo_at = _STAMP.size + 8 * self._count
        self._set_at = _STAMP.size + 8 * 3 * n
        self._set_points = struct.Struct(f"<{2 * n}d")
        self._nothing = (nan,) * n

    @property
    def format(self) -> str:
        """Of the whole record, for :mod:`struct`."""
        parts = (_STAMP.format, f"{self._count}d", _SERVO.format, fault_layout.FORMAT)
        return "".join(part.removeprefix("<") for part in parts)

    def values(
        self,
        reading: Reading,
        servo: ServoRecord,
        tcp: Sequence[float],
        tcp_set: Sequence[float],
        twist: Sequence[float],
    ) -> tuple[Any, ...]:
        """What a record holds: a reading, what the servo adds to it, and what kinematics makes of both."""
        nothing = self._nothing
        return (
            *reading[:3],  # t, t_device, seq
            *reading.q,
            *reading.dq,
            *(reading.tau or nothing),
            *servo.q_set,
            *servo.dq_set,
            *tcp,
            *tcp_set,
            *twist,
            *(reading.tau_ext or nothing),
            *(reading.wrench_ext or (nan,) * 6),
            *servo[:9],  # all but the set-points
            *fault_layout.fault_values(reading.fault),
        )

    def servo(self, record: bytes) -> ServoRecord:
        """What the servo says in a record."""
        status, trip, limited, *rest = _SERVO.unpack_from(record, self._servo_at)
        sets = self._set_points.unpack_from(record, self._set_at)
        n = self.n
        return ServoRecord._make((_STATUSES[status], _TRIPS[trip], _limited(limited), *rest, sets[:n], sets[n:]))

    def state(self, record: bytes) -> RobotState:
        """The whole of a record."""
        n, end = self.n, self._servo_at
        numbers: NDArray[np.float64] = np.frombuffer(record, "<f8", self._count, _STAMP.size)
        status, trip, limited, target_seq, *_ = _SERVO.unpack_from(record, end)
        tau = numbers[2 * n : 3 * n]
        rest = numbers[5 * n :]
        tau_ext, wrench_ext = rest[20 : 20 + n], rest[20 + n :]
        return RobotState(
            stamp=Stamp(*_STAMP.unpack_from(record, 0)),
            q=numbers[:n],
            dq=numbers[n : 2 * n],
            tau=_known(tau),
            q_set=numbers[3 * n : 4 * n],
            dq_set=numbers[4 * n : 5 * n],
            tcp=Pose.trusted(rest[:3], rest[3:7]),
            tcp_set=Pose.trusted(rest[7:10], rest[10:14]),
            tcp_twist=rest[14:20],
            tau_ext=_known(tau_ext),
            wrench_ext=_known(wrench_ext),
            status=_STATUSES[status],
            trip=_TRIPS[trip],
            fault=fault_layout.fault_at(record, end + _SERVO.size),
            limited=_limited(limited),
            target_seq=target_seq,
        )


def _limited(bits: int) -> Limited:
    return Limited(bits) if bits else Limited.NONE


def _known(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return None if isnan(values[0]) else values
