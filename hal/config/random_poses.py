"""Where a thing starts in each episode: ranges, of which a pose is drawn with the episode's seed."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, model_validator

from ..specs import RangesSpec, Vector3
from .schema import Quantity, Several, Strict

__all__ = ["RandomPose"]


_ENDS = "the least and the greatest"


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    least, greatest = ends
    if least > greatest:
        raise ValueError(f"must be {_ENDS}; {least:g} is above {greatest:g}")
    return ends


_Two = tuple[float, float]
Range = Annotated[_Two, Several(Quantity("m", -50.0, 50.0), 2, _ENDS), AfterValidator(_ordered)]
Turn = Annotated[_Two, Several(Quantity("deg", -360.0, 360.0), 2, _ENDS), AfterValidator(_ordered)]


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

    def around(self, position: Vector3) -> RangesSpec:
        """The ranges of a thing that is configured at ``position``."""
        places = [given or (value, value) for given, value in zip((self.x, self.y, self.z), position, strict=True)]
        turns = [given or (0.0, 0.0) for given in (self.roll_deg, self.pitch_deg, self.yaw_deg)]
        ends = [*places, *((math.radians(least), math.radians(greatest)) for least, greatest in turns)]
        return RangesSpec(tuple(least for least, _ in ends), tuple(greatest for _, greatest in ends))
