"""Options of a camera by name: exposure, gain, laser power, visual preset and whatever else its sensors have.

A name alone means the sensor that has it. Where the depth sensor and the colour sensor both have it (``exposure``,
``gain``), it stands under ``depth:`` or ``color:``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple, TypeAlias

import pyrealsense2 as rs

from hal.errors import NotSupported

__all__ = ["Sensors", "apply", "is_automatic", "present", "sensors_of"]

Sensors: TypeAlias = Mapping[str, Any]
"""``depth`` and ``color`` -> the sensor (``rs2::sensor``); a camera may have one of them, or one that is both."""

_AUTOMATIC = {
    "exposure": "enable_auto_exposure",
    "gain": "enable_auto_exposure",
    "white_balance": "enable_auto_white_balance",
}
"""What is set by hand -> what must not be automatic then."""
_FIRST = ("visual_preset", "enable_auto_exposure", "enable_auto_white_balance")
"""A preset changes other options, and a manual value needs its automatic off: so these are set first."""
_MOST_WORDS = 64
"""An option with more values than this is a number, and none of its values has a name."""


class _Setting(NamedTuple):
    place: str
    sensor: Any
    name: str
    value: Any

    def __str__(self) -> str:
        return f"{self.place}.{self.name}"


def sensors_of(device: Any) -> dict[str, Any]:
    """The sensors of a camera by what they send."""
    found: dict[str, Any] = {}
    for sensor in device.query_sensors():
        streams = {profile.stream_type() for profile in sensor.get_stream_profiles()}
        for place, stream in (("depth", rs.stream.depth), ("color", rs.stream.color)):
            if stream in streams:
                found.setdefault(place, sensor)
    return found


def apply(sensors: Sensors, wanted: Mapping[str, Any]) -> tuple[str, ...]:
    """Set what the rig wants, and read it back; what was changed beyond that comes back in words.

    Raises NotSupported: for an option that the camera lacks (lists those that it has), for a value out of its range,
    and for one that the camera does not keep.
    """
    settings = sorted(_settings(sensors, wanted), key=_rank)
    notes = []
    for setting in settings:
        automatic = _AUTOMATIC.get(setting.name)
        option = _option(setting.sensor, automatic) if automatic else None
        if option is not None and setting.sensor.get_option(option):
            if any(other.name == automatic and other.sensor is setting.sensor for other in settings):
                raise NotSupported(f"option {setting} is set by hand, so {setting.place}.{automatic} must be false")
            setting.sensor.set_option(option, 0.0)
            notes.append(f"{setting.place}.{automatic} is off, because {setting} is set by hand")
        _set(setting)
    return tuple(notes)


def present(sensors: Sensors) -> dict[str, float]:
    """Present values of what the camera can be told, as ``depth.exposure``."""
    values = {}
    for place, sensor in sensors.items():
        for name, option in _options(sensor):
            try:
                if not sensor.is_option_read_only(option):
                    values[f"{place}.{name}"] = float(sensor.get_option(option))
            except RuntimeError:  # not every option can be read at every time
                continue
    return values


def is_automatic(sensors: Sensors) -> bool:
    """Does any sensor find its exposure by itself?"""
    for sensor in sensors.values():
        option = _option(sensor, "enable_auto_exposure")
        if option is not None and sensor.get_option(option):
            return True
    return False


def _options(sensor: Any) -> Iterator[tuple[str, Any]]:
    for option in sensor.get_supported_options():
        name = getattr(option, "name", None)
        if isinstance(name, str):
            yield name, option


def _option(sensor: Any, name: str) -> Any | None:
    return next((option for known, option in _options(sensor) if known == name), None)


def _rank(setting: _Setting) -> int:
    return _FIRST.index(setting.name) if setting.name in _FIRST else len(_FIRST)


def _settings(sensors: Sensors, wanted: Mapping[str, Any]) -> Iterator[_Setting]:
    for key, value in wanted.items():
        if isinstance(value, Mapping):
            if key not in sensors:
                raise NotSupported(f"options.{key}: this camera has no {key} sensor; it has {', '.join(sensors)}")
            for name, item in value.items():
                if _option(sensors[key], name) is None:
                    raise NotSupported(_unknown(name, {key: sensors[key]}))
                yield _Setting(key, sensors[key], name, item)
            continue
        places = [place for place, sensor in sensors.items() if _option(sensor, key) is not None]
        if not places:
            raise NotSupported(_unknown(key, sensors))
        if len({id(sensors[place]) for place in places}) > 1:
            raise NotSupported(f"the {' and the '.join(places)} sensor both have {key!r}: put it under one of them")
        yield _Setting(places[0], sensors[places[0]], key, value)


def _set(setting: _Setting) -> None:
    sensor, option = setting.sensor, _option(setting.sensor, setting.name)
    if sensor.is_option_read_only(option):
        raise NotSupported(f"option {setting} can only be read")
    limits = sensor.get_option_range(option)
    value = _number(setting, option, limits)
    if not limits.min <= value <= limits.max:
        raise NotSupported(f"option {setting} must be {_range(limits)}, not {value:g}")
    try:
        sensor.set_option(option, value)
        kept = sensor.get_option(option)
    except RuntimeError as error:
        raise NotSupported(f"option {setting} cannot be set to {value:g}: {error}") from None
    if abs(kept - value) > max(limits.step, 1e-6 * abs(value)):
        raise NotSupported(f"the camera keeps {kept:g} for option {setting}, not {value:g}")


def _number(setting: _Setting, option: Any, limits: Any) -> float:
    value = setting.value
    if not isinstance(value, str):
        return float(value)
    words = _words(setting.sensor, option, limits)
    for number, word in words.items():
        if word == _plain(value):
            return number
    choices = ", ".join(words.values()) if words else f"a number, {_range(limits)}"
    raise NotSupported(f"option {setting} has no value {value!r}; it has: {choices}")


def _words(sensor: Any, option: Any, limits: Any) -> dict[float, str]:
    """Names of an option's values, as a rig writes them (``high_accuracy``)."""
    step = limits.step or 1.0
    count = int((limits.max - limits.min) / step) + 1
    if count > _MOST_WORDS:
        return {}
    words = {}
    for k in range(count):
        value = limits.min + k * step
        word = sensor.get_option_value_description(option, value)
        if word:
            words[value] = _plain(word)
    if not words and option == rs.option.visual_preset:
        presets = rs.rs400_visual_preset.__members__.items()
        words = {float(int(preset)): name for name, preset in presets if name != "count"}
    return words


def _plain(word: str) -> str:
    return word.strip().lower().replace(" ", "_").replace("-", "_")


def _range(limits: Any) -> str:
    return f"{limits.min:g} to {limits.max:g}"


def _unknown(name: str, sensors: Sensors) -> str:
    known = {place: sorted(_options(sensor), key=lambda pair: pair[0]) for place, sensor in sensors.items()}
    close = get_close_matches(name, [known_name for pairs in known.values() for known_name, _ in pairs], n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    lines = [f"this camera has no option {name!r}{hint}; it has:"]
    for place, pairs in known.items():
        lines += [f"  {place}.{known_name}: {_described(sensors[place], option)}" for known_name, option in pairs]
    return "\n".join(lines)


def _described(sensor: Any, option: Any) -> str:
    try:
        value, limits = sensor.get_option(option), sensor.get_option_range(option)
        if sensor.is_option_read_only(option):
            return f"{value:g}, can only be read"
        return f"{_range(limits)}, now {value:g}"
    except RuntimeError:
        return "cannot be read at the moment"
