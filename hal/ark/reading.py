"""Ark's YAML files with the line of every key, and errors that name file and line."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from ..config.files import PlacedErrors, Problems, check_size, nearest
from ..config.schema import describe, is_number
from ..errors import ConfigError

__all__ = ["Node", "Reading", "Wrong"]


class Wrong(Exception):
    """Something cannot be used; the problem is noted already."""


class Node:
    """A value in one of Ark's files, and where it stands."""

    def __init__(self, file: Path, line: int, key: str, data: Any, children: dict[str, Node]) -> None:
        self.file = file
        self.line = line
        """Of its key, counted from 1."""
        self.key = key
        """Dotted, from the top of its file; empty for the whole file."""
        self.data = data
        self.children = children
        """Of keys and values, and of a list in which there are such; nothing else is looked into."""

    def get(self, key: str) -> Node | None:
        """What stands at a key; None where there is nothing."""
        child = self.children.get(key)
        return None if child is None or child.data is None else child

    def leaves(self) -> Iterator[Node]:
        """Itself where it is a plain value, else those below it, in the order of the file."""
        if not self.children:
            yield self
        for child in self.children.values():
            yield from child.leaves()

    @property
    def place(self) -> str:
        """``file:line``."""
        return f"{self.file}:{self.line}"


class Reading:
    """Reads Ark's files, and takes values out of them. What is wrong is noted, with its line, and raises Wrong."""

    def __init__(self) -> None:
        self.problems = Problems()
        self.files: dict[Path, Node] = {}
        """What was read so far, in that order."""

    def wrong(self, node: Node, message: str) -> Wrong:
        """Note a problem; raise what comes back."""
        self.problems.add(node.place, node.key, message)
        return Wrong()

    def file(self, path: Path) -> Node:
        """The keys and values of a file, read once."""
        if path not in self.files:
            self.files[path] = self._read(path)
        return self.files[path]

    def _read(self, path: Path) -> Node:
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            siblings = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
            self.problems.add(path, "", "there is no such file" + (nearest(path.name, siblings) if siblings else ""))
            raise Wrong from None
        except (OSError, UnicodeDecodeError) as error:
            self.problems.add(path, "", f"cannot be read: {error}")
            raise Wrong from None
        try:
            root, data = _parse(text)
        except yaml.YAMLError as error:
            line, message = _not_yaml(text, error)
            self.problems.add(f"{path}:{line}", "", message)
            raise Wrong from None
        if not isinstance(data, dict) or root is None:
            self.problems.add(path, "", f"must hold keys and values, not {describe(data)}")
            raise Wrong
        for line, key, message in (*_long_quotes(root, ""), *_twice(root, "")):
            self.problems.add(f"{path}:{line}", key, message)
        return _node(path, 1, "", root, data)

    def need(self, node: Node, key: str) -> Node:
        """What stands at a key that must be there."""
        child = node.get(key)
        if child is None:
            raise self.wrong(node, f"{key!r} is missing")
        return child

    def keys(self, node: Node) -> Node:
        """The same node, if it holds keys and values."""
        if not isinstance(node.data, dict):
            raise self.wrong(node, f"must hold keys and values, not {describe(node.data)}")
        return node

    def text(self, node: Node) -> str:
        """A word."""
        if not isinstance(node.data, str) or not node.data:
            raise self.wrong(node, f"must be a text, not {describe(node.data)}")
        return node.data

    def words(self, node: Node) -> list[str]:
        """A list of words."""
        if not isinstance(node.data, list) or not all(isinstance(item, str) for item in node.data):
            raise self.wrong(node, f"must be a list of names, not {describe(node.data)}")
        return list(node.data)

    def flag(self, node: Node) -> bool:
        """True or false; PyBullet takes 1 and 0 as well."""
        if node.data not in (True, False, 0, 1):
            raise self.wrong(node, f"must be true or false, not {describe(node.data)}")
        return bool(node.data)

    def whole(self, node: Node) -> int:
        """A whole number."""
        if not isinstance(node.data, int) or isinstance(node.data, bool):
            raise self.wrong(node, f"must be a whole number, not {describe(node.data)}")
        return node.data

    def number(self, node: Node, *, positive: bool = False) -> float | int:
        """A number, as it is written."""
        if not is_number(node.data) or (positive and not node.data > 0):
            raise self.wrong(node, f"must be a {'positive ' if positive else ''}number, not {describe(node.data)}")
        value: float | int = node.data
        return value

    def numbers(self, node: Node, counts: Collection[int] = ()) -> list[float | int]:
        """A list of numbers, as they are written, one of ``counts`` long."""
        data = node.data
        if not isinstance(data, list) or (counts and len(data) not in counts):
            size = f"{' or '.join(map(str, sorted(counts)))} numbers" if counts else "numbers"
            raise self.wrong(node, f"must be a list of {size}, not {describe(data)}")
        for k, item in enumerate(data):
            if not is_number(item):
                raise self.wrong(node, f"must be numbers; item {k + 1} is {describe(item)}")
        return list(data)

    def rotation(self, node: Node) -> list[float | int]:
        """Three angles, or a quaternion that is not zero."""
        values = self.numbers(node, (3, 4))
        if len(values) == 4 and math.hypot(*values) < 1e-6:
            raise self.wrong(node, "is no rotation: a quaternion of nothing but zeros")
        return values

    def raise_any(self) -> None:
        """Raise a ConfigError with every problem, if there is one."""
        if self.problems.found:
            found = self.problems.found
            raise ConfigError(sorted(found, key=lambda problem: problem.file.rpartition(":")[0] or problem.file))


class _Loader(PlacedErrors, yaml.SafeLoader):
    """YAML 1.1, as Ark reads it."""


def _parse(text: str) -> tuple[yaml.Node | None, Any]:
    """Return one document, as nodes with their lines and as data. Raises yaml.YAMLError."""
    check_size(text, _Loader)
    loader = _Loader(text)
    try:
        root = loader.get_single_node()
        return root, loader.construct_document(root) if root is not None else None
    finally:
        loader.dispose()


def _node(file: Path, line: int, key: str, node: yaml.Node, data: Any) -> Node:
    children: dict[str, Node] = {}
    if isinstance(node, yaml.MappingNode) and isinstance(data, dict):
        by_text = {str(name): value for name, value in data.items()}
        for name, value in node.value:
            word = str(name.value)
            inside = f"{key}.{word}" if key else word
            children[word] = _node(file, name.start_mark.line + 1, inside, value, by_text.get(word))
    elif isinstance(node, yaml.SequenceNode) and isinstance(data, list) and any(isinstance(x, dict) for x in data):
        for k, (item, value) in enumerate(zip(node.value, data, strict=True)):
            children[str(k)] = _node(file, item.start_mark.line + 1, f"{key}.{k}", item, value)
    return Node(file, line, key, data, children)


def _twice(node: yaml.Node, key: str) -> Iterator[tuple[int, str, str]]:
    """Keys that are given twice: line, key and message."""
    if isinstance(node, yaml.MappingNode):
        first: dict[str, int] = {}
        for name, value in node.value:
            inside, line = f"{key}.{name.value}" if key else str(name.value), name.start_mark.line + 1
            if inside in first:
                yield line, inside, f"is given in line {first[inside]}, too; Ark takes the last one. Take one out"
            first[inside] = line
            yield from _twice(value, inside)
    elif isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            yield from _twice(item, f"{key}.{k}")


def _long_quotes(node: yaml.Node, key: str) -> Iterator[tuple[int, str, str]]:
    """Quoted texts that run over several lines and look like YAML: line, key and message."""
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            yield from _long_quotes(value, f"{key}.{name.value}" if key else str(name.value))
    elif isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            yield from _long_quotes(item, f"{key}.{k}")
    elif isinstance(node, yaml.ScalarNode) and node.style in ('"', "'") and ":" in node.value:
        first, last = node.start_mark.line + 1, node.end_mark.line + 1
        if last > first:
            yield first, key, f"the quote that opens in this line closes only in line {last}: is one missing?"


def _not_yaml(text: str, error: yaml.YAMLError) -> tuple[int, str]:
    """The line to look at, and what is wrong there. A quote that is not closed shows only lines later."""
    if isinstance(error, yaml.reader.ReaderError):
        return text.count(
            "\n", 0, error.position
        ) + 1, f"holds a character that YAML does not allow: {error.character:#x}"
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    line = mark.line + 1 if mark is not None else 1
    said = getattr(error, "problem", None) or " ".join(str(error).split())
    lines = text.splitlines()
    for number, content in enumerate(lines[:line], start=1):
        if _open_quote(content):
            return number, f"the quote that opens here is not closed: {content.strip()} (in line {line}: {said})"
    shown = lines[line - 1].strip() if line <= len(lines) else ""
    return line, f"is not valid YAML: {said}" + (f": {shown}" if shown else "")


def _open_quote(line: str) -> bool:
    """Does a quoted text begin in this line that does not end in it?"""
    quote = ""
    before = " "
    for letter in line:
        if quote:
            if letter == quote and before != "\\":
                quote = ""
        elif letter in "\"'" and before in " \t[{,:-":
            quote = letter
        elif letter == "#" and before in " \t":
            return False
        before = letter
    return bool(quote)
