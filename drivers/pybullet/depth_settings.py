"""What a rig may say of a simulated camera under ``simulated:``: is its depth as noisy as a real one's?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import Field

from hal.config.files import Problems, validate
from hal.config.schema import Flag, Strict, describe
from hal.errors import ConfigError
from hal.specs import CameraSpec

__all__ = ["LidarNoise", "Noise", "StereoNoise", "check", "noise_of"]


class _Options(Strict):
    depth_noise: Any = False


class Noise(Strict):
    """What the noise of every kind of camera has."""

    seed: int = Field(default=0, ge=0, strict=True)
    """In lock-step the same seed gives the same noise, frame by frame."""


class StereoNoise(Noise):
    """Of depth that is worked out from two pictures. Distances in pixels are those of the depth picture as captured."""

    subpixel: float = Field(default=0.08, gt=0.0, le=2.0, strict=True)
    """RMS error of the disparity, pixels."""
    step: float = Field(default=1 / 32, ge=0.0, le=1.0, strict=True)
    """Smallest difference between two disparities, pixels; 0 for none."""
    patch: float = Field(default=4.0, ge=1.0, le=64.0, strict=True)
    """Over how many pixels neighbours err alike; 1 for each on its own."""
    shadow: Flag = True
    """Is there no depth where only one of the two imagers sees?"""


class LidarNoise(Noise):
    """Of depth that is measured by light's time of flight: standard deviation, m, and on a line through both."""

    sigma_1m: float = Field(default=0.0025, ge=0.0, le=1.0, strict=True)
    sigma_9m: float = Field(default=0.0155, ge=0.0, le=1.0, strict=True)


_KINDS: dict[str, type[StereoNoise] | type[LidarNoise]] = {"stereo": StereoNoise, "lidar": LidarNoise}


def check(spec: CameraSpec) -> Iterator[tuple[str, str]]:
    """What is wrong in a simulated camera's record: (key in the camera's entry of the rig, sentence)."""
    problems = Problems()
    _read(spec, problems)
    for problem in problems.found:
        yield problem.key, problem.message


def noise_of(spec: CameraSpec) -> StereoNoise | LidarNoise | None:
    """The noise of this camera's depth; None where it has none. Raises ConfigError, which lists what is wrong."""
    problems = Problems()
    found = _read(spec, problems)
    if problems.found:
        raise ConfigError(problems.found)
    return found


def _read(spec: CameraSpec, problems: Problems) -> StereoNoise | LidarNoise | None:
    given = validate(_Options, spec.options, "", problems, "simulated").depth_noise
    if given is False or problems.found:
        return None
    key = "simulated.depth_noise"
    if spec.depth_sensor is None:
        problems.add("", key, f"model {spec.model!r} does not say how it measures depth, so nobody knows its noise")
        return None
    kind = _KINDS[spec.depth_sensor.kind]
    if given is not True and not isinstance(given, Mapping):
        keys = ", ".join(kind.model_fields)
        problems.add("", key, f"must be true, false or keys and values, not {describe(given)}; keys: {keys}")
        return None
    found = validate(kind, {} if given is True else given, "", problems, key)
    return None if problems.found else found
