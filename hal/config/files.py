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

__all__ = ["Problems", "closest", "nearest", "parse_yaml", "plain_copy", "read_yaml"]


class Problems:
    """What was found to be wrong so far, each thing once."""

    def __init__(self) -> None:
        self.found: list[Problem] = []
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
        if problem not in self.found:
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


class _Loader(_SafeLoader):  # type: ignore[misc]  # one of two bases
    """Safe YAML in which 1e-3 is a number, as YAML 1.2 has it (PyYAML wants 1.0e-3)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def parse_yaml(text: str) -> Any:
    """One YAML document. Raises yaml.YAMLError."""
    return yaml.load(text, Loader=_Loader)


def read_yaml(path: Path, problems: Problems) -> dict[str, Any] | None:
    """The mapping in a YAML file. Every trouble is noted, keys that are given twice too; None where nothing is left."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        siblings = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
        problems.add(path, "", "there is no such file" + (nearest(path.name, siblings) if siblings else ""))
        return None
    except (OSError, UnicodeDecodeError) as error:
        problems.add(path, "", f"cannot be read: {error}")
        return None
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            problems.add(path, "", "is empty")
            return None
        _find_duplicates(node, (), path, problems, set())
        data = plain_copy(loader.construct_document(node))
    except RecursionError:
        problems.add(path, "", "holds an alias (*) of something that the alias is in, or is nested too deeply")
        return None
    except yaml.YAMLError as error:
        problems.add(path, "", f"is not valid YAML: {' '.join(str(error).split())}")
        return None
    finally:
        loader.dispose()
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
