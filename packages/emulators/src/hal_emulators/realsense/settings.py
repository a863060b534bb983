"""How an emulated camera behaves: its fixed properties, set in the rig file, and the faults that tests inject."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from hal.config.files import check_record
from hal.config.schema import Flag, Strict
from hal.errors import CommandError, ConfigError

Stream = Literal["color", "depth", "infrared", "infrared_right"]
Count = Annotated[int, Field(strict=True, ge=0)]
R = TypeVar("R", bound=Strict)


class Emulation(Strict):
    """Properties of an emulated camera, ``real.emulated`` of a rig file; the defaults are those of a healthy camera."""

    pattern: Literal["test", "scene"] = "test"
    """``test``: gradients, a different image every time. ``scene``: a table, and a box that moves on it."""
    seed: Count = 0
    """Changes the images, so that two cameras can be told apart."""
    serial: Annotated[str, Field(strict=True, min_length=1)] | None = None
    """Serial number; None for one made from the camera's name."""
    metadata: Flag = True
    """Whether frames carry their rate and number. Without them the library matches colour and depth badly."""
    clock: Literal["hardware", "global", "system"] = "hardware"
    """Clock of the stamps: the sensor's own (``hardware``), that clock converted to the host's time of day
    (``global``), or the host's time of day at arrival (``system``)."""
    clock_at: float = Field(default=1000.0, ge=0.0)
    """Reading of the sensor's clock when the camera is created, s. Like the real one it counts microseconds in 32 bits:
    it wraps after 4294.97 s."""
    drift_ppm: float = Field(default=0.0, ge=-1e4, le=1e4)
    """Rate error of the sensor's clock, parts per million; positive is fast."""
    arrival_jitter: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Largest delay between capture and arrival, s; random, and different for each sensor."""
    color_ahead: Count = 0
    """Offset of the colour sensor's frame numbers: on a real camera each sensor counts for itself."""
    usb: str = "3.2"
    """USB version that is reported."""

    @classmethod
    def from_options(cls, options: object) -> Emulation:
        """Return the properties that a rig file sets: ``true``, or a mapping. Raises CommandError."""
        return read_record(cls, {} if options is True else options)


class CameraFaults(Strict):
    """Faults of an emulated camera; the defaults are harmless."""

    disconnect: Flag = False
    """The cable is pulled: see :meth:`.SoftwareCamera.unplug`."""
    freeze: Flag = False
    """The camera stays listed and sends nothing; frame numbers continue."""
    drop: Count = 0
    """Lose every n-th frame; 0 for none."""
    drop_stream: Stream | None = None
    """The stream whose frames are lost; None for all."""
    skew: float = 0.0
    """Colour is stamped that much later than it was taken, s."""

    def updated(self, changes: Mapping[str, object]) -> CameraFaults:
        """Return these faults with changes. Raises CommandError for an unknown name or an impossible value."""
        return read_record(CameraFaults, {**self.model_dump(), **changes})


def read_record(kind: type[R], values: Any) -> R:
    """Return values as a record. Raises CommandError, which names what is wrong."""
    try:
        return check_record(kind, values, "")
    except ConfigError as error:
        found = error.problems[0]
        raise CommandError(f"{found.key}: {found.message}".lstrip(": "), code=found.code) from None
