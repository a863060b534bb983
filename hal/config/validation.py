"""Plain data into checked records. What is wrong leaves holes, so that everything else can still be checked."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from .files import Problems, closest, nearest, plain_copy
from .schema import describe, keys_at, kind_inside, record_in

__all__ = ["validate", "with_holes"]

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
