"""The software device as librealsense has it, and how it is plugged into and removed from the library's contexts.

A software device that is added to a context is listed by the library, and announced to a callback that was set with
``set_devices_changed_callback``. It leaves the list when its last reference goes; but a pipeline keeps every device
that it ever saw until it is deleted, and nothing announces that a device left (measured with 2.59, and so in its
``src/context.cpp`` and ``src/device_hub.cpp``). So an emulated camera is attached to an :func:`emulated_context`: an
``rs.context`` that hides unplugged cameras from its lists and announces their removal.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import DriverMissing
from hal.geometry import Pose, quaternion_to_matrix

from .pictures import DEPTH_UNIT, EmulatedStream, PinholeLens, StreamMode

_KINDS = {"depth": ("depth", 0), "color": ("color", 0), "infrared": ("infrared", 1), "infrared_right": ("infrared", 2)}
_BYTES = {"z16": 2, "y8": 1, "rgb8": 3, "bgr8": 3, "yuyv": 2, "uyvy": 2, "rgba8": 4, "bgra8": 4}

# Ranges (lowest, highest, step, default), roughly those of a D435.
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


def load_realsense() -> Any:
    """Import and return ``pyrealsense2``. Raises DriverMissing if it is not installed."""
    try:
        import pyrealsense2
    except ImportError as error:
        raise DriverMissing(
            f"an emulated RealSense needs librealsense ({error}); install it with: pip install 'robot-hal[realsense]'",
            name="pyrealsense2",
        ) from error
    return pyrealsense2


class EmulatedDevice:
    """One plugging-in of an emulated camera: a stereo module with depth and two infrared streams, and a colour sensor.

    Options can be set and are remembered; none changes an image.
    """

    def __init__(
        self, streams: dict[str, EmulatedStream], *, title: str, serial: str, usb: str, port: str, global_time: bool
    ) -> None:
        """Create the device.

        Args:
            streams: Its streams, in every mode that they offer.
            title: Make and model.
            serial: Serial number.
            usb: USB version that is reported.
            port: Identifier of this plugging-in, different from those of the same camera before.
            global_time: Default of the option ``global_time_enabled``.
        """
        rs = self._rs = load_realsense()
        self.port = port
        self.native = rs.software_device()
        info = {
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
        for key, text in info.items():
            self._set_info(getattr(rs.camera_info, key), text)
        self._stereo = self.native.add_sensor("Stereo Module")
        self._color = self.native.add_sensor("RGB Camera")
        for sensor, options in ((self._stereo, _STEREO_OPTIONS), (self._color, _COLOR_OPTIONS)):
            for name, figures in options.items():
                sensor.add_option(getattr(rs.option, name), _range(rs, *figures), True)
            sensor.add_option(rs.option.global_time_enabled, _range(rs, 0, 1, 1, int(global_time)), True)
        self._stereo.add_read_only_option(rs.option.depth_units, DEPTH_UNIT)
        baseline = streams["infrared_right"].pose.distance(streams["infrared"].pose)[0]
        self._stereo.add_read_only_option(rs.option.stereo_baseline, 1e3 * baseline)
        self._profiles: dict[tuple[str, StreamMode], Any] = {}
        self._reference: tuple[Any, Pose] | None = None
        for number, stream in enumerate(streams.values()):
            self._add_stream(number, stream)
        self.native.create_matcher(rs.matchers.default)

    def _set_info(self, key: Any, text: str) -> None:
        if self.native.supports(key):
            self.native.update_info(key, text)
        else:
            self.native.register_info(key, text)

    def _add_stream(self, number: int, stream: EmulatedStream) -> None:
        rs, sensor = self._rs, self._sensor(stream.name)
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
                reference, pose = self._reference
                profile.register_extrinsics_to(reference, _extrinsics(rs, pose.inverse() @ stream.pose))

    def _sensor(self, stream: str) -> Any:
        return self._color if stream == "color" else self._stereo

    def streaming(self) -> dict[str, StreamMode]:
        """Return the streams that a client has opened, with their modes."""
        return dict(map(self.identify, [*self._stereo.get_active_streams(), *self._color.get_active_streams()]))

    def identify(self, profile: Any) -> tuple[str, StreamMode]:
        video = profile.as_video_stream_profile()
        kind = (profile.stream_type().name, profile.stream_index())
        name = next(name for name, known in _KINDS.items() if known == kind)
        return name, StreamMode(video.width(), video.height(), profile.fps(), profile.format().name)

    def uses_global_time(self, stream: str) -> bool:
        """Return whether the option ``global_time_enabled`` of a stream's sensor is on."""
        return bool(self._sensor(stream).get_option(self._rs.option.global_time_enabled))

    def set_metadata(self, stream: str, values: dict[str, int]) -> None:
        """Set the metadata of a stream's sensor, from its next frame on."""
        sensor = self._sensor(stream)
        for key, value in values.items():
            sensor.set_metadata(getattr(self._rs.frame_metadata_value, key), value)

    def push(self, stream: str, mode: StreamMode, image: NDArray[Any], number: int, stamp: float, domain: str) -> None:
        """Hand an image in its mode's format to the library, which copies it; without effect while nobody streams.

        ``stamp`` is in ms, on the clock ``domain``, a name of ``rs2_timestamp_domain``.
        """
        rs = self._rs
        frame = rs.software_video_frame()  # a new one each time: the library frees the last one's pixels
        frame.pixels = image
        frame.bpp = _BYTES[mode.format]
        frame.stride = mode.width * frame.bpp
        frame.timestamp, frame.domain = stamp, getattr(rs.timestamp_domain, domain)
        frame.frame_number = number
        frame.profile = self._profiles[stream, mode]
        if stream == "depth":
            frame.depth_units = DEPTH_UNIT
        self._sensor(stream).on_video_frame(frame)

    def clear_serial(self) -> None:
        """Remove the serial number: the library lists an unplugged camera while it is referenced, but it can then not
        be opened by its number.
        """
        self._set_info(self._rs.camera_info.serial_number, "")


def _range(rs: Any, low: float, high: float, step: float, default: float) -> Any:
    found = rs.option_range()
    found.min, found.max, found.step, found.default = low, high, step, default
    return found


def _intrinsics(rs: Any, lens: PinholeLens, mode: StreamMode) -> Any:
    found = rs.intrinsics()
    found.width, found.height = mode.width, mode.height
    found.fx, found.fy, found.ppx, found.ppy = lens
    found.model, found.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    return found


def _extrinsics(rs: Any, pose: Pose) -> Any:
    """Return the transform from points in the sensor's frame to points in the frame of its pose."""
    found = rs.extrinsics()
    found.rotation = [float(value) for value in np.ravel(quaternion_to_matrix(pose.orientation), order="F")]
    found.translation = [float(value) for value in pose.position]
    return found


# Contexts.


class DevicesRemoved:
    """The announcement that devices were removed, as the library's ``event_information``."""

    def __init__(self, ports: tuple[str, ...]) -> None:
        self._ports = ports

    def was_removed(self, device: Any) -> bool:
        return _read_port(device) in self._ports

    def was_added(self, device: Any) -> bool:
        return False

    def get_new_devices(self) -> list[Any]:
        return []


def emulated_context() -> Any:
    """Return a new ``rs.context`` from which emulated cameras can be unplugged. Raises DriverMissing."""
    rs = load_realsense()

    class EmulatedContext(rs.context):  # type: ignore[misc, name-defined]  # its base is known when the library is
        def __init__(self) -> None:
            super().__init__()
            self._callback: Callable[[Any], None] | None = None
            self._removed: set[str] = set()
            self._newest: Any = None
            reference = weakref.ref(self)  # the library must not keep this object alive

            def forward(change: Any) -> None:
                context = reference()
                if context is not None:
                    context.handle_change(change)

            super().set_devices_changed_callback(forward)

        def query_devices(self, *mask: int) -> list[Any]:
            return [device for device in super().query_devices(*mask) if _read_port(device) not in self._removed]

        @property
        def devices(self) -> list[Any]:
            return self.query_devices()

        def set_devices_changed_callback(self, callback: Callable[[Any], None]) -> None:
            self._callback = callback

        def handle_change(self, change: Any) -> None:
            self._newest = change.get_new_devices()
            if self._callback is not None:
                self._callback(change)

        def add_device(self, device: EmulatedDevice) -> Any:
            """Add a device; return the library's reference, which keeps it on the list."""
            device.native.add_to(self)
            reference, self._newest = self._newest, None
            return reference

        def remove_device(self, device: EmulatedDevice) -> None:
            self._removed.add(device.port)
            if self._callback is not None:
                self._callback(DevicesRemoved((device.port,)))

    return EmulatedContext()


class ContextEntry:
    def __init__(self, context: Any, device: EmulatedDevice) -> None:
        self._context = context
        self._device = device
        # The library crashes on a device that is listed and deleted, so it lives for as long as the context.
        self._life = weakref.finalize(context, _drop_reference, device.native)
        self._life.atexit = False
        self._keeper = context.add_device(device)  # its list drops a device without a reference

    def remove(self) -> None:
        """Unplug the device. Callbacks run in this thread."""
        self._keeper = None
        self._device.clear_serial()
        self._context.remove_device(self._device)

    def release_if_unused(self) -> bool:
        """Release a removed device that the library no longer lists; return whether it did."""
        listed = load_realsense().context.query_devices(self._context)
        if any(_read_port(device) == self._device.port for device in listed):
            return False
        self._life.detach()
        return True


def _drop_reference(device: Any) -> None:
    """Hold the last reference to a device until this call."""


def _read_port(device: Any) -> str:
    key = load_realsense().camera_info.physical_port
    try:
        return str(device.get_info(key)) if device.supports(key) else ""
    except RuntimeError:  # it is being removed
        return ""
