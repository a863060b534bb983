"""Does what is to be recorded fit a dataset that is there already?"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..errors import CommandError
from .columns import SEGMENTATION, CameraSetup
from .index import check_next, read_about, read_index
from .layout import Layout
from .tables import VERSION

__all__ = ["check_compatible"]

_SAID_ELSEWHERE = ("video.fps", "video.width", "video.height")
"""Of a video: the dataset's own fps, and its shape, say it."""


def check_compatible(
    layout: Layout, features: Mapping[str, Any], fps: int, robot_type: str, cameras: Sequence[CameraSetup]
) -> None:
    """Raise CommandError, with everything that differs, where episodes of this kind cannot be added; DatasetError where
    the dataset is damaged."""
    root = layout.root
    if root.exists() and not root.is_dir():
        raise CommandError(f"{root} is a file; a recording needs a folder")
    if layout.info.exists() and not layout.numbers():
        raise CommandError(f"the dataset in {root} was not recorded by this program; choose a new folder")
    info = read_index(layout)
    if info is None:
        if root.is_dir() and not layout.episodes.is_dir() and any(root.iterdir()):
            raise CommandError(f"{root} holds other things than a recording; choose a new folder")
        return
    last = int(info["total_episodes"]) - 1
    if not layout.interrupted:
        check_next(layout, info)
    if info["codebase_version"] != VERSION:
        raise CommandError(f"the dataset in {root} was not recorded by this program; choose a new folder")
    found = [*_settings(info, fps, robot_type), *_features(info["features"], features)]
    if last >= 0:
        found += _depth(read_about(layout, last)["cameras"], cameras)
    if found:
        raise CommandError(f"the dataset in {root} is another kind: {'; '.join(found)}; choose a new folder")


def _settings(info: Mapping[str, Any], fps: int, robot_type: str) -> Iterator[str]:
    for name, new in (("fps", fps), ("robot_type", robot_type)):
        if info.get(name) != new:
            yield f"{name} is {info.get(name)} there, and {new} here"


def _features(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    if missing := [key for key in old if key not in new]:
        yield f"only there: {', '.join(missing)}"
    if added := [key for key in new if key not in old]:
        yield f"only here: {', '.join(added)}"
    for key in (key for key in old if key in new):
        there, here = old[key], new[key]
        for what in ("dtype", "shape"):
            if there.get(what) != here.get(what):
                yield f"{what} of {key} is {there.get(what)} there, and {here.get(what)} here"
        if there.get("names") != here.get("names"):
            yield _names(key, there.get("names") or [], here.get("names") or [])
        video, ours = there.get("info") or {}, here.get("info") or {}
        for what in dict.fromkeys([*video, *ours]):
            if what not in _SAID_ELSEWHERE and video.get(what) != ours.get(what):
                yield f"{what} of {key} is {video.get(what)} there, and {ours.get(what)} here"


def _names(key: str, old: Sequence[str], new: Sequence[str]) -> str:
    """In which numbers a column differs, at most three of each."""
    parts = []
    for where, names, others in (("there", old, new), ("here", new, old)):
        if own := [name for name in names if name not in others]:
            parts.append(f"only {where} it has {', '.join(own[:3])}{' and more' if len(own) > 3 else ''}")
    return f"the names of {key} differ: {'; '.join(parts) or 'their order is another'}"


def _depth(old: Mapping[str, Any], new: Sequence[CameraSetup]) -> Iterator[str]:
    """Cameras, in both, whose depth is not kept alike; no feature of the dataset says so."""
    for camera in new:
        if camera.name not in old:
            continue
        kept = SEGMENTATION in old[camera.name].get("streams", ()), SEGMENTATION in camera.more
        if kept[0] != kept[1]:
            yield f"segmentation of {camera.name} is kept {'there, and not here' if kept[0] else 'here, and not there'}"
        there, here = old[camera.name].get("depth_unit_m"), camera.depth_unit
        if there is None and here is not None:
            yield f"depth of {camera.name} is not kept there, and is here"
        elif there is not None and here is None:
            yield f"depth of {camera.name} is kept there, and not here"
        elif there is not None and here is not None and not math.isclose(there, here, rel_tol=1e-6):
            yield f"depth of {camera.name} is in units of {1e3 * there:g} mm there, and {1e3 * here:g} mm here"
