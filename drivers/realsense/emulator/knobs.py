"""The knobs that make an emulated camera misbehave; every default is harmless."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches

from hal.errors import CommandError

__all__ = ["Knobs"]

_STREAMS = ("color", "depth", "infrared", "infrared_right")


@dataclass(frozen=True)
class Knobs:
    """Raises CommandError for a value that cannot be."""

    disconnect: bool = False
    """The cable is pulled: see :meth:`~.camera.SoftwareCamera.unplug`."""
    freeze: bool = False
    """It stays listed and sends nothing; the numbers go on."""
    drop: int = 0
    """Every n-th picture is lost. 0 for never."""
    drop_stream: str | None = None
    """Of this stream only; None for all."""
    skew: float = 0.0
    """Colour is stamped that much later than it was taken, s."""

    def turned(self, changes: Mapping[str, object]) -> Knobs:
        """These with ``changes`` made. Raises CommandError for a knob that does not exist, too."""
        known = [f.name for f in fields(self)]
        for name in changes:
            if name not in known:
                close = get_close_matches(name, known, n=1)
                hint = f" (did you mean {close[0]!r}?)" if close else ""
                raise CommandError(f"there is no knob {name!r}{hint}; knobs: {', '.join(known)}")
        return replace(self, **changes)  # type: ignore[arg-type]  # checked when it is made

    def __post_init__(self) -> None:
        for name in ("disconnect", "freeze"):
            if not isinstance(getattr(self, name), bool):
                raise CommandError(f"{name} must be True or False, not {getattr(self, name)!r}")
        if type(self.drop) is not int or self.drop < 0:
            raise CommandError(f"drop must be a count, 0 for never, not {self.drop!r}")
        if self.drop_stream is not None and self.drop_stream not in _STREAMS:
            raise CommandError(f"drop_stream must be one of {', '.join(_STREAMS)} or None, not {self.drop_stream!r}")
        if type(self.skew) not in (int, float) or not math.isfinite(self.skew):
            raise CommandError(f"skew must be in s, not {self.skew!r}")
