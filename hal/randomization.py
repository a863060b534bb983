"""Scenes that vary: what ``rig.world.randomize(seed)`` draws from the ranges of a rig file, and how it is applied.

Each value has a random generator of its own, of the seed and the value's key: a range that is added to the rig file
changes no other value, and the values do not depend on the engine. They are plain numbers, texts and lists by the key
of their range in ``simulation.randomize``, for example ``cameras.scene.exposure``.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from .arguments import integer
from .errors import CommandError
from .geometry import Pose
from .specs import BodySpec, CameraSpec, RandomizeSpec, VariationSpec, ViewSpec, WorldSpec

TEXTURES = ("checker", "gradient", "marble", "noise", "stripes", "wood")
"""Names of the built-in textures."""
LIGHTS = 3
"""Greatest number of lights."""
COUNT, DISTRACTORS = "light.count", "distractors"
"""Keys of the number of lights, and of the names of the distractors."""

Values = Mapping[str, Any]


def draw_values(spec: RandomizeSpec, seed: int) -> dict[str, Any]:
    """Return a value of each range, by its key; the same seed gives the same values."""
    drawn: dict[str, Any] = {}
    for variation in spec.variations:
        random = np.random.default_rng([seed, zlib.crc32(variation.key.encode())])
        if variation.choices:
            drawn[variation.key] = variation.choices[int(random.integers(len(variation.choices)))]
        elif variation.key == DISTRACTORS:
            count = int(random.integers(int(variation.lower[0]), int(variation.upper[0]) + 1))
            chosen = set(random.permutation(len(spec.distractors))[:count].tolist())
            drawn[variation.key] = [body.name for k, body in enumerate(spec.distractors) if k in chosen]
        elif variation.key == COUNT:
            drawn[variation.key] = int(random.integers(int(variation.lower[0]), int(variation.upper[0]) + 1))
        else:
            lower, upper = np.array(variation.lower), np.array(variation.upper)
            numbers = (lower + (upper - lower) * random.random(len(lower))).tolist()
            drawn[variation.key] = numbers if len(numbers) > 1 else numbers[0]
    lights = drawn.get(COUNT, 1)
    gone = tuple(f"objects.{body.name}." for body in spec.distractors if body.name not in drawn[DISTRACTORS])
    return {key: value for key, value in drawn.items() if _light_number(key) < lights and not key.startswith(gone)}


def _light_number(key: str) -> int:
    """Return the number of the light that a key is of; 0 for any other key."""
    number = key.removeprefix("light.").partition(".")[0]
    return int(number) if key.startswith("light.") and number.isdecimal() else 0


def list_distractors(world: WorldSpec | None) -> tuple[BodySpec, ...]:
    """Return the objects that a randomization may add to a world."""
    return () if world is None or world.randomize is None else world.randomize.distractors


def vary_camera(spec: CameraSpec, values: Values) -> CameraSpec:
    """Return the record of a camera with the pose and the field of view in ``values``."""
    section = f"cameras.{spec.name}"
    shift, turn = values.get(f"{section}.position_m"), values.get(f"{section}.rotation_deg")
    scale = values.get(f"{section}.field_of_view_scale")
    if (shift or turn) and spec.view is not None:
        view = spec.view
        there = Pose(view.position, view.orientation)
        there = there @ Pose.from_rpy(shift or (0.0, 0.0, 0.0), [math.radians(angle) for angle in turn or (0, 0, 0)])
        position, orientation = there.position.tolist(), there.orientation.tolist()
        spec = replace(spec, view=ViewSpec(tuple(position), tuple(orientation), view.robot, view.link))
    if scale is not None:
        sensors = {name: replace(sensor, K=_widen(sensor.K, scale)) for name, sensor in spec.sensors.items()}
        infrared = None if spec.K_infrared is None else _widen(spec.K_infrared, scale)
        spec = replace(spec, K=_widen(spec.K, scale), K_infrared=infrared, sensors=sensors)
    return spec


def _widen(K: Any, scale: float) -> Any:
    """Return a camera matrix whose picture shows ``scale`` times as much to each side."""
    (fx, skew, cx), (zero, fy, cy), last = K
    return (fx / scale, skew / scale, cx), (zero, fy / scale, cy), last


class _VariedWorld(Protocol):
    """What is needed of a :class:`hal.world.World`."""

    @property
    def bodies(self) -> tuple[str, ...]: ...
    def links(self, name: str) -> tuple[str, ...]: ...
    def add(self, body: BodySpec) -> None: ...
    def remove(self, name: str) -> None: ...
    def dynamics(self, name: str, link: str | None = None) -> dict[str, Any]: ...
    def set_dynamics(self, name: str, link: str | None = None, **values: float) -> dict[str, Any]: ...


class Randomizer:
    """Applies drawn values to a world, and restores what the rig file says."""

    def __init__(self, spec: WorldSpec | None) -> None:
        self._spec = spec.randomize if spec is not None else None
        self._undo: list[tuple[str, str, dict[str, Any]]] = []
        self._added: list[str] = []
        self.clean = True
        """Whether the world is as in the rig file; not after an attempt that failed midway, either."""
        self.record: dict[str, Any] | None = None
        """``seed`` and ``values`` of what is applied; None if the world is as in the rig file."""

    def make_record(self, given: int | Mapping[str, Any]) -> dict[str, Any]:
        """Return the record of a seed, or a checked copy of a record. Raises CommandError."""
        if self._spec is None:
            text = "this rig varies nothing: add ranges as simulation.randomize to its file"
            raise CommandError(text, code="no_randomize")
        if not isinstance(given, Mapping):
            seed = integer("seed", given, least=0)
            return {"seed": seed, "values": draw_values(self._spec, seed)}
        if set(given) != {"seed", "values"} or not isinstance(given["values"], Mapping):
            raise CommandError("a record of a randomization has the keys seed and values", code="bad_record")
        known = {variation.key: variation for variation in self._spec.variations}
        for key, value in given["values"].items():
            if key not in known or not self._can_be_drawn(known[key], value):
                text = f"the record has {key} = {value!r}, which simulation.randomize of this rig does not draw"
                raise CommandError(text, code="bad_record")
        copied: dict[str, Any] = json.loads(json.dumps(dict(given)))
        return copied | {"seed": integer("seed", copied["seed"], least=0)}

    def _can_be_drawn(self, variation: VariationSpec, value: Any) -> bool:
        """Return whether a value is one of the choices, or within the range."""
        if variation.choices:
            return value in variation.choices
        if variation.key == DISTRACTORS:
            assert self._spec is not None
            return isinstance(value, list) and {body.name for body in self._spec.distractors}.issuperset(value)
        numbers = value if isinstance(value, list) else [value]
        return len(numbers) == len(variation.lower) and all(
            isinstance(number, int | float) and low <= number <= high
            for number, low, high in zip(numbers, variation.lower, variation.upper, strict=True)
        )

    def apply(self, world: _VariedWorld, record: dict[str, Any] | None) -> dict[str, Any]:
        """Restore the dynamics and objects of the rig file, then apply those of ``record``.

        Returns:
            The parameters of the edit that does the rest: light, colours, cameras, latencies and noise.
        """
        self.clean = False
        there = world.bodies
        for name, link, values in reversed(self._undo):
            if name in there:
                world.set_dynamics(name, link, **values)
        for name in self._added:
            if name in there:
                world.remove(name)
        self._undo, self._added, self.record = [], [], None
        values = {} if record is None else record["values"]
        assert self._spec is not None
        for body in self._spec.distractors:
            if body.name in values.get(DISTRACTORS, ()):
                world.add(body)
                self._added.append(body.name)
        for key, value in values.items():
            section, _, rest = key.partition(".")
            what = rest.rpartition(".")[2]
            if section in ("objects", "robots") and what in _SCALED:
                name, _, place = rest.rpartition(".")[0].partition(".")
                if name in there:
                    links: Iterable[str] = (place.removeprefix("links."),) if place else world.links(name)
                    self._scale(world, name, links, _SCALED[what], value)
        return {"values": dict(values), "seed": 0 if record is None else record["seed"]}

    def _scale(self, world: _VariedWorld, name: str, links: Iterable[str], quantity: str, factor: float) -> None:
        for link in links:
            before = world.dynamics(name, link)[quantity]
            if before:
                self._undo.append((name, link, world.set_dynamics(name, link, **{quantity: factor * before})))


_SCALED = {"mass_scale": "mass", "friction_scale": "lateral_friction"}
"""Keys whose value is a factor on a property of a link."""
