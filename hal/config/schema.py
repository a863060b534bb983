"""What the schemas of all YAML files are built from: strict records, vectors, poses; units stand in the docs."""

from __future__ import annotations

import math
import typing
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

__all__ = [
    "Flag",
    "Name",
    "Number",
    "Numbers",
    "PerJoint",
    "Pixels",
    "PoseConfig",
    "Positive",
    "QuaternionConfig",
    "Rgba",
    "Share",
    "Strict",
    "Unknown",
    "Vector",
    "describe",
    "is_number",
    "keys_at",
    "kind_inside",
    "record_in",
]


class Unknown(AttributeError):
    """A key was asked for whose value is wrong or missing, which has been noted: leave out what needs it."""


class Strict(BaseModel):
    """A record that knows all its keys. One from a file with mistakes can have holes, which raise :class:`Unknown`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    if not TYPE_CHECKING:  # so that mypy still finds misspelt attributes

        def __getattr__(self, name: str) -> Any:
            if name in type(self).model_fields:
                raise Unknown(name)
            return super().__getattr__(name)


def describe(value: Any) -> str:
    """A wrong value, short enough for a message."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return "nothing"
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "keys and values"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def is_number(value: Any) -> bool:
    """A number that any of the quantities here can be: finite, and no whole number beyond what floats hold."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -1e12 < value < 1e12


def _numbers(count: int | None, what: str) -> Callable[[Any], tuple[float, ...]]:
    """A validator of a list of finite numbers."""

    def check(value: Any) -> tuple[float, ...]:
        size = f"{count} numbers" if count is not None else "numbers"
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"must be a list of {size} ({what}), not {describe(value)}")
        if count is not None and len(value) != count:
            raise ValueError(f"must be {size} ({what}), not {len(value)}")
        for k, item in enumerate(value):
            if not is_number(item):
                raise ValueError(f"must be {size} ({what}); item {k + 1} is {describe(item)}")
        return tuple(float(item) for item in value)

    return check


def _quaternion(value: Any) -> tuple[float, ...]:
    q = _numbers(4, "a unit quaternion x, y, z, w")(value)
    norm = math.hypot(*q)
    if abs(norm - 1.0) > 0.01:
        raise ValueError(f"must be a unit quaternion x, y, z, w; the length of this one is {norm:.3g}")
    return tuple(item / norm for item in q)


def _per_joint(value: Any) -> Any:
    if is_number(value):
        return (float(value),)
    return _numbers(None, "one for each joint, or one number for all of them")(value)


def _rgba(value: Any) -> tuple[float, ...]:
    colour = _numbers(4, "red, green, blue, alpha, each 0..1")(value)
    if not all(0.0 <= item <= 1.0 for item in colour):
        raise ValueError("must be red, green, blue, alpha, each in 0..1")
    return colour


Flag = Annotated[bool, Field(strict=True)]
Number = Annotated[float, Field(strict=True)]
Positive = Annotated[float, Field(strict=True, gt=0.0)]
Pixels = Annotated[int, Field(strict=True, gt=0, le=16384)]
Share = Annotated[float, Field(strict=True, gt=0.0, le=1.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]
Vector = Annotated[tuple[float, float, float], BeforeValidator(_numbers(3, "x, y, z in m"))]
QuaternionConfig = Annotated[tuple[float, float, float, float], BeforeValidator(_quaternion)]
Rgba = Annotated[tuple[float, float, float, float], BeforeValidator(_rgba)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_numbers(None, "one for each joint"))]
PerJoint = Annotated[tuple[float, ...], BeforeValidator(_per_joint)]
"""One number for each joint; a single one stands for all of them."""


class PoseConfig(Strict):
    """``{position: [x, y, z], orientation: [x, y, z, w]}``, or the same seven numbers as one list. m."""

    position: Vector = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)

    @model_validator(mode="before")
    @classmethod
    def _seven_numbers(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            seven = _numbers(7, "x, y, z in m, then a quaternion x, y, z, w; or {position, orientation}")(data)
            return {"position": seven[:3], "orientation": seven[3:]}
        return data


def keys_at(model: type[BaseModel], loc: Sequence[Any]) -> tuple[str, ...]:
    """The keys that are allowed at a place in a record: what an unknown key is compared with."""
    kind: Any = model
    for part in loc:
        kind = kind_inside(kind, part)
    kind = record_in(kind)
    return tuple(kind.model_fields) if kind is not None else ()


def kind_inside(kind: Any, part: Any) -> Any:
    """The type of what stands at ``part`` in a record, a dict or a list of the type ``kind``; None where unknown."""
    record = record_in(kind)
    if record is not None:
        found = record.model_fields.get(str(part))
        return found.annotation if found is not None else None
    for option in _options(kind):
        arguments = typing.get_args(option)
        if typing.get_origin(option) in (dict, list, tuple) and arguments:
            return arguments[1] if typing.get_origin(option) is dict else arguments[0]
    return None


def record_in(kind: Any) -> type[BaseModel] | None:
    """The record that a value of the type ``kind`` is, where it is one."""
    return next((k for k in _options(kind) if isinstance(k, type) and issubclass(k, BaseModel)), None)


def _options(kind: Any) -> tuple[Any, ...]:
    """``X | None`` and ``Annotated[X, ...]`` hold X."""
    if typing.get_origin(kind) is Annotated:
        return _options(typing.get_args(kind)[0])
    if type(None) in typing.get_args(kind):
        return tuple(inner for option in typing.get_args(kind) for inner in _options(option))
    return (kind,)
