"""What an emulated camera is made of: its streams, their modes, lenses and places, by the figures of its spec."""

from __future__ import annotations

import zlib
from typing import NamedTuple

from hal.geometry import Pose
from hal.specs import CameraSpec

__all__ = ["COLOR_FORMATS", "SIZES", "Lens", "Mode", "Stream", "serial_of", "streams_of", "title_of"]

SIZES = ((1280, 720), (848, 480), (640, 480), (640, 360), (424, 240))
"""What every stream offers beside the mode that the spec asks for."""
RATES = (6, 15, 30, 60)
COLOR_FORMATS = ("rgb8", "bgr8", "yuyv", "uyvy", "rgba8", "bgra8")

# Of a D435, about: the infrared pair 50 mm apart, colour 15 mm to the left of it as the camera sees.
_PLACES = {"color": 0.0, "depth": 0.015, "infrared": 0.015, "infrared_right": 0.065}  # m along x of colour


class Lens(NamedTuple):
    """A pinhole without distortion, pixels; the centre of the upper left pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float


class Mode(NamedTuple):
    """One way in which a stream can be had."""

    width: int
    height: int
    rate: int
    """Hz"""
    format: str


class Stream(NamedTuple):
    """One stream of the camera, whether or not the spec wants it."""

    name: str
    mode: Mode
    """What the spec asks for, or would."""
    lens: Lens
    """In that mode."""
    pose: Pose
    """Of its sensor's optical frame in that of the colour sensor."""

    def modes(self) -> tuple[Mode, ...]:
        """All that it offers, the one asked for first."""
        own = self.mode
        formats = COLOR_FORMATS if self.name == "color" else (own.format,)
        sizes = [(own.width, own.height), *(size for size in SIZES if size != (own.width, own.height))]
        rates = [own.rate, *(rate for rate in RATES if rate != own.rate)]
        found = (Mode(*size, rate, format) for size in sizes for rate in rates for format in formats)
        return tuple(sorted(found, key=lambda mode: mode != own))

    def lens_at(self, width: int, height: int) -> Lens:
        """The lens in a mode of another size: the sensor's middle, as large as it fits, scaled."""
        own = self.mode
        if (width, height) == (own.width, own.height):
            return self.lens
        scale = _scale(width, height) / _scale(own.width, own.height)
        cx = (self.lens.cx - (own.width - 1) / 2.0) * scale + (width - 1) / 2.0
        cy = (self.lens.cy - (own.height - 1) / 2.0) * scale + (height - 1) / 2.0
        return Lens(self.lens.fx * scale, self.lens.fy * scale, cx, cy)


def serial_of(spec: CameraSpec) -> str:
    """The serial number of a camera that was given none: twelve digits, always the same for a name."""
    return f"9{zlib.crc32(spec.name.encode()) % 10**11:011d}"


def title_of(spec: CameraSpec) -> str:
    """What it calls itself: by the model's name in the rig, where that is one of Intel's."""
    maker, _, model = spec.model.partition("_")
    return f"Intel RealSense {model.upper() if maker == 'realsense' and model else 'D435'} (emulated)"


def streams_of(spec: CameraSpec) -> dict[str, Stream]:
    """Depth, colour and both infrared streams. What the spec says of them holds; the rest is that of a D435, about."""
    found = {}
    for name, x in _PLACES.items():
        default = "rgb8" if name == "color" else "z16" if name == "depth" else "y8"
        sensor = spec.sensors.get(name)
        if sensor is None:
            width, height = spec.capture_width, spec.capture_height
            mode = Mode(width, height, round(spec.rate_hz), default)
            found[name] = Stream(name, mode, _nominal_lens(name, width, height), Pose((x, 0.0, 0.0)))
        else:
            (fx, _, cx), (_, fy, cy), _ = sensor.K
            mode = Mode(sensor.width, sensor.height, round(sensor.rate_hz), sensor.format or default)
            found[name] = Stream(name, mode, Lens(fx, fy, cx, cy), Pose(sensor.position, sensor.orientation))
    return found


def _nominal_lens(name: str, width: int, height: int) -> Lens:
    f = 1.275 * height if name == "color" else 640.0 * _scale(width, height)
    return Lens(f, f, (width - 1) / 2.0, (height - 1) / 2.0)


def _scale(width: int, height: int) -> float:
    """Pixels of a mode for each of the imager's 1280x800."""
    return max(width / 1280.0, height / 800.0)
