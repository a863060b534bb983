"""YAML files into plain data, gathering every problem on the way instead of stopping at the first."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..errors import ConfigError, Problem
from .schema import describe

__all__ = [
    "PlacedErrors",
    "Problems",
    "check_size",
    "closest",
    "nearest",
    "parse_yaml",
    "plain_copy",
    "read_yaml",
    "yaml_problem",
]


class Problems:
    """What was found to be wrong so far, each thing once."""

    def __init__(self) -> None:
        self.found: list[Problem] = []
        self._known: set[Problem] = set()
        self.overridden: set[str] = set()
        """Dotted keys that the caller set on top of the file."""
        self.written: dict[tuple[str, str], str] = {}
        """File and dotted key as it should be spelt -> the last part of that key as the file spells it."""

    def add(self, file: Path | str, key: str, message: str) -> None:
        """Note a problem. One in a key that an override set is the override's, not the file's."""
        right = key.split(".")
        key = ".".join(self.written.get((str(file), ".".join(right[: k + 1])), part) for k, part in enumerate(right))
        by_override = any(key == path or key.startswith(path + ".") for path in self.overridden)
        problem = Problem("--set" if by_override else str(file), key, message)
        if problem not in self._known:
            self._known.add(problem)
            self.found.append(problem)

    def raise_any(self) -> None:
        """Raise a ConfigError with all of them, if there are any."""
        if self.found:
            raise ConfigError(self.found)


def closest(word: str, choices: Iterable[str]) -> str | None:
    """The one of ``choices`` that was probably meant by ``word``."""
    return next(iter(difflib.get_close_matches(word, sorted(choices), n=1)), None)


def nearest(word: str, choices: Iterable[str]) -> str:
    """``"; did you mean ...? there are: ..."`` for a name that is not among ``choices``."""
    known = sorted(choices)
    close = closest(word, known)
    hint = f"; did you mean {close!r}?" if close else ";"
    return f"{hint} there are: {', '.join(known)}" if known else "; there are none"


def plain_copy(value: Any) -> Any:
    """A copy of nested dicts and lists, down to the values in them."""
    if isinstance(value, Mapping):
        return {key: plain_copy(item) for key, item in value.items()}
    return [plain_copy(item) for item in value] if isinstance(value, (list, tuple)) else value


# The one in C is ten times as fast; PyYAML can be built without it.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class PlacedErrors:
    """Part of a loader: a value that cannot be built (``2001-99-99``, ``!!int x``) is a YAMLError with its place.

    PyYAML lets the ValueError, KeyError or AttributeError of the constructor through.
    """

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)  # type: ignore[misc]  # that of the loader beside it
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            tag = str(node.tag).rpartition(":")[2]
            problem = f"{describe(node.value)} is no {tag}: {error}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


class _Loader(PlacedErrors, _SafeLoader):  # type: ignore[misc]  # one of two bases
    """Safe YAML in which 1e-3 is a number, as YAML 1.2 has it (PyYAML wants 1.0e-3)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


MAX_BYTES, MAX_DEPTH, MAX_VALUES = 1 << 20, 50, 20_000
"""Limits of one document: a rig needs a hundredth of each. Aliases count as often as they are used."""


def check_size(text: str, loader: Any = _SafeLoader) -> None:
    """Check depth, aliases and number of values of a YAML document before anything is built of it.

    libyaml's composer is recursive and has no limit of its own: deep nesting would end the process.

    Raises yaml.YAMLError for what is not YAML, too.
    """
    if len(text) > MAX_BYTES:
        raise yaml.MarkedYAMLError(problem=f"is larger than {MAX_BYTES // 1024} KiB")
    mark: Any
    open_nodes: list[tuple[str | None, int, int]] = [(None, 0, 0)]  # anchor, values, levels below
    anchors: dict[str, tuple[int, int] | None] = {}  # values and levels; None while it is open
    for event in yaml.parse(text, Loader=loader):
        mark = event.start_mark
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, 1, 1))
            if event.anchor is not None:
                anchors[event.anchor] = None
            values, levels = 0, 0
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, values, levels = open_nodes.pop()
            if anchor is not None:
                anchors[anchor] = values, levels
        elif isinstance(event, yaml.AliasEvent):
            known = anchors.get(str(event.anchor), (1, 0))
            if known is None:
                raise yaml.MarkedYAMLError(problem=f"alias *{event.anchor} stands inside itself", problem_mark=mark)
            values, levels = known
        elif isinstance(event, yaml.ScalarEvent):
            values, levels = 1, 0
            if event.anchor is not None:
                anchors[event.anchor] = values, levels
        else:
            continue
        anchor, before, below = open_nodes[-1]
        open_nodes[-1] = anchor, before + values, max(below, levels + 1)
        if len(open_nodes) + levels > MAX_DEPTH + 1:
            raise yaml.MarkedYAMLError(problem=f"nested more than {MAX_DEPTH} deep", problem_mark=mark)
        if before + values > MAX_VALUES:
            raise yaml.MarkedYAMLError(
                problem=f"more than {MAX_VALUES} values, those behind aliases included", problem_mark=mark
            )


def yaml_problem(error: yaml.YAMLError) -> str:
    """Return what is wrong in a YAML document, with line and column where they are known."""
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    said = getattr(error, "problem", None) or getattr(error, "context", None) or str(error)
    place = f" (line {mark.line + 1}, column {mark.column + 1})" if mark is not None else ""
    return f"is not valid YAML: {' '.join(said.split())}{place}"


def parse_yaml(text: str) -> Any:
    """Return the data of one YAML document. Raises yaml.YAMLError for everything that is wrong with it."""
    check_size(text)
    return yaml.load(text, Loader=_Loader)


def read_yaml(path: Path, problems: Problems) -> dict[str, Any] | None:
    """Return the mapping in a YAML file; None where there is none.

    Everything that is wrong is noted, keys that are given twice too.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1).decode("utf-8")
    except FileNotFoundError:
        siblings = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
        problems.add(path, "", "there is no such file" + (nearest(path.name, siblings) if siblings else ""))
        return None
    except (OSError, UnicodeDecodeError) as error:
        problems.add(path, "", f"cannot be read: {error}")
        return None
    try:
        check_size(text)
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                problems.add(path, "", "is empty")
                return None
            _find_duplicates(node, (), path, problems, set())
            data = plain_copy(loader.construct_document(node))
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        problems.add(path, "", yaml_problem(error))
        return None
    if not isinstance(data, dict):
        problems.add(path, "", f"must hold keys and values, not {describe(data)}")
        return None
    return data


def _find_duplicates(node: yaml.Node, place: tuple[str, ...], path: Path, problems: Problems, seen: set[int]) -> None:
    if id(node) in seen:  # an alias
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(getattr(key, "value", key)), key.start_mark.line + 1
            if name in lines and name != "<<":
                where = ".".join((*place, name))
                problems.add(path, where, f"is given twice, in lines {lines[name]} and {line}; the names must differ")
            lines.setdefault(name, line)
            _find_duplicates(value, (*place, name), path, problems, seen)
    elif isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            _find_duplicates(item, (*place, str(k)), path, problems, seen)
