"""What an episode's own file says besides its rows: where they come from, and with what they were made."""

from __future__ import annotations

import json
import operator
import platform
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import CommandError
from .cameras import CameraTrack

if TYPE_CHECKING:
    from ..geometry import Pose
    from ..rig import Rig

__all__ = ["about_call", "about_rig", "about_start"]

_PACKAGES = (
    "robot-hal",
    "numpy",
    "ruckig",
    "pin",
    "pybullet",
    "pylibfranka",
    "pyrealsense2",
    "pyarrow",
    "av",
    "zstandard",
)


def about_rig(rig: Rig) -> dict[str, Any]:
    """The rig's configuration, as it was written and as it came out, and the versions of what ran it."""
    plan = rig.plan
    resolved = asdict(plan)
    for pad in resolved["pads"]:
        del pad["models"]  # all pads that are known, not those that are here
    written = None
    if Path(plan.source).is_file():
        written = Path(plan.source).read_text(encoding="utf-8")
    return {
        "rig": {"source": plan.source, "written": written, "resolved": resolved, "renderer": rig.renderer},
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


def about_start(rig: Rig, tracks: Iterable[CameraTrack]) -> dict[str, Any]:
    """What is so when an episode begins."""
    objects = {}
    if rig.has_world:
        seen = rig.world.poses().poses
        objects = {name: _pose(pose) for name, pose in seen.items() if name not in rig.robots}
    return {
        "started": datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        "clock": rig.plan.clock,
        "objects_at_start": objects,
        "cameras": {track.camera.name: _camera(track) for track in tracks},
    }


def _camera(track: CameraTrack) -> dict[str, Any]:
    info, setup = track.camera.info, track.setup
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


def about_call(task: str, seed: int | None, info: Mapping[str, Any] | None) -> dict[str, Any]:
    """What a caller wants to have kept with an episode. CommandError for what the files cannot hold."""
    try:
        task.encode()
    except (AttributeError, UnicodeEncodeError) as error:
        raise CommandError(f"the task must be a text, not {task!r}: {error}") from None
    try:
        number = None if seed is None else operator.index(seed)
    except TypeError:
        raise CommandError(f"the seed must be a whole number, not {seed!r}") from None
    try:
        return {"task": task, "seed": number, "info": json.loads(json.dumps(dict(info or {}), allow_nan=False))}
    except (TypeError, ValueError) as error:
        raise CommandError(f"info must be plain numbers, texts, lists and dicts: {error}") from None
