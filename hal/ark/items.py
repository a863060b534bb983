"""The robots, sensors and objects that Ark's global file lists: in files of their own, or where they are listed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from .ledger import Ledger
from .options import Options
from .places import Places
from .reading import Node, Reading, Wrong

__all__ = ["Item", "Work"]

SECTIONS = {"robots": "robots", "sensors": "cameras", "objects": "objects"}
"""Ark's sections -> those of a rig."""


class Item(NamedTuple):
    """A robot, a sensor or an object of Ark's files."""

    name: str
    """Here."""
    given: str
    """In Ark's files."""
    config: Node
    key: str
    """Where it will stand in the rig."""


@dataclass
class Work:
    """An import as it goes on."""

    reading: Reading
    ledger: Ledger
    places: Places
    options: Options
    names: set[str] = field(default_factory=set)
    """Of everything in the rig."""
    given: dict[str, list[str]] = field(default_factory=lambda: {section: [] for section in SECTIONS})
    """Section -> the names in it, as Ark has them, those left out as well."""
    left_out: list[str] = field(default_factory=list)

    def items(self, root: Node, section: str) -> Iterator[Item]:
        """Those of a section that can be read; what is wrong with the others is noted."""
        with suppress(Wrong):
            yield from self._listed(root, section, nested=False)

    def _listed(self, root: Node, section: str, *, nested: bool) -> Iterator[Item]:
        listed = root.get(section)
        if listed is None:
            return
        if not isinstance(listed.data, list):
            raise self.reading.wrong(listed, "must be a list of files, or of items with name and config")
        if not listed.children:
            self.ledger.kept(listed, SECTIONS[section], "the files are read")
        for k, entry in enumerate(listed.data):
            with suppress(Wrong):
                yield from self._entry(listed, listed.children.get(str(k)), entry, section, nested)

    def _entry(self, listed: Node, node: Node | None, entry: Any, section: str, nested: bool) -> Iterator[Item]:
        if isinstance(entry, str) and not nested:
            self.ledger.kept(node, SECTIONS[section], "the file is read")
            beside = listed.file.parent / entry  # where Ark looks
            item = self.reading.file((beside if beside.is_file() else self.places.find(entry) or beside).resolve())
            if section in item.children:  # so are the examples that come with Ark's drivers
                yield from self._listed(item, section, nested=True)
                return
        elif isinstance(entry, dict) and node is not None:
            item = node
        else:
            raise self.reading.wrong(node or listed, f"must be files, or items with name and config, not {entry!r}")
        name = self.reading.need(item, "name")
        given = self.reading.text(name)
        if given in self.given[section]:
            raise self.reading.wrong(name, f"{given!r} is given twice among the {section}; Ark takes the last")
        self.given[section].append(given)
        config = self.reading.need(item, "config")
        if given in self.options.without:
            self.left_out.append(given)
            for left in (name, config):
                self.ledger.nothing(left, "left out, as --without says")
            return
        yield self._item(name, given, config, section)

    def _item(self, node: Node, given: str, config: Node, section: str) -> Item:
        name = self.own_name(given)
        key = f"{SECTIONS[section]}.{name}"
        target = key
        if section == "objects":  # a list
            number = len(self.given[section]) - 1 - sum(left in self.given[section] for left in self.left_out)
            key = f"objects.{number}"
            target = f"{key}.name"
        if name == given:
            self.ledger.kept(node, target)
        else:
            self.ledger.changed(node, target, f"{name}: letters, digits, _ and -, and no name twice in a rig")
        return Item(name, given, config, key)

    def own_name(self, given: str) -> str:
        """A name that a rig can have, and that is free in it."""
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", given).strip("_") or "thing"
        plain = plain if re.match(r"[A-Za-z_]", plain) else f"_{plain}"
        name, number = plain, 1
        while name in self.names:
            number += 1
            name = f"{plain}_{number}"
        self.names.add(name)
        return name
