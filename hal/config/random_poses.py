"""Where a thing starts in each episode: ranges, of which a pose is drawn with the episode's seed."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BeforeValidator, model_validator

from ..specs import RangesSpec
from .schema import Strict, Vector, describe, is_number

__all__ = ["RandomPose"]


def _range(value: Any) -> tuple[float, float]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise ValueError(f"must be two numbers, the least and the greatest, not {describe(value)}")
    for item in value:
        if not is_number(item):
            raise ValueError(f"must be two numbers, the least and the greatest; one is {describe(item)}")
    least, greatest = float(value[0]), float(value[1])
    if least > greatest:
        raise ValueError(f"must be the least and the greatest; {least:g} is above {greatest:g}")
    return least, greatest


def _turn(value: Any) -> tuple[float, float]:
    least, greatest = _range(value)
    if least < -360.0 or greatest > 360.0:
        raise ValueError(f"must be within -360 and 360 degrees, not {least:g} to {greatest:g}")
    return least, greatest


Range = Annotated[tuple[float, float], BeforeValidator(_range)]
Turn = Annotated[tuple[float, float], BeforeValidator(_turn)]


class RandomPose(Strict):
    """Ranges ``[least, greatest]``; what is left out stays as it is configured."""

    x: Range | None = None
    """m, in the world; likewise y and z."""
    y: Range | None = None
    z: Range | None = None
    roll_deg: Turn | None = None
    """Turned by so much about the world's x axis, then about y by pitch and about z by yaw, after its orientation."""
    pitch_deg: Turn | None = None
    yaw_deg: Turn | None = None

    @model_validator(mode="after")
    def _something(self) -> RandomPose:
        if all(getattr(self, key) is None for key in type(self).model_fields):
            raise ValueError(f"holds no range; keys: {', '.join(type(self).model_fields)}")
        return self

    def around(self, position: Vector) -> RangesSpec:
        """The ranges of a thing that is configured at ``position``."""
        places = [given or (value, value) for given, value in zip((self.x, self.y, self.z), position, strict=True)]
        turns = [given or (0.0, 0.0) for given in (self.roll_deg, self.pitch_deg, self.yaw_deg)]
        ends = [*places, *((math.radians(least), math.radians(greatest)) for least, greatest in turns)]
        return RangesSpec(tuple(least for least, _ in ends), tuple(greatest for _, greatest in ends))
