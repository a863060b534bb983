"""Pictures of a camera over a connection of their own, so that a large one delays no command and no sign of life.

Newest only: a frame is encoded when the connection has taken the one before. Images travel as they are. Once the link
has turned out to be too slow for that, colour travels as JPEG and all else compressed without loss.
"""

from __future__ import annotations

import json
import math
import struct
import threading
import zlib
from collections.abc import Callable
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..arguments import freeze
from ..driver import CameraInfo, RawFrame, StreamInfo
from ..errors import ConnectionLost
from ..geometry import Pose
from ..specs import CameraSpec, to_json
from ..types import STREAMS, Frame
from .boxes import Box
from .link import RigLink

if TYPE_CHECKING:
    from ..camera import Camera

LARGEST = 64 << 20
"""Size of the largest frame, bytes: 4K with colour and depth."""
_PERIOD = 0.002
"""Longest time from a new picture to its frame, s."""
_SHARE, _TIMES = 0.25, 3
"""Images are compressed once they took more than this share of their period to be sent, so many times in a row."""
_QUALITY = 90
_HEAD = struct.Struct("<dI")
"""Time of the capture, and length of what describes the images."""


class SentFrames(Box):
    """The newest frame of a camera, to be sent."""

    def __init__(self, camera: Camera, link: RigLink) -> None:
        super().__init__()
        self._camera, self._link = camera, link
        self._frame: Frame | None = None
        self._sent: Frame | None = None
        self._late = 0
        self.stop: Callable[[], None] = camera.on_frame(self._note)
        """Ends it."""

    def _note(self, frame: Frame) -> None:
        self._frame = frame

    def number(self) -> int:
        """Return a number that grows with each frame."""
        return 0 if self._frame is None else self._frame.stamp.seq + 1

    def read(self) -> bytes:
        """Return the newest frame as bytes; empty if it was returned before."""
        frame = self._frame
        if frame is None or frame is self._sent:
            return b""
        self._sent = frame
        if self._late < _TIMES:
            self._late = self._late + 1 if self._link.took > _SHARE / self._camera.spec.rate_hz else 0
        return encode_frame(frame, self._camera.spec, compress=self._late >= _TIMES)


class ReceivedFrames(Box):
    """The newest frame that has come; :attr:`frame` is None once it was taken out."""

    def __init__(self, spec: CameraSpec) -> None:
        super().__init__()
        self._spec = spec
        self.frame: RawFrame | None = None

    def take(self, number: int, record: bytes, shift: float, now: float) -> None:
        """Keep a frame that has come, as :meth:`.Box.take` does."""
        if number != self._taken and record:
            self._taken = number
            try:
                self.frame = decode_frame(record, self._spec, shift, now)
            except (KeyError, TypeError, zlib.error) as error:
                raise ValueError(f"no frame of camera {self._spec.name}: {error!r}") from error


def send_frames(camera: Camera, link: RigLink, over: threading.Event) -> None:
    """Send what a camera is, then its frames, until the client leaves, the camera is lost or the server ends.

    Raises:
        ConnectionLost: The client is gone, or the camera is lost.
    """
    lost: list[ConnectionLost | None] = []
    detach = camera.on_connection(lost.append)
    frames = SentFrames(camera, link)
    try:
        camera.check()
        link.post({"info": pack_info(camera.info), "camera": describe_camera(camera.spec)})
        link.outgoing = [frames]
        while not over.is_set():
            link.wait(_PERIOD)
            link.receive()
            link.send()
            if lost and lost[0] is not None:
                raise lost[0]
    finally:
        frames.stop()
        detach()


# Frames as bytes.


def encode_frame(frame: Frame, spec: CameraSpec, compress: bool) -> bytes:
    """Return a frame as bytes.

    Args:
        frame: The frame.
        spec: Record of its camera.
        compress: Whether the images are made small.
    """
    kinds, parts = {}, []
    for stream in spec.streams:
        image = getattr(frame, stream)
        if image is not None:
            kind, data = _encode_image(stream, image, spec, compress)
            kinds[stream] = [kind, len(data)]
            parts.append(data)
    pose, stamp = frame.T_world_camera, frame.stamp
    where = None if pose is None else [pose.position.tolist(), pose.orientation.tolist()]
    head = json.dumps([stamp.t_device, stamp.seq, frame.skew, where, kinds]).encode()
    return b"".join((_HEAD.pack(stamp.t, len(head)), head, *parts))


def decode_frame(data: bytes, spec: CameraSpec, shift: float, now: float) -> RawFrame:
    """Return the frame that :func:`encode_frame` encoded, with its time ``shift`` s later and not after ``now``.

    Raises:
        ValueError: It is none.
    """
    t, length = _HEAD.unpack_from(data)
    place = _HEAD.size + length
    t_device, seq, skew, where, kinds = json.loads(data[_HEAD.size : place])
    images = {}
    for stream, (kind, size) in kinds.items():
        images[stream] = _decode_image(stream, kind, data[place : place + size], spec)
        place += size
    pose = None if where is None else Pose(*where)
    return RawFrame(min(t + shift, now), t_device, seq, T_world_camera=pose, skew=skew, **images)


def _encode_image(stream: str, image: NDArray[Any], spec: CameraSpec, compress: bool) -> tuple[str, bytes]:
    """Return how an image is encoded, ``jpeg`` or the type of the numbers with a ``z`` if they are packed, and it."""
    if stream == "color" and compress:
        import simplejpeg

        return "jpeg", simplejpeg.encode_jpeg(np.ascontiguousarray(image), _QUALITY, colorspace="RGB")
    kind = np.dtype(STREAMS[stream].dtype).str
    if stream == "depth":
        units = np.rint(image / np.float32(_unit(spec))).astype(np.uint16)
        if np.array_equal(_to_metres(units, spec), image):  # as most cameras measure it, in half of the bytes
            kind, image = units.dtype.str, units
    data = image.tobytes()
    return (f"z{kind}", zlib.compress(data, 1)) if compress else (kind, data)


def _decode_image(stream: str, kind: str, data: bytes, spec: CameraSpec) -> NDArray[Any]:
    shape = (spec.height, spec.width, *STREAMS[stream].shape)
    if kind == "jpeg":
        import simplejpeg

        return np.reshape(simplejpeg.decode_jpeg(data, colorspace="RGB"), shape)
    if kind.startswith("z"):
        kind = kind[1:]
        data = zlib.decompressobj().decompress(data, np.dtype(kind).itemsize * math.prod(shape))
    image: NDArray[Any] = np.frombuffer(data, kind).reshape(shape)
    return _to_metres(image, spec) if image.dtype == np.uint16 else image


def _unit(spec: CameraSpec) -> float:
    return spec.depth_sensor.unit if spec.depth_sensor is not None else 0.001


def _to_metres(units: NDArray[np.uint16], spec: CameraSpec) -> NDArray[np.float32]:
    metres: NDArray[np.float32] = units.astype(np.float32) * np.float32(_unit(spec))
    return metres


# What a camera is, as JSON.


def describe_camera(spec: CameraSpec) -> dict[str, Any]:
    """Return the record of a camera without the options of its driver."""
    described: dict[str, Any] = to_json(replace(spec, options={}))
    return described


def check_camera(spec: CameraSpec, there: dict[str, Any]) -> None:
    """Raise ConnectionLost if a computer now serves, under its name, another camera than a rig was opened with."""
    here = json.loads(json.dumps(describe_camera(spec)))
    own = ("driver", "at", "view")  # of the rig that was opened; frames have their pose
    changed = [key for key in here if key not in own and here[key] != there[key]]
    if changed:
        text = f"{spec.at} serves another camera {spec.name!r} now ({', '.join(changed)} changed): open the rig again"
        raise ConnectionLost(text, code="other_camera")


def pack_info(info: CameraInfo) -> dict[str, Any]:
    """Return the figures of a camera as plain data, from which :func:`unpack_info` makes them again."""
    packed = {name: getattr(info, name) for name in CameraInfo.__slots__}
    packed["streams"] = {name: _pack_stream(stream) for name, stream in info.streams.items()}
    packed["options"] = dict(info.options)
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in packed.items()}


def _pack_stream(stream: StreamInfo) -> list[Any]:
    pose = stream.T_color_stream
    numbers = [
        stream.format,
        stream.width,
        stream.height,
        stream.rate_hz,
        stream.K.tolist(),
        stream.distortion.tolist(),
    ]
    return [*numbers, [pose.position.tolist(), pose.orientation.tolist()]]


def unpack_info(data: dict[str, Any]) -> CameraInfo:
    """Return the figures that :func:`pack_info` packed."""
    streams = {
        name: StreamInfo(kind, width, height, rate_hz, freeze(K), freeze(distortion), Pose(*pose))
        for name, (kind, width, height, rate_hz, K, distortion, pose) in data["streams"].items()
    }
    arrays = {name: freeze(data[name]) for name in ("K", "distortion", "K_infrared") if data[name] is not None}
    whole = {"streams": MappingProxyType(streams), "options": MappingProxyType(data["options"])}
    return CameraInfo(**{**data, **arrays, **whole})
