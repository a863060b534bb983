"""Resolve the section ``simulation.randomize`` of a rig's file: every name in it is looked up."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import suggest
from ..kinematics.urdf import read_urdf
from ..randomization import COUNT, DISTRACTORS, TEXTURES
from ..specs import BodySpec, CameraSpec, RandomizeSpec, RobotSpec, VariationSpec
from .context import Context
from .data_files import is_path, user_path
from .objects import load_objects
from .randomize import EVERY, BodyVariation, LightVariation, RandomizeConfig
from .schema import Strict, Unknown

SECTION = "simulation.randomize"
_NO_TEXTURE = "none"
_AXES = 3
"""A range of these keys is for each of three axes."""
_ON_EACH_AXIS = frozenset({"position_m", "rotation_deg"})


def resolve_randomize(
    context: Context,
    robots: Sequence[RobotSpec],
    cameras: Sequence[CameraSpec],
    bodies: Sequence[BodySpec],
    taken: dict[str, str],
) -> RandomizeSpec | None:
    """Return what varies in a rig's world; None if nothing does, or with problems, which are added."""
    config = context.rig.simulation.randomize
    if config is None:
        return None
    found = list(_light(config.light))
    found += _variations(context, "background", f"{SECTION}.background", config.background)
    if config.light.count is not None:
        found.append(VariationSpec(COUNT, *_ends(config.light.count)))
    distractors: tuple[BodySpec, ...] = ()
    with suppress(Unknown):
        if config.distractors is not None:
            distractors = load_objects(context, config.distractors.objects, f"{SECTION}.distractors.objects", taken)
            found.append(VariationSpec(DISTRACTORS, *_ends(config.distractors.count)))
            if len(config.distractors.objects) < config.distractors.count[1]:
                text = f"asks for up to {config.distractors.count[1]:g} of {len(config.distractors.objects)} objects"
                context.report(f"{SECTION}.distractors.count", text, "out_of_range")
    _check_textures(context, config)
    if context.problems.found:  # else a name would be unknown because its file is wrong
        return None
    links = {body.name: _links_of(body) for body in (*bodies, *distractors)}
    for robot in robots:
        own = {name: name for name in context.urdfs[robot.name].links}
        links[robot.name] = own | context.links.get(robot.name, {})
    names = [body.name for body in (*bodies, *distractors)]
    for name, key, own in _entries(context, "objects", config.objects, names):
        found += _body(context, f"objects.{name}", key, own, links[name])
    for name, key, arm in _entries(context, "robots", config.robots, [robot.name for robot in robots]):
        found += _body(context, f"robots.{name}", key, arm, links[name])
        found += _variations(context, f"robots.{name}.gripper", f"{key}.gripper", arm.gripper)
    for name, key, camera in _entries(context, "cameras", config.cameras, [camera.name for camera in cameras]):
        found += _variations(context, f"cameras.{name}", key, camera)
    return RandomizeSpec(tuple(found), distractors)


def _ends(ends: tuple[float, float], count: int = 1) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (ends[0],) * count, (ends[1],) * count


def _light(config: LightVariation) -> Iterator[VariationSpec]:
    """Yield the ranges of the light: those of one light are for each of them."""
    most = int(config.count[1]) if config.count is not None else 1
    if config.ambient is not None:
        yield VariationSpec("light.ambient", *_ends(config.ambient))
    if config.intensity is not None:
        yield VariationSpec("light.intensity", *_ends(config.intensity))
    for k in range(most):
        for key in ("azimuth_deg", "elevation_deg"):
            if (ends := getattr(config, key)) is not None:
                yield VariationSpec(f"light.{k}.{key}", *_ends(ends))
        if config.color is not None:
            yield VariationSpec(f"light.{k}.color", *config.color)


def _links_of(body: BodySpec) -> dict[str, str]:
    names = ("base",) if body.urdf is None else tuple(read_urdf(Path(body.urdf)).links)
    return {name: name for name in names}


def _entries(
    context: Context, section: str, given: Mapping[str, Any], names: Sequence[str]
) -> Iterator[tuple[str, str, Any]]:
    """Yield name, key in the file and variation of each device or object that has one."""
    for name in given:
        if name != EVERY and name not in names:
            kind = section.removesuffix("s")
            text = f"this rig has no {kind} {name!r}{suggest(name, (*names, EVERY))}"
            context.report(f"{SECTION}.{section}.{name}", text, f"unknown_{kind}")
    every = given.get(EVERY)
    for name in names:
        own = given.get(name)
        if own is not None and every is not None:
            fields = {key: getattr(own, key) for key in own.model_fields_set}
            yield name, f"{SECTION}.{section}.{name}", every.model_copy(update=fields)
        elif (found := own or every) is not None:
            yield name, f"{SECTION}.{section}.{name if own is not None else EVERY}", found


def _body(
    context: Context, prefix: str, key: str, config: BodyVariation, links: Mapping[str, str]
) -> Iterator[VariationSpec]:
    yield from _variations(context, prefix, key, config)
    for link, own in config.links.items():
        place = f"{key}.links.{link}"
        if link in links:
            yield from _variations(context, f"{prefix}.links.{links[link]}", place, own)
        else:
            name = prefix.partition(".")[2]
            context.report(place, f"{name!r} has no link {link!r}{suggest(link, links)}", "unknown_link")


def _variations(context: Context, prefix: str, key: str, config: Strict) -> Iterator[VariationSpec]:
    """Yield the ranges and choices in a record, not those in records inside of it."""
    for name in type(config).model_fields:
        value = getattr(config, name)
        if name == "texture" and value is not None:
            yield VariationSpec(f"{prefix}.{name}", choices=tuple(_textures(context, f"{key}.{name}", value)))
        elif name == "color" and value is not None:
            yield VariationSpec(f"{prefix}.{name}", *value)
        elif isinstance(value, tuple):
            yield VariationSpec(f"{prefix}.{name}", *_ends(value, _AXES if name in _ON_EACH_AXIS else 1))


def _check_textures(context: Context, config: RandomizeConfig) -> None:
    """Report missing textures, each at its place in the file."""
    with suppress(Unknown):
        records: list[tuple[str, Any]] = [("background", config.background)]
        for section in ("objects", "robots"):
            for name, body in getattr(config, section).items():
                records.append((f"{section}.{name}", body))
                records += [(f"{section}.{name}.links.{link}", own) for link, own in body.links.items()]
        for key, record in records:
            with suppress(Unknown):
                if record.texture is not None:
                    list(_textures(context, f"{SECTION}.{key}.texture", record.texture))


def _textures(context: Context, key: str, given: Iterable[str]) -> Iterator[str]:
    """Yield the textures to choose from: built-in names, absolute paths, and "" for none."""
    for k, name in enumerate(given):
        if name in TEXTURES:
            yield name
        elif name == _NO_TEXTURE:
            yield ""
        elif not is_path(name) and not Path(name).suffix:
            text = f"there is no texture {name!r}{suggest(name, (*TEXTURES, _NO_TEXTURE))}, or a path to a picture"
            context.report(f"{key}.{k}", text, "unknown_texture")
        else:
            path = user_path(name, context.base)
            if problem := _explain_picture(path):
                context.report(f"{key}.{k}", *problem)
            yield str(path)


def _explain_picture(path: Path) -> tuple[str, str] | None:
    """Return message and code if a file is no picture; None if it is one."""
    if not os.path.isfile(path):
        there = [f"{path.parent.name}/{one.name}" for one in path.parent.glob("*.[pj][np]*g")]
        return f"there is no file {path}{suggest(f'{path.parent.name}/{path.name}', there)}", "missing_file"
    from PIL import Image

    try:
        with Image.open(path) as picture:
            picture.verify()
    except (OSError, SyntaxError, ValueError) as error:
        return f"{path} is no picture that can be read: {error}; use a PNG or JPEG file", "bad_texture"
    return None
