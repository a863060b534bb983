"""Building blocks of all YAML schemas: strict records, quantities with units and ranges, vectors, poses."""

from __future__ import annotations

import ipaddress
import math
import re
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema


class Unknown(AttributeError):
    """A key was read whose value is wrong or missing, which is already a problem: skip what needs it."""


class ValueProblem(ValueError):
    """A value that a record's own check refuses."""

    def __init__(self, message: str, code: str) -> None:
        super().__init__(message)
        self.code = code
        """Stable identifier of the kind of problem (see :mod:`.files`)."""


class Strict(BaseModel):
    """A record without unknown keys. One from a file with mistakes can have holes, which raise :class:`Unknown`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    if not TYPE_CHECKING:  # so that mypy still finds misspelt attributes

        def __getattr__(self, name: str) -> Any:
            if name in type(self).model_fields:
                raise Unknown(name)
            return super().__getattr__(name)


def describe(value: Any) -> str:
    """Return a wrong value in words short enough for a message."""
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
    """Return whether a value is a number that a quantity can have: finite, and within what floats represent exactly."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -1e12 < value < 1e12


_SMALLER = {
    "m": ("mm", 1e-3),
    "m/s": ("mm/s", 1e-3),
    "kg": ("g", 1e-3),
    "rad": ("deg", math.pi / 180.0),
    "rad/s": ("deg/s", math.pi / 180.0),
}
"""Unit -> the unit that a value out of range was probably written in, and its factor."""


@dataclass(frozen=True)
class Quantity:
    """A physical quantity: its unit, and the range outside which a value is a mistake, usually a wrong unit.

    Used in an ``Annotated`` type: it checks the value, and adds range and unit to the JSON schema.
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
        """Return the value as a float. Raises ValueProblem, whose message has the range and the unit."""
        if not is_number(value):
            unit = f" in {self.unit}" if self.unit else ""
            raise ValueProblem(f"must be a number{unit}, not {describe(value)}", "wrong_type")
        if value not in self:
            raise ValueProblem(f"must be {self}, not {value:g}{self.hint(value)}", "out_of_range")
        return float(value)

    def hint(self, value: float) -> str:
        """Return a value out of range in the unit that was probably meant; "" if there is no such unit."""
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
    """A list of numbers of one quantity; used in an ``Annotated`` type, as :class:`Quantity` is."""

    quantity: Quantity
    count: int | None
    """None: any count."""
    what: str
    """Names of the numbers."""
    single: bool = False
    """Whether one number may stand for all of them."""

    def check(self, value: Any) -> tuple[float, ...]:
        """Return the numbers as floats. Raises ValueProblem, which names the first wrong one."""
        if self.single and is_number(value):
            value = (value,)
        count = f"{self.count} numbers" if self.count is not None else "numbers"
        what = f"{self.what} in {self.quantity.unit}" if self.quantity.unit else self.what
        if not isinstance(value, (list, tuple)):
            raise ValueProblem(f"must be a list of {count} ({what}), not {describe(value)}", "wrong_type")
        if self.count is not None and len(value) != self.count:
            raise ValueProblem(f"must be {count} ({what}), not {len(value)}", "wrong_count")
        for k, item in enumerate(value):
            if not is_number(item):
                raise ValueProblem(f"must be {count} ({what}); item {k + 1} is {describe(item)}", "wrong_type")
            if item not in self.quantity:
                which = f"; item {k + 1} is {item:g}" if len(value) > 1 else f", not {item:g}"
                message = f"must be {self.quantity} ({self.what}){which}{self.quantity.hint(item)}"
                raise ValueProblem(message, "out_of_range")
        return tuple(float(item) for item in value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return self.json_schema()

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of the list, or of the one number in place of it."""
        item = self.quantity.json_schema()
        size = {"minItems": self.count, "maxItems": self.count} if self.count is not None else {}
        several = {"type": "array", "items": item, "description": self.what, **size}
        return {"anyOf": [item, several]} if self.single else several


ENDS = "the least and the greatest"
"""Numbers of a range, for messages."""


def check_order(ends: tuple[float, ...]) -> tuple[float, ...]:
    """Return the two ends of a range. Raises ValueProblem if the range is upside down."""
    least, greatest = ends
    if least > greatest:
        raise ValueProblem(f"must be {ENDS}; {least:g} is above {greatest:g}", "empty_range")
    return ends


def _normalise(q: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*q)
    if abs(norm - 1.0) > 0.01:
        raise ValueProblem(
            f"must be a unit quaternion x, y, z, w; the length of this one is {norm:.3g}", "bad_rotation"
        )
    return tuple(item / norm for item in q)


def _check_length(direction: tuple[float, ...]) -> tuple[float, ...]:
    if math.hypot(*direction) < 1e-6:
        raise ValueProblem("must be a direction, of any length but 0", "out_of_range")
    return direction


_LABEL = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")


def _host(value: Any) -> str:
    advice = "must be the robot's address, for example 172.16.0.2, without scheme and port"
    if not isinstance(value, str):
        raise ValueProblem(f"{advice}, not {describe(value)}", "bad_address")
    text = value.strip()
    labels = text.removesuffix(".").split(".")
    if labels[-1].isdecimal():  # no host name ends in a number
        try:
            return str(ipaddress.IPv4Address(text))
        except ValueError:
            raise ValueProblem(f"{advice}, not {describe(value)}", "bad_address") from None
    if not all(_LABEL.fullmatch(label) for label in labels):
        raise ValueProblem(f"{advice}, not {describe(value)}", "bad_address")
    return text


def _check_port(at: str) -> str:
    port = at.rpartition(":")[2] if not at.endswith("]") else ""
    if port.isdecimal() and not 0 < int(port) < 65536:
        raise ValueProblem(f"a port is a number from 1 to 65535, not {port}", "out_of_range")
    return at


def is_own_host(options: Mapping[str, Any]) -> bool:
    """Return whether ``host`` in a device's options is this computer, so that the device can only be an emulator."""
    host = str(options.get("host", "")).strip().removesuffix(".").lower()
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(pattern=r"^_?[A-Za-z][A-Za-z0-9_-]*$")]
Host = Annotated[str, BeforeValidator(_host)]
Address = Annotated[
    str,
    Field(pattern=r"^([A-Za-z0-9._-]+|\[[0-9a-fA-F:.]+\])(:[0-9]{1,5})?$"),
    AfterValidator(_check_port),
]
"""A computer's name or address, with or without a port."""
Pixels = Annotated[int, Field(strict=True, gt=0, le=16384)]

# Every number of a rig, a model, an object or a mapping is one of these. The ranges include everything that fits on one
# bench; bounds for a real arm are in resolve_robots.py.
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
Direction = Annotated[_Three, Several(Quantity("", -1e6, 1e6), 3, "x, y, z"), AfterValidator(_check_length)]
QuaternionConfig = Annotated[
    _Four, Several(Quantity("", -1e6, 1e6), 4, "a unit quaternion x, y, z, w"), AfterValidator(_normalise)
]
Rgba = Annotated[_Four, Several(Quantity("", 0.0, 1.0), 4, "red, green, blue, alpha")]

_Any = tuple[float, ...]
_EACH = "one for each joint"
_OR_ALL = "one for each joint, or one for all of them"
# Joints that slide have m instead of rad.
JointPositions = Annotated[_Any, Several(Quantity("rad", -1e4, 1e4), None, _EACH)]
"""Compared with the limits of the joints later."""
FingerPosition = Annotated[float, Quantity("rad", -10.0, 10.0)]
"""rad, or m for a finger that slides."""
JointLimits = Annotated[_Any, Several(Quantity("rad", -30.0, 30.0), None, _OR_ALL, single=True)]
Velocities = Annotated[_Any, Several(Quantity("rad/s", 0.0, 50.0, above=True), None, _OR_ALL, single=True)]
Accelerations = Annotated[_Any, Several(Quantity("rad/s2", 0.0, 2000.0, above=True), None, _OR_ALL, single=True)]
Jerks = Annotated[_Any, Several(Quantity("rad/s3", 0.0, 1e6, above=True), None, _OR_ALL, single=True)]
Torques = Annotated[_Any, Several(Quantity("Nm", 0.0, 5000.0, above=True), None, _OR_ALL, single=True)]

_POSE = Several(Quantity("", -50.0, 50.0), 7, "x, y, z in m, then a quaternion x, y, z, w; or {position, orientation}")


class Load(Strict):
    """Everything that is mounted on the flange, the gripper included."""

    mass: Mass
    """kg"""
    com: Offset = (0.0, 0.0, 0.0)
    """Centre of mass in the frame of the flange, m."""


class PoseConfig(Strict):
    """``{position: [x, y, z], orientation: [x, y, z, w]}``, or the same seven numbers as one list. m."""

    position: Position = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """Return the schema of both ways to write a pose."""
        own = handler(core_schema)
        return {
            "description": own.pop("description", ""),
            "anyOf": [handler.resolve_ref_schema(own), _POSE.json_schema()],
        }

    @model_validator(mode="before")
    @classmethod
    def _expand_numbers(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            seven = _POSE.check(data)
            return {"position": seven[:3], "orientation": seven[3:]}
        return data


def list_keys(model: type[BaseModel], loc: Sequence[Any]) -> tuple[str, ...]:
    """Return the keys that are allowed at a place (keys and indices, from the outermost inwards) in a record."""
    kind: Any = model
    for part in loc:
        kind = find_kind(kind, part)
    kind = find_record(kind)
    return tuple(kind.model_fields) if kind is not None else ()


def find_kind(kind: Any, part: Any) -> Any:
    """Return the type of the value at ``part`` of a record, a dict or a list of the type ``kind``; None if unknown."""
    record = find_record(kind)
    if record is not None:
        found = record.model_fields.get(str(part))
        return found.annotation if found is not None else None
    for option in _list_options(kind):
        arguments = typing.get_args(option)
        if typing.get_origin(option) in (dict, list, tuple) and arguments:
            return arguments[1] if typing.get_origin(option) is dict else arguments[0]
    return None


def find_record(kind: Any) -> type[BaseModel] | None:
    """Return the class of record that a value of the type ``kind`` is; None if it is not a record."""
    return next((k for k in _list_options(kind) if isinstance(k, type) and issubclass(k, BaseModel)), None)


def _list_options(kind: Any) -> tuple[Any, ...]:
    """Return the types in ``X | None`` and ``Annotated[X, ...]``: X."""
    if typing.get_origin(kind) is Annotated:
        return _list_options(typing.get_args(kind)[0])
    if type(None) in typing.get_args(kind):
        return tuple(inner for option in typing.get_args(kind) for inner in _list_options(option))
    return (kind,)
