"""Metadata of an episode: where it comes from, what made it, and how fast each arm's own clock passed."""

from __future__ import annotations

import json
import math
import operator
import platform
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import registry
from ..errors import CommandError
from .layout import TIMES

if TYPE_CHECKING:
    from ..geometry import Pose
    from ..rig import Rig
    from .sampling import CameraBuffer

_ENOUGH = 2.0
"""Length of an episode before its pace is reported, s."""
_CHANGED = 0.02
"""Smallest change of the pace that is reported again."""
_ROBOT = f"{TIMES}robot."
SLOW_PACE = 0.97
"""Share of real time below which speeds in a recording are noticeably too low."""


class ClockPace:
    """Measures the pace of each arm's own clock, relative to the rig's, over the rows of one episode.

    A simulation that cannot keep up with real time is slower than 1.
    """

    def __init__(self, columns: Iterable[Sequence[Any]], simulated: Collection[str] = ()) -> None:
        self._places: dict[str, int] = {}
        self._simulated = simulated
        self._reported = 1.0
        place = 0
        for key, _, names in columns:
            if key.startswith(_ROBOT):
                self._places[key.removeprefix(_ROBOT)] = place
            place += len(names)
        self._last: dict[str, tuple[float, float]] = {}
        self._passed: dict[str, tuple[float, float]] = {}
        """Time on the rig's clock and on the arm's own while both increased, s."""

    def add(self, row: Sequence[float]) -> None:
        """Add a row. While an arm's clock is unknown, or after it was reset, that arm is left out."""
        for name, place in self._places.items():
            now = float(row[place]), float(row[place + 1])
            before, self._last[name] = self._last.get(name, now), now
            t, own = now[0] - before[0], now[1] - before[1]
            if t > 0.0 and own >= 0.0:  # false for NaN, too
                sums = self._passed.get(name, (0.0, 0.0))
                self._passed[name] = sums[0] + t, sums[1] + own

    def as_json(self) -> dict[str, float]:
        """Return the pace of each arm, by name, without those whose own clock is unknown."""
        return {name: round(own / t, 4) for name, (t, own) in self._passed.items() if math.isfinite(own)}

    @property
    def trouble(self) -> str:
        """Message for the operator about a simulation that is too slow; empty if it keeps up."""
        found = [
            own / t
            for name, (t, own) in self._passed.items()
            if name in self._simulated and t >= _ENOUGH and own < t * SLOW_PACE
        ]
        if not found:
            self._reported = 1.0
            return ""
        if self._reported == 1.0 or abs(min(found) - self._reported) >= _CHANGED:
            self._reported = min(found)
        return (
            f"the simulation runs at {self._reported:.2f} of real time: speeds in this recording are too low; fewer or "
            "smaller cameras help"
        )


def simulated_pace(info: Mapping[str, Any]) -> float | None:
    """Return the pace of the slowest simulated arm in an episode's metadata; None if there is none or it is unknown."""
    resolved = info.get("rig", {}).get("resolved", {})
    driver = (resolved.get("world") or {}).get("driver")
    simulated = {robot["name"] for robot in resolved.get("robots", ()) if driver and robot["driver"] == driver}
    found = [float(pace) for name, pace in (info.get("pace") or {}).items() if name in simulated]
    return min(found, default=None)


_PACKAGES = (
    "robot-hal",
    "numpy",
    "ruckig",
    "pin",
    "pybullet",
    "mujoco",
    "pylibfranka",
    "pyrealsense2",
    "pyarrow",
    "av",
    "zstandard",
)


def rig_metadata(rig: Rig) -> dict[str, Any]:
    """Return the rig's configuration, as written and as resolved, its engine, and the versions of the software."""
    plan = rig.plan
    resolved = asdict(plan)
    for pad in resolved["pads"]:
        del pad["models"]  # all known models, not the connected ones
    written = None
    if Path(plan.source).is_file():
        written = Path(plan.source).read_text(encoding="utf-8")
    return {
        "rig": {"source": plan.source, "written": written, "resolved": resolved, "renderer": rig.renderer},
        "engine": None if plan.engine is None else {"name": plan.engine, "versions": registry.versions(plan.engine)},
        "versions": {"python": platform.python_version(), "system": platform.platform(), **_versions()},
        "program": sys.argv[0],
    }


def _versions() -> dict[str, str]:
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def start_metadata(rig: Rig, cameras: Iterable[CameraBuffer]) -> dict[str, Any]:
    """Return what is known when an episode starts: time, poses of objects, calibration of each camera, what varies."""
    objects, randomization = {}, None
    if rig.has_world:
        randomization = rig.world.randomization
        seen = rig.world.poses().poses
        objects = {name: _pose(pose) for name, pose in seen.items() if name not in rig.robots}
    return {
        "started": datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        "clock": rig.plan.clock,
        "objects_at_start": objects,
        "randomization": randomization,
        "cameras": {camera.camera.name: _camera(camera) for camera in cameras},
    }


def _camera(buffer: CameraBuffer) -> dict[str, Any]:
    info, setup = buffer.camera.info, buffer.setup
    return {
        "title": info.title,
        "serial": info.serial,
        "firmware": info.firmware,
        "clock": info.clock,
        "K": info.K.tolist(),
        "distortion": info.distortion.tolist(),
        "depth_unit_m": setup.depth_unit,
        "streams": [*setup.videos.values(), *setup.depths.values()],
        "depth_lossless": setup.depth_lossless if setup.depth_unit is not None else None,
    }


def _pose(pose: Pose) -> list[float]:
    return [*pose.position.tolist(), *pose.orientation.tolist()]


def caller_metadata(task: str, seed: int | None, info: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what the caller stores with an episode; CommandError (``bad_metadata``) for what JSON cannot hold."""
    try:
        task.encode()
    except (AttributeError, UnicodeEncodeError) as error:
        raise CommandError(f"the task must be a text, not {task!r}: {error}", code="bad_metadata") from None
    try:
        number = None if seed is None else operator.index(seed)
    except TypeError:
        raise CommandError(f"the seed must be a whole number, not {seed!r}", code="bad_metadata") from None
    try:
        return {"task": task, "seed": number, "info": json.loads(json.dumps(dict(info or {}), allow_nan=False))}
    except (TypeError, ValueError) as error:
        raise CommandError(
            f"info must be plain numbers, texts, lists and dicts: {error}", code="bad_metadata"
        ) from None
