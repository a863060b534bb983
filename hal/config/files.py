"""YAML files into plain data, gathering every problem on the way instead of stopping at the first."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError

from ..errors import ConfigError, Problem
from .schema import describe, keys_at, kind_inside, record_in

__all__ = [
    "PlacedErrors",
    "Problems",
    "apply_overrides",
    "check_size",
    "closest",
    "nearest",
    "parse_yaml",
    "plain_copy",
    "read_yaml",
    "validate",
    "with_holes",
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


# [validation.py] Plain data into checked records. What is wrong leaves holes, so that everything else can still
# be checked.

M = TypeVar("M", bound=BaseModel)
Place = tuple[Any, ...]
"""Keys and numbers of items, from the outside in."""


def validate(model: type[M], data: Any, file: Path | str, problems: Problems, prefix: str = "") -> M:
    """A record from plain data, every problem noted. What has one is a hole in the record: asking for it is Unknown.

    Keys that do not exist are noted, and then taken for the nearest ones that do and are not given: so a misspelt key
    is not missing as well, and what is wrong in its value is found too. ``prefix`` is where the data stand in the file.
    """
    data = plain_copy(data)
    guessed: set[Place] = set()
    while True:  # each round spells some keys right
        try:
            return model.model_validate(data)
        except ValidationError as error:
            found = error.errors(include_url=False)
        unknown = [one for one in found if one["type"] == "extra_forbidden"]
        for one in unknown or found:
            # That a value does not fit a key that was only guessed is no mistake of anybody's.
            if one["loc"] not in guessed or isinstance(one["input"], dict):
                problems.add(file, _dotted(prefix, one["loc"]), _sentence(model, one))
        if not unknown:
            return with_holes(model, data, [one["loc"] for one in found])
        for one in unknown:
            right = _respell(model, data, one["loc"])
            if right is not None:
                guessed.add(right)
                problems.written[str(file), _dotted(prefix, right)] = str(one["loc"][-1])


def with_holes(model: type[M], data: Any, wrong: Collection[Place]) -> M:
    """A record of what is right in ``data``: all but the places ``wrong``. Nothing but holes if ``data`` is no dict."""
    values: dict[str, Any] = {}
    holes: set[str] = set()
    for name, field in model.model_fields.items():
        if not isinstance(data, dict) or (name not in data and field.is_required()):
            holes.add(name)
        elif name in data:
            inside = _inside(wrong, name)
            if not inside:
                kind: Any = Annotated[field.annotation, field]
                values[name] = TypeAdapter(kind).validate_python(data[name])
            elif (value := _rest(field.annotation, data[name], inside)) is not None:
                values[name] = value
            else:
                holes.add(name)
    record = model.model_construct(set(values), **values)
    for name in holes:
        record.__dict__.pop(name, None)  # the default is not what the file means
    return record


def _rest(kind: Any, value: Any, wrong: Collection[Place]) -> Any:
    """What is right in a value, as a record or a dict of records; None where it is neither."""
    if not isinstance(value, dict):
        return None
    record, item = record_in(kind), record_in(kind_inside(kind, ""))
    if record is not None:
        return with_holes(record, value, wrong)
    if item is not None:
        return {str(key): with_holes(item, inner, _inside(wrong, key)) for key, inner in value.items()}
    return None


def _inside(places: Collection[Place], key: Any) -> list[Place]:
    return [place[1:] for place in places if place[:1] == (key,)]


def _respell(model: type[BaseModel], data: Any, place: Place) -> Place | None:
    """Spell an unknown key right, in ``data``, and return its new place; take it out if nobody knows what it means."""
    *outer, given = place
    for part in outer:
        data = data[part]
    value = data.pop(given)
    right = closest(str(given), keys_at(model, outer))
    if right is None or right in data:
        return None
    data[right] = value
    return (*outer, right)


def _dotted(prefix: str, place: Place) -> str:
    return ".".join(str(part) for part in (*filter(None, [prefix]), *place) if part != "[key]")


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
    if kind == "too_long":
        return f"must have at most {found['ctx']['max_length']} entries, not {len(given)}"
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


# [overrides.py] ``KEY=VALUE``: any key of a rig, set from outside its file.

SET = "--set"
DEVICES = {"robots": "robot", "cameras": "camera", "gamepads": "gamepad"}


def apply_overrides(
    data: dict[str, Any], overrides: Sequence[str] | Mapping[str, Any], problems: Problems
) -> dict[str, Any]:
    """A copy of the rig's data with the overrides in it; what is wrong with their form is noted."""
    result = plain_copy(data)
    for key, value in _pairs(overrides, problems):
        _put(result, key, value, problems)
    return dict(result)


def _pairs(overrides: Sequence[str] | Mapping[str, Any], problems: Problems) -> list[tuple[str, Any]]:
    if isinstance(overrides, Mapping):
        return [(str(key), value) for key, value in overrides.items()]
    pairs = []
    for text in (overrides,) if isinstance(overrides, str) else overrides:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            problems.add(SET, "", f"must be KEY=VALUE, for example cameras.wrist.output.width=320, not {text!r}")
            continue
        try:
            pairs.append((key.strip(), parse_yaml(value)))
        except yaml.YAMLError as error:
            problems.add(SET, key.strip(), f"the value {yaml_problem(error)}")
    return pairs


def _put(data: dict[str, Any], key: str, value: Any, problems: Problems) -> None:
    """Set one key, and note what the override is to blame for: the key, and what it made on the way there."""
    parts = key.split(".")
    if "" in parts:
        problems.add(SET, key, "has an empty part between its dots")
        return
    if len(parts) > 2 and parts[0] in DEVICES:
        known = data.get(parts[0]) or {}
        if isinstance(known, dict) and parts[1] not in known:
            problems.add(SET, key, f"this rig has no {DEVICES[parts[0]]} {parts[1]!r}{nearest(parts[1], known)}")
            return
    place: Any = data
    for k, part in enumerate(parts):
        last = k == len(parts) - 1
        if isinstance(place, list):
            if not part.isdecimal() or int(part) >= len(place):
                problems.add(SET, key, f"{'.'.join(parts[:k])} is a list of {len(place)}; {part!r} is no place in it")
                return
            index: Any = int(part)
        elif isinstance(place, dict):
            index = part
            if not last and place.get(part) is None:
                place[part] = {}
                problems.overridden.add(".".join(parts[: k + 1]))
        else:
            problems.add(SET, key, f"{'.'.join(parts[:k])} holds no keys")
            return
        if last:
            place[index] = value
        else:
            place = place[index]
    problems.overridden.add(key)
