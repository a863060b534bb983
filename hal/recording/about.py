"""Metadata of an episode on the disk: ``episodes/N.json``, and ``episodes/common-*.json`` for what many have in common.

The rig, the columns, the cameras and the versions are long, and the same in nearly all episodes. They are in a file of
their own, whose name follows from its content; ``common`` in ``episodes/N.json`` is that name. Episodes of earlier
versions have everything in ``episodes/N.json``, which is read alike: its entries precede those of the common file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat

from .layout import DatasetLayout, file_version, read_json
from .validation import CameraName, Feature, Model, dataset_errors

_COMMON = (
    "cameras",
    "clock",
    "encoder",
    "engine",
    "features",
    "fps",
    "program",
    "recipe",
    "rig",
    "robot_type",
    "versions",
)
"""Entries of the common file; ``recipe`` is that of ``info``, where ``hal generate`` keeps it."""


class _Camera(Model):
    K: Annotated[list[Annotated[list[float], Field(min_length=3, max_length=3)]], Field(min_length=3, max_length=3)]
    distortion: list[float]
    depth_unit_m: Annotated[FiniteFloat, Field(gt=0)] | None = None
    streams: list[str] = Field(default_factory=list)


class _World(Model):
    driver: str


class _Robot(Model):
    name: str
    model: str
    driver: str
    base_position: Annotated[list[float], Field(min_length=3, max_length=3)]
    base_orientation: Annotated[list[float], Field(min_length=4, max_length=4)]


class _View(Model):
    robot: str | None = None


class _RigCamera(Model):
    name: str
    view: _View | None = None


class _Resolved(Model):
    world: _World | None = None
    robots: list[_Robot] = Field(default_factory=list)
    cameras: list[_RigCamera] = Field(default_factory=list)


class _Rig(Model):
    resolved: _Resolved


class _Common(Model):
    """The entries of :data:`_COMMON` that are used here."""

    cameras: dict[CameraName, _Camera]
    rig: _Rig
    fps: Annotated[int, Field(ge=1, le=1000)] | None = None
    robot_type: str | None = None
    clock: Literal["real_time", "lock_step"] | None = None
    features: dict[CameraName, Feature] | None = None
    """Missing in episodes of older versions."""


_At = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]


class _Files(Model):
    index: Annotated[int, Field(ge=0)]
    data: _At
    videos: dict[CameraName, _At]


class _Own(Model):
    """The entries of ``episodes/N.json`` that are used here, without those of :class:`_Common`."""

    length: Annotated[int, Field(ge=1)]
    t_start: FiniteFloat
    task: str
    success: bool | None
    dropped: int | None = None
    gaps: list[Any] = Field(default_factory=list)
    trouble: str | None = None
    recovered: bool = False
    pace: dict[str, float] = Field(default_factory=dict)
    info: dict[str, Any] = Field(default_factory=dict)
    seed: int | None = None
    started: str | None = None
    files: _Files | None = None
    common: Annotated[str, Field(pattern="^common-[0-9a-f]{12}$")] | None = None


def read_about(layout: DatasetLayout, number: int) -> dict[str, Any]:
    """Return the metadata of an episode. What it has in common with others is in memory once; it must not be changed.

    Raises DatasetError.
    """
    path = layout.about(number)
    with dataset_errors(layout, path, number):
        data = read_json(path)
        name = _Own.model_validate(data).common
    common: dict[str, Any] = {}
    if name is not None:
        file = layout.common(name)
        with dataset_errors(layout, file, number):
            common = _read_common(file, file_version(file))
    with dataset_errors(layout, path, number):
        own = {key: value for key, value in data.items() if key not in _COMMON}
        if name is None or len(own) < len(data):
            common = _parse_common(json.dumps(common | {key: data[key] for key in _COMMON if key in data}))
    if "recipe" in common:
        own["info"] = own.get("info", {}) | {"recipe": common["recipe"]}
    found = common | own
    found.pop("recipe", None)
    return found


@lru_cache(maxsize=64)
def _read_common(path: Path, version: tuple[int, int] | None) -> dict[str, Any]:
    """Return the content of a common file; ``version`` is that of the file now."""
    return _parse_common(path.read_text(encoding="utf-8"))


@lru_cache(maxsize=64)
def _parse_common(text: str) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(text)
    _Common.model_validate(data)
    return data


def split_about(about: Mapping[str, Any]) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Return an episode's own entries, and the name and the content of the common file."""
    common = {key: about[key] for key in _COMMON if key in about}
    own = {key: value for key, value in about.items() if key not in common}
    if "recipe" in (info := dict(own.get("info") or {})):
        common["recipe"] = info.pop("recipe")
        own["info"] = info
    values = tuple(map(id, common.values()))
    if values not in _NAMES:
        if len(_NAMES) >= 64:
            _NAMES.clear()
        text = json.dumps(common, sort_keys=True, default=str)
        _NAMES[values] = f"common-{hashlib.sha256(text.encode()).hexdigest()[:12]}", common
    name, _ = _NAMES[values]
    return own | {"common": name}, name, common


_NAMES: dict[tuple[int, ...], tuple[str, dict[str, Any]]] = {}
"""Names by the identity of what a common file holds, which stays alive here."""
