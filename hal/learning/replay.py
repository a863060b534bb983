"""A recorded episode once more: through the servo, under the same limits and the same dead-man as a person."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..commands import JointChunk
from ..control import Control
from ..errors import CommandError, DatasetError
from ..geometry import Pose
from ..types import Limited, RobotStatus
from .policy import follows

if TYPE_CHECKING:
    from ..deadman import Deadman
    from ..recording import Episode
    from ..rig import Rig
    from ..robot import Robot

__all__ = [
    "Deviation",
    "Player",
    "RecordedTrajectory",
    "arms_of",
    "moved_besides",
]

# [course.py] What one arm did in a recorded episode, ready to be done again, and whether this rig's arm may do
# it.

Array = NDArray[np.float64]

_ROUNDED = 1e-5
"""rad; recordings hold positions as 32-bit numbers."""
_SPEED_ROOM = 1.02
"""Speeds are differences of rounded positions."""
_SPANS = (0.1, 1.0)
"""s over which a speed is measured: in a burst, and for long."""
_JITTER = 0.010
"""s by which the stamps of rows may be off: a tick of the servo that came late is followed by one that came in time, so
between two neighbours a set-point seems faster than it was."""
_MOVED = 0.01
"""rad, or m of a gripper; less is an arm that stood still."""
_OBJECT = "observation.object."


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTrajectory:
    """Rows of an episode, ``k`` of them, of one arm with ``n`` joints."""

    joints: tuple[str, ...]
    model: str
    """The arm's model; empty where the recording does not say."""
    t: Array
    """(k,) s since the first row, increasing."""
    q_set: Array
    """(k, n) set-points, rad."""
    q: Array
    """(k, n) measured, rad."""
    tcp: Array
    """(k, 3) measured, in the base frame, m."""
    width: Array | None
    """(k,) what the gripper was told, m; None without one."""
    objects: Mapping[str, Pose]
    """Where things lay in the first row, in the world; simulation only."""

    @classmethod
    def of(cls, episode: Episode, robot: Robot) -> RecordedTrajectory:
        """That of ``robot``, or of the only arm in the recording. CommandError for an episode without such an arm."""
        places, names = episode.names("observation.tcp"), episode.names("observation.setpoint")
        several = "x" not in places  # then the arm's name leads every other name
        lead = f"{robot.name}." if several else ""
        if f"{lead}x" not in places:
            arms = dict.fromkeys(name.partition(".")[0] for name in places)
            raise CommandError(f"the episode has no arm {robot.name!r}; it has: {', '.join(arms)}")
        own = [k for k, name in enumerate(names) if name.startswith(lead)]
        labels = [names[k].removeprefix(lead) for k in own]
        hand = "gripper" in labels
        joints = labels[:-1] if hand else labels
        n, first = len(joints), places.index(f"{lead}x")

        clocks = [key for key in episode.stamps if key.startswith("robot.")]
        if not clocks or episode.names("observation.state") != names:
            raise DatasetError("does not have the columns of an arm", file="meta/info.json")
        key = f"robot.{robot.name}" if several else clocks[0]
        stamps = episode.stamps[key]
        t = stamps - stamps[0]
        later = np.append(True, np.diff(np.maximum.accumulate(t)) > 0.0)

        def rows(column: str, which: Any) -> Array:
            values: Array = np.asarray(episode.columns[f"observation.{column}"], float)[later][:, which]
            return values

        setpoint = rows("setpoint", own)
        return cls(
            joints=tuple(joints),
            model=_model(episode.info, key.removeprefix("robot.")),
            t=t[later],
            q_set=setpoint[:, :n],
            q=rows("state", own)[:, :n],
            tcp=rows("tcp", slice(first, first + 3)),
            width=setpoint[:, n] if hand else None,
            objects=_objects(episode.columns),
        )

    @property
    def duration(self) -> float:
        """s"""
        return float(self.t[-1])

    def check(self, robot: Robot, speed: float) -> None:
        """Raise CommandError, which says everything that is in the way, where ``robot`` cannot do it at ``speed``."""
        if not 0.0 < speed <= 1.0:
            raise CommandError(f"speed must be above 0 and at most 1, not {speed:g}")
        problems = self._other_arm(robot)
        if not problems:
            problems = self._broken() or [*self._outside(robot), *self._too_fast(robot, speed)]
        if problems:
            raise CommandError(f"{robot.name} cannot replay this: " + "; ".join(problems))

    def _other_arm(self, robot: Robot) -> list[str]:
        if self.model and self.model != robot.spec.model:
            return [f"it was recorded with the model {self.model}, and this arm is a {robot.spec.model}"]
        if self.joints != robot.joints:
            return [f"it was recorded with the joints {', '.join(self.joints)}; this arm has {', '.join(robot.joints)}"]
        if self.width is not None and robot.gripper is None:
            return ["it was recorded with a gripper, and this arm has none"]
        return []

    def _broken(self) -> list[str]:
        if len(self.t) < 2:
            return [f"it has {len(self.t)} row(s); there is nothing to replay"]
        if not np.isfinite(self.q_set).all():
            row = int(np.flatnonzero(~np.isfinite(self.q_set).all(axis=1))[0])
            return [f"its set-point at {self.t[row]:.3f} s is not a number"]
        return []

    def _outside(self, robot: Robot) -> list[str]:
        limits, found = robot.limits, []
        for name, values, low, high in zip(self.joints, self.q_set.T, limits.lower, limits.upper, strict=True):
            if values.min() < low - _ROUNDED or values.max() > high + _ROUNDED:
                span = f"{values.min():.3f}..{values.max():.3f} rad"
                found.append(f"{name} goes through {span}, and its limits here are {low:g}..{high:g}")
        return found

    def _too_fast(self, robot: Robot, speed: float) -> list[str]:
        """The servo would hold it back, and the arm would not be where it was."""
        most = robot.spec.speed * np.asarray(robot.limits.velocity)
        share, row, worst = max(self._fastest(span, most) for span in _SPANS)
        if share * speed <= _SPEED_ROOM:
            return []
        return [
            f"{self.joints[worst]} moves at {speed * share * most[worst]:.3f} rad/s at {self.t[row]:.2f} s, and may at "
            f"{most[worst]:.3f} here: at speed {np.floor(100.0 / share) / 100.0:g} it could"
        ]

    def _fastest(self, span: float, most: Array) -> tuple[float, int, int]:
        """The highest mean speed over ``span`` s, as a share of ``most``; the row in which it begins, and the joint."""
        last = len(self.t) - 1
        ends = np.minimum(np.searchsorted(self.t, self.t + span - _ROUNDED), last)
        starts = np.flatnonzero(np.append(True, ends[:-1] < last))  # one of the spans that reach the end will do
        ends = ends[starts]
        took = self.t[ends] - self.t[starts] + _JITTER
        shares = np.abs(self.q_set[ends] - self.q_set[starts]) / took[:, None] / most
        row, joint = np.unravel_index(int(shares.argmax()), shares.shape)
        return float(shares[row, joint]), int(starts[row]), int(joint)

    # At a time.

    def at(self, values: Array, s: float) -> Array:
        """Rows of one of the arrays above, at ``s`` in between, s since the first row."""
        k = min(max(int(np.searchsorted(self.t, s, side="right")), 1), len(self.t) - 1)
        share = min(max((s - self.t[k - 1]) / (self.t[k] - self.t[k - 1]), 0.0), 1.0)
        mixed: Array = values[k - 1] + share * (values[k] - values[k - 1])
        return mixed

    def width_at(self, s: float) -> float | None:
        """What the gripper had been told last, m; None without one."""
        if self.width is None:
            return None
        value = float(self.width[max(0, int(np.searchsorted(self.t, s, side="right")) - 1)])
        return value if np.isfinite(value) else None


def arms_of(episode: Episode) -> list[str]:
    """Names of the arms in the recording."""
    return [key.removeprefix("robot.") for key in episode.stamps if key.startswith("robot.")]


def moved_besides(episode: Episode, name: str) -> list[str]:
    """The other arms of the recording that did more than stand still: the replay of one arm leaves them out."""
    arms, names = arms_of(episode), episode.names("observation.setpoint")
    setpoint = np.asarray(episode.columns["observation.setpoint"], float)
    found = []
    for arm in arms if len(arms) > 1 else ():
        own = setpoint[:, [k for k, label in enumerate(names) if label.startswith(f"{arm}.")]]
        if arm != name and (np.nanmax(own, axis=0) - np.nanmin(own, axis=0) > _MOVED).any():
            found.append(arm)
    return found


def _model(info: Mapping[str, Any], name: str) -> str:
    robots = info.get("rig", {}).get("resolved", {}).get("robots", ())
    return next((str(robot["model"]) for robot in robots if robot["name"] == name), "")


def _objects(columns: Mapping[str, NDArray[Any]]) -> dict[str, Pose]:
    first = {key.removeprefix(_OBJECT): rows[0] for key, rows in columns.items() if key.startswith(_OBJECT)}
    return {name: Pose(row[:3], row[3:]) for name, row in first.items() if np.isfinite(row).all()}


# [deviation.py] How far an arm was from where it should have been, measured along the way.


class Deviation:
    """Root mean square and greatest deviation of each joint, rad, and of the tcp, m."""

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self.samples = 0
        self._squares = np.zeros(len(self.joints) + 1)
        self._most = np.zeros(len(self.joints) + 1)

    def add(self, joints: Array, tcp: Array) -> None:
        """One sample: by how much the joints (n,) are off, rad, and the tcp (3,), m."""
        off = np.append(np.abs(joints), np.linalg.norm(tcp))
        self._squares += off * off
        np.maximum(self._most, off, out=self._most)
        self.samples += 1

    @property
    def rms(self) -> Array:
        """(n,) rad; zeros where nothing was measured (see :attr:`samples`)."""
        found: Array = np.sqrt(self._squares[:-1] / max(1, self.samples))
        return found

    @property
    def most(self) -> Array:
        """(n,) rad"""
        return self._most[:-1]

    @property
    def tcp(self) -> tuple[float, float]:
        """Root mean square and greatest distance, m."""
        return float(np.sqrt(self._squares[-1] / max(1, self.samples))), float(self._most[-1])

    def lines(self) -> list[str]:
        """For people."""
        if not self.samples:
            return ["nothing was measured"]
        pairs = zip(self.joints, self.rms, self.most, strict=True)
        lines = [f"{name:16s} rms {rms:.4f} rad   max {most:.4f} rad" for name, rms, most in pairs]
        rms, most = self.tcp
        return [*lines, f"{'tcp':16s} rms {1e3 * rms:6.2f} mm    max {1e3 * most:6.2f} mm"]

    def as_json(self) -> dict[str, Any]:
        """For programs; None where nothing was measured."""
        if not self.samples:
            return {"samples": 0, "joints_rad": None, "tcp_mm": None}
        pairs = zip(self.joints, self.rms.tolist(), self.most.tolist(), strict=True)
        rms, most = self.tcp
        return {
            "samples": self.samples,
            "joints_rad": {name: {"rms": r, "max": m} for name, r, m in pairs},
            "tcp_mm": {"rms": 1e3 * rms, "max": 1e3 * most},
        }


RATE_HZ = 50.0
_EVERY = 5
"""A chunk is sent every so many turns."""
_AHEAD = 0.4
"""s of set-points in a chunk: the longest that the arm goes on while this program does not turn."""
_RAMP = 0.3
"""s in which playing comes to its speed: a pause may have been in the middle of a motion."""
_JOIN = 0.3
"""s, at least, in which the arm is brought from where it rests to where it goes on."""
_SETTLE = 0.5
"""s that the last set-point is held."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Playing without a pause: the episode's time ``s`` against the clock's ``t``."""

    t: float
    """When it begins, s on the clock."""
    s: float
    """Where, s since the first row."""
    speed: float

    def place(self, t: float) -> float:
        """``s`` at ``t``; before the beginning, the beginning."""
        spent = t - self.t
        if spent <= 0.0:
            return self.s
        return self.s + self.speed * (spent * spent / (2.0 * _RAMP) if spent < _RAMP else spent - _RAMP / 2.0)

    def time(self, s: float) -> float:
        """``t`` at ``s``."""
        ahead = max(0.0, s - self.s) / self.speed
        return self.t + (math.sqrt(2.0 * _RAMP * ahead) if ahead < _RAMP / 2.0 else ahead + _RAMP / 2.0)


class Player:
    """Plays one episode.

    While the dead-man is not held, the episode's time stands still: what was sent ahead is dropped, and after a new
    press the arm goes back to where it was let go of, and on from there. A trip ends it: MotionStopped.
    """

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        course: RecordedTrajectory,
        *,
        speed: float = 1.0,
        deadman: Deadman | None = None,
        unattended: bool = False,
    ) -> None:
        """``speed`` is above 0 and at most 1. Raises CommandError where the arm cannot do it."""
        course.check(robot, speed)
        self.rig, self.robot, self.course, self.speed = rig, robot, course, speed
        self._deadman, self._unattended = deadman, unattended
        self.deviation = Deviation(course.joints)
        """Of what was measured from what was measured then, at the same times of the episode."""
        self.limited = Limited.NONE
        """What the servo held back."""
        self.pauses = 0
        self.place = 0.0
        """How far it is, s since the first row."""
        self.finished = False

    def approach(self, patience: float = 60.0) -> None:
        """Drive to the first set-point, and put the things of a simulated world where they lay.

        Raises what :meth:`hal.robot.Robot.move_to` raises, and CommandError where a thing is not there.
        """
        there = set(self.rig.world.bodies) if self.rig.has_world else set(self.course.objects)
        if missing := [name for name in self.course.objects if name not in there]:
            raise CommandError(f"the episode's world has {', '.join(missing)}, and this one has not")
        spec = self.robot.spec
        self.robot.move_to(
            self._inside(self.course.q_set[0]),
            deadman=self._deadman,
            unattended=self._unattended,
            speed=None if spec.attended else spec.speed,
            patience=patience,
        )
        if self.rig.has_world:
            for name, pose in self.course.objects.items():
                self.rig.world.reset(name, pose=pose)

    def play(self, on_turn: Callable[[Player, bool], None] = lambda player, plays: None) -> None:
        """To the end. ``on_turn(player, does it play?)`` is called 50 times a second.

        Raises MotionStopped after a trip, RobotFault, ConnectionLost; the arm is at rest then.
        """
        clock, stretch, turn = self.rig.clock, None, 0
        seen = clock.now()
        control = self.robot.control(deadman=self._deadman, rate_hz=RATE_HZ, unattended=self._unattended)
        with control:
            for tick in clock.rate(RATE_HZ):
                if not follows(control):
                    if stretch is not None:
                        self._measure(stretch, seen)
                        self.pauses += 1
                    stretch, seen = None, tick.t
                    on_turn(self, False)
                    continue
                if stretch is None:
                    stretch, turn = self._begin(tick.t), 0
                if turn % _EVERY == 0:
                    self._send(control, stretch, tick.t, first=turn == 0)
                turn += 1
                seen = self._measure(stretch, seen)
                self._grip(control)
                on_turn(self, True)
                if tick.t >= stretch.time(self.course.duration) + _SETTLE / 2.0:
                    self.finished = True
                    return

    def _inside(self, q: Array) -> Array:
        """Rounding may have brought a set-point out of the limits."""
        limits = self.robot.limits
        found: Array = np.clip(q, limits.lower, limits.upper)
        return found

    def _begin(self, now: float) -> Stretch:
        """Go on from ``place``; the arm rests near it, and gets the time that it needs to be brought there slowly."""
        state, spec = self.robot.state(), self.robot.spec
        away = np.abs(self.course.at(self.course.q_set, self.place) - state.q_set)
        slowly = spec.move_speed * np.asarray(spec.limits.velocity)
        return Stretch(now + _JOIN + 2.0 * float((away / slowly).max()), self.place, self.speed)

    def _send(self, control: Control, stretch: Stretch, now: float, first: bool) -> None:
        """The rows that are due from now on, and the one before."""
        course = self.course
        begin = max(0, int(np.searchsorted(course.t, stretch.place(now), side="right")) - 1)
        last = int(np.searchsorted(course.t, stretch.place(now + _AHEAD), side="right")) + 1
        times, points = [], []
        if first:
            times, points = [now], [self.robot.state().q_set]
        if now < stretch.t:  # from where it rests to where it begins
            times.append(stretch.t)
            points.append(course.at(course.q_set, stretch.s))
        for k in range(begin, min(last, len(course.t))):
            if course.t[k] > stretch.s:
                times.append(stretch.time(float(course.t[k])))
                points.append(course.q_set[k])
        if last >= len(course.t):
            times.append(max(now, stretch.time(course.duration)) + _SETTLE)
            points.append(course.q_set[-1])
        control.send(JointChunk(times, points))

    def _measure(self, stretch: Stretch, seen: float) -> float:
        """Compare what was measured since ``seen`` with the recording; returns the time of the newest state."""
        course = self.course
        for state in self.robot.states(after=max(seen, stretch.t)):
            seen = state.stamp.t
            if state.status is not RobotStatus.FOLLOWING:
                continue  # braking, for a pause or for good
            self.place = min(stretch.place(seen), course.duration)
            if stretch.place(seen) <= course.duration:
                off = state.q - course.at(course.q, self.place)
                self.deviation.add(off, state.tcp.position - course.at(course.tcp, self.place))
            self.limited |= state.limited
        return seen

    def _grip(self, control: Control) -> None:
        gripper, width = self.robot.gripper, self.course.width_at(self.place)
        if gripper is not None and width is not None:
            control.send(None, width=float(np.clip(width, 0.0, gripper.width_max)))
