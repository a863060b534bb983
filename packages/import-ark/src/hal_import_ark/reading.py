"""Reads Ark's YAML files with the line of every key; errors name file and line."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from hal.config.files import PlacedErrors, Problems
from hal.config.schema import describe, is_number
from hal.errors import ConfigError, suggest
from hal.kinematics.mesh_files import package_folder

UPWARDS = 4
"""Searched folders above the global file; the tutorial's robots are three levels above its folder."""
PACKAGE = "pybullet_data"
"""Package whose folder Ark adds to PyBullet's search path."""


class PackageFile(str):
    """Path of a file inside :data:`PACKAGE`."""


class FileFinder:
    """Finds files by paths relative to the folder that Ark is started in, which its files do not state.

    Args:
        global_file: Ark's global file.
        start: The folder that Ark is started in; None to search beside and above the global file.
    """

    def __init__(self, global_file: Path, start: Path | None) -> None:
        folder = global_file.parent
        guesses = [start] if start is not None else [folder, *folder.parents[:UPWARDS], Path.cwd()]
        self.starts = list(dict.fromkeys(guess.resolve() for guess in guesses))

    def find(self, path: str, *beside: Path) -> Path | None:
        """Return a file or folder: ``path`` relative to where Ark starts, or to one of the folders ``beside``."""
        given = Path(path).expanduser()
        return next(
            (there for folder in (*self.starts, *beside) if (there := (folder / given).resolve()).exists()), None
        )

    def in_package(self, path: str) -> PackageFile | None:
        """Return the path if it exists in PyBullet's own data."""
        folder = package_folder(PACKAGE)
        return PackageFile(path) if folder is not None and (folder / path).is_file() else None

    def searched(self) -> str:
        """Return the searched folders as text."""
        first, *others = map(str, self.starts)
        return first if not others else f"{first} and {len(others)} more folders"


class InvalidValue(Exception):
    """A value cannot be used; the problem is already noted."""


class ArkNode:
    """A value in one of Ark's files, with its position."""

    def __init__(self, file: Path, line: int, key: str, data: Any, children: dict[str, ArkNode]) -> None:
        self.file = file
        self.line = line
        """Line of its key, counted from 1."""
        self.key = key
        """Dotted key from the top of the file; empty for the whole file."""
        self.data = data
        self.children = children
        """Values of a mapping, and of a list that contains mappings; empty for others."""

    def get(self, key: str) -> ArkNode | None:
        """Return the value of a key; None if it is missing or empty."""
        child = self.children.get(key)
        return None if child is None or child.data is None else child

    def leaves(self) -> Iterator[ArkNode]:
        """Yield the plain values at or below this one, in the order of the file."""
        if not self.children:
            yield self
        for child in self.children.values():
            yield from child.leaves()

    @property
    def place(self) -> str:
        """``file:line``."""
        return f"{self.file}:{self.line}"


class ArkReader:
    """Reads and checks values of Ark's files. A wrong one is noted with its line, and InvalidValue is raised."""

    def __init__(self) -> None:
        self.problems = Problems()
        self.files: dict[Path, ArkNode] = {}
        """Files read so far, in order."""

    def wrong(self, node: ArkNode, message: str, code: str) -> InvalidValue:
        """Note a problem and return the exception to raise."""
        self.problems.add(node.place, node.key, message, code)
        return InvalidValue()

    def file(self, path: Path) -> ArkNode:
        """Return the content of a file; every file is read once."""
        if path not in self.files:
            self.files[path] = self._read(path)
        return self.files[path]

    def _read(self, path: Path) -> ArkNode:
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            siblings = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
            hint = suggest(path.name, siblings) if siblings else ""
            self.problems.add(path, "", f"there is no such file{hint}", "missing_file")
            raise InvalidValue from None
        except (OSError, UnicodeDecodeError) as error:
            self.problems.add(path, "", f"cannot be read: {error}", "unreadable")
            raise InvalidValue from None
        try:
            root, data = _parse(text)
        except yaml.YAMLError as error:
            line, message = _not_yaml(text, error)
            self.problems.add(f"{path}:{line}", "", message, "bad_yaml")
            raise InvalidValue from None
        if not isinstance(data, dict) or root is None:
            self.problems.add(path, "", f"must be keys and values, not {describe(data)}", "wrong_type")
            raise InvalidValue
        for line, key, message in _long_quotes(root, ""):
            self.problems.add(f"{path}:{line}", key, message, "bad_yaml")
        for line, key, message in _twice(root, ""):
            self.problems.add(f"{path}:{line}", key, message, "duplicate_key")
        return _node(path, 1, "", root, data)

    def need(self, node: ArkNode, key: str) -> ArkNode:
        """Return the value of a required key."""
        child = node.get(key)
        if child is None:
            raise self.wrong(node, f"{key!r} is missing", "missing_key")
        return child

    def keys(self, node: ArkNode) -> ArkNode:
        """Return the same node if it is a mapping."""
        if not isinstance(node.data, dict):
            raise self.wrong(node, f"must be keys and values, not {describe(node.data)}", "wrong_type")
        return node

    def text(self, node: ArkNode) -> str:
        """Return a text that is not empty."""
        if not isinstance(node.data, str) or not node.data:
            raise self.wrong(node, f"must be a text, not {describe(node.data)}", "wrong_type")
        return node.data

    def words(self, node: ArkNode) -> list[str]:
        """Return a list of texts."""
        if not isinstance(node.data, list) or not all(isinstance(item, str) for item in node.data):
            raise self.wrong(node, f"must be a list of names, not {describe(node.data)}", "wrong_type")
        return list(node.data)

    def flag(self, node: ArkNode) -> bool:
        """Return true or false; 1 and 0 are accepted, as by PyBullet."""
        if node.data not in (True, False, 0, 1):
            raise self.wrong(node, f"must be true or false, not {describe(node.data)}", "wrong_type")
        return bool(node.data)

    def whole(self, node: ArkNode) -> int:
        """Return a whole number."""
        if not isinstance(node.data, int) or isinstance(node.data, bool):
            raise self.wrong(node, f"must be a whole number, not {describe(node.data)}", "wrong_type")
        return node.data

    def number(self, node: ArkNode, *, positive: bool = False) -> float | int:
        """Return a number as written."""
        if not is_number(node.data) or (positive and not node.data > 0):
            message = f"must be a {'positive ' if positive else ''}number, not {describe(node.data)}"
            raise self.wrong(node, message, "out_of_range" if is_number(node.data) else "wrong_type")
        value: float | int = node.data
        return value

    def numbers(self, node: ArkNode, counts: Collection[int] = ()) -> list[float | int]:
        """Return a list of numbers as written; its length is one of ``counts`` if given."""
        data = node.data
        if not isinstance(data, list) or (counts and len(data) not in counts):
            size = f"{' or '.join(map(str, sorted(counts)))} numbers" if counts else "numbers"
            raise self.wrong(node, f"must be a list of {size}, not {describe(data)}", "wrong_count")
        for k, item in enumerate(data):
            if not is_number(item):
                raise self.wrong(node, f"must be numbers; item {k + 1} is {describe(item)}", "wrong_type")
        return list(data)

    def rotation(self, node: ArkNode) -> list[float | int]:
        """Return three angles, or a quaternion that is not zero."""
        values = self.numbers(node, (3, 4))
        if len(values) == 4 and math.hypot(*values) < 1e-6:
            raise self.wrong(node, "is no rotation: all four numbers of the quaternion are zero", "bad_rotation")
        return values

    def raise_any(self) -> None:
        """Raise ConfigError with every problem, if there is one."""
        if self.problems.found:
            found = self.problems.found
            raise ConfigError(sorted(found, key=lambda problem: problem.file.rpartition(":")[0] or problem.file))


class _Loader(PlacedErrors, yaml.SafeLoader):
    """YAML 1.1, as read by Ark."""


def _parse(text: str) -> tuple[yaml.Node | None, Any]:
    """Return one document, as nodes with their lines and as data. Raises yaml.YAMLError."""
    loader = _Loader(text)
    try:
        root = loader.get_single_node()
        return root, loader.construct_document(root) if root is not None else None
    finally:
        loader.dispose()


def _node(file: Path, line: int, key: str, node: yaml.Node, data: Any) -> ArkNode:
    children: dict[str, ArkNode] = {}
    if isinstance(node, yaml.MappingNode) and isinstance(data, dict):
        by_text = {str(name): value for name, value in data.items()}
        for name, value in node.value:
            word = str(name.value)
            inside = f"{key}.{word}" if key else word
            children[word] = _node(file, name.start_mark.line + 1, inside, value, by_text.get(word))
    elif isinstance(node, yaml.SequenceNode) and isinstance(data, list) and any(isinstance(x, dict) for x in data):
        for k, (item, value) in enumerate(zip(node.value, data, strict=True)):
            children[str(k)] = _node(file, item.start_mark.line + 1, f"{key}.{k}", item, value)
    return ArkNode(file, line, key, data, children)


def _twice(node: yaml.Node, key: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, key and message of each repeated key."""
    if isinstance(node, yaml.MappingNode):
        first: dict[str, int] = {}
        for name, value in node.value:
            inside, line = f"{key}.{name.value}" if key else str(name.value), name.start_mark.line + 1
            if inside in first:
                yield line, inside, f"is also given in line {first[inside]}; Ark uses the last one. Remove one"
            first[inside] = line
            yield from _twice(value, inside)
    elif isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            yield from _twice(item, f"{key}.{k}")


def _long_quotes(node: yaml.Node, key: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, key and message of each quoted text that spans several lines and contains YAML."""
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            yield from _long_quotes(value, f"{key}.{name.value}" if key else str(name.value))
    elif isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            yield from _long_quotes(item, f"{key}.{k}")
    elif isinstance(node, yaml.ScalarNode) and node.style in ('"', "'") and ":" in node.value:
        first, last = node.start_mark.line + 1, node.end_mark.line + 1
        if last > first:
            yield first, key, f"the quote that opens in this line closes only in line {last}; one may be missing"


def _not_yaml(text: str, error: yaml.YAMLError) -> tuple[int, str]:
    """Return line and message of a syntax error; for an unclosed quote the line where it opens."""
    if isinstance(error, yaml.reader.ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return line, f"has a character that YAML does not allow: {error.character:#x}"
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    line = mark.line + 1 if mark is not None else 1
    reason = getattr(error, "problem", None) or " ".join(str(error).split())
    lines = text.splitlines()
    for number, content in enumerate(lines[:line], start=1):
        if _open_quote(content):
            return number, f"the quote that opens here is not closed: {content.strip()} (in line {line}: {reason})"
    shown = lines[line - 1].strip() if line <= len(lines) else ""
    return line, f"is not valid YAML: {reason}" + (f": {shown}" if shown else "")


def _open_quote(line: str) -> bool:
    """Return whether a quoted text begins in this line and does not end in it."""
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
