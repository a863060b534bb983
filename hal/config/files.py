"""Read YAML files into checked records, and collect every problem on the way instead of stopping at the first.

:class:`Problems` collects, :func:`read_yaml` reads a file, :func:`validate` makes a record of its data, and
:func:`apply_overrides` puts ``KEY=VALUE`` on top of it. Codes of problems (:attr:`hal.errors.Problem.code`)::

    unknown_key     missing_key    duplicate_key   a key
    wrong_type      wrong_count    out_of_range    a value
    invalid_choice  conflict       empty_range
    bad_name        bad_rotation   invalid
    missing_file    unreadable     bad_yaml        a file

An unknown name has the code ``unknown_`` with its kind, for example ``unknown_model`` or ``unknown_link``; drivers add
codes of their own.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, TypeAdapter, ValidationError

from ..errors import ConfigError, Problem, find_closest, suggest
from ..specs import CameraSpec, GripperSpec, RobotSpec
from .data_files import data_folder, is_path, list_data, user_path
from .schema import Strict, ValueProblem, describe, find_kind, find_record, list_keys


class Problems:
    """The problems found so far, each once."""

    def __init__(self) -> None:
        self.found: list[Problem] = []
        self._known: set[Problem] = set()
        self.overridden: set[str] = set()
        """Dotted keys that the caller set on top of the file."""
        self.written: dict[tuple[str, str], str] = {}
        """File and dotted key as it should be spelt -> the last part of that key as the file spells it."""

    def add(self, file: Path | str, key: str, message: str, code: str) -> None:
        """Add a problem. One in a key that an override set is reported in ``--set`` instead of the file."""
        right = key.split(".")
        key = ".".join(self.written.get((str(file), ".".join(right[: k + 1])), part) for k, part in enumerate(right))
        by_override = any(key == path or key.startswith(path + ".") for path in self.overridden)
        problem = Problem("--set" if by_override else str(file), key, message, code)
        if problem not in self._known:
            self._known.add(problem)
            self.found.append(problem)

    def raise_any(self) -> None:
        """Raise a ConfigError with all of them, if there are any."""
        if self.found:
            raise ConfigError(self.found)


def one_of(kind: str, names: Collection[str]) -> AfterValidator:
    """Return a check, for an ``Annotated`` type, that a name is one of ``names``, which are those of a ``kind``."""

    def check(name: str) -> str:
        if name not in names:
            raise ValueProblem(f"{name!r} is not a known {kind}{suggest(name, names)}", "unknown_control")
        return name

    return AfterValidator(check)


def copy_plain(value: Any) -> Any:
    """Return a deep copy of nested dicts and lists; the values in them are not copied."""
    if isinstance(value, Mapping):
        return {key: copy_plain(item) for key, item in value.items()}
    return [copy_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


# YAML

# The loader in C is ten times as fast; PyYAML can be built without it.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class PlacedErrors:
    """Mix-in of a loader: a value that cannot be built (``2001-99-99``, ``!!int x``) is a YAMLError with its place.

    PyYAML lets the ValueError, KeyError or AttributeError of the constructor through.
    """

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node. Raises yaml.constructor.ConstructorError if it cannot be built."""
        try:
            return super().construct_object(node, deep)  # type: ignore[misc]  # that of the loader beside it
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            tag = str(node.tag).rpartition(":")[2]
            problem = f"{describe(node.value)} is not a valid {tag}: {error}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


class _Loader(PlacedErrors, _SafeLoader):  # type: ignore[misc]  # one of two bases
    """Safe YAML in which 1e-3 is a number, as in YAML 1.2 (PyYAML requires 1.0e-3)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def read_yaml(path: Path, problems: Problems) -> dict[str, Any] | None:
    """Return the mapping in a YAML file; None, with all problems added, if there is none.

    A key that is given twice is a problem, too.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        siblings = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
        hint = suggest(path.name, siblings) if siblings else ""
        problems.add(path, "", f"there is no such file{hint}", "missing_file")
        return None
    except (OSError, UnicodeDecodeError) as error:
        problems.add(path, "", f"cannot be read: {error}", "unreadable")
        return None
    try:
        data, twice = _read_document(text)
        data = copy_plain(data)
    except yaml.YAMLError as error:
        problems.add(path, "", describe_yaml_error(error), "bad_yaml")
        return None
    except RecursionError:
        problems.add(path, "", "is nested too deeply, or has an alias inside itself", "bad_yaml")
        return None
    for key, message in twice:
        problems.add(path, key, message, "duplicate_key")
    if not isinstance(data, dict):
        problem = "is empty" if data is _EMPTY else f"must be keys and values, not {describe(data)}"
        problems.add(path, "", problem, "wrong_type")
        return None
    return data


_EMPTY = object()


@lru_cache(maxsize=64)  # the files of a rig, which an app may open again and again
def _read_document(text: str) -> tuple[Any, tuple[tuple[str, str], ...]]:
    """Return the data of a document, ``_EMPTY`` if it has none, and the keys that are given twice, with messages."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return _EMPTY, ()
        twice = tuple(_find_duplicates(node, (), set()))
        return loader.construct_document(node), twice
    finally:
        loader.dispose()


def parse_yaml(text: str) -> Any:
    """Return the data of one YAML document. Raises yaml.YAMLError for everything that is wrong with it."""
    return yaml.load(text, Loader=_Loader)


def describe_yaml_error(error: yaml.YAMLError) -> str:
    """Return the problem in a YAML document, with line and column where they are known."""
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    problem = getattr(error, "problem", None) or getattr(error, "context", None) or str(error)
    place = f" (line {mark.line + 1}, column {mark.column + 1})" if mark is not None else ""
    return f"is not valid YAML: {' '.join(problem.split())}{place}"


def _find_duplicates(node: yaml.Node, place: tuple[str, ...], seen: set[int]) -> Iterator[tuple[str, str]]:
    if id(node) in seen:  # an alias
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(getattr(key, "value", key)), key.start_mark.line + 1
            if name in lines and name != "<<":
                message = f"is given twice, in lines {lines[name]} and {line}; names must be unique"
                yield ".".join((*place, name)), message
            lines.setdefault(name, line)
            yield from _find_duplicates(value, (*place, name), seen)
    elif isinstance(node, yaml.SequenceNode):
        for k, item in enumerate(node.value):
            yield from _find_duplicates(item, (*place, str(k)), seen)


# Records. A wrong value leaves a hole in its record, so that everything else can still be checked.

M = TypeVar("M", bound=BaseModel)
Place = tuple[Any, ...]
"""Keys and indices of items, from the outermost inwards."""


def validate(model: type[M], data: Any, file: Path | str, problems: Problems, prefix: str = "") -> M:
    """Return plain data as a record, and add every problem in them.

    A value with a problem is a hole in the record: reading it raises :class:`~hal.config.schema.Unknown`. An unknown
    key is taken for the nearest known one that is not given: so a misspelt key is not reported as missing as well, and
    its value is checked, too.
    """
    data = copy_plain(data)
    guessed: set[Place] = set()
    while True:  # each round respells some keys
        try:
            return model.model_validate(data)
        except ValidationError as error:
            found = error.errors(include_url=False)
        unknown = [one for one in found if one["type"] == "extra_forbidden"]
        for one in unknown or found:
            # A value that does not fit a key that was only guessed is not a problem.
            if one["loc"] not in guessed or isinstance(one["input"], dict):
                problems.add(file, _join_key(prefix, one["loc"]), *_explain_error(model, one))
        if not unknown:
            return leave_holes(model, data, [one["loc"] for one in found])
        for one in unknown:
            right = _respell(model, data, one["loc"])
            if right is not None:
                guessed.add(right)
                problems.written[str(file), _join_key(prefix, right)] = str(one["loc"][-1])


def check_record(model: type[M], data: Any, file: Path | str) -> M:
    """Return plain data as a record. Raises ConfigError, which lists every problem; ``file`` is the name in them."""
    problems = Problems()
    record = validate(model, data, file, problems)
    problems.raise_any()
    return record


class DeviceSettings(Strict):
    """Base of the settings that a driver takes under ``real:`` of a device."""

    @classmethod
    def of(cls: type[M], spec: RobotSpec | GripperSpec | CameraSpec) -> M:
        """Return the settings in a device's record. Raises ConfigError, which lists every problem."""
        section = "cameras" if isinstance(spec, CameraSpec) else "robots"
        return check_record(cls, spec.options, f"{section}.{spec.name}.real")

    @classmethod
    def check(cls: type[M], spec: RobotSpec | GripperSpec | CameraSpec) -> tuple[M | None, list[tuple[str, str, str]]]:
        """Return the settings in a device's record, None if they have problems, and the problems.

        A problem is a key in the device's entry of the rig file, a message and a code.
        """
        problems = Problems()
        settings = validate(cls, spec.options, "", problems, "real")
        found = [(problem.key, problem.message, problem.code) for problem in problems.found]
        return (None if found else settings), found


def load_record(model: type[M], given: str | Path | Mapping[str, Any] | M, folder: str, kind: str) -> M:
    """Return the record of a built-in file, a file of the user, or data.

    Args:
        model: The class of the record.
        given: The name of a file in ``config/<folder>/``, the path of a file, a dict with the same keys, or a record,
            which is returned as it is.
        folder: Folder of the built-in files.
        kind: What the file is, for the problems, in the form of a code such as ``policy_config``.

    Raises:
        ConfigError: It has problems; all are listed.
    """
    if isinstance(given, model):
        return given
    if isinstance(given, Mapping):
        return check_record(model, given, "<dict>")
    name = given if isinstance(given, Path) else str(given)
    file = find_file(name, kind.replace("_", " "), Path.cwd(), "config", folder)
    if isinstance(file, str):
        raise ConfigError([Problem("<arguments>", kind.replace("_", "-"), file, f"unknown_{kind}")])
    problems = Problems()
    data = read_yaml(file, problems)
    problems.raise_any()
    return check_record(model, data, file)


def find_file(given: str | Path, kind: str, base: Path, folder: str, *parts: str) -> Path | str:
    """Return the path of a YAML file, or a message if there is none."""
    name = str(given)
    if isinstance(given, Path) or is_path(name):
        return user_path(given, base)
    there = list_data(folder, *parts)
    if name not in there:
        return f"there is no {kind} {name!r}{suggest(name, there)}, or a path to your own"
    return data_folder(folder).joinpath(*parts, f"{name}.yaml")


def leave_holes(model: type[M], data: Any, wrong: Collection[Place]) -> M:
    """Return a record of ``data`` without the places in ``wrong``; of holes only if ``data`` is not a dict."""
    values: dict[str, Any] = {}
    holes: set[str] = set()
    for name, field in model.model_fields.items():
        if not isinstance(data, dict) or (name not in data and field.is_required()):
            holes.add(name)
        elif name in data:
            inside = _select_inside(wrong, name)
            if not inside:
                kind: Any = Annotated[field.annotation, field]
                values[name] = TypeAdapter(kind).validate_python(data[name])
            elif (value := _keep_valid(field.annotation, data[name], inside)) is not None:
                values[name] = value
            else:
                holes.add(name)
    record = model.model_construct(set(values), **values)
    for name in holes:
        record.__dict__.pop(name, None)  # the default is not what the file means
    return record


def _keep_valid(kind: Any, value: Any, wrong: Collection[Place]) -> Any:
    """Return the valid part of a record or of a dict of records; None for any other kind of value."""
    if not isinstance(value, dict):
        return None
    record, item = find_record(kind), find_record(find_kind(kind, ""))
    if record is not None:
        return leave_holes(record, value, wrong)
    if item is not None:
        return {str(key): leave_holes(item, inner, _select_inside(wrong, key)) for key, inner in value.items()}
    return None


def _select_inside(places: Collection[Place], key: Any) -> list[Place]:
    return [place[1:] for place in places if place[:1] == (key,)]


def _respell(model: type[BaseModel], data: Any, place: Place) -> Place | None:
    """Correct the spelling of an unknown key in ``data`` and return its new place; remove the key if none is near."""
    *outer, given = place
    for part in outer:
        data = data[part]
    value = data.pop(given)
    right = find_closest(str(given), list_keys(model, outer))
    if right is None or right in data:
        return None
    data[right] = value
    return (*outer, right)


def _join_key(prefix: str, place: Place) -> str:
    return ".".join(str(part) for part in (*filter(None, [prefix]), *place) if part != "[key]")


def _explain_error(model: type[BaseModel], found: Any) -> tuple[str, str]:
    kind, loc, given = found["type"], found["loc"], found["input"]
    if kind == "missing":
        return "is missing", "missing_key"
    if kind == "extra_forbidden":
        return f"unknown key{suggest(str(loc[-1]), list_keys(model, loc[:-1]))}", "unknown_key"
    if kind == "value_error":
        error = found["ctx"]["error"]
        return str(error), error.code if isinstance(error, ValueProblem) else "invalid"
    if kind == "literal_error":
        choices = [part.strip("' ") for part in found["ctx"]["expected"].replace(" or ", ", ").split(",")]
        return f"{describe(given)} is not possible{suggest(str(given), choices)}", "invalid_choice"
    if kind in ("model_type", "dict_type", "model_attributes_type"):
        keys = ", ".join(list_keys(model, loc))
        return f"must be keys and values, not {describe(given)}" + (f"; keys: {keys}" if keys else ""), "wrong_type"
    if kind in ("too_long", "too_short"):
        bounds = found["ctx"]
        many = f"at most {bounds['max_length']}" if kind == "too_long" else f"at least {bounds['min_length']}"
        return f"must have {many} entries, not {len(given)}", "wrong_count"
    if kind in _WRONG_TYPES:
        return f"{_WRONG_TYPES[kind]}, not {describe(given)}", "wrong_type"
    message = found["msg"].replace("Input should be", "must be").replace("String should", "must")
    return f"{message}, not {describe(given)}", _CODES.get(kind, "invalid")


_WRONG_TYPES = {
    "bool_type": "must be true or false",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "finite_number": "must be a finite number",
    "string_type": "must be text",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
}
_CODES = {
    "greater_than": "out_of_range",
    "greater_than_equal": "out_of_range",
    "less_than": "out_of_range",
    "less_than_equal": "out_of_range",
    "string_pattern_mismatch": "bad_name",
}


# Overrides: ``KEY=VALUE`` sets any key of a rig from outside its file.

SET = "--set"
SECTIONS = {"robots": "robot", "cameras": "camera", "leaders": "leader", "gamepads": "gamepad"}


def apply_overrides(
    data: dict[str, Any], overrides: Sequence[str] | Mapping[str, Any], problems: Problems
) -> dict[str, Any]:
    """Return a copy of the rig's data with the overrides in it."""
    result = copy_plain(data)
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
            message = f"must be KEY=VALUE, for example cameras.wrist.output.width=320, not {text!r}"
            problems.add(SET, "", message, "bad_override")
            continue
        try:
            pairs.append((key.strip(), parse_yaml(value)))
        except yaml.YAMLError as error:
            problems.add(SET, key.strip(), f"the value {describe_yaml_error(error)}", "bad_yaml")
    return pairs


def _put(data: dict[str, Any], key: str, value: Any, problems: Problems) -> None:
    """Set one key, and note which keys the override set: this one, and those that it created on the way."""
    parts = key.split(".")
    if "" in parts:
        problems.add(SET, key, "has an empty part between its dots", "bad_override")
        return
    if len(parts) > 2 and parts[0] in SECTIONS:
        known = data.get(parts[0]) or {}
        if isinstance(known, dict) and parts[1] not in known:
            message = f"this rig has no {SECTIONS[parts[0]]} {parts[1]!r}{suggest(parts[1], known)}"
            problems.add(SET, key, message, "unknown_device")
            return
    place: Any = data
    for k, part in enumerate(parts):
        last = k == len(parts) - 1
        if isinstance(place, list):
            if not part.isdecimal() or int(part) >= len(place):
                message = f"{'.'.join(parts[:k])} is a list of {len(place)}; {part!r} is not an index of it"
                problems.add(SET, key, message, "unknown_key")
                return
            index: Any = int(part)
        elif isinstance(place, dict):
            index = part
            if not last and place.get(part) is None:
                place[part] = {}
                problems.overridden.add(".".join(parts[: k + 1]))
        else:
            problems.add(SET, key, f"{'.'.join(parts[:k])} has no keys", "unknown_key")
            return
        if last:
            place[index] = value
        else:
            place = place[index]
    problems.overridden.add(key)
