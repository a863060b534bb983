"""A camera on Video4Linux2: a webcam, a capture card, or any other device of USB's video class."""

from __future__ import annotations

import errno
import logging
import mmap
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from ctypes import c_int32
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConnectionLost, ControlTaken, DeviceNotFound, HalError, NotSupported
from hal.specs import CameraSpec

from . import kernel
from .kernel import Buffer, Control, FoundCamera, VideoNode
from .pictures import PictureDecoder, PictureOutput
from .settings import FORMATS, V4l2Settings

_LOG = logging.getLogger("hal.webcam")
_BUFFERS = 4
_FIRST = 5.0
"""Longest time until the first frame of a camera, s."""
_OLDEST, _AHEAD = 10.0, 1e-3
"""Greatest age of a frame that is read, and by how much its stamp may be ahead, s; others are of another clock."""
_GONE = (errno.ENODEV, errno.ENXIO, errno.ENOENT)
"""Errors of a device that was unplugged."""
_RIGHTS = "no permission to open it; sudo usermod -aG video $USER, then log out and in"


class V4l2Camera(CameraDriver):
    """A camera on Video4Linux2; the options are those of :class:`.settings.V4l2Settings`.

    A frame's time and number are those that the kernel gave it. Images without compression are preferred where the
    camera offers them in the size and at the rate of the rig file.
    """

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._settings = V4l2Settings.of(spec)
        self._output = PictureOutput(spec, self._settings.undistort)
        self._node: VideoNode | None = None
        self._info: CameraInfo | None = None
        self._maps: list[mmap.mmap] = []
        self._heard = self._patience = 0.0
        self._trouble = ""
        self._identity: tuple[str, str | None] | None = None
        """Name, and serial number or else port, of the camera that was opened first."""
        self._misdated = False
        """Whether stamps of another clock were reported."""

    @classmethod
    def list_plugged(cls) -> tuple[str, ...]:
        """Return the connected cameras, each with what selects it and its formats, sizes and rates."""
        return tuple(_list_captures(kernel.find_cameras(), _describe_modes).values())

    @property
    def info(self) -> CameraInfo:
        return self._info if self._info is not None else self._output.describe(super().info)

    def open(self) -> None:
        self.close()
        found = _choose(self._settings, self.spec.name)
        identity = found.name, found.serial or found.port
        if self._identity not in (None, identity):
            first = ", ".join(filter(None, self._identity))
            text = f"camera {self.spec.name} was {first}; now there is {found}: plug the first one in where it was"
            raise DeviceNotFound(text, code="other_device")
        try:
            self._node = VideoNode(found.path)
            decoder = _set_mode(self._node, self.spec)
            controls = _set_controls(self._node, self._settings)
            clock = self._start(self._node)
        except OSError as error:
            self.close()
            raise _explain(error, f"camera {self.spec.name} ({found})") from error
        except BaseException:
            self.close()
            raise
        self._decoder, self._trouble, self._identity = decoder, "", identity
        self._heard, self._patience = time.monotonic(), max(_FIRST, self._settings.stall_s)
        self._info = self._output.describe(
            self.nominal_info(found.name), serial=found.serial, clock=clock, options=MappingProxyType(controls)
        )

    def _start(self, node: VideoNode) -> str:
        """Start to stream; return the clock of the frames' stamps."""
        request = kernel.BufferRequest(count=_BUFFERS, type=kernel.CAPTURE, memory=kernel.MAPPED)
        node.call(kernel.REQUEST_BUFFERS, request)
        flags = 0
        for index in range(request.count):
            buffer = _make_buffer(index)
            node.call(kernel.QUERY_BUFFER, buffer)
            self._maps.append(node.map(buffer.offset, buffer.length))
            node.call(kernel.QUEUE, _make_buffer(index))
            flags = buffer.flags
        node.call(kernel.START, c_int32(kernel.CAPTURE))
        return "kernel" if flags & kernel.CLOCK == kernel.MONOTONIC else "system"

    def grab(self, timeout: float) -> RawFrame | None:
        node, deadline = self._node, time.monotonic() + timeout
        if node is None:
            raise ConnectionLost(f"camera {self.spec.name} is not open", code="not_open")
        while True:
            try:
                buffer = self._dequeue_newest(node, max(0.0, deadline - time.monotonic()))
            except OSError as error:
                raise _explain(error, f"camera {self.spec.name}") from error
            now = time.monotonic()
            if buffer is not None and (frame := self._make_frame(*buffer, now)) is not None:
                return frame
            if now - self._heard > self._patience:
                why = self._trouble or "it sends nothing; unplug it and plug it in again, or use another USB port"
                text = f"no frame of camera {self.spec.name} for {now - self._heard:.1f} s: {why}"
                raise ConnectionLost(text, code="stalled")
            if now >= deadline:
                return None

    def _dequeue_newest(self, node: VideoNode, timeout: float) -> tuple[Buffer, bytes] | None:
        """Return the newest frame, as the kernel has it; those before it are the gaps in their numbers."""
        newest: tuple[Buffer, bytes] | None = None
        for _ in self._maps:  # not for ever, if frames come faster than they are decoded
            if not node.wait(timeout if newest is None else 0.0):
                break
            buffer = _make_buffer()
            try:
                node.call(kernel.DEQUEUE, buffer)
            except BlockingIOError:
                break
            if newest is not None and self._decoder.sequential:
                self._decode(*newest)
            newest = buffer, self._maps[buffer.index][: buffer.bytesused]
            node.call(kernel.QUEUE, _make_buffer(buffer.index))
        return newest

    def _decode(self, buffer: Buffer, data: bytes) -> NDArray[np.uint8] | None:
        """Return the captured image of a buffer; None if it is damaged."""
        try:
            if buffer.flags & kernel.DAMAGED:
                raise ValueError("the kernel reports damaged frames: use another USB port or cable")
            return self._decoder.decode(data)
        except ValueError as error:
            if str(error) != self._trouble:
                _LOG.warning("camera %s: %s", self.spec.name, error)
            self._trouble = str(error)
            return None

    def _make_frame(self, buffer: Buffer, data: bytes, now: float) -> RawFrame | None:
        """Return the frame of a buffer; None if it is damaged, so that its number is missing."""
        image = self._decode(buffer, data)
        if image is None:
            return None
        self._heard, self._patience = now, self._settings.stall_s
        stamped = buffer.flags & kernel.CLOCK == kernel.MONOTONIC
        t = buffer.seconds + 1e-6 * buffer.microseconds if stamped else now
        if not now - _OLDEST < t <= now + _AHEAD:
            if not self._misdated:
                why = "its stamps are of another clock, so that frames have the time when they are read"
                how = "echo CLOCK_MONOTONIC | sudo tee /sys/module/uvcvideo/parameters/clock"
                _LOG.warning("camera %s: %s; %s", self.spec.name, why, how)
            self._misdated, t = True, now
        return RawFrame(t, t, buffer.sequence, color=self._output.finish(image))

    def close(self) -> None:
        node, self._node = self._node, None
        for memory in self._maps:
            memory.close()
        self._maps = []
        if node is not None:
            node.close()


def _make_buffer(index: int = 0) -> Buffer:
    return Buffer(index=index, type=kernel.CAPTURE, memory=kernel.MAPPED)


def _explain(error: OSError, what: str) -> HalError:
    if error.errno in _GONE:
        return ConnectionLost(f"{what} was unplugged", code="unplugged")
    if error.errno == errno.EBUSY:
        return ControlTaken(f"{what} is in use by another program: end it", code="device_busy")
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceNotFound(f"{what}: {_RIGHTS}", code="no_rights")
    if error.errno == errno.ENOSPC:
        return NotSupported(f"{what}: its USB bus has no room for this mode; use mjpeg, or a port of another bus")
    return ConnectionLost(f"{what}: {error.strerror}", code="device_error")


# Which camera


def _describe_modes(camera: FoundCamera, node: VideoNode) -> str:
    return "\n    ".join([str(camera), *kernel.list_modes(node)])


def _list_captures(
    cameras: list[FoundCamera], describe: Callable[[FoundCamera, VideoNode], str]
) -> dict[FoundCamera, str]:
    """Return those nodes that capture images, each with its description, or with the reason why it has none."""
    found = {}
    for camera in cameras:
        try:
            with closing(VideoNode(camera.path)) as node:
                if kernel.is_capture(node):
                    found[camera] = describe(camera, node)
        except OSError as error:
            if error.errno not in _GONE:
                found[camera] = str(_explain(error, str(camera)))
    return found


def _choose(settings: V4l2Settings, name: str) -> FoundCamera:
    """Return the camera that a rig's file selects. Raises DeviceNotFound, which lists all that are connected."""
    present = _list_captures(kernel.find_cameras(), lambda camera, node: str(camera))
    found = [
        camera
        for camera in present
        if (settings.name is None or settings.name.lower() in camera.name.lower())
        and settings.serial in (None, camera.serial)
        and settings.port in (None, camera.port)
        and (settings.device is None or Path(settings.device).resolve() == Path(camera.path).resolve())
    ]
    if len(found) == 1:
        return found[0]
    listed = "\n".join(f"  {text}" for text in present.values()) or "  none"
    keys = {"name": settings.name, "serial": settings.serial, "port": settings.port, "device": settings.device}
    wanted = ", ".join(f"{key} {value!r}" for key, value in keys.items() if value is not None) or "any"
    if not found:
        raise DeviceNotFound(
            f"camera {name}: no camera with {wanted} is connected: plug it in, or select one of these:\n{listed}"
        )
    raise DeviceNotFound(
        f"camera {name}: {len(found)} cameras match ({wanted}); select one by serial, or alike ones by port:\n{listed}",
        code="several_devices",
    )


# Mode and controls


def _set_mode(node: VideoNode, spec: CameraSpec) -> PictureDecoder:
    """Set format, size and rate; raises NotSupported, which lists what the camera offers."""
    width, height, rate = spec.capture_width, spec.capture_height, spec.rate_hz
    wanted = spec.sensors["color"].format if "color" in spec.sensors else None
    for name in (wanted,) if wanted is not None else FORMATS:
        pixels = kernel.PixelFormat(width=width, height=height, pixelformat=kernel.fourcc(FORMATS[name][0]), field=1)
        record = kernel.Format(type=kernel.CAPTURE, pixels=pixels)
        if not kernel.answers(node, kernel.SET_FORMAT, record):
            continue
        got = record.pixels
        if (got.width, got.height, got.pixelformat) != (width, height, pixels.pixelformat):
            continue
        pace = kernel.StreamParameters(type=kernel.CAPTURE, numerator=1000, denominator=round(1000 * rate))
        paced = kernel.answers(node, kernel.SET_PARAMETERS, pace) and pace.numerator
        if paced and abs(pace.denominator / pace.numerator / rate - 1.0) > 0.01:
            continue
        hd = got.encoding == 2 or (got.encoding == 0 and got.colorspace == 3)  # V4L2_YCBCR_ENC_709, or by default
        return PictureDecoder(name, width, height, "ITU709" if hd else "ITU601", full=got.quantization == 1)
    offered = "\n  ".join(kernel.list_modes(node)) or "no format that can be decoded"
    raise NotSupported(
        f"camera {spec.name} has no mode {width}x{height} at {rate:g} Hz"
        f"{f' in {wanted}' if wanted is not None else ''}; it offers:\n  {offered}",
        code="unknown_mode",
    )


def _set_controls(node: VideoNode, settings: V4l2Settings) -> Mapping[str, float]:
    """Set the controls of a rig's file, and switch off what would change them; return the values of all."""
    present = kernel.list_controls(node)
    ids = {control.title: id for id, control in present.items()}
    wanted = dict[int, float]()
    if settings.exposure_s is not None:
        wanted[kernel.EXPOSURE] = 1e4 * settings.exposure_s
    if settings.focus is not None:
        wanted[kernel.FOCUS] = settings.focus
    listed = ", ".join(f"{c.title} ({c.minimum} to {c.maximum})" for c in present.values())
    for title, value in settings.options.items():
        if title not in ids:
            raise NotSupported(f"this camera has no control {title!r}; it has: {listed}", code="unknown_option")
        wanted[ids[title]] = value
    for id, value in wanted.items():
        control = present.get(id)
        if control is None:
            what = "exposure" if id == kernel.EXPOSURE else "focus"
            raise NotSupported(f"the {what} of this camera cannot be set; it has: {listed}", code="unknown_option")
        if not control.minimum <= round(value) <= control.maximum:
            text = f"{control.title} must be {control.minimum} to {control.maximum}, not {value:g}"
            raise NotSupported(text, code="out_of_range")
        automatic, manual = kernel.AUTOMATIC.get(id, (None, 0))
        if automatic in present:
            node.call(kernel.SET_CONTROL, Control(id=automatic, value=manual))
        node.call(kernel.SET_CONTROL, Control(id=id, value=round(value)))
    return {control.title: now for id, control in present.items() if (now := _get(node, id)) is not None}


def _get(node: VideoNode, id: int) -> float | None:
    record = Control(id=id)
    try:
        node.call(kernel.GET_CONTROL, record)
    except OSError:
        return None
    return float(record.value)
