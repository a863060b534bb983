"""Motions along a path that is known from the start: straight to a goal, or along lines of the tcp and waypoints.

A planned path arrives whole when the session is opened, and is checked again here, so that no program's mistake gets
past the limits. Stops are made on the path wherever that is possible, and a motion that was stopped continues from
there. So a way that was free when it was checked is free for every step of it, and for the stop after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import ceil, dist, inf, isfinite
from operator import sub

from ..commands import PATH_KNOTS, CommandRecord, PathSection
from ..errors import CommandError
from ..specs import LimitsSpec
from ..types import Limited
from .collisions import Stop
from .envelope import UNLIMITED, Envelope
from .joint import ServoMotion
from .path import JointPath, Leg, Zone, ZonePlanner, zones_of
from .smoothing import JointSmoother, stop_displacement

Floats = Sequence[float]

START_MOVED = 0.02
"""An arm farther than this from the path's start is not where the path was planned from, rad (one joint)."""

OFF_PATH = 0.05
"""An arm that was moved farther than this off its path, by whatever cause, does not come back to it by itself, rad."""

_HERE = 1e-8
"""An arm at rest and this near to the path is on it, rad: the step onto it is rounding."""

_COMING_BACK = 0.05
"""Share of the session's joint speeds with which an arm at rest beside its path comes back to it."""

_SAMPLES = 4
"""Positions between two knots at which limits and workspace are checked."""

_JOINED = 1e-9
"""Greatest distance between the end of a section and the start of the next, rad."""

_TCP_SHARE = 0.99
"""Share of the session's tcp speed for which a path is planned."""

_SLOWER = 0.8
"""After a step that was refused, the rest is planned at this share of the speed before."""

_SLOWEST = 0.1
_RETRY = 0.1
"""Behind something in its way an arm waits so long, s, and continues at this share of the speed at least."""


class _StopOnPath(Stop):
    """A stop along a path, from one parameter to another."""

    def __init__(self, path: JointPath, start: float, end: float) -> None:
        self._path, self._start, self._length = path, start, end - start
        self.ways = self.ways_between(0.0, 1.0)

    def at(self, u: float) -> Floats:
        return self._path.at(self._start + u * self._length)[0]

    def ways_between(self, u: float, v: float) -> Floats:
        start, end = self._start + u * self._length, self._start + v * self._length
        return list(map(sub, self._path.gone(end), self._path.gone(start)))


class PlannedMotion(ServoMotion):
    """Follows a path of smooth sections from rest to rest (see :mod:`hal.servo.path`)."""

    size = 0

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self.arrived = False
        self.lost = False
        """Whether the arm cannot continue: it was moved too far off the path, or there is no plan from where it is."""
        self._planner = ZonePlanner()
        self._sections: list[tuple[JointPath, list[Zone]]] = []
        self._before: list[float] = []
        """Length of all sections before each one, and of all, in units of s."""
        self._section = self._zone = 0
        self._s = self._v = self._a = 0.0
        """Parameter in the present section, its speed and its acceleration."""
        self._leg: Leg | None = None
        """The present part of the plan; None at rest."""
        self._t = 0.0
        """Time since the leg's start, s."""
        self._stopping = False
        """Whether the leg is part of a stop."""
        self._at: Floats = ()
        """The set-point that the last step made."""
        self._share = 1.0
        self._waits = 0
        """Number of ticks for which the arm still waits for what is in its way."""

    @property
    def progress(self) -> float:
        """Share of the path that is done, from 0 to 1."""
        if self.arrived or not self._sections:
            return 1.0 if self.arrived else 0.0
        return min(1.0, (self._before[self._section] + self._s) / self._before[-1])

    def set_path(self, sections: Sequence[PathSection], pause: Callable[[], None] = lambda: None) -> None:
        """Set the path.

        Args:
            sections: The path, from where the set-point is.
            pause: Called again and again during the checks, which take a third of a millisecond for each knot.

        Raises:
            CommandError: The path is malformed (``code`` is ``bad_path``), longer than :data:`.PATH_KNOTS` knots
                (``path_too_long``), starts elsewhere (``start_moved``), or leaves limits or workspace (``joint_limit``,
                ``outside_workspace``); nothing changes.
        """
        smoother, envelope = self.smoother, self.envelope
        self._check_form(sections)
        away = max(abs(x - y) for x, y in zip(sections[0].q[0], smoother.q, strict=True))
        if away > START_MOVED:
            raise CommandError(
                f"the path starts {away:.3f} rad from the arm, which has moved since it was planned", code="start_moved"
            )
        paths = []
        for section in sections:
            paths.append(JointPath(section))
            pause()
        self._check_limits(paths, pause)
        self._check_workspace(paths, pause)
        tcp_speed = _TCP_SHARE * envelope.tcp_speed if envelope.tcp_speed < UNLIMITED else inf
        limits = LimitsSpec(
            tuple(smoother.lower),
            tuple(smoother.upper),
            tuple(smoother.velocity),
            tuple(smoother.acceleration),
            tuple(smoother.jerk),
        )
        velocity, arm = list(envelope.velocity), envelope.kinematics
        plan = [(path, zones_of(path, limits, velocity, tcp_speed, arm, pause)) for path in paths]
        if not all(min(zone.speed, zone.acceleration, zone.braking, zone.jerk) > 0.0 for _, z in plan for zone in z):
            raise CommandError("the path has a part that no speed is slow enough for", code="bad_path")
        self._reset()
        self._sections = plan
        for path in paths:
            self._before.append(self._before[-1] + path.length)

    def _reset(self) -> None:
        """Forget the path and what became of it."""
        self._sections, self._before = [], [0.0]
        self._section = self._zone = 0
        self._s = self._v = self._a = 0.0
        self._leg = None
        self._at = ()
        self._share = 1.0
        self._waits = 0
        self.arrived = self.lost = self._stopping = False

    def stop_end(self) -> Floats:
        """Return where a stop that begins now ends (n,), rad, or a little farther along the path."""
        if self._leg is None or self._at is not self.smoother.q:
            return self.smoother.stop_end()
        return self._sections[self._section][0].at(self._stop_parameter())[0]

    def start(self) -> None:
        super().start()
        if self._at is not self.smoother.q:  # else a stop on the path is finished first
            self._leg = None

    def reanchored(self) -> None:
        self._leg = None
        self._at = ()

    def accept(self, command: CommandRecord) -> None:
        raise CommandError("a session along a path takes no commands", code="move_to_session")

    def step(self, now: float) -> None:
        smoother = self.smoother
        if self.arrived or self.lost:
            smoother.stop()
        elif self._leg is not None:
            self._follow_leg()
        elif self._waits > 0:
            self._waits -= 1
            self.envelope.limited |= Limited.COLLISION
            smoother.stop()
        elif not smoother.at_rest():
            smoother.stop()
        elif self._returns():
            if self._begin_leg(0.0):
                self._follow_leg()
            else:  # never seen; the next tick would find none either
                self.lost = True
                smoother.stop()

    def brake(self) -> bool:
        """Advance a stop on the path by one tick; False, and nothing has moved, if the arm is not moving along it."""
        if self._leg is None or self._at is not self.smoother.q:
            self._leg = None
            return False
        if not self._stopping:
            self._begin_stop()
        self._follow_leg()
        return True

    # Along the path.

    def _follow_leg(self) -> None:
        """Move the set-point by one tick along the plan."""
        smoother = self.smoother
        before = self._zone, self._leg, self._t, self._s, self._v, self._a
        self._t += smoother.dt
        while self._leg is not None and self._t >= self._leg.duration:
            self._finish_leg(self._leg)
        if self._leg is None:
            if self._v > 0.0:  # never seen: Ruckig has no plan from here
                smoother.stop()
                self._at = ()
            else:
                self._rest()
            return
        self._s, self._v, self._a = self._leg.at(self._t)
        q, first, second = self._sections[self._section][0].at(self._s)
        v, a = self._v, self._a
        dq = [x * v for x in first]
        ddq = [x * a + y * v * v for x, y in zip(first, second, strict=True)]
        if smoother.adopt(q, dq, ddq, None if self._stopping else self._allows):  # a stop was checked before it began
            self._at = smoother.q
            return
        self.envelope.note(smoother)
        self._zone, self._leg, self._t, self._s, self._v, self._a = before
        moving = self._v > 0.0 or self._a > 0.0
        # It stops, and continues more slowly.
        if not self.envelope.blocked:
            self._share *= _SLOWER
        else:  # by another arm, which may leave: the whole path was free
            if moving:
                self._share = max(_SLOWEST, _SLOWER * self._share)
            self._waits = round(_RETRY / smoother.dt)
        if moving:
            self._begin_stop()
            self._follow_leg()
        else:
            self._leg = None
            smoother.stop()

    def _begin_leg(self, speed: float) -> bool:
        """Plan from the present place, at ``speed`` (v) without acceleration, to the zone's end; False if it cannot."""
        zone = self._sections[self._section][1][self._zone]
        self._leg = self._planner.through(zone, self._s, speed, self._share)
        self._t, self._v, self._a = 0.0, speed, 0.0
        self._stopping = False
        return self._leg is not None

    def _begin_stop(self) -> None:
        """Replace the plan by a stop; where the zone is too short for one, it goes on in the next."""
        zone = self._sections[self._section][1][self._zone]
        leg = self._planner.stop(zone, self._s, self._v, self._a)
        if leg is not None:
            self._leg, self._t = leg, 0.0
        self._stopping = True

    def _finish_leg(self, leg: Leg) -> None:
        """Begin the next leg at the end of this one; none at a rest."""
        stopping = self._stopping
        late = self._t - leg.duration
        zones = self._sections[self._section][1]
        self._s, self._v, self._a = leg.end, leg.speed, 0.0
        inside = leg.end < zones[self._zone].end
        if inside or self._zone == len(zones) - 1:  # the end of a stop, or of the section
            self._leg = None
            return
        self._zone += 1
        self._begin_leg(self._v)
        if stopping:
            self._begin_stop()
        self._t = late

    def _rest(self) -> None:
        """Take the set-point to where the plan ended, and on to the next section if the present one is done."""
        smoother = self.smoother
        path, zones = self._sections[self._section]
        done = self._zone == len(zones) - 1 and self._s >= zones[-1].end
        q = path.q[-1].tolist() if done else path.at(self._s)[0]
        smoother.adopt(q, [0.0] * smoother.n, [0.0] * smoother.n)
        self._v = self._a = 0.0
        self._at = smoother.q
        if done and self._section == len(self._sections) - 1:
            self.arrived = True
        elif done:
            self._section += 1
            self._zone, self._s = 0, 0.0

    def _allows(self, smoother: JointSmoother) -> bool:
        """Return whether the proposed step keeps the tcp's speed limit, and it and its stop touch nothing."""
        if not self._keeps_tcp_speed(smoother):
            return False
        if self.envelope.collisions is None:
            return True
        return self.envelope.keeps_apart(_StopOnPath(self._sections[self._section][0], self._s, self._stop_parameter()))

    def _stop_parameter(self) -> float:
        """Return the parameter at which a stop from the present place ends at most."""
        zones = self._sections[self._section][1]
        zone = zones[self._zone]
        end = self._s + stop_displacement(self._v, self._a, zone.braking, zone.jerk)
        if end <= zone.end:
            return end
        return zones[self._zone + 1].stop_end if self._zone + 1 < len(zones) else zone.end

    def _keeps_tcp_speed(self, smoother: JointSmoother) -> bool:
        """Return whether the tcp keeps its speed limit in the proposed step. A stop on the path is no faster."""
        limit = self.envelope.tcp_speed
        if limit >= UNLIMITED:
            return True
        fk = self.envelope.kinematics.fk
        if dist(fk(smoother.q)[:3], fk(smoother.q_next)[:3]) <= limit * smoother.dt:
            return True
        self.envelope.note_tcp_speed()
        return False

    # Beside the path.

    def _returns(self) -> bool:
        """Move an arm at rest back to its path by one tick; returns whether it is there already."""
        smoother = self.smoother
        path, zones = self._sections[self._section]
        s = path.nearest(smoother.q, self._s) if self._s > 0.0 or self._zone > 0 else self._s
        q = path.at(s)[0]
        away = max(abs(x - y) for x, y in zip(q, smoother.q, strict=True))
        if away > OFF_PATH:
            self.lost = True  # the progress stays what it was
            smoother.stop()
            return False
        self._s = s
        self._zone = next((k for k, zone in enumerate(zones) if s < zone.end), len(zones) - 1)
        if away <= _HERE:
            return True
        slowly = [_COMING_BACK * v for v in self.envelope.velocity]
        if not smoother.reach(q, slowly, self.envelope.guard):
            smoother.stop()
        return False

    # The checks of a path.

    def _check_form(self, sections: Sequence[PathSection]) -> None:
        n = self.smoother.n
        count = sum(len(section.s) for section in sections)
        if count > PATH_KNOTS:
            raise CommandError(f"a path has at most {PATH_KNOTS} knots, not {count}", code="path_too_long")
        for section in sections:
            s, q = section.s, section.q
            shaped = len(s) == len(q) >= 2 and all(len(row) == n for row in q)
            if not (shaped and isfinite(sum(s)) and all(isfinite(sum(map(abs, row))) for row in q)):
                raise CommandError(f"a section of a path needs knots of {n} finite numbers each", code="bad_path")
            if s[0] != 0.0 or not all(a < b for a, b in pairwise(s)):
                raise CommandError("the parameters of a section must increase from 0", code="bad_path")
        joined = all(dist(a.q[-1], b.q[0]) <= _JOINED for a, b in pairwise(sections))
        if not sections or not joined:
            raise CommandError("each section of a path must begin where the one before ends", code="bad_path")

    def _check_limits(self, paths: Sequence[JointPath], pause: Callable[[], None]) -> None:
        """Raise CommandError unless all joints stay inside their limits, or only come back in."""
        smoother = self.smoother
        start = paths[0].q[0].tolist()
        lowest = [min(low, x) - 1e-6 for low, x in zip(smoother.lower, start, strict=True)]
        highest = [max(high, x) + 1e-6 for high, x in zip(smoother.upper, start, strict=True)]
        for path in paths:
            pause()
            q = path.samples(_SAMPLES)
            outside = ((q < lowest) | (q > highest)).any(axis=0)
            if outside.any():
                joints = ", ".join(str(k) for k in outside.nonzero()[0].tolist())
                raise CommandError(f"the path leaves the position limits of joint {joints}", code="joint_limit")

    def _check_workspace(self, paths: Sequence[JointPath], pause: Callable[[], None]) -> None:
        """Raise CommandError unless the tcp stays inside the workspace, or only comes back in."""
        if self.envelope.workspace is not None:
            for path in paths:
                self._check_tcp(path.samples(2).tolist(), pause)

    def _check_tcp(self, places: Sequence[Floats], pause: Callable[[], None] = lambda: None) -> None:
        """Raise CommandError unless the tcp is inside the workspace at these places, or no farther outside than now."""
        box = self.envelope.workspace
        assert box is not None
        fk = self.envelope.kinematics.fk
        begun = fk(self.smoother.q)
        for q in places:
            pause()
            for x, x0, low, high, axis in zip(fk(q), begun, box.lower, box.upper, "xyz", strict=False):
                if x > max(high, x0) + 1e-6 or x < min(low, x0) - 1e-6:
                    raise CommandError(
                        f"the path leaves the workspace: {axis} = {x:.3f} m, allowed {low:.3f} to {high:.3f}",
                        code="outside_workspace",
                    )


_SAMPLE = 0.05
_MOST_SAMPLES = 64
"""A straight way is checked every so many rad, at most this many times: planning must fit into a tick."""


class PathMotion(PlannedMotion):
    """Goes straight to a goal, in joint space, from wherever the arm rests.

    Each joint's limits, seen along the way, bound its speed, acceleration and jerk; so do the session's speed and the
    tcp's. All joints start and arrive together. A set-point on the way is between start and goal, and so is the end of
    every stop: joint limits need no further check.
    """

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self._goal: list[float] = []
        self._whole_way = 0.0
        """Distance of the goal from the first start, rad (the joint that goes farthest)."""

    def set_goal(self, goal: Floats) -> None:
        """Set the goal.

        Args:
            goal: Joint positions (n,), rad.

        Raises:
            CommandError: If the goal or the path leaves the limits or the workspace; nothing changes.
        """
        smoother = self.smoother
        if len(goal) != smoother.n:
            raise CommandError(f"move_to needs {smoother.n} joint positions, not {len(goal)}", code="wrong_shape")
        for i, (x, low, high) in enumerate(zip(goal, smoother.lower, smoother.upper, strict=True)):
            if not low - 1e-6 <= x <= high + 1e-6:
                raise CommandError(
                    f"joint {i} of the goal is {x:.4f} rad; its limits are {low:.4f} to {high:.4f}", code="joint_limit"
                )
        inside = [max(low, min(high, x)) for x, low, high in zip(goal, smoother.lower, smoother.upper, strict=True)]
        if self.envelope.workspace is not None:
            self._check_tcp(_interpolate(smoother.q, inside))
        self._reset()
        self._goal = inside
        self._whole_way = max([abs(x - y) for x, y in zip(inside, smoother.q, strict=True)])

    def _returns(self) -> bool:
        """Make a new plan unless the arm rests on the present one; returns whether there is a way to go."""
        smoother = self.smoother
        if self._sections:
            q = self._sections[0][0].at(self._s)[0]
            if max(map(abs, map(sub, q, smoother.q))) <= _HERE:
                return True
        self._plan()
        if self.arrived:
            smoother.stop()
        return not self.arrived

    def _plan(self) -> None:
        smoother, envelope = self.smoother, self.envelope
        delta: list[float] = list(map(sub, self._goal, smoother.q))
        length = max(map(abs, delta))
        self.arrived = length < _HERE
        if self.arrived:
            return
        along = [d / length for d in delta]

        def slowest(limits: Floats) -> float:
            return min(limit / abs(d) for limit, d in zip(limits, along, strict=True) if d)

        speed = slowest(envelope.velocity)
        fastest_tcp = envelope.stop_speed(along, _interpolate(smoother.q, self._goal))
        if fastest_tcp * speed > envelope.goal_tcp_speed:
            speed = envelope.goal_tcp_speed / fastest_tcp
        acceleration = slowest(smoother.acceleration)
        path = JointPath(PathSection((0.0, length), (tuple(smoother.q), tuple(self._goal))))
        zone = Zone(0.0, length, speed, acceleration, acceleration, slowest(smoother.jerk), 0.0, length)
        self._sections = [(path, [zone])]
        whole = max(self._whole_way, length)
        self._before = [whole - length, whole]
        self._s = 0.0


def _interpolate(start: Floats, goal: Floats) -> list[list[float]]:
    """Return joint positions (n,), rad, on the straight way from ``start`` to ``goal``."""
    count = min(_MOST_SAMPLES, 1 + ceil(max(abs(b - a) for a, b in zip(start, goal, strict=True)) / _SAMPLE))
    return [[a + k / count * (b - a) for a, b in zip(start, goal, strict=True)] for k in range(count + 1)]
