"""What the schemas of all YAML files are built from: strict records, quantities with their units, vectors, poses."""

from __future__ import annotations

import math
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

__all__ = [
    "Accelerations",
    "CameraRate",
    "Coordinate",
    "Degrees",
    "Direction",
    "Distance",
    "Factor",
    "Flag",
    "Force",
    "Gravity",
    "Jerks",
    "JointLimits",
    "JointPositions",
    "Mass",
    "Name",
    "Offset",
    "Pixels",
    "PoseConfig",
    "Position",
    "Quantity",
    "QuaternionConfig",
    "RateHz",
    "Rgba",
    "Seconds",
    "Several",
    "Share",
    "Size",
    "Sizes",
    "Speed",
    "Strict",
    "TcpSpeed",
    "Torques",
    "Unknown",
    "Velocities",
    "ViewAngle",
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

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

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
    if isinstance(value, int) and not -1e12 < value < 1e12:
        return f"a whole number of about {math.ceil(value.bit_length() * math.log10(2))} digits"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def is_number(value: Any) -> bool:
    """A number that any of the quantities here can be: finite, and no whole number beyond what floats hold."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -1e12 < value < 1e12


_SMALLER = {
    "m": ("mm", 1e-3),
    "m/s": ("mm/s", 1e-3),
    "kg": ("g", 1e-3),
    "rad": ("deg", math.pi / 180.0),
    "rad/s": ("deg/s", math.pi / 180.0),
}
"""Units that are mistaken for others: what a value out of range was probably written in, and how much that is."""


@dataclass(frozen=True)
class Quantity:
    """A physical quantity: its unit, and the range outside which a value is a mistake (mostly a wrong unit).

    Stands in an ``Annotated`` type: it checks the value, and puts range and unit into the JSON schema.
    """

    unit: str
    least: float
    most: float
    above: bool = False
    """Whether the value must be above ``least`` instead of at least that."""

    def __str__(self) -> str:
        low = f"above {self.least:g} and at most" if self.above else f"{self.least:g} to"
        return f"{low} {self.most:g} {self.unit}".rstrip()

    def __contains__(self, value: float) -> bool:
        return (value > self.least if self.above else value >= self.least) and value <= self.most

    def check(self, value: Any) -> float:
        """Return the value as a float. Raises ValueError with the range and the unit."""
        if not is_number(value):
            raise ValueError(f"must be a number{f' in {self.unit}' if self.unit else ''}, not {describe(value)}")
        if value not in self:
            raise ValueError(f"must be {self}, not {value:g}{self.hint(value)}")
        return float(value)

    def hint(self, value: float) -> str:
        """Return what a value out of range is in the unit that was probably meant; empty where there is none."""
        name, factor = _SMALLER.get(self.unit, ("", 0.0))
        return f"; {value:g} {name} would be {value * factor:.4g}" if name and value * factor in self else ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return self.json_schema()

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of one number."""
        unit = {"description": self.unit} if self.unit else {}
        lower = "exclusiveMinimum" if self.above else "minimum"
        return {"type": "number", lower: self.least, "maximum": self.most, **unit}


@dataclass(frozen=True)
class Several:
    """A list of numbers of one quantity; stands in an ``Annotated`` type, as :class:`Quantity` does."""

    quantity: Quantity
    count: int | None
    """None: any count."""
    what: str
    """Names of the numbers."""
    single: bool = False
    """Whether one number may stand for all of them."""

    def check(self, value: Any) -> tuple[float, ...]:
        """Return the numbers as floats. Raises ValueError that names the first wrong one."""
        if self.single and is_number(value):
            value = (value,)
        count = f"{self.count} numbers" if self.count is not None else "numbers"
        what = f"{self.what} in {self.quantity.unit}" if self.quantity.unit else self.what
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"must be a list of {count} ({what}), not {describe(value)}")
        if self.count is not None and len(value) != self.count:
            raise ValueError(f"must be {count} ({what}), not {len(value)}")
        for k, item in enumerate(value):
            if not is_number(item):
                raise ValueError(f"must be {count} ({what}); item {k + 1} is {describe(item)}")
            if item not in self.quantity:
                which = f"; item {k + 1} is {item:g}" if len(value) > 1 else f", not {item:g}"
                raise ValueError(f"must be {self.quantity} ({self.what}){which}{self.quantity.hint(item)}")
        return tuple(float(item) for item in value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return self.json_schema()

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of the list, or of the one number in its place."""
        item = self.quantity.json_schema()
        size = {"minItems": self.count, "maxItems": self.count} if self.count is not None else {}
        several = {"type": "array", "items": item, "description": self.what, **size}
        return {"anyOf": [item, several]} if self.single else several


def _unit_quaternion(q: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*q)
    if abs(norm - 1.0) > 0.01:
        raise ValueError(f"must be a unit quaternion x, y, z, w; the length of this one is {norm:.3g}")
    return tuple(item / norm for item in q)


def _with_length(direction: tuple[float, ...]) -> tuple[float, ...]:
    if math.hypot(*direction) < 1e-6:
        raise ValueError("must be a direction; its length may be any but 0")
    return direction


Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]
Pixels = Annotated[int, Field(strict=True, gt=0, le=16384)]

# Every number of a rig, a model, an object or a mapping is one of these. The ranges hold what can stand on one bench;
# what a real arm may be given at most is in resolve_limits.py.
Share = Annotated[float, Quantity("", 0.0, 1.0, above=True)]
Factor = Annotated[float, Quantity("", 0.0, 1000.0, above=True)]
Size = Annotated[float, Quantity("m", 0.0, 5.0, above=True)]
Distance = Annotated[float, Quantity("m", 0.0, 50.0, above=True)]
Coordinate = Annotated[float, Quantity("m", -50.0, 50.0)]
Mass = Annotated[float, Quantity("kg", 0.0, 50.0)]
Force = Annotated[float, Quantity("N", 0.0, 1000.0, above=True)]
Speed = Annotated[float, Quantity("m/s", 0.0, 2.0, above=True)]
TcpSpeed = Annotated[float, Quantity("m/s", 0.0, 10.0, above=True)]
Degrees = Annotated[float, Quantity("deg", -360.0, 360.0)]
ViewAngle = Annotated[float, Quantity("deg", 0.0, 179.0, above=True)]
Seconds = Annotated[float, Quantity("s", 0.0, 60.0, above=True)]
RateHz = Annotated[float, Quantity("Hz", 10.0, 10000.0)]
CameraRate = Annotated[float, Quantity("Hz", 0.0, 1000.0, above=True)]

_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]
Position = Annotated[_Three, Several(Quantity("m", -50.0, 50.0), 3, "x, y, z")]
"""In the world, or in the base frame of an arm."""
Offset = Annotated[_Three, Several(Quantity("m", -5.0, 5.0), 3, "x, y, z")]
"""In the frame of a link or of a sensor."""
Sizes = Annotated[_Three, Several(Quantity("m", 0.0, 5.0, above=True), 3, "x, y, z")]
Gravity = Annotated[_Three, Several(Quantity("m/s2", -100.0, 100.0), 3, "x, y, z")]
Direction = Annotated[_Three, Several(Quantity("", -1e6, 1e6), 3, "x, y, z"), AfterValidator(_with_length)]
QuaternionConfig = Annotated[
    _Four, Several(Quantity("", -1e6, 1e6), 4, "a unit quaternion x, y, z, w"), AfterValidator(_unit_quaternion)
]
Rgba = Annotated[_Four, Several(Quantity("", 0.0, 1.0), 4, "red, green, blue, alpha")]

_Any = tuple[float, ...]
_EACH = "one for each joint"
_OR_ALL = "one for each joint, or one for all of them"
# Joints that slide have m in the place of rad.
JointPositions = Annotated[_Any, Several(Quantity("rad", -1e4, 1e4), None, _EACH)]
"""Compared with the limits of the joints later."""
JointLimits = Annotated[_Any, Several(Quantity("rad", -30.0, 30.0), None, _OR_ALL, single=True)]
Velocities = Annotated[_Any, Several(Quantity("rad/s", 0.0, 50.0, above=True), None, _OR_ALL, single=True)]
Accelerations = Annotated[_Any, Several(Quantity("rad/s2", 0.0, 2000.0, above=True), None, _OR_ALL, single=True)]
Jerks = Annotated[_Any, Several(Quantity("rad/s3", 0.0, 1e6, above=True), None, _OR_ALL, single=True)]
Torques = Annotated[_Any, Several(Quantity("Nm", 0.0, 5000.0, above=True), None, _OR_ALL, single=True)]

_POSE = Several(Quantity("", -50.0, 50.0), 7, "x, y, z in m, then a quaternion x, y, z, w; or {position, orientation}")


class PoseConfig(Strict):
    """``{position: [x, y, z], orientation: [x, y, z, w]}``, or the same seven numbers as one list. m."""

    position: Position = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """Both ways to write it."""
        own = handler(core_schema)
        return {
            "description": own.pop("description", ""),
            "anyOf": [handler.resolve_ref_schema(own), _POSE.json_schema()],
        }

    @model_validator(mode="before")
    @classmethod
    def _seven_numbers(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            seven = _POSE.check(data)
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
