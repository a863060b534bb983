"""YAML files into checked records, gathering every problem on the way instead of stopping at the first."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from ..errors import ConfigError, Problem
from .schema import describe, keys_at

__all__ = ["Problems", "nearest", "read_yaml", "validate"]

M = TypeVar("M", bound=BaseModel)


class Problems:
    """What was found to be wrong so far, each thing once."""

    def __init__(self) -> None:
        self.found: list[Problem] = []
        self.overridden: set[str] = set()
        """Dotted keys that the caller set on top of the file."""

    def add(self, file: Path | str, key: str, message: str) -> None:
        """Note a problem. One in a key that an override set is the override's, not the file's."""
        by_override = any(key == path or key.startswith(path + ".") for path in self.overridden)
        problem = Problem("--set" if by_override else str(file), key, message)
        if problem not in self.found:
            self.found.append(problem)

    def raise_any(self) -> None:
        """Raise a ConfigError with all of them, if there are any."""
        if self.found:
            raise ConfigError(self.found)


def nearest(word: str, choices: Iterable[str]) -> str:
    """``"; did you mean ...? known: ..."`` for a name that is not among ``choices``."""
    known = sorted(choices)
    close = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} there are: {', '.join(known)}" if known else "; there are none"


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
        data = loader.construct_document(node)
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


def validate(model: type[M], data: Any, file: Path | str, problems: Problems, prefix: str = "") -> M | None:
    """A record from plain data; None, and every problem noted, where that cannot be."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        for key, message in explain(model, error):
            problems.add(file, ".".join(part for part in (prefix, key) if part), message)
        return None


def explain(model: type[BaseModel], error: ValidationError) -> list[tuple[str, str]]:
    """Dotted key and a sentence for each thing that pydantic found."""
    return [
        (".".join(str(part) for part in found["loc"] if part != "[key]"), _sentence(model, found))
        for found in error.errors(include_url=False)
    ]


def _sentence(model: type[BaseModel], found: Any) -> str:
    kind, loc, given = found["type"], found["loc"], found["input"]
    if kind == "missing":
        return "is missing"
    if kind == "extra_forbidden":
        return f"is no key here{nearest(str(loc[-1]), keys_at(model, loc[:-1]))}"
    if kind == "value_error":
        return str(found["ctx"]["error"])
    if kind == "literal_error":
        choices = _choices(found["ctx"]["expected"])
        return f"{describe(given)} is not possible{nearest(str(given), choices)}"
    if kind in ("model_type", "dict_type", "model_attributes_type"):
        keys = keys_at(model, loc)
        return f"must hold keys and values, not {describe(given)}" + (f"; keys: {', '.join(keys)}" if keys else "")
    wanted = _WANTED.get(kind) or found["msg"].replace("Input should be", "must be").replace("String should", "must")
    return f"{wanted}, not {describe(given)}"


_WANTED = {
    "bool_type": "must be true or false",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "finite_number": "must be a finite number",
    "string_type": "must be text",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
}


def _choices(expected: str) -> Sequence[str]:
    return [part.strip("' ") for part in expected.replace(" or ", ", ").split(",")]
