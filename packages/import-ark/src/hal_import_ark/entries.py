"""The robots, sensors and objects of Ark's global file, its options, and positions and rotations in its files."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from hal.geometry import matrix_to_quaternion, rpy_to_matrix

from .output import Commented, KeyReport
from .reading import ArkNode, ArkReader, FileFinder, InvalidValue


class ArkRotation(NamedTuple):
    """A quaternion x, y, z, w, with a comment if it was converted."""

    value: list[float | int] | Commented
    turns: bool
    """Whether it differs from the identity."""


def position_of(
    node: ArkNode, key: str, target: str, reading: ArkReader, ledger: KeyReport
) -> list[float | int] | None:
    """Return the position at ``key``, m; None if there is none."""
    child = node.get(key)
    if child is None:
        return None
    values = reading.numbers(child, (3,))
    ledger.kept(child, target)
    return values


def rotation_of(node: ArkNode, key: str, target: str, reading: ArkReader, ledger: KeyReport) -> ArkRotation | None:
    """Return the rotation at ``key``, a quaternion or Euler angles in rad; None if there is none."""
    child = node.get(key)
    if child is None:
        return None
    values = reading.rotation(child)
    if len(values) == 4:
        length = math.hypot(*values)
        if abs(length - 1.0) <= 0.005:
            ledger.kept(child, target)
            return ArkRotation(values, any(values[:3]))
        unit = tidy([value / length for value in values])
        note = f"a quaternion of length {length:.3g}, normalised"
    else:
        unit = tidy(matrix_to_quaternion(rpy_to_matrix(*values)).tolist())
        note = "Euler angles (rad) converted to a quaternion"
        if max(map(abs, values)) > 2.0 * math.pi:
            note += "; beyond a full turn: check that these are not degrees; Ark reads them as rad"
    ledger.changed(child, target, note)
    return ArkRotation(Commented(unit, f"Ark: {values}"), any(unit[:3]))


def tidy(values: list[float]) -> list[float | int]:
    """Return computed numbers rounded to six digits."""
    return [int(rounded) if (rounded := round(value, 6)).is_integer() else rounded for value in values]


RIG_SECTIONS = {"robots": "robots", "sensors": "cameras", "objects": "objects"}
"""Sections of a rig by Ark's sections."""


class ArkItem(NamedTuple):
    """A robot, a sensor or an object of Ark's files."""

    name: str
    """Name in the rig."""
    given: str
    """Name in Ark's files."""
    config: ArkNode
    key: str
    """Its key in the rig."""


@dataclass
class ImportState:
    """State of a running import."""

    reading: ArkReader
    ledger: KeyReport
    places: FileFinder
    options: ArkOptions
    names: set[str] = field(default_factory=set)
    """All names of the rig."""
    given: dict[str, list[str]] = field(default_factory=lambda: {section: [] for section in RIG_SECTIONS})
    """Names in each of Ark's sections, including those left out."""
    left_out: list[str] = field(default_factory=list)

    def items(self, root: ArkNode, section: str) -> Iterator[ArkItem]:
        """Yield the entries of a section that can be read; problems of the others are noted."""
        with suppress(InvalidValue):
            yield from self._list_items(root, section, nested=False)

    def _list_items(self, root: ArkNode, section: str, *, nested: bool) -> Iterator[ArkItem]:
        listed = root.get(section)
        if listed is None:
            return
        if not isinstance(listed.data, list):
            raise self.reading.wrong(listed, "must be a list of files, or of items with name and config", "wrong_type")
        if not listed.children:
            self.ledger.kept(listed, RIG_SECTIONS[section], "the files are read")
        for k, entry in enumerate(listed.data):
            with suppress(InvalidValue):
                yield from self._entry(listed, listed.children.get(str(k)), entry, section, nested)

    def _entry(
        self, listed: ArkNode, node: ArkNode | None, entry: Any, section: str, nested: bool
    ) -> Iterator[ArkItem]:
        if isinstance(entry, str) and not nested:
            self.ledger.kept(node, RIG_SECTIONS[section], "the file is read")
            beside = listed.file.parent / entry  # where Ark looks
            item = self.reading.file((beside if beside.is_file() else self.places.find(entry) or beside).resolve())
            if section in item.children:  # so are the examples that come with Ark's drivers
                yield from self._list_items(item, section, nested=True)
                return
        elif isinstance(entry, dict) and node is not None:
            item = node
        else:
            message = f"must be files, or items with name and config, not {entry!r}"
            raise self.reading.wrong(node or listed, message, "wrong_type")
        name = self.reading.need(item, "name")
        given = self.reading.text(name)
        if given in self.given[section]:
            message = f"{given!r} is given twice among the {section}; Ark takes the last"
            raise self.reading.wrong(name, message, "duplicate_name")
        self.given[section].append(given)
        config = self.reading.need(item, "config")
        if given in self.options.without:
            self.left_out.append(given)
            for left in (name, config):
                self.ledger.ignored(left, "left out (--without)")
            return
        yield self._item(name, given, config, section)

    def _item(self, node: ArkNode, given: str, config: ArkNode, section: str) -> ArkItem:
        name = self.own_name(given)
        key = f"{RIG_SECTIONS[section]}.{name}"
        target = key
        if section == "objects":  # a list
            number = len(self.given[section]) - 1 - sum(left in self.given[section] for left in self.left_out)
            key = f"objects.{number}"
            target = f"{key}.name"
        if name == given:
            self.ledger.kept(node, target)
        else:
            self.ledger.changed(node, target, f"{name}: letters, digits, _ and -, and no name twice in a rig")
        return ArkItem(name, given, config, key)

    def own_name(self, given: str) -> str:
        """Return a name that is valid and unused in the rig."""
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", given).strip("_") or "object"
        plain = plain if re.match(r"[A-Za-z_]", plain) else f"_{plain}"
        name, number = plain, 1
        while name in self.names:
            number += 1
            name = f"{plain}_{number}"
        self.names.add(name)
        return name


@dataclass(frozen=True)
class ArkOptions:
    """Options of an import. Names are those in Ark's files."""

    start: Path | None = None
    """Folder that Ark is started in and its paths are relative to; None to search for it."""
    arms: Mapping[str, str] = field(default_factory=dict)
    """Model of each robot, by name, if its joints do not identify it."""
    urdfs: Mapping[str, Path] = field(default_factory=dict)
    """URDF of each robot or object, by name, if it is not found."""
    without: frozenset[str] = frozenset()
    """Robots, sensors and objects to leave out."""
    camera_model: str = "pinhole"
    """Model of every camera: ``pinhole`` uses the field of view of Ark's file, a real camera's name uses its own."""
