"""What one arm did in a recorded episode, ready to be done again, and whether this rig's arm may do it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import CommandError, DatasetError
from .geometry import Pose

if TYPE_CHECKING:
    from .recording import Episode
    from .robot import Robot

__all__ = ["Course", "arms_of", "moved_besides"]

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
class Course:
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
    def of(cls, episode: Episode, robot: Robot) -> Course:
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
