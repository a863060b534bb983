"""Random target streams through the servo: limits, times to reach held targets, and overshoot.

Each stream has its own servo rate, command rate (10-1000 Hz), limits (acceleration x 0.1-1, jerk x 0.02-1), start
(inside, at or beyond a limit) and a mixture of smooth motion, jumps (past the limits too), reversals, broken commands
and silence, and ends with a target that is held. Only the positions that a driver would receive are judged. The
reference for the time to reach the held target is Ruckig's time-optimal motion from the same state under the same
limits; overshoot is what lies beyond everything that this reference passes. Both are measured from the first command
with that target; after a stream of positions without velocities, where it is not yet known that it will be held,
from the second.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, field

from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from hal.commands import NO_INBOX, CommandRecord, Inbox, Kind, Session
from hal.driver import Reading
from hal.servo.audit import SetpointAudit
from hal.servo.servo import Servo
from hal.specs import KinematicsSpec, LimitsSpec, RobotSpec

from .kit import Table, median

PATHS = ("hal/servo/smoothing.py", "hal/servo/joint.py", "hal/servo/servo.py")

N = 7
PANDA = LimitsSpec(
    lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
)
NEAR = 1e-3
"""A joint this near to its target has reached it, rad."""


class NoKinematics:
    """Joint streams with an unlimited tcp speed need none; any use beyond the servo's making is an error."""

    def reach(self) -> tuple[float, ...]:
        """Return no lever arms."""
        return (0.0,) * N


@dataclass
class Result:
    """Result of one stream."""

    peaks: dict[str, float]
    travel: float
    """Sum of the joints' paths, rad."""
    ratio: float
    """Time until every joint had reached the held target, over the time-optimal time."""
    overshoot: float
    """rad"""
    trips: int
    ticks: int
    description: str = field(default="")


def robot_spec(limits: LimitsSpec, rate_hz: float) -> RobotSpec:
    """Return a spec with these limits and without a model."""
    home = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
    identity = (0.0, 0.0, 0.0, 1.0)
    names = tuple(f"joint{i}" for i in range(N))
    kinematics = KinematicsSpec("", names, limits.lower, limits.upper, home, None, "", (0.0, 0.0, 0.0), identity)
    return RobotSpec(
        "arm", "none", "none", rate_hz, "", names, home, home, limits, kinematics, (0.0, 0.0, 0.0), identity
    )


class Stream:
    """One random stream; deterministic in its seed."""

    def __init__(self, seed: int) -> None:
        self.random = rng = random.Random(seed)
        self.rate_hz = rng.choice((240.0, 500.0, 1000.0))
        self.dt = 1.0 / self.rate_hz
        self.command_hz = 10.0 ** rng.uniform(1.0, 3.0)
        accelerations, jerks = rng.uniform(0.1, 1.0), 10.0 ** rng.uniform(math.log10(0.02), 0.0)
        self.limits = LimitsSpec(
            PANDA.lower,
            PANDA.upper,
            PANDA.velocity,
            tuple(accelerations * a for a in PANDA.acceleration),
            tuple(jerks * j for j in PANDA.jerk),
        )
        self.speed = rng.choice((0.1, 0.3, 1.0))
        self.description = (
            f"seed {seed}: servo {self.rate_hz:.0f} Hz, commands {self.command_hz:.0f} Hz, "
            f"A x {accelerations:.2f}, J x {jerks:.3f}, speed {self.speed}"
        )
        self.servo = Servo(robot_spec(self.limits, self.rate_hz), self.dt, NoKinematics())  # type: ignore[arg-type]
        self.audit = SetpointAudit(self.limits, self.dt)
        self.now = 100.0
        self.seq = 0
        self.rearms = 0
        self.trips = 0
        self.ticks = 0
        self.travel = 0.0
        self.command: CommandRecord | None = None
        self.bare = False
        """Whether the last command was one of a stream of positions without velocities."""
        start = [rng.uniform(low, high) for low, high in zip(PANDA.lower, PANDA.upper, strict=True)]
        if rng.random() < 0.3:  # at a limit, or outside
            i = rng.randrange(N)
            start[i] = PANDA.upper[i] + rng.choice((0.0, rng.uniform(0.0, 0.05)))
        self.start = start
        self.q = list(start)
        self.servo.anchor(start)
        self.servo.open_session(Session(1, self.speed, 1e9, False), NO_INBOX)

    def send(self, q: list[float], dq: list[float]) -> None:
        """Send a joint target as an app would."""
        before = self.command.values if self.command is not None else None
        self.bare = before is not None and (*q, *dq) != before and not any(dq) and not any(before[N:])
        self.seq += 1
        deadline = self.now + max(0.1, 2.5 / self.command_hz)
        self.command = CommandRecord(self.seq, 1, self.now, deadline, Kind.JOINT_TARGET, (*q, *dq))

    def tick(self) -> list[float]:
        """Run one tick of the servo."""
        self.now += self.dt
        self.ticks += 1
        reading = Reading(self.now, self.now, self.ticks, self.q, [0.0] * N)
        setpoint = self.servo.tick(self.now, reading, Inbox(self.command, None, 0, self.rearms, self.now))
        assert setpoint is not None
        q = list(setpoint.q)
        self.audit.add(q)
        self.travel += sum(abs(a - b) for a, b in zip(q, self.q, strict=True))
        self.q = q
        return q

    def wander(self, seconds: float) -> None:
        """Send random commands of every kind."""
        rng = self.random
        target, velocity = list(self.q), [0.0] * N
        next_command = self.now
        until = self.now + seconds
        mode, mode_until = "smooth", self.now
        phase = [rng.uniform(0.0, 6.3) for _ in range(N)]
        while self.now < until:
            if self.servo.report.trip and not any(self.servo.report.dq_set):
                self.trips += 1
                self.rearms += 1
                target, velocity, mode, mode_until = list(self.q), [0.0] * N, "smooth", self.now + 0.3
            if self.now >= mode_until:
                mode = rng.choice(("smooth", "smooth", "hold", "jumps", "broken", "silence", "positions"))
                mode_until = self.now + rng.uniform(0.1, 1.0)
                frequency = 10.0 ** rng.uniform(-1.0, 0.5)
                amplitude = rng.uniform(0.1, 1.0)
            if self.now >= next_command:
                period = 1.0 / self.command_hz
                next_command = max(next_command + period * rng.uniform(0.8, 1.2), self.now)
                if mode in ("smooth", "positions"):
                    velocity = [
                        amplitude * v * math.sin(frequency * self.now + p)
                        for v, p in zip(PANDA.velocity, phase, strict=True)
                    ]
                    target = [x + v * period for x, v in zip(target, velocity, strict=True)]
                    self.send(target, velocity if mode == "smooth" else [0.0] * N)
                elif mode == "hold":
                    self.send(target, [0.0] * N)
                elif mode == "jumps":
                    if rng.random() < 0.2:
                        i = rng.randrange(N)
                        target[i] = rng.uniform(PANDA.lower[i] - 0.5, PANDA.upper[i] + 0.5)
                    self.send(target, [rng.uniform(-3.0, 3.0) * rng.choice((0.0, 1.0)) for _ in range(N)])
                elif mode == "broken":
                    self.send([rng.choice((x, math.nan, math.inf, 1e300)) for x in target], [0.0] * N)
            self.tick()

    def hold(self) -> tuple[float, float]:
        """Hold a last target; return the ratio of its time to the optimum, and the overshoot."""
        rng = self.random
        report = self.servo.report
        while report.status.name == "FOLLOWING" and report.refused == self.seq and not report.trip:
            self.tick()  # the last act was broken: it is late soon, perhaps in the tick of the next command
            report = self.servo.report
        while self.servo.report.trip:  # the last act was silence: rearm
            self.tick()
            if not any(self.servo.report.dq_set):
                self.rearms += 1
        reach = rng.choice((0.02, 0.09, 0.5, 3.0 * self.speed))
        if report.status.name != "FOLLOWING":
            reach = 0.09  # a first target must be near
        goal = [
            max(low, min(high, x + rng.uniform(-reach, reach)))
            for x, low, high in zip(self.q, PANDA.lower, PANDA.upper, strict=True)
        ]
        if self.bare:
            self.send(goal, [0.0] * N)
            for _ in range(round(self.rate_hz / self.command_hz)):
                self.tick()
        optimum, low, high = self._reference(goal)
        begun = self.now
        reached = begun
        next_command = begun
        overshoot = 0.0
        while self.now < begun + 1.3 * optimum + 0.2:
            if self.now >= next_command:
                self.send(goal, [0.0] * N)
                next_command = self.now + 1.0 / self.command_hz
            q = self.tick()
            if any(abs(a - b) > NEAR for a, b in zip(q, goal, strict=True)):
                reached = self.now
            for x, a, b in zip(q, low, high, strict=True):
                overshoot = max(overshoot, x - b, a - x)
        return (reached - begun) / max(optimum, self.dt), overshoot

    def _reference(self, goal: list[float]) -> tuple[float, list[float], list[float]]:
        """Return the time-optimal time to within NEAR of the goal, and the range that each joint passes."""
        report = self.servo.report
        inputs = InputParameter(N)
        inputs.current_position, inputs.current_velocity = report.q_set, report.dq_set
        inputs.current_acceleration = report.ddq_set
        inputs.target_position = goal
        inputs.max_velocity = [self.speed * v for v in self.limits.velocity]
        inputs.max_acceleration, inputs.max_jerk = list(self.limits.acceleration), list(self.limits.jerk)
        inputs.synchronization = Synchronization.No
        trajectory = Trajectory(N)
        Ruckig(N, self.dt).calculate(inputs, trajectory)
        optimum = 0.0
        path = [list(report.q_set), goal]
        steps = 1000
        for k in range(steps + 1):
            t = trajectory.duration * k / steps
            q = trajectory.at_time(t)[0]
            path.append(q)
            if any(abs(x - g) > NEAR for x, g in zip(q, goal, strict=True)):
                optimum = t
        joints = list(zip(*path, strict=True))
        return optimum, [min(joint) for joint in joints], [max(joint) for joint in joints]


def run_stream(seed: int) -> Result:
    """Run one stream from its start to the end of its held target."""
    stream = Stream(seed)
    stream.wander(stream.random.uniform(0.5, 2.0))
    ratio, overshoot = stream.hold()
    peaks = stream.audit.peaks()
    # An arm that starts outside may come back in, and no more.
    start = SetpointAudit(PANDA, stream.dt)
    start.add(stream.start)
    peaks["position"] /= max(1.0, start.peaks()["position"])
    return Result(peaks, stream.travel, ratio, overshoot, stream.trips, stream.ticks, stream.description)


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    results = [run_stream(seed) for seed in range(10 if quick else 10_000)]
    trips, ticks = sum(each.trips for each in results), sum(each.ticks for each in results)
    table = Table(
        f"{len(results)} streams, {ticks} set-points, {trips} trips", ("", "peak, of the limit", "streams over")
    )
    for name in ("position", "velocity", "acceleration", "jerk"):
        values = [each.peaks[name] for each in results]
        table.add(name, f"{max(values):.9f}", sum(value > 1.0 for value in values))
    yield table
    table = Table("held targets", ("", "median", "p99", "worst", "its stream", "over", "allowed"))
    for name, key, factor, allowed in (
        ("time / time-optimal", "ratio", 1.0, 1.2),
        ("overshoot, mrad", "overshoot", 1e3, 1.0),
    ):
        found = sorted((factor * getattr(each, key), each.description) for each in results)
        values = [value for value, _ in found]
        p99, over = values[int(0.99 * len(values))], sum(value > allowed for value in values)
        table.add(name, median(values), p99, *found[-1], over, allowed)
    yield table
