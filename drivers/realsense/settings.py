"""What a rig may say of a RealSense under ``real:``, checked before anything is opened.

Nothing here imports the vendor's library.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from hal.config.files import Problems, validate
from hal.config.schema import Flag, Quantity, Seconds, Strict, describe, is_number
from hal.errors import CommandError, ConfigError
from hal.specs import CameraSpec

from .emulator import Emulation

__all__ = ["COLOR_FORMATS", "FORMATS", "RealSenseSettings", "problems"]

COLOR_FORMATS = ("rgb8", "bgr8", "rgba8", "bgra8", "yuyv", "uyvy")
"""Formats of colour that become RGB here, the one that costs least first."""
FORMATS = {"color": COLOR_FORMATS, "depth": ("z16",), "infrared": ("y8",), "infrared_right": ("y8",)}
"""Streams by the names of a rig's file -> the formats that they may have, the default first."""
_SENSORS = ("color", "depth")
_SUFFIX = ".db3"
_NEEDS = {"overwrite": "record", "repeat": "play", "paced": "play"}
"""Keys -> those without which they would be ignored."""


def _serial(value: Any) -> Any:
    if value is None:
        return None
    if isinstance(value, int) and not isinstance(value, bool):
        raise ValueError(f'must be text, because zeros at its start count: write it in quotes, "{value}"')
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"must be the number that is printed on the camera, in quotes, not {describe(value)}")
    return value.strip()


def _recording(value: Any) -> Any:
    if value is None:
        return None
    if not isinstance(value, str) or not value.endswith(_SUFFIX):
        raise ValueError(f"must be the path of a recording, which ends in {_SUFFIX}, not {describe(value)}")
    return str(Path(value).expanduser())


def _options(value: Any) -> Any:
    """Names of options -> values, or ``color`` and ``depth`` -> the same for one sensor each."""
    if not isinstance(value, dict):
        raise ValueError(f"must hold names and values, not {describe(value)}")
    for name, item in value.items():
        if name in _SENSORS:
            if not isinstance(item, dict):
                raise ValueError(f"{name} must hold names and values, not {describe(item)}")
            for inner, setting in item.items():
                _check_option(f"{name}.{inner}", setting)
        else:
            _check_option(str(name), item)
    return value


def _check_option(name: str, value: Any) -> None:
    if not (is_number(value) or isinstance(value, (bool, str))):
        raise ValueError(f"{name} must be a number, true, false or a word, not {describe(value)}")


def _emulated(value: Any) -> Any:
    if value is None or value is False:
        return None
    try:
        Emulation.of(value)
    except CommandError as error:
        raise ValueError(str(error)) from None
    return {} if value is True else dict(value)


class RealSenseSettings(Strict):
    """``real:`` of a RealSense."""

    serial: Annotated[str | None, BeforeValidator(_serial)] = None
    """Which one; needed where several are plugged in."""
    options: Annotated[dict[str, Any], BeforeValidator(_options)] = Field(default_factory=dict)
    """What the camera is told before it streams, see :mod:`.options`."""
    warm_up_s: Annotated[float, Quantity("s", 0.0, 60.0)] = 1.0
    """For so long after the first picture none is handed out, while automatic exposure settles."""
    stall_s: Seconds = 1.0
    """A camera that sends nothing new for so long counts as lost."""
    record: Annotated[str | None, BeforeValidator(_recording)] = None
    """File that everything streamed is written to."""
    overwrite: Flag = False
    """May the file be there already?"""
    play: Annotated[str | None, BeforeValidator(_recording)] = None
    """A recording to play instead of opening a camera."""
    repeat: Flag = True
    """Does the recording begin anew at its end?"""
    paced: Flag = True
    """Is it played as fast as it was taken? Otherwise each ``read`` takes the next frame, and none is lost."""
    emulated: Annotated[dict[str, Any] | None, BeforeValidator(_emulated)] = None
    """A camera in software instead of a real one, and what it is like."""

    @model_validator(mode="after")
    def _one_source(self) -> RealSenseSettings:
        if self.play is not None and self.record is not None:
            raise ValueError("plays one recording or makes one: give play or record")
        if self.play is not None and self.emulated is not None:
            raise ValueError("has one place where its pictures come from: give play or emulated")
        if self.play is not None and self.options:
            raise ValueError("plays a recording, whose options were set when it was made: leave options out")
        for key, other in _NEEDS.items():
            if key in self.model_fields_set and getattr(self, other) is None:
                raise ValueError(f"has {key}, which says nothing without {other}")
        return self

    @property
    def is_real(self) -> bool:
        """Is it a camera that is plugged in?"""
        return self.play is None and self.emulated is None

    @classmethod
    def of(cls, spec: CameraSpec) -> RealSenseSettings:
        """Those of a camera's record. Raises ConfigError, which lists everything that is wrong."""
        found = Problems()
        settings = validate(cls, spec.options, f"cameras.{spec.name}.real", found)
        if found.found:
            raise ConfigError(found.found)
        return settings


def problems(spec: CameraSpec) -> Iterator[tuple[str, str]]:
    """What is wrong in a camera's record: (key in the camera's entry of the rig, sentence)."""
    found = Problems()
    validate(RealSenseSettings, spec.options, "", found, "real")
    for problem in found.found:
        yield problem.key, problem.message
    played = spec.options.get("play")
    if isinstance(played, str) and not found.found and not Path(played).expanduser().is_file():
        yield "real.play", f"there is no recording {played}"
    recorded = spec.options.get("record")
    if isinstance(recorded, str) and not found.found and not Path(recorded).expanduser().parent.is_dir():
        yield "real.record", f"there is no folder {Path(recorded).expanduser().parent} for the recording"
    for stream in spec.streams:
        formats = FORMATS.get(stream)
        if formats is None:
            yield f"streams.{stream}", f"is nothing that a RealSense sends; it has {', '.join(FORMATS)}"
            continue
        wanted = spec.sensors[stream].format if stream in spec.sensors else None
        if wanted is not None and wanted not in formats:
            yield f"streams.{stream}.format", f"{describe(wanted)} is none of {', '.join(formats)}"
