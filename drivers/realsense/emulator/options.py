"""How an emulated camera behaves: what a rig may say under ``real.emulated``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches

from hal.errors import CommandError

__all__ = ["CLOCKS", "PATTERNS", "Emulation"]

PATTERNS = ("test", "scene")
CLOCKS = ("hardware", "global", "system")


@dataclass(frozen=True)
class Emulation:
    """Every default is that of a camera in good order. Raises CommandError for a value that cannot be."""

    pattern: str = "test"
    """``test``: gradients, another picture every time. ``scene``: a table and a box that moves on it."""
    seed: int = 0
    """Another one gives other pictures: two cameras can be told apart."""
    serial: str | None = None
    """None for one made from the camera's name."""
    metadata: bool = True
    """Whether pictures bear their rate and number. Without them the library matches colour and depth badly."""
    clock: str = "hardware"
    """Whose time the stamps are: the sensor's own (``hardware``), that clock brought to the host's time of day
    (``global``), or the host's time of day at arrival (``system``)."""
    clock_at: float = 1000.0
    """Where the sensor's clock stands when the camera is made, s. It counts microseconds in 32 bits, as the real one:
    after 4294.97 s it begins anew."""
    drift_ppm: float = 0.0
    """By how much the sensor's clock is too fast."""
    arrival_jitter: float = 0.0
    """Pictures arrive up to this much after they were taken, s, each sensor's by another time."""
    color_ahead: int = 0
    """By how much the colour sensor's numbers are ahead: on a real camera each sensor counts for itself."""
    usb: str = "3.2"
    """The link that is found."""

    @classmethod
    def of(cls, options: object) -> Emulation:
        """From what stands in a rig's file: ``true``, or a mapping. Raises CommandError, with what there is."""
        if options is True:
            return cls()
        if not isinstance(options, Mapping):
            raise CommandError(f"emulated must be true or a mapping, not {options!r}")
        known = [f.name for f in fields(cls)]
        for name in options:
            if name not in known:
                close = get_close_matches(str(name), known, n=1)
                hint = f" (did you mean {close[0]!r}?)" if close else ""
                raise CommandError(f"an emulated camera has no option {name!r}{hint}; it has: {', '.join(known)}")
        return cls(**options)

    def __post_init__(self) -> None:
        for name, allowed in (("pattern", PATTERNS), ("clock", CLOCKS)):
            if getattr(self, name) not in allowed:
                raise CommandError(f"{name} must be one of {', '.join(allowed)}, not {getattr(self, name)!r}")
        for name, kind in (("seed", int), ("color_ahead", int), ("metadata", bool), ("usb", str)):
            if type(getattr(self, name)) is not kind:
                raise CommandError(f"{name} must be of type {kind.__name__}, not {getattr(self, name)!r}")
        if not (self.serial is None or (type(self.serial) is str and self.serial)):
            raise CommandError(f"serial must be a text, not {self.serial!r}")
        if self.seed < 0 or self.color_ahead < 0:
            raise CommandError("seed and color_ahead are counts, 0 or more")
        if not (_number(self.arrival_jitter) and 0.0 <= self.arrival_jitter < 1.0):
            raise CommandError(f"arrival_jitter must be in s, below 1, not {self.arrival_jitter!r}")
        if not (_number(self.clock_at) and self.clock_at >= 0.0):
            raise CommandError(f"clock_at must be in s, 0 or more, not {self.clock_at!r}")
        if not (_number(self.drift_ppm) and abs(self.drift_ppm) <= 1e4):
            raise CommandError(f"drift_ppm must be a number within 10000, not {self.drift_ppm!r}")


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
