"""What a rig file may set under ``real:`` of these cameras, and its check, which needs neither PyAV nor Linux."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from hal.config.files import DeviceSettings
from hal.config.schema import Flag, Quantity, Seconds, ValueProblem
from hal.specs import CameraSpec

FORMATS = {
    "yuyv": ("YUYV", "rawvideo", "yuyv422"),
    "uyvy": ("UYVY", "rawvideo", "uyvy422"),
    "nv12": ("NV12", "rawvideo", "nv12"),
    "rgb8": ("RGB3", "rawvideo", "rgb24"),
    "bgr8": ("BGR3", "rawvideo", "bgr24"),
    "mjpeg": ("MJPG", "mjpeg", ""),
    "h264": ("H264", "h264", ""),
}
"""Format in a rig file -> the kernel's four characters, ffmpeg's decoder, and its pixel format; in the order in which
they are tried: without loss first."""


class _PictureSettings(DeviceSettings):
    undistort: Flag = False
    """Whether the lens distortion of the rig's ``intrinsics`` is removed from the images."""
    stall_s: Seconds = 2.0
    """Time without a new frame after which the camera counts as lost."""


class V4l2Settings(_PictureSettings):
    """``real:`` of a camera on Video4Linux2. Without a name, serial, port or device, it is the only one."""

    name: str | None = None
    """A part of its name, for example ``C920``."""
    serial: str | None = None
    """Serial number of the USB device."""
    port: str | None = None
    """USB port, as ``hal check --cameras`` prints it: it tells two alike cameras without a serial number apart."""
    device: str | None = None
    """Path, for example ``/dev/v4l/by-id/...`` or ``/dev/video0``."""
    exposure_s: Annotated[float | None, Quantity("s", 1e-4, 10.0)] = None
    """Fixed exposure time, in steps of 0.1 ms; None leaves it to the camera."""
    focus: float | None = None
    """Fixed focus, in the camera's own unit; None leaves it to the camera."""
    options: dict[str, float] = Field(default_factory=dict)
    """Other controls of the camera, by the names that an error about an unknown one lists."""


class VideoSettings(_PictureSettings):
    """``real:`` of a video."""

    file: str | None = None
    """A video file, played at its own pace."""
    url: str | None = None
    """A stream: ``rtsp://``, ``http://`` or another one that ffmpeg reads."""
    repeat: Flag = True
    """Whether a file starts again at its end."""
    transport: str = "tcp"
    """How RTSP is transported, ``tcp`` or ``udp``."""

    @model_validator(mode="after")
    def _check_source(self) -> VideoSettings:
        if (self.file is None) == (self.url is None):
            raise ValueProblem("needs one source: file or url", "missing_key")
        if self.transport not in ("tcp", "udp"):
            raise ValueProblem(f"transport must be tcp or udp, not {self.transport!r}", "invalid_choice")
        return self


def check_v4l2(spec: CameraSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the mistakes in a camera's record: key, message and code."""
    settings, found = V4l2Settings.check(spec)
    yield from found
    yield from _check_color(spec, settings)
    wanted = spec.sensors["color"].format if "color" in spec.sensors else None
    if wanted is not None and wanted not in FORMATS:
        yield "streams.color.format", f"{wanted!r} is none of {', '.join(FORMATS)}", "unknown_format"


def check_video(spec: CameraSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the mistakes in the record of a video: key, message and code."""
    settings, found = VideoSettings.check(spec)
    yield from found
    yield from _check_color(spec, settings)
    if settings is not None and settings.file is not None and not Path(settings.file).is_file():
        yield "real.file", f"there is no video {settings.file}", "missing_file"


def _check_color(spec: CameraSpec, settings: Any) -> Iterator[tuple[str, str, str]]:
    if set(spec.streams) != {"color"}:
        yield "streams", f"this camera has only color, not {', '.join(spec.streams)}", "unknown_stream"
    if settings is not None and settings.undistort and not any(spec.distortion):
        text = "needs the distortion in the camera's intrinsics: leave it out, and run hal calibrate intrinsics first"
        yield "real.undistort", text, "missing_key"
