"""How an emulated camera behaves: its fixed properties, set in the rig file, and the faults that tests inject."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches

from hal.errors import CommandError

PATTERNS = ("test", "scene")
CLOCKS = ("hardware", "global", "system")
_STREAMS = ("color", "depth", "infrared", "infrared_right")


@dataclass(frozen=True)
class Emulation:
    """Properties of an emulated camera, ``real.emulated`` of a rig file; the defaults are those of a healthy camera.

    Raises CommandError for an impossible value.
    """

    pattern: str = "test"
    """``test``: gradients, a different image every time. ``scene``: a table, and a box that moves on it."""
    seed: int = 0
    """Changes the images, so that two cameras can be told apart."""
    serial: str | None = None
    """Serial number; None for one made from the camera's name."""
    metadata: bool = True
    """Whether frames carry their rate and number. Without them the library matches colour and depth badly."""
    clock: str = "hardware"
    """Clock of the stamps: the sensor's own (``hardware``), that clock converted to the host's time of day
    (``global``), or the host's time of day at arrival (``system``)."""
    clock_at: float = 1000.0
    """Reading of the sensor's clock when the camera is created, s. Like the real one it counts microseconds in 32 bits:
    it wraps after 4294.97 s."""
    drift_ppm: float = 0.0
    """Rate error of the sensor's clock, parts per million; positive is fast."""
    arrival_jitter: float = 0.0
    """Largest delay between capture and arrival, s; random, and different for each sensor."""
    color_ahead: int = 0
    """Offset of the colour sensor's frame numbers: on a real camera each sensor counts for itself."""
    usb: str = "3.2"
    """USB version that is reported."""

    @classmethod
    def from_options(cls, options: object) -> Emulation:
        """Return the properties that a rig file sets: ``true``, or a mapping.

        Raises:
            CommandError: For anything else, an unknown key (lists the known ones) or an impossible value.
        """
        if options is True:
            return cls()
        if not isinstance(options, Mapping):
            raise CommandError(f"emulated must be true or a mapping, not {options!r}")
        _check_names(options, [f.name for f in fields(cls)], "an emulated camera has no option")
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
            raise CommandError("seed and color_ahead must be 0 or more")
        if not (_is_finite(self.arrival_jitter) and 0.0 <= self.arrival_jitter < 1.0):
            raise CommandError(f"arrival_jitter must be from 0 to below 1 s, not {self.arrival_jitter!r}")
        if not (_is_finite(self.clock_at) and self.clock_at >= 0.0):
            raise CommandError(f"clock_at must be 0 s or more, not {self.clock_at!r}")
        if not (_is_finite(self.drift_ppm) and abs(self.drift_ppm) <= 1e4):
            raise CommandError(f"drift_ppm must be from -10000 to 10000, not {self.drift_ppm!r}")


@dataclass(frozen=True)
class CameraFaults:
    """Faults of an emulated camera; the defaults are harmless. Raises CommandError for an impossible value."""

    disconnect: bool = False
    """The cable is pulled: see :meth:`.SoftwareCamera.unplug`."""
    freeze: bool = False
    """The camera stays listed and sends nothing; frame numbers continue."""
    drop: int = 0
    """Lose every n-th frame; 0 for none."""
    drop_stream: str | None = None
    """The stream whose frames are lost; None for all."""
    skew: float = 0.0
    """Colour is stamped that much later than it was taken, s."""

    def updated(self, changes: Mapping[str, object]) -> CameraFaults:
        """Return these faults with changes. Raises CommandError for an unknown name or an impossible value."""
        _check_names(changes, [f.name for f in fields(self)], "there is no fault")
        return replace(self, **changes)  # type: ignore[arg-type]  # checked when it is made

    def __post_init__(self) -> None:
        for name in ("disconnect", "freeze"):
            if not isinstance(getattr(self, name), bool):
                raise CommandError(f"{name} must be True or False, not {getattr(self, name)!r}")
        if type(self.drop) is not int or self.drop < 0:
            raise CommandError(f"drop must be a count, 0 for none, not {self.drop!r}")
        if self.drop_stream is not None and self.drop_stream not in _STREAMS:
            raise CommandError(f"drop_stream must be one of {', '.join(_STREAMS)} or None, not {self.drop_stream!r}")
        if type(self.skew) not in (int, float) or not math.isfinite(self.skew):
            raise CommandError(f"skew must be in s, not {self.skew!r}")


def _check_names(names: Iterable[object], known: list[str], error: str) -> None:
    """Raise CommandError for a name that is not known."""
    for name in names:
        if name not in known:
            close = get_close_matches(str(name), known, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise CommandError(f"{error} {name!r}{hint}; known: {', '.join(known)}", code="unknown_name")


def _is_finite(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
