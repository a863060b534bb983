"""Replay of a recorded episode on an arm, through the servo, with its limits and the dead-man."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..commands import JointChunk
from ..control import Control
from ..errors import CommandError, DatasetError, RobotFault
from ..geometry import Pose
from ..randomization import DISTRACTORS
from ..recording.exporters.content import ArmColumns, EpisodeContent
from ..recording.layout import GRIP_FORCE, SETPOINT, STATE
from ..types import GripperOutcome, Limited, RobotStatus

if TYPE_CHECKING:
    from ..deadman import Deadman
    from ..recording import Episode
    from ..rig import Rig
    from ..robot import Robot

Array = NDArray[np.float64]

_ROUNDED = 1e-5
"""Rounding of recorded positions, which are 32-bit numbers, rad."""
_SPEED_ROOM = 1.02
"""Tolerance of a speed, which is a difference of rounded positions."""
_SPANS = (0.1, 1.0)
"""Spans over which a speed is measured, s: in a burst, and in the long run."""
_JITTER = 0.010
"""Error of the rows' stamps, s: a late tick of the servo is followed by one on time, so a set-point seems to have
moved faster between two neighbours than it did."""
_MOVED = 0.01
"""Motion below which an arm counts as standing still, rad, or m of a gripper."""
_FINGERS_REST = 0.01
"""Speed of a width up to which the fingers count as resting, m/s."""
_ARM_RESTS = 0.02
"""Speed of the joints up to which the arm counts as resting, rad/s."""
_SAME_TCP = 0.01
"""Distance between the recorded tcp and the arm's own from which on the tool is another one, m."""
_OUTSIDE = 1e-3
"""Distance by which the tcp may leave the workspace, m."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTrajectory:
    """The joint trajectory of one arm in an episode: ``k`` rows of ``n`` joints, with the gripper and the scene."""

    joints: tuple[str, ...]
    model: str
    """The arm's model; empty if the recording lacks it."""
    t: Array
    """(k,) since the first row, increasing, s."""
    q_set: Array
    """(k, n) set-points, rad."""
    q: Array
    """(k, n) measured positions, rad."""
    tcp: Array
    """(k, 3) measured positions of the tcp in the base frame, m."""
    grip: Array | None
    """(k, 2) commanded widths, m, and forces, N, of the gripper; None without one. A force is NaN where the recording
    lacks it."""
    width: Array | None
    """(k,) measured widths of the gripper, m; None without one."""
    objects: Mapping[str, Pose]
    """Poses of the objects in the first row, in the world; simulation only."""
    randomization: Mapping[str, Any] | None
    """What the scene was varied with, see :meth:`hal.world.World.randomize`; None without that."""

    @classmethod
    def from_episode(cls, episode: Episode, robot: Robot) -> RecordedTrajectory:
        """Read the trajectory of ``robot``, or of the only arm in the recording.

        Raises:
            CommandError: The episode has no such arm (code ``no_such_arm``).
            DatasetError: The episode lacks the columns of an arm.
        """
        content = EpisodeContent(episode)
        arms = {arm.name: arm for arm in content.arms}
        if len(arms) > 1 and robot.name not in arms:
            raise CommandError(
                f"the episode has no arm {robot.name!r}; it has: {', '.join(arms)}; open the rig that it was "
                "recorded with (--config)",
                code="no_such_arm",
            )
        arm = arms.get(robot.name) or next(iter(arms.values()), ArmColumns("", ""))
        if f"robot.{arm.name}" not in episode.stamps or episode.names(STATE) != episode.names(SETPOINT):
            raise DatasetError("does not have the columns of an arm", file="meta/info.json")
        stamps = episode.stamps[f"robot.{arm.name}"]
        t = stamps - stamps[0]
        later = np.append(True, np.diff(np.maximum.accumulate(t)) > 0.0)

        def select(values: NDArray[Any]) -> Array:
            found: Array = np.asarray(values, float)[later]
            return found

        width, target = content.width(arm), content.width(arm, SETPOINT)
        force = content.width(arm, GRIP_FORCE) if content.has(GRIP_FORCE) else None
        if force is None:
            force = np.full(len(t), np.nan)
        return cls(
            joints=tuple(content.joints(arm)),
            model=_model(episode.info, arm.name),
            t=t[later],
            q_set=select(content.of(arm, SETPOINT)),
            q=select(content.of(arm, STATE)),
            width=None if width is None else select(width),
            tcp=select(content.of(arm, "observation.tcp"))[:, :3],
            grip=None if target is None else select(np.column_stack([target, force])),
            objects=_distractors(episode.info) | _objects(content),
            randomization=episode.info.get("randomization"),
        )

    @property
    def duration(self) -> float:
        """Time from the first row to the last, s."""
        return float(self.t[-1])

    def find_waits(self) -> list[float]:
        """Return when the fingers came to rest while the arm rested, which may have waited for them, s since the start.

        The last row at which they moved counts, or the one before if the arm has left by then.
        """
        if self.width is None:
            return []
        took = np.diff(self.t)
        moved = np.abs(np.diff(self.width)) > _FINGERS_REST * took
        rests = np.abs(np.diff(self.q_set, axis=0)).max(axis=1) <= _ARM_RESTS * took
        ends = np.flatnonzero(moved[1:-1] & ~moved[2:]) + 2
        return [float(self.t[k] if rests[k - 1] else self.t[k - 1]) for k in ends if rests[k - 2]]

    def check(self, robot: Robot, speed: float) -> None:
        """Check whether an arm can follow the trajectory.

        Args:
            robot: The arm.
            speed: Share of the recorded speed, above 0 and at most 1.

        Raises:
            CommandError: It cannot; the message lists every reason (code ``cannot_replay``, or ``bad_speed``).
        """
        if not 0.0 < speed <= 1.0:
            raise CommandError(f"speed must be above 0 and at most 1, not {speed:g}", code="bad_speed")
        problems = self._check_arm(robot)
        if not problems:
            problems = self._check_rows()
        if not problems:
            places = np.array([robot.kinematics.fk(q)[:3] for q in self.q_set])
            problems = [*self._check_limits(robot), *self._check_tcp(robot, places)]
            problems += self._check_speed(robot, speed, places)
        if problems:
            raise CommandError(f"{robot.name} cannot replay this: " + "; ".join(problems), code="cannot_replay")

    def _check_arm(self, robot: Robot) -> list[str]:
        if self.model and self.model != robot.spec.model:
            return [f"it was recorded with the model {self.model}, and this arm is a {robot.spec.model}"]
        if self.joints != robot.joints:
            return [f"it was recorded with the joints {', '.join(self.joints)}; this arm has {', '.join(robot.joints)}"]
        if self.grip is not None and robot.gripper is None:
            return ["it was recorded with a gripper, and this arm has none"]
        return []

    def _check_rows(self) -> list[str]:
        if len(self.t) < 2:
            return [f"it has {len(self.t)} row(s); nothing to replay"]
        if not np.isfinite(self.q_set).all():
            row = int(np.flatnonzero(~np.isfinite(self.q_set).all(axis=1))[0])
            return [f"its set-point at {self.t[row]:.3f} s is not a number"]
        return []

    def _check_limits(self, robot: Robot) -> list[str]:
        limits, found = robot.limits, []
        for name, values, low, high in zip(self.joints, self.q_set.T, limits.lower, limits.upper, strict=True):
            if values.min() < low - _ROUNDED or values.max() > high + _ROUNDED:
                span = f"{values.min():.3f}..{values.max():.3f} rad"
                found.append(f"{name} goes through {span}, and its limits here are {low:g}..{high:g}")
        if self.grip is not None and robot.gripper is not None:
            most, force = robot.gripper.force_max, float(np.nanmax(self.grip[:, 1], initial=0.0))
            if force > most + _ROUNDED:
                found.append(f"the fingers press with {force:g} N, and with at most {most:g} N here")
        return found

    def _check_tcp(self, robot: Robot, places: Array) -> list[str]:
        """Describe a tcp that is not the recorded one, or leaves the workspace; ``places`` (k, 3) of it here, m."""
        away = float(np.linalg.norm(np.array(robot.kinematics.fk(self.q[0])[:3]) - self.tcp[0]))
        if away > _SAME_TCP:
            return [f"its tcp is {1e3 * away:.0f} mm from this arm's: it was recorded with another gripper or tool"]
        box = robot.spec.workspace
        if box is None:
            return []
        past = np.maximum(places - np.maximum(box.upper, places[0]), np.minimum(box.lower, places[0]) - places)
        row, axis = np.unravel_index(int(past.argmax()), past.shape)  # one that starts outside may come back in
        if past[row, axis] <= _OUTSIDE:
            return []
        side = f"{box.lower[axis]:.3f} to {box.upper[axis]:.3f} m"
        return [f"{'xyz'[axis]} of the tcp is {places[row, axis]:.3f} m at {self.t[row]:.2f} s, and may be {side} here"]

    def _check_speed(self, robot: Robot, speed: float, places: Array) -> list[str]:
        """Describe a speed at which the servo would limit the motion, so that the arm would lag behind."""
        joints, tcp = robot.spec.speed * np.asarray(robot.limits.velocity), robot.spec.tcp_speed
        found = []
        for span in _SPANS:
            rows, speeds = self._measure_speeds(self.q_set, span)
            shares = np.abs(speeds) / joints
            row, joint = np.unravel_index(int(shares.argmax()), shares.shape)
            found.append((shares[row, joint], rows[row], self.joints[joint], joints[joint], "rad/s"))
            shares = np.linalg.norm(self._measure_speeds(places, span)[1], axis=1) / tcp
            row = shares.argmax()
            found.append((shares[row], rows[row], "the tcp", tcp, "m/s"))
        share, row, what, most, unit = max(found, key=lambda each: float(each[0]))
        if share * speed <= _SPEED_ROOM:
            return []
        return [
            f"{what} moves at {speed * share * most:.3f} {unit} at {self.t[row]:.2f} s, and may at {most:.3f} here: at "
            f"speed {np.floor(100.0 / share) / 100.0:g} it could"
        ]

    def _measure_speeds(self, values: Array, span: float) -> tuple[NDArray[np.intp], Array]:
        """Return rows, and the mean speed of each of ``values`` (k, m) in ``span`` s from each of them on."""
        last = len(self.t) - 1
        ends = np.minimum(np.searchsorted(self.t, self.t + span - _ROUNDED), last)
        starts = np.flatnonzero(np.append(True, ends[:-1] < last))  # one span that reaches the end is enough
        ends = ends[starts]
        took = self.t[ends] - self.t[starts] + _JITTER
        return starts, (values[ends] - values[starts]) / took[:, None]

    def interpolate(self, values: Array, s: float) -> Array:
        """Return the row of ``values``, one of the arrays above, interpolated at ``s``, s since the first row."""
        k = min(max(int(np.searchsorted(self.t, s, side="right")), 1), len(self.t) - 1)
        share = min(max((s - self.t[k - 1]) / (self.t[k] - self.t[k - 1]), 0.0), 1.0)
        mixed: Array = values[k - 1] + share * (values[k] - values[k - 1])
        return mixed

    def grip_at(self, s: float) -> tuple[float, float | None] | None:
        """Return the gripper's last commanded width, m, and force, N, at ``s``; None for what is not known."""
        if self.grip is None:
            return None
        width, force = self.grip[max(0, int(np.searchsorted(self.t, s, side="right")) - 1)].tolist()
        return (width, force if math.isfinite(force) else None) if math.isfinite(width) else None


def list_recorded_arms(episode: Episode) -> list[str]:
    """Return the names of the arms in the recording."""
    return [key.removeprefix("robot.") for key in episode.stamps if key.startswith("robot.")]


def list_other_arms(episode: Episode, name: str) -> list[str]:
    """Return the names of the other arms that moved in the recording, which a replay of arm ``name`` leaves out."""
    arms, names = list_recorded_arms(episode), episode.names("rig.setpoint")
    setpoint = np.asarray(episode.columns["rig.setpoint"], float)
    found = []
    for arm in arms if len(arms) > 1 else ():
        own = setpoint[:, [k for k, label in enumerate(names) if label.startswith(f"{arm}.")]]
        if arm != name and (np.nanmax(own, axis=0) - np.nanmin(own, axis=0) > _MOVED).any():
            found.append(arm)
    return found


def _model(info: Mapping[str, Any], name: str) -> str:
    robots = info.get("rig", {}).get("resolved", {}).get("robots", ())
    return next((str(robot["model"]) for robot in robots if robot["name"] == name), "")


def _distractors(info: Mapping[str, Any]) -> dict[str, Pose]:
    """Return the poses at the start of the distractors, which have no columns."""
    names = ((info.get("randomization") or {}).get("values") or {}).get(DISTRACTORS, ())
    start = info.get("objects_at_start") or {}
    return {name: Pose(start[name][:3], start[name][3:]) for name in names if name in start}


def _objects(content: EpisodeContent) -> dict[str, Pose]:
    first = {name: poses[0] for name, poses in content.objects.items()}
    return {name: Pose(row[:3], row[3:]) for name, row in first.items() if np.isfinite(row).all()}


class Deviation:
    """Root mean square and greatest deviation of each joint, rad, and of the tcp, m."""

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self.samples = 0
        self._squares = np.zeros(len(self.joints) + 1)
        self._most = np.zeros(len(self.joints) + 1)

    def add(self, joints: Array, tcp: Array) -> None:
        """Add a sample: deviation of the joints (n,), rad, and of the tcp (3,), m."""
        off = np.append(np.abs(joints), np.linalg.norm(tcp))
        self._squares += off * off
        np.maximum(self._most, off, out=self._most)
        self.samples += 1

    @property
    def rms(self) -> Array:
        """Root mean square of each joint (n,), rad; zeros without samples."""
        return np.sqrt(self._squares[:-1] / max(1, self.samples))

    @property
    def most(self) -> Array:
        """Greatest deviation of each joint (n,), rad."""
        return self._most[:-1]

    @property
    def tcp(self) -> tuple[float, float]:
        """Root mean square and greatest distance, m."""
        return float(np.sqrt(self._squares[-1] / max(1, self.samples))), float(self._most[-1])

    def lines(self) -> list[str]:
        """Return the table as lines of text."""
        if not self.samples:
            return ["nothing was measured"]
        pairs = zip(self.joints, self.rms, self.most, strict=True)
        lines = [f"{name:16s} rms {rms:.4f} rad   max {most:.4f} rad" for name, rms, most in pairs]
        rms, most = self.tcp
        return [*lines, f"{'tcp':16s} rms {1e3 * rms:6.2f} mm    max {1e3 * most:6.2f} mm"]

    def as_json(self) -> dict[str, Any]:
        """Return the same as plain data; None for what was not measured."""
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
"""Turns per second."""
_EVERY = 5
"""Turns between two chunks."""
_AHEAD = 0.4
"""Span of a chunk, s: the longest that the arm continues if this program stalls."""
_RAMP = 0.3
"""Time in which playback reaches its speed, s: a pause may have been in the middle of a motion."""
_JOIN = 0.3
"""Shortest time in which the arm is brought from rest to the point at which it continues, s."""
_LONGEST_JOIN = 2.0
"""Longest such time, s: a chunk reaches no farther than 3 s ahead."""
_LONGEST_WAIT = 10.0
"""Time after which fingers that have not come to rest end the playback, s."""
_SETTLE = 0.5
"""Time for which the last set-point is held, s."""


@dataclass(frozen=True, slots=True)
class TimeScaling:
    """Time scaling of playback without a pause: progress ``s`` in the episode against the clock's time ``t``."""

    t: float
    """Start, s on the clock."""
    s: float
    """Progress at the start, s since the first row."""
    speed: float
    """Share of the recorded speed."""

    def progress_at(self, t: float) -> float:
        """Return the progress at time ``t``, s; before the start, that of the start."""
        spent = t - self.t
        if spent <= 0.0:
            return self.s
        return self.s + self.speed * (spent * spent / (2.0 * _RAMP) if spent < _RAMP else spent - _RAMP / 2.0)

    def time_at(self, s: float) -> float:
        """Return the time at which the progress is ``s``, s on the clock."""
        ahead = max(0.0, s - self.s) / self.speed
        return self.t + (math.sqrt(2.0 * _RAMP * ahead) if ahead < _RAMP / 2.0 else ahead + _RAMP / 2.0)


class TrajectoryPlayer:
    """Plays one recorded trajectory on an arm.

    While the dead-man is not held, the episode's time stands still: what was sent ahead is dropped, and after a new
    press the arm returns to where it stopped and continues from there. A trip ends the playback with MotionStopped.

    Where the arm rested in the recording until the fingers did, it rests here until these fingers do, so that a hand
    which takes longer than the recorded one has closed before the arm lifts, and has opened before it leaves.
    """

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        trajectory: RecordedTrajectory,
        *,
        speed: float = 1.0,
        deadman: Deadman | None = None,
        unattended: bool = False,
    ) -> None:
        """Check the trajectory.

        Args:
            rig: An open rig.
            robot: The arm.
            trajectory: The trajectory.
            speed: Share of the recorded speed, above 0 and at most 1.
            deadman: Dead-man; something that really moves needs it, or ``unattended``.
            unattended: Let a real arm move without a dead-man.

        Raises:
            CommandError: The arm cannot follow it (code ``cannot_replay``, or ``bad_speed``).
        """
        trajectory.check(robot, speed)
        self.rig, self.robot, self.trajectory, self.speed = rig, robot, trajectory, speed
        self._deadman, self._unattended = deadman, unattended
        self.deviation = Deviation(trajectory.joints)
        """Difference between the measured and the recorded motion at the same progress."""
        self.limited = Limited.NONE
        """Limits that the servo applied."""
        self.pauses = 0
        self.progress = 0.0
        """Progress in the episode, s since the first row."""
        self._waits = trajectory.find_waits()
        self._wait_ends = math.inf
        """Time at which the present wait for the fingers counts as too long, s on the clock."""
        self.finished = False

    def approach(self, patience: float = 60.0) -> None:
        """Drive to the first set-point, and place the objects of a simulated world where they were recorded.

        If the rig file has ``simulation.randomize``, the scene is varied as it was in the recording.

        Raises:
            CommandError: An object is missing in this world (code ``missing_object``). Other errors are those of
                :meth:`hal.robot.Robot.move_to`.
        """
        plan = self.rig.plan.world
        if self.rig.has_world and plan is not None and plan.randomize is not None:
            self.rig.world.randomize(self.trajectory.randomization)
        there = set(self.rig.world.bodies) if self.rig.has_world else set(self.trajectory.objects)
        if missing := [name for name in self.trajectory.objects if name not in there]:
            raise CommandError(
                f"the episode's world has {', '.join(missing)}, and this one does not", code="missing_object"
            )
        spec = self.robot.spec
        self.robot.move_to(
            self._clip(self.trajectory.q_set[0]),
            deadman=self._deadman,
            unattended=self._unattended,
            speed=None if spec.attended else spec.speed,
            patience=patience,
        )
        if self.rig.has_world:
            for name, pose in self.trajectory.objects.items():
                self.rig.world.reset(name, pose=pose)

    def play(self, on_turn: Callable[[TrajectoryPlayer, bool], None] = lambda player, playing: None) -> None:
        """Play to the end; the arm is at rest afterwards.

        Args:
            on_turn: Called with the player, and whether it is playing, in each turn.

        Raises:
            MotionStopped: After a trip.
            RobotFault: The robot reports a fault, or the fingers do not come to rest where they did in the recording.
            ConnectionLost: The arm is lost.
        """
        clock, scaling, turn = self.rig.clock, None, 0
        seen = clock.now()
        control = self.robot.control(deadman=self._deadman, rate_hz=RATE_HZ, unattended=self._unattended)
        with control:
            for tick in clock.rate(RATE_HZ):
                if not control.hold_until_following():
                    if scaling is not None:
                        self._measure(scaling, seen)
                        self.pauses += 1
                    scaling, seen, self._wait_ends = None, tick.t, math.inf
                    on_turn(self, False)
                    continue
                if self._waits_for_fingers(tick.t):
                    scaling, seen = None, tick.t
                    control.hold_for(_AHEAD)
                    self._grip(control)
                    on_turn(self, True)
                    continue
                if scaling is None:
                    scaling, turn = self._begin(tick.t), 0
                if turn % _EVERY == 0:
                    self._send(control, scaling, tick.t, first=turn == 0)
                turn += 1
                seen = self._measure(scaling, seen)
                self._grip(control)
                on_turn(self, True)
                if tick.t >= scaling.time_at(self.trajectory.duration) + _SETTLE / 2.0:
                    self.finished = True
                    return

    def _waits_for_fingers(self, now: float) -> bool:
        """Return whether the arm has to rest because the fingers, unlike the recorded ones, do not rest yet."""
        gripper, grip = self.robot.gripper, self.trajectory.grip_at(self.progress)
        if gripper is None or grip is None or not self._waits or self.progress < self._waits[0]:
            return False
        trouble, state = gripper.trouble, gripper.peek()
        if state is not None:
            if state.outcome is GripperOutcome.FAILED:
                cause = f"{gripper.name} failed, while the arm waits for its fingers: {state.fault}"
                raise RobotFault(cause, "clear the gripper's fault, and replay again")
            taken = abs(state.width_target - min(grip[0], gripper.width_max)) <= _MOVED
            open_yet = state.moving or state.outcome in (GripperOutcome.RUNNING, GripperOutcome.STOPPED)  # by a pause
            if taken and not open_yet and not trouble:
                self._waits = [wait for wait in self._waits if wait > self.progress]
                self._wait_ends = math.inf
                return False
            trouble = trouble or f"{state.width:.4f} m"
        self._wait_ends = min(self._wait_ends, now + _LONGEST_WAIT)
        if now > self._wait_ends:
            cause = f"{gripper.name} does not come to rest, as it did in the recording: {trouble}"
            raise RobotFault(cause, "see what is in the way of the fingers")
        return True

    def _clip(self, q: Array) -> Array:
        """Return ``q`` within the limits: rounding may have moved a recorded set-point out of them."""
        limits = self.robot.limits
        return np.clip(q, limits.lower, limits.upper)

    def _begin(self, now: float) -> TimeScaling:
        """Return the scaling that continues from :attr:`progress`, after the time to get there slowly."""
        state, spec = self.robot.state(), self.robot.spec
        away = np.abs(self.trajectory.interpolate(self.trajectory.q_set, self.progress) - state.q_set)
        slowly = spec.move_speed * np.asarray(spec.limits.velocity)
        joins = min(_JOIN + 2.0 * float((away / slowly).max()), _LONGEST_JOIN)
        return TimeScaling(now + joins, self.progress, self.speed)

    def _send(self, control: Control, scaling: TimeScaling, now: float, first: bool) -> None:
        """Send the rows that are due from now on, and the one before."""
        trajectory = self.trajectory
        begin = max(0, int(np.searchsorted(trajectory.t, scaling.progress_at(now), side="right")) - 1)
        last = int(np.searchsorted(trajectory.t, scaling.progress_at(now + _AHEAD), side="right")) + 1
        times, points = [], []
        if first:
            times, points = [now], [self.robot.state().q_set]
        if now < scaling.t:  # from where it rests to where it begins
            times.append(scaling.t)
            points.append(trajectory.interpolate(trajectory.q_set, scaling.s))
        rest = next((wait for wait in self._waits if wait > scaling.s), math.inf)
        for k in range(begin, min(last, len(trajectory.t))):
            if rest >= trajectory.t[k] > scaling.s:  # not beyond a wait for the fingers: this program may be late
                times.append(scaling.time_at(float(trajectory.t[k])))
                points.append(trajectory.q_set[k])
        if trajectory.t[min(last, len(trajectory.t)) - 1] > rest:
            if not times:
                control.hold_for(_AHEAD)
                return
            times.append(times[-1] + _AHEAD)
            points.append(points[-1])
        elif last >= len(trajectory.t):
            times.append(max(now, scaling.time_at(trajectory.duration)) + _SETTLE)
            points.append(trajectory.q_set[-1])
        control.send(JointChunk(times, points))

    def _measure(self, scaling: TimeScaling, seen: float) -> float:
        """Compare the states measured since ``seen`` with the recording. Return the time of the newest state."""
        trajectory = self.trajectory
        for state in self.robot.states(after=max(seen, scaling.t)):
            seen = state.stamp.t
            if state.status is not RobotStatus.FOLLOWING:
                continue  # braking
            self.progress = min(scaling.progress_at(seen), trajectory.duration)
            if scaling.progress_at(seen) <= trajectory.duration:
                off = state.q - trajectory.interpolate(trajectory.q, self.progress)
                self.deviation.add(off, state.tcp.position - trajectory.interpolate(trajectory.tcp, self.progress))
            self.limited |= state.limited
        return seen

    def _grip(self, control: Control) -> None:
        gripper, grip = self.robot.gripper, self.trajectory.grip_at(self.progress)
        if gripper is not None and grip is not None:
            width, force = grip
            if force is not None:
                force = min(force, gripper.force_max)
            control.send(None, width=float(np.clip(width, 0.0, gripper.width_max)), force=force)
