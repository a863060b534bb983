"""Commanded motion of the emulated arm, from the Move that starts it to its end, and the limits that it is held to.

Pure: no socket and no clock. A cycle is one millisecond. How exact the real controller is about each limit is not
documented, so the tolerances are assumptions (:class:`Tolerances`).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

from hal.drivers.franka.flags import flag_index
from hal.drivers.franka.limits import ArmLimits

from .protocol import CommandPacket, Controller, Generator, RequestOutcome

# Samples: one millisecond of commanded motion.

DT = 1e-3
"""The control cycle, s."""

Floats = Sequence[float]


class MotionSample(NamedTuple):
    q: Floats
    dq: Floats
    ddq: Floats

    @property
    def moving(self) -> bool:
        return any(self.dq)


def at_rest(q: Floats) -> MotionSample:
    """Return the sample of an arm at rest at ``q`` (7,), rad."""
    return MotionSample(q, (0.0,) * 7, (0.0,) * 7)


def step_position(before: MotionSample, q: Floats) -> MotionSample:
    """Return the sample after ``before`` for a commanded position ``q`` (7,), rad."""
    dq = [(new - old) / DT for new, old in zip(q, before.q, strict=True)]
    ddq = [(new - old) / DT for new, old in zip(dq, before.dq, strict=True)]
    return MotionSample(q, dq, ddq)


def step_velocity(before: MotionSample, dq: Floats) -> MotionSample:
    """Return the sample after ``before`` for a commanded velocity ``dq`` (7,), rad/s."""
    q = [old + new * DT for old, new in zip(before.q, dq, strict=True)]
    ddq = [(new - old) / DT for new, old in zip(dq, before.dq, strict=True)]
    return MotionSample(q, dq, ddq)


def extrapolate(before: MotionSample) -> MotionSample:
    """Return the sample after ``before`` for a lost command: it keeps the acceleration."""
    dq = [v + a * DT for v, a in zip(before.dq, before.ddq, strict=True)]
    q = [p + v * DT for p, v in zip(before.q, dq, strict=True)]
    return MotionSample(q, dq, before.ddq)


def braked(before: MotionSample, deceleration: Floats) -> MotionSample:
    """Return the next sample of an arm that brakes to rest with ``deceleration`` (7,), rad/s2, in every joint."""
    if not before.moving:
        return before if not any(before.ddq) else at_rest(before.q)
    dq = [
        0.0 if abs(v) <= a * DT else v - a * DT if v > 0.0 else v + a * DT
        for v, a in zip(before.dq, deceleration, strict=True)
    ]
    return step_velocity(before, dq)


# Limits.


@dataclass(frozen=True)
class Tolerances:
    """How far a command may exceed each limit. All of them are assumptions."""

    start_pose: float = 1e-2
    """Between the arm's position and the first commanded position, rad."""
    velocity: float = 1e-3
    """rad/s: the margin of the client library's own limiter."""
    acceleration: float = 0.5
    """rad/s2. A state in single precision resolves 2.4e-7 rad near pi, which are 0.24 rad/s2 in second differences."""
    jerk: float = 0.02
    """Share of the limit."""
    torque: float = 1e-3
    """Nm"""
    torque_rate: float = 1.0
    """Nm/s"""


class Violation(NamedTuple):
    """The first limit that a command exceeds."""

    flag: int
    """Index of the error flag that the robot raises."""
    text: str
    """Joint, value and limit."""


_START = flag_index("joint_position_motion_generator_start_pose_invalid")
_POSITION = flag_index("joint_motion_generator_position_limits_violation")
_VELOCITY = flag_index("joint_motion_generator_velocity_limits_violation")
_ACCELERATION = flag_index("joint_motion_generator_velocity_discontinuity")
_JERK = flag_index("joint_motion_generator_acceleration_discontinuity")
_TORQUE = flag_index("tau_j_range_violation")
_TORQUE_RATE = flag_index("controller_torque_discontinuity")
_MEASURED_POSITION = flag_index("joint_position_limits_violation")
_MEASURED_VELOCITY = flag_index("joint_velocity_violation")


class LargestShare:
    """Largest share of one limit, including its tolerance, that was used so far. More than 1 is a violation."""

    __slots__ = ("joint", "limit", "share", "unit", "value")

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.share, self.joint, self.value, self.limit = 0.0, 0, 0.0, 0.0

    def report(self) -> dict[str, object]:
        """Return the share as plain values; joints count from 1."""
        return {
            "share": self.share,
            "joint": self.joint + 1,
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
        }


class LimitChecker:
    """Compares samples and torques with the limits of one model, and records the largest share of each limit.

    Differences over one cycle are backward differences, as in Franka's documentation.
    """

    def __init__(self, limits: ArmLimits, tolerances: Tolerances | None = None) -> None:
        self.limits = limits
        self.tolerances = tolerances or Tolerances()
        self.worst: dict[str, LargestShare] = {}
        self.reset()

    def reset(self) -> None:
        """Reset the statistics."""
        units = {
            "start_pose": "rad",
            "position": "rad",
            "velocity": "rad/s",
            "acceleration": "rad/s2",
            "jerk": "rad/s3",
            "torque": "Nm",
            "torque_rate": "Nm/s",
        }
        self.worst = {name: LargestShare(unit) for name, unit in units.items()}

    def report(self) -> dict[str, dict[str, object]]:
        """Return the largest share of every limit; ``position`` is measured from the middle of the range."""
        return {name: worst.report() for name, worst in self.worst.items()}

    def start(self, q: Floats, q_commanded: Floats) -> Violation | None:
        """Compare the first commanded position with the arm's position, both (7,), rad."""
        allowed = self.tolerances.start_pose
        for k, (measured, commanded) in enumerate(zip(q, q_commanded, strict=True)):
            if self._is_over("start_pose", k, commanded - measured, allowed, 0.0):
                return self._violation(
                    _START, "start_pose", k, "first position is off by", commanded - measured, allowed
                )
        return None

    def joints(self, before: MotionSample, after: MotionSample) -> Violation | None:
        """Check position, velocity, acceleration and jerk of ``after``, in this order."""
        limits, tolerances = self.limits, self.tolerances
        for k, position in enumerate(after.q):
            middle = 0.5 * (limits.lower[k] + limits.upper[k])
            if self._is_over("position", k, position - middle, limits.upper[k] - middle, 0.0):
                bound = limits.lower[k] if position < middle else limits.upper[k]
                return self._violation(_POSITION, "position", k, "position", position, bound)
        lowest, highest = limits.velocity_range(before.q)
        for k, velocity in enumerate(after.dq):
            allowed = highest[k] if velocity > 0.0 else -lowest[k]
            if self._is_over("velocity", k, velocity, allowed, tolerances.velocity):
                return self._violation(_VELOCITY, "velocity", k, "velocity", velocity, allowed)
        for k, acceleration in enumerate(after.ddq):
            allowed = limits.acceleration[k]
            if self._is_over("acceleration", k, acceleration, allowed, tolerances.acceleration):
                return self._violation(_ACCELERATION, "acceleration", k, "acceleration", acceleration, allowed)
        for k, (new, old) in enumerate(zip(after.ddq, before.ddq, strict=True)):
            allowed = limits.jerk[k]
            if self._is_over("jerk", k, (new - old) / DT, allowed, tolerances.jerk * allowed):
                return self._violation(_JERK, "jerk", k, "jerk", (new - old) / DT, allowed)
        return None

    def torques(self, before: Floats, after: Floats) -> Violation | None:
        """Check commanded torques (7,), Nm, and their rate. The documentation only recommends the range."""
        limits, tolerances = self.limits, self.tolerances
        for k, (new, old) in enumerate(zip(after, before, strict=True)):
            if self._is_over("torque", k, new, limits.torque[k], tolerances.torque):
                return self._violation(_TORQUE, "torque", k, "torque", new, limits.torque[k])
            rate = (new - old) / DT
            if self._is_over("torque_rate", k, rate, limits.torque_rate[k], tolerances.torque_rate):
                return self._violation(_TORQUE_RATE, "torque_rate", k, "torque changes by", rate, limits.torque_rate[k])
        return None

    def measured(self, q: Floats, dq: Floats) -> Violation | None:
        """Check position (7,), rad, and speed (7,), rad/s, of an arm under torque control."""
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

    def _is_over(self, name: str, joint: int, value: float, allowed: float, tolerance: float) -> bool:
        share = abs(value) / (allowed + tolerance)
        worst = self.worst[name]
        if share > worst.share:
            worst.share, worst.joint, worst.value, worst.limit = share, joint, value, allowed
        return share > 1.0

    def _violation(self, flag: int, name: str, joint: int, what: str, value: float, limit: float) -> Violation:
        unit = self.worst[name].unit
        return Violation(flag, f"joint {joint + 1}: {what} {value:.6g} {unit}, limit {limit:.6g} {unit}")


# Options of a Move.

_MODES = struct.Struct("<II")
_DEVIATIONS = struct.Struct("<6d")
_ASYNCHRONOUS = _MODES.size + _DEVIATIONS.size
"""Size of a Move in protocol 5; in protocol 10 more fields follow."""


class MoveOptions(NamedTuple):
    """Kind of motion that a Move requests."""

    controller: Controller
    generator: Generator

    def describe(self) -> str:
        """Return a short description."""
        if self.generator is Generator.NONE:
            return "torques"
        return f"{self.generator.name}, {self.controller.name}".lower().replace("_", " ")


def read_move(payload: bytes) -> MoveOptions:
    """Decode the payload of a Move. Raises ValueError if it is invalid."""
    controller_number, generator_number = _MODES.unpack_from(payload)
    controller, generator = Controller(controller_number), Generator(generator_number)
    if not all(isfinite(value) for value in _DEVIATIONS.unpack_from(payload, _MODES.size)):
        raise ValueError("a deviation is not finite")
    if generator is Generator.NONE and controller is not Controller.EXTERNAL:
        raise ValueError("neither positions nor torques")
    if any(payload[_ASYNCHRONOUS : _ASYNCHRONOUS + 1]):
        raise ValueError("asynchronous motions are not emulated")
    return MoveOptions(controller, generator)


# The motion.

LOST_LIMIT = 20
"""Consecutive lost commands that end a motion."""
_RATED = 100
"""Cycles that the success rate covers."""
_COMMUNICATION = flag_index("communication_constraints_violation")


class Ending(NamedTuple):
    """Reason for the end of a motion."""

    outcome: RequestOutcome
    text: str
    flag: int | None = None
    """Error flag that it raises."""


class EmulatedMotion:
    """A running motion. Until its first command the robot waits, and no command counts as lost (an assumption)."""

    def __init__(
        self, request: int, options: MoveOptions, start: MotionSample, begun_at: int, checker: LimitChecker
    ) -> None:
        self.request = request
        """Number of the Move, which gets a second answer at the end."""
        self.begun_at = begun_at
        """message_id of the last state before it."""
        self.options = options
        self.external = options.controller is Controller.EXTERNAL
        self.sample = start
        """Present command."""
        self.torques: Floats = (0.0,) * 7
        self.waiting = True
        self.states_shown = 0
        """States sent since it began."""
        self.lost_in_row = 0
        self.commands = 0
        self._checker = checker
        self._in_time = deque([1] * _RATED, _RATED)
        self._successes = _RATED

    @property
    def success_rate(self) -> float:
        """Share of the last 100 cycles whose command arrived in time; 0 before the first."""
        return 0.0 if self.waiting else self._successes / _RATED

    def step(self, command: CommandPacket | None, q: Floats) -> Ending | None:
        """Advance one cycle, with the arm at ``q`` (7,), rad; return the ending once the motion ends."""
        if command is not None:
            return self._apply(command, q)
        return None if self.waiting else self._miss()

    def _apply(self, command: CommandPacket, q: Floats) -> Ending | None:
        self._count(1)
        self.lost_in_row = 0
        self.commands += 1
        if command.finished:
            return Ending(RequestOutcome.SUCCESS, "finished")
        if not isfinite(sum(command.q) + sum(command.dq) + sum(command.tau)):
            return Ending(RequestOutcome.INPUT_ERROR, "a command with a number that is not finite")
        violation = self._generate(command, q)
        if violation is None and self.external:
            violation = self._checker.torques(self.torques, command.tau)
            self.torques = command.tau
        self.waiting = False
        return _reflex(violation)

    def _generate(self, command: CommandPacket, q: Floats) -> Violation | None:
        generator = self.options.generator
        if generator is Generator.NONE:
            return None
        if generator is Generator.JOINT_POSITION:
            if self.waiting:
                violation = self._checker.start(q, command.q)
                if violation is not None:
                    return violation
            sample = step_position(self.sample, command.q)
        else:
            sample = step_velocity(self.sample, command.dq)
        violation = self._checker.joints(self.sample, sample)
        if violation is None:
            self.sample = sample
        return violation

    def _miss(self) -> Ending | None:
        self._count(0)
        self.lost_in_row += 1
        if self.lost_in_row >= LOST_LIMIT:
            text = f"{self.lost_in_row} commands in a row were lost"
            return Ending(RequestOutcome.REFLEX, text, _COMMUNICATION)
        if self.options.generator is not Generator.NONE:
            self.sample = extrapolate(self.sample)
        return None

    def _count(self, success: int) -> None:
        self._successes += success - self._in_time[0]
        self._in_time.append(success)


def _reflex(violation: Violation | None) -> Ending | None:
    return None if violation is None else Ending(RequestOutcome.REFLEX, violation.text, violation.flag)
