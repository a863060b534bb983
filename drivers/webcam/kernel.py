"""Video4Linux2 as the kernel has it: records and requests of ``linux/videodev2.h``, and the nodes in sysfs.

Plain system calls, because PyAV's own input of this kind reports neither the numbers of frames nor the camera's
controls, and prints the modes instead of returning them.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import re
from collections.abc import Iterator
from ctypes import c_char, c_int32, c_long, c_ubyte, c_uint32, c_ulong
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .settings import FORMATS

CLASS = Path("/sys/class/video4linux")
DEVICES = Path("/dev")

CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE, and V4L2_CAP_VIDEO_CAPTURE
MAPPED = 1  # V4L2_MEMORY_MMAP
DAMAGED = 0x40  # V4L2_BUF_FLAG_ERROR
CLOCK, MONOTONIC = 0xE000, 0x2000  # V4L2_BUF_FLAG_TIMESTAMP_MASK, _MONOTONIC
NEXT = 0x80000000  # V4L2_CTRL_FLAG_NEXT_CTRL
UNUSABLE = 0x1 | 0x4 | 0x40  # V4L2_CTRL_FLAG_DISABLED, _READ_ONLY, _WRITE_ONLY
NUMBERS = (1, 2, 3)  # V4L2_CTRL_TYPE_INTEGER, _BOOLEAN, _MENU
EXPOSURE_AUTO, EXPOSURE, FOCUS, FOCUS_AUTO = 0x9A0901, 0x9A0902, 0x9A090A, 0x9A090C
AUTOMATIC = {
    EXPOSURE: (EXPOSURE_AUTO, 1),
    FOCUS: (FOCUS_AUTO, 0),
    0x98091A: (0x98090C, 0),  # colour temperature of the white balance
    0x980913: (0x980912, 0),  # gain
}
"""Control -> the control that leaves it to the camera, with its value for "manual"."""


class Capability(ctypes.Structure):
    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    _fields_ = (
        *((name, c_uint32) for name in ("index", "type", "flags")),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class FrameSize(ctypes.Structure):
    _fields_ = (
        *((name, c_uint32) for name in ("index", "pixelformat", "type")),
        ("size", c_uint32 * 6),  # discrete: width, height; else least, greatest and step of both
        ("reserved", c_uint32 * 2),
    )


class FrameInterval(ctypes.Structure):
    _fields_ = (
        *((name, c_uint32) for name in ("index", "pixelformat", "width", "height", "type")),
        ("period", c_uint32 * 6),  # numerator, denominator, s; not discrete: least, greatest, step
        ("reserved", c_uint32 * 2),
    )


class PixelFormat(ctypes.Structure):
    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            *("width", "height", "pixelformat", "field", "bytesperline", "sizeimage", "colorspace"),
            *("priv", "flags", "encoding", "quantization", "transfer"),
        )
    )


class _FormatUnion(ctypes.Union):
    _fields_ = (("pixels", PixelFormat), ("size", c_ulong * (200 // ctypes.sizeof(c_ulong))))


class Format(ctypes.Structure):
    _anonymous_ = ("union",)
    _fields_ = (("type", c_uint32), ("union", _FormatUnion))


class StreamParameters(ctypes.Structure):
    _fields_ = (
        *((name, c_uint32) for name in ("type", "capability", "mode", "numerator", "denominator")),
        ("reserved", c_uint32 * 46),
    )


class BufferRequest(ctypes.Structure):
    _fields_ = tuple((name, c_uint32) for name in ("count", "type", "memory", "capabilities", "flags"))


class Buffer(ctypes.Structure):
    _fields_ = (
        *((name, c_uint32) for name in ("index", "type", "bytesused", "flags", "field")),
        ("seconds", c_long),
        ("microseconds", c_long),
        ("timecode", c_ubyte * 16),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("offset", c_ulong),  # a union, of which 32 bits are the offset
        *((name, c_uint32) for name in ("length", "reserved", "request")),
    )


class Control(ctypes.Structure):
    _fields_ = (("id", c_uint32), ("value", c_int32))


class ControlDescription(ctypes.Structure):
    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        *((name, c_int32) for name in ("minimum", "maximum", "step", "default")),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )

    @property
    def title(self) -> str:
        """Name as v4l2-ctl writes it: ``white_balance_temperature``."""
        return re.sub(r"[^a-z0-9]+", "_", self.name.decode(errors="replace").lower()).strip("_")


def _request(number: int, record: Any, direction: int = 3) -> int:
    return direction << 30 | ctypes.sizeof(record) << 16 | ord("V") << 8 | number


QUERY_CAPABILITY = _request(0, Capability, 2)
LIST_FORMATS = _request(2, FormatDescription)
SET_FORMAT = _request(5, Format)
REQUEST_BUFFERS = _request(8, BufferRequest)
QUERY_BUFFER = _request(9, Buffer)
QUEUE = _request(15, Buffer)
DEQUEUE = _request(17, Buffer)
START = _request(18, c_int32, 1)
SET_PARAMETERS = _request(22, StreamParameters)
GET_CONTROL = _request(27, Control)
SET_CONTROL = _request(28, Control)
QUERY_CONTROL = _request(36, ControlDescription)
LIST_SIZES = _request(74, FrameSize)
LIST_INTERVALS = _request(75, FrameInterval)


class VideoNode:
    """One open ``/dev/video*``; its methods are system calls, and raise OSError."""

    def __init__(self, path: str) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def call(self, request: int, record: Any) -> None:
        """Make a request; the kernel writes its answer into the record."""
        import fcntl  # only on Linux

        fcntl.ioctl(self._file, request, record)

    def map(self, offset: int, length: int) -> mmap.mmap:
        """Return the memory of a buffer."""
        return mmap.mmap(self._file, length, offset=offset)

    def wait(self, timeout: float) -> bool:
        """Return whether a frame, or an error, came within ``timeout`` s."""
        import select

        poll = select.poll()
        poll.register(self._file, select.POLLIN)
        return bool(poll.poll(1e3 * timeout))

    def close(self) -> None:
        os.close(self._file)


def answers(node: VideoNode, request: int, record: Any) -> bool:
    """Return whether the node answers a request that lists something, or that it need not have."""
    try:
        node.call(request, record)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY):
            return False
        raise
    return True


def is_capture(node: VideoNode) -> bool:
    """Return whether a node captures images in one plane; others are of metadata, or of a codec."""
    record = Capability()
    return answers(node, QUERY_CAPABILITY, record) and bool(record.device_caps & CAPTURE)


def fourcc(text: str) -> int:
    return int.from_bytes(text.encode(), "little")


def list_modes(node: VideoNode) -> list[str]:
    """Return the sizes of a camera and the rates of each, by format; those alike together. Others are left out."""
    names = {fourcc(code): name for name, (code, *_) in FORMATS.items()}
    known, modes = FormatDescription(type=CAPTURE), dict[str, list[str]]()
    while answers(node, LIST_FORMATS, known):
        if known.pixelformat in names:
            sizes = ", ".join(_list_sizes(node, known.pixelformat)) or "any size"
            modes.setdefault(sizes, []).append(names[known.pixelformat])
        known.index += 1
    return [f"{', '.join(formats)}: {sizes}" for sizes, formats in modes.items()]


def _list_sizes(node: VideoNode, pixelformat: int) -> Iterator[str]:
    record = FrameSize(pixelformat=pixelformat)
    while answers(node, LIST_SIZES, record):
        width, height, *more = record.size
        if record.type != 1:  # V4L2_FRMSIZE_TYPE_DISCRETE
            yield f"{width}x{more[1]} to {height}x{more[2]}"
            return
        yield f"{width}x{height}{_describe_rates(node, pixelformat, width, height)}"
        record.index += 1


def _describe_rates(node: VideoNode, pixelformat: int, width: int, height: int) -> str:
    record, rates = FrameInterval(pixelformat=pixelformat, width=width, height=height), []
    while answers(node, LIST_INTERVALS, record) and record.period[0]:
        rates.append(record.period[1] / record.period[0])
        if record.type != 1:
            break
        record.index += 1
    return f" at {'/'.join(f'{rate:g}' for rate in sorted(set(rates)))} Hz" if rates else ""


def list_controls(node: VideoNode) -> dict[int, ControlDescription]:
    """Return the controls of a camera that have a number as their value, by id."""
    found, record = {}, ControlDescription(id=NEXT)
    while answers(node, QUERY_CONTROL, record):
        if record.type in NUMBERS and not record.flags & UNUSABLE:
            found[record.id] = record
        record = ControlDescription(id=record.id | NEXT)
    return found


@dataclass(frozen=True)
class FoundCamera:
    """A node of Video4Linux2, as sysfs describes it."""

    path: str
    name: str
    serial: str | None
    port: str | None
    """Name of the USB device by its port (``1-2.4``); of another device, its own."""

    def __str__(self) -> str:
        serial = f'serial "{self.serial}"' if self.serial else "no serial"
        return f"{self.name}, {serial}, port {self.port}, {self.path}"


def find_cameras() -> list[FoundCamera]:
    """Return the nodes of all cameras, in the order of their numbers. Opens none."""
    folders = [folder for folder in CLASS.glob("video*") if folder.name[5:].isdecimal()]
    return [_describe(folder) for folder in sorted(folders, key=lambda folder: int(folder.name[5:]))]


def _describe(folder: Path) -> FoundCamera:
    device = (folder / "device").resolve()
    usb = next((place for place in (device, *device.parents) if (place / "busnum").is_file()), None)
    port = (usb or device).name
    serial = None if usb is None else _read(usb / "serial")
    return FoundCamera(str(DEVICES / folder.name), _read(folder / "name") or "camera", serial, port)


def _read(file: Path) -> str | None:
    try:
        return file.read_text(errors="replace").strip() or None
    except OSError:
        return None
