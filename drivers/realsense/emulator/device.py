"""The software device itself: one plugging-in of an emulated camera, as librealsense sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose, quaternion_to_matrix

from .figures import Lens, Mode, Stream
from .library import load_realsense
from .pictures import DEPTH_UNIT

__all__ = ["Device"]

_KINDS = {"depth": ("depth", 0), "color": ("color", 0), "infrared": ("infrared", 1), "infrared_right": ("infrared", 2)}
_BYTES = {"z16": 2, "y8": 1, "rgb8": 3, "bgr8": 3, "yuyv": 2, "uyvy": 2, "rgba8": 4, "bgra8": 4}

# Ranges (lowest, highest, step, default) as a D435 has them, about.
_STEREO_OPTIONS = {
    "exposure": (1, 165000, 1, 8500),
    "gain": (16, 248, 1, 16),
    "enable_auto_exposure": (0, 1, 1, 1),
    "visual_preset": (0, 5, 1, 0),
    "laser_power": (0, 360, 30, 150),
    "emitter_enabled": (0, 2, 1, 1),
}
_COLOR_OPTIONS = {
    "exposure": (1, 10000, 1, 156),
    "gain": (0, 128, 1, 64),
    "enable_auto_exposure": (0, 1, 1, 1),
    "white_balance": (2800, 6500, 10, 4600),
    "enable_auto_white_balance": (0, 1, 1, 1),
    "brightness": (-64, 64, 1, 0),
    "contrast": (0, 100, 1, 50),
    "saturation": (0, 100, 1, 64),
    "sharpness": (0, 100, 1, 50),
    "backlight_compensation": (0, 1, 1, 0),
    "power_line_frequency": (0, 2, 1, 1),
}


class Device:
    """A stereo module with depth and two infrared streams, and a colour sensor, in every mode that they offer.

    Options can be set and are remembered; none changes a picture.
    """

    def __init__(
        self, streams: dict[str, Stream], *, title: str, serial: str, usb: str, port: str, global_time: bool
    ) -> None:
        rs = self._rs = load_realsense()
        self.port = port
        """What tells this plugging-in from another one of the same camera."""
        self.native = rs.software_device()
        said = {
            "name": title,
            "serial_number": serial,
            "asic_serial_number": serial,
            "firmware_version": "5.16.0.1",
            "recommended_firmware_version": "5.16.0.1",
            "product_line": "D400",
            "product_id": "0B07",
            "usb_type_descriptor": usb,
            "physical_port": port,
        }
        for key, text in said.items():
            self._say(getattr(rs.camera_info, key), text)
        self._stereo = self.native.add_sensor("Stereo Module")
        self._color = self.native.add_sensor("RGB Camera")
        for sensor, options in ((self._stereo, _STEREO_OPTIONS), (self._color, _COLOR_OPTIONS)):
            for name, figures in options.items():
                sensor.add_option(getattr(rs.option, name), _range(rs, *figures), True)
            sensor.add_option(rs.option.global_time_enabled, _range(rs, 0, 1, 1, int(global_time)), True)
        self._stereo.add_read_only_option(rs.option.depth_units, DEPTH_UNIT)
        baseline = streams["infrared_right"].pose.distance(streams["infrared"].pose)[0]
        self._stereo.add_read_only_option(rs.option.stereo_baseline, 1e3 * baseline)
        self._profiles: dict[tuple[str, Mode], Any] = {}
        self._reference: tuple[Any, Pose] | None = None
        for number, stream in enumerate(streams.values()):
            self._offer(number, stream)
        self.native.create_matcher(rs.matchers.default)

    def _say(self, key: Any, text: str) -> None:
        if self.native.supports(key):
            self.native.update_info(key, text)
        else:
            self.native.register_info(key, text)

    def _offer(self, number: int, stream: Stream) -> None:
        rs, sensor = self._rs, self.sensor(stream.name)
        kind, index = _KINDS[stream.name]
        for mode in stream.modes():
            video = rs.video_stream()
            video.type, video.index, video.uid = getattr(rs.stream, kind), index, number
            video.width, video.height, video.fps = mode.width, mode.height, mode.rate
            video.bpp, video.fmt = _BYTES[mode.format], getattr(rs.format, mode.format)
            video.intrinsics = _intrinsics(rs, stream.lens_at(mode.width, mode.height), mode)
            profile = sensor.add_video_stream(video, mode == stream.mode).as_video_stream_profile()
            self._profiles[stream.name, mode] = profile
            if self._reference is None:
                self._reference = (profile, stream.pose)
            else:
                reference, place = self._reference
                profile.register_extrinsics_to(reference, _extrinsics(rs, place.inverse() @ stream.pose))

    def sensor(self, name: str) -> Any:
        """The sensor of a stream."""
        return self._color if name == "color" else self._stereo

    def streaming(self) -> dict[str, Mode]:
        """The streams that somebody has opened, and how."""
        return dict(map(self.identify, [*self._stereo.get_active_streams(), *self._color.get_active_streams()]))

    def identify(self, profile: Any) -> tuple[str, Mode]:
        """Which stream a profile of the library is, and in which mode."""
        video = profile.as_video_stream_profile()
        kind = (profile.stream_type().name, profile.stream_index())
        name = next(name for name, known in _KINDS.items() if known == kind)
        return name, Mode(video.width(), video.height(), profile.fps(), profile.format().name)

    def takes_global_time(self, name: str) -> bool:
        """Is the option ``global_time_enabled`` of that stream's sensor on?"""
        return bool(self.sensor(name).get_option(self._rs.option.global_time_enabled))

    def note(self, name: str, figures: dict[str, int]) -> None:
        """Metadata of the pictures of that stream's sensor, from the next one on."""
        sensor = self.sensor(name)
        for key, value in figures.items():
            sensor.set_metadata(getattr(self._rs.frame_metadata_value, key), value)

    def push(self, name: str, mode: Mode, picture: NDArray[Any], number: int, stamp: float, domain: str) -> None:
        """Hand a picture to the library, which copies it; ``stamp`` in ms. Nothing happens where nobody streams."""
        rs = self._rs
        frame = rs.software_video_frame()  # a new one each time: the library frees the last one's pixels
        frame.pixels = picture
        frame.bpp = _BYTES[mode.format]
        frame.stride = mode.width * frame.bpp
        frame.timestamp, frame.domain = stamp, getattr(rs.timestamp_domain, domain)
        frame.frame_number = number
        frame.profile = self._profiles[name, mode]
        if name == "depth":
            frame.depth_units = DEPTH_UNIT
        self.sensor(name).on_video_frame(frame)

    def forget_serial(self) -> None:
        """For as long as somebody holds on to an unplugged camera the library lists it: then at least without a name
        to open it by."""
        self._say(self._rs.camera_info.serial_number, "")


def _range(rs: Any, low: float, high: float, step: float, default: float) -> Any:
    found = rs.option_range()
    found.min, found.max, found.step, found.default = low, high, step, default
    return found


def _intrinsics(rs: Any, lens: Lens, mode: Mode) -> Any:
    found = rs.intrinsics()
    found.width, found.height = mode.width, mode.height
    found.fx, found.fy, found.ppx, found.ppy = lens
    found.model, found.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    return found


def _extrinsics(rs: Any, pose: Pose) -> Any:
    """From points in the sensor's frame to points in the frame that its pose is given in."""
    found = rs.extrinsics()
    found.rotation = [float(value) for value in np.ravel(quaternion_to_matrix(pose.orientation), order="F")]
    found.translation = [float(value) for value in pose.position]
    return found
