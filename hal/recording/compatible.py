"""Does what is to be recorded fit a dataset that is there already?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..errors import CommandError
from .layout import Layout, read_json
from .tables import VERSION

__all__ = ["check_compatible"]


def check_compatible(layout: Layout, features: Mapping[str, Any], fps: int, robot_type: str) -> None:
    """Raise CommandError, which says everything that differs, where episodes of this kind cannot be added."""
    root = layout.root
    if root.exists() and not root.is_dir():
        raise CommandError(f"{root} is a file; a recording needs a folder")
    if not layout.info.exists():
        if root.is_dir() and not layout.episodes.is_dir() and any(root.iterdir()):
            raise CommandError(f"{root} holds other things than a recording; choose a new folder")
        return
    info = read_json(layout.info)
    last = int(info["total_episodes"]) - 1
    if info.get("codebase_version") != VERSION or (last >= 0 and not layout.about(last).exists()):
        raise CommandError(f"the dataset in {root} was not recorded by this program; choose a new folder")
    found = [*_settings(info, fps, robot_type), *_features(info["features"], features)]
    if found:
        raise CommandError(f"the dataset in {root} is another kind: {'; '.join(found)}; choose a new folder")


def _settings(info: Mapping[str, Any], fps: int, robot_type: str) -> Iterator[str]:
    for name, new in (("fps", fps), ("robot_type", robot_type)):
        if info[name] != new:
            yield f"{name} is {info[name]} there, and {new} here"


def _features(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    if missing := [key for key in old if key not in new]:
        yield f"only there: {', '.join(missing)}"
    if added := [key for key in new if key not in old]:
        yield f"only here: {', '.join(added)}"
    for key in old:
        if key not in new:
            continue
        for what in ("dtype", "shape", "names", "info"):
            if old[key].get(what) != new[key].get(what):
                yield f"{what} of {key} is {old[key].get(what)} there, and {new[key].get(what)} here"
