"""What a rig file may set under ``real:`` of a RealSense: its check, and the camera's own options by name.

The check runs without the vendor's library. The camera's options (exposure, gain, laser power, visual preset and
whatever else its sensors have) are set in the camera's process. A name alone means the sensor that has it; where the
depth sensor and the colour sensor both have it (``exposure``, ``gain``), it is written under ``depth:`` or ``color:``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias

from pydantic import BeforeValidator, Field, model_validator

from hal.config.files import DeviceSettings
from hal.config.schema import Flag, Quantity, Seconds, ValueProblem, describe, is_number
from hal.errors import CommandError, NotSupported, find_closest
from hal.specs import CameraSpec

COLOR_FORMATS = ("rgb8", "bgr8", "rgba8", "bgra8", "yuyv", "uyvy")
"""Colour formats that are converted to RGB, the cheapest first."""
FORMATS = {"color": COLOR_FORMATS, "depth": ("z16",), "infrared": ("y8",), "infrared_right": ("y8",)}
"""Stream names of the rig file -> possible formats, the default first."""
_SENSORS = ("color", "depth")
_SUFFIX = ".db3"
_NEEDS = {"overwrite": "record", "repeat": "play", "paced": "play"}
"""Keys -> those without which they have no effect."""


# The rig file.


def _check_serial(value: Any) -> Any:
    if value is None:
        return None
    if isinstance(value, int) and not isinstance(value, bool):
        raise ValueProblem(f'must be text, because leading zeros count: write it in quotes, "{value}"', "wrong_type")
    if not isinstance(value, str) or not value.strip():
        raise ValueProblem(
            f"must be the number that is printed on the camera, in quotes, not {describe(value)}", "wrong_type"
        )
    return value.strip()


def _check_recording(value: Any) -> Any:
    if value is None:
        return None
    if not isinstance(value, str) or not value.endswith(_SUFFIX):
        raise ValueProblem(
            f"must be the path of a recording that ends in {_SUFFIX}, not {describe(value)}", "bad_suffix"
        )
    return str(Path(value).expanduser())


def _check_options(value: Any) -> Any:
    if not isinstance(value, dict):
        raise ValueProblem(f"must hold names and values, not {describe(value)}", "wrong_type")
    for name, item in value.items():
        if name in _SENSORS:
            if not isinstance(item, dict):
                raise ValueProblem(f"{name} must hold names and values, not {describe(item)}", "wrong_type")
            for inner, setting in item.items():
                _check_option(f"{name}.{inner}", setting)
        else:
            _check_option(str(name), item)
    return value


def _check_option(name: str, value: Any) -> None:
    if not (is_number(value) or isinstance(value, (bool, str))):
        raise ValueProblem(f"{name} must be a number, true, false or a word, not {describe(value)}", "wrong_type")


def _check_emulated(value: Any) -> Any:
    if value is None or value is False:
        return None
    try:
        from hal_emulators.realsense import Emulation

        Emulation.from_options(value)
    except ModuleNotFoundError:
        remedy = "pip install -e packages/emulators, in the repository of robot-hal"
        raise ValueProblem(f"needs the emulators, a package of their own: {remedy}", "missing_package") from None
    except CommandError as error:
        raise ValueProblem(str(error), error.code) from None
    return {} if value is True else dict(value)


class RealSenseSettings(DeviceSettings):
    """``real:`` of a RealSense."""

    serial: Annotated[str | None, BeforeValidator(_check_serial)] = None
    """Serial number; needed if several cameras are connected."""
    options: Annotated[dict[str, Any], BeforeValidator(_check_options)] = Field(default_factory=dict)
    """Names of camera options -> values, or ``color`` and ``depth`` -> the same for one sensor each."""
    warm_up_s: Annotated[float, Quantity("s", 0.0, 60.0)] = 1.0
    """Time after the first frame in which none is handed out, while automatic exposure settles."""
    stall_s: Seconds = 1.0
    """Time without a new frame after which the camera counts as lost."""
    record: Annotated[str | None, BeforeValidator(_check_recording)] = None
    """File that everything streamed is written to."""
    overwrite: Flag = False
    """Whether that file may exist already, and is then overwritten."""
    play: Annotated[str | None, BeforeValidator(_check_recording)] = None
    """A recording to play instead of opening a camera."""
    repeat: Flag = True
    """Whether the recording starts again at its end."""
    paced: Flag = True
    """Whether it is played at the rate it was recorded; otherwise each ``read`` takes the next frame, without loss."""
    emulated: Annotated[dict[str, Any] | None, BeforeValidator(_check_emulated)] = None
    """Fields of ``hal_emulators.realsense.Emulation``, for an emulated camera instead of a real one."""

    @model_validator(mode="after")
    def _check_source(self) -> RealSenseSettings:
        if self.play is not None and self.record is not None:
            raise ValueProblem("plays a recording or makes one: give play or record", "conflict")
        if self.play is not None and self.emulated is not None:
            raise ValueProblem("has one source of frames: give play or emulated", "conflict")
        if self.play is not None and self.options:
            raise ValueProblem(
                "plays a recording, whose options were set when it was made: leave options out", "conflict"
            )
        for key, other in _NEEDS.items():
            if key in self.model_fields_set and getattr(self, other) is None:
                raise ValueProblem(f"has {key}, which has no effect without {other}", "missing_key")
        return self

    @property
    def is_real(self) -> bool:
        return self.play is None and self.emulated is None


def problems(spec: CameraSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a camera's record: key in its entry of the rig file, message and code."""
    settings, found = RealSenseSettings.check(spec)
    yield from found
    if settings is not None and settings.play is not None and not Path(settings.play).is_file():
        yield "real.play", f"there is no recording {settings.play}", "missing_file"
    if settings is not None and settings.record is not None and not Path(settings.record).parent.is_dir():
        yield "real.record", f"there is no folder {Path(settings.record).parent} for the recording", "missing_folder"
    for stream in spec.streams:
        formats = FORMATS.get(stream)
        if formats is None:
            yield (
                f"streams.{stream}",
                f"no such stream; streams: {', '.join(FORMATS)}",
                "unknown_stream",
            )
            continue
        wanted = spec.sensors[stream].format if stream in spec.sensors else None
        if wanted is not None and wanted not in formats:
            yield f"streams.{stream}.format", f"{describe(wanted)} is none of {', '.join(formats)}", "unknown_format"


# The camera's own options.

Sensors: TypeAlias = Mapping[str, Any]
"""``depth`` and ``color`` -> the sensor (``rs2::sensor``); a camera may have one of them, or one that is both."""

_AUTOMATIC = {
    "exposure": "enable_auto_exposure",
    "gain": "enable_auto_exposure",
    "white_balance": "enable_auto_white_balance",
}
"""Manual option -> the automatic that must be off for it."""
_FIRST = ("visual_preset", "enable_auto_exposure", "enable_auto_white_balance")
"""Options that are set first: a preset changes other options, and a manual value needs its automatic off."""
_MOST_WORDS = 64
"""An option with more values than this is a number, and none of its values has a name."""


class _Assignment(NamedTuple):
    """An option of a sensor and the value that the rig file gives it."""

    place: str
    sensor: Any
    name: str
    value: Any

    def __str__(self) -> str:
        return f"{self.place}.{self.name}"


def find_sensors(device: Any) -> dict[str, Any]:
    import pyrealsense2 as rs

    found: dict[str, Any] = {}
    for sensor in device.query_sensors():
        streams = {profile.stream_type() for profile in sensor.get_stream_profiles()}
        for place, stream in (("depth", rs.stream.depth), ("color", rs.stream.color)):
            if stream in streams:
                found.setdefault(place, sensor)
    return found


def apply_options(sensors: Sensors, wanted: Mapping[str, Any]) -> tuple[str, ...]:
    """Set options (of :class:`RealSenseSettings`), read each one back, and describe what was changed beyond them.

    Raises NotSupported for an option that the camera lacks (lists those that it has), for a value out of its range, and
    for one that the camera does not keep.
    """
    assignments = sorted(_resolve(sensors, wanted), key=lambda one: (*_FIRST, one.name).index(one.name))
    notes = []
    for assignment in assignments:
        automatic = _AUTOMATIC.get(assignment.name)
        option = _find_option(assignment.sensor, automatic) if automatic else None
        if option is not None and assignment.sensor.get_option(option):
            if any(other.name == automatic and other.sensor is assignment.sensor for other in assignments):
                text = f"option {assignment} is set, so {assignment.place}.{automatic} must be false"
                raise NotSupported(text, code="option_conflict")
            assignment.sensor.set_option(option, 0.0)
            notes.append(f"{assignment.place}.{automatic} was switched off, because {assignment} is set")
        _set_option(assignment)
    return tuple(notes)


def read_options(sensors: Sensors) -> dict[str, float]:
    """Return the present values of all options that can be set, by names such as ``depth.exposure``."""
    values = {}
    for place, sensor in sensors.items():
        for name, option in _list_options(sensor):
            try:
                if not sensor.is_option_read_only(option):
                    values[f"{place}.{name}"] = float(sensor.get_option(option))
            except RuntimeError:  # not every option can be read at every time
                continue
    return values


def has_auto_exposure(sensors: Sensors) -> bool:
    for sensor in sensors.values():
        option = _find_option(sensor, "enable_auto_exposure")
        if option is not None and sensor.get_option(option):
            return True
    return False


def _list_options(sensor: Any) -> Iterator[tuple[str, Any]]:
    for option in sensor.get_supported_options():
        name = getattr(option, "name", None)
        if isinstance(name, str):
            yield name, option


def _find_option(sensor: Any, name: str) -> Any | None:
    return next((option for known, option in _list_options(sensor) if known == name), None)


def _resolve(sensors: Sensors, wanted: Mapping[str, Any]) -> Iterator[_Assignment]:
    for key, value in wanted.items():
        if isinstance(value, Mapping):
            if key not in sensors:
                text = f"options.{key}: this camera has no {key} sensor; it has {', '.join(sensors)}"
                raise NotSupported(text, code="unknown_sensor")
            for name, item in value.items():
                if _find_option(sensors[key], name) is None:
                    raise NotSupported(_describe_unknown(name, {key: sensors[key]}), code="unknown_option")
                yield _Assignment(key, sensors[key], name, item)
            continue
        places = [place for place, sensor in sensors.items() if _find_option(sensor, key) is not None]
        if not places:
            raise NotSupported(_describe_unknown(key, sensors), code="unknown_option")
        if len({id(sensors[place]) for place in places}) > 1:
            text = f"the {' and the '.join(places)} sensor both have {key!r}: put it under one of them"
            raise NotSupported(text, code="ambiguous_option")
        yield _Assignment(places[0], sensors[places[0]], key, value)


def _set_option(assignment: _Assignment) -> None:
    sensor, option = assignment.sensor, _find_option(assignment.sensor, assignment.name)
    if sensor.is_option_read_only(option):
        raise NotSupported(f"option {assignment} is read-only", code="option_read_only")
    limits = sensor.get_option_range(option)
    value = _parse_value(assignment, option, limits)
    if not limits.min <= value <= limits.max:
        text = f"option {assignment} must be {_describe_range(limits)}, not {value:g}"
        raise NotSupported(text, code="option_out_of_range")
    try:
        sensor.set_option(option, value)
        kept = sensor.get_option(option)
    except RuntimeError as error:
        text = f"option {assignment} cannot be set to {value:g}: {error}"
        raise NotSupported(text, code="option_rejected") from None
    if abs(kept - value) > max(limits.step, 1e-6 * abs(value)):
        text = f"the camera keeps {kept:g} for option {assignment}, not {value:g}"
        raise NotSupported(text, code="option_rejected")


def _parse_value(assignment: _Assignment, option: Any, limits: Any) -> float:
    value = assignment.value
    if not isinstance(value, str):
        return float(value)
    words = _value_names(assignment.sensor, option, limits)
    for number, word in words.items():
        if word == _normalise(value):
            return number
    choices = ", ".join(words.values()) if words else f"a number, {_describe_range(limits)}"
    text = f"option {assignment} has no value {value!r}; it has: {choices}"
    raise NotSupported(text, code="unknown_option_value")


def _value_names(sensor: Any, option: Any, limits: Any) -> dict[float, str]:
    """Return the names of an option's values, as a rig file writes them (``high_accuracy``)."""
    import pyrealsense2 as rs

    step = limits.step or 1.0
    count = int((limits.max - limits.min) / step) + 1
    if count > _MOST_WORDS:
        return {}
    words = {}
    for k in range(count):
        value = limits.min + k * step
        word = sensor.get_option_value_description(option, value)
        if word:
            words[value] = _normalise(word)
    if not words and option == rs.option.visual_preset:
        presets = rs.rs400_visual_preset.__members__.items()
        words = {float(int(preset)): name for name, preset in presets if name != "count"}
    return words


def _normalise(word: str) -> str:
    return word.strip().lower().replace(" ", "_").replace("-", "_")


def _describe_range(limits: Any) -> str:
    return f"{limits.min:g} to {limits.max:g}"


def _describe_unknown(name: str, sensors: Sensors) -> str:
    known = {place: sorted(_list_options(sensor), key=lambda pair: pair[0]) for place, sensor in sensors.items()}
    close = find_closest(name, (known_name for pairs in known.values() for known_name, _ in pairs))
    hint = f" (did you mean {close!r}?)" if close else ""
    lines = [f"this camera has no option {name!r}{hint}; it has:"]
    for place, pairs in known.items():
        lines += [f"  {place}.{known_name}: {_describe_option(sensors[place], option)}" for known_name, option in pairs]
    return "\n".join(lines)


def _describe_option(sensor: Any, option: Any) -> str:
    try:
        value, limits = sensor.get_option(option), sensor.get_option_range(option)
        if sensor.is_option_read_only(option):
            return f"{value:g}, read-only"
        return f"{_describe_range(limits)}, now {value:g}"
    except RuntimeError:
        return "cannot be read at the moment"
