"""From a set of the library's frames to the app's pictures: aligned, cropped, scaled, RGB and metres.

Copies, for each stream: alignment makes a picture of its own (in the library, of depth or of colour), and what comes
out is written once, into the memory that it travels in. A crop that scales makes one more, of the smaller picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray

from hal.images import Cropping
from hal.specs import CameraSpec

from .ring import Images

__all__ = ["Darkroom"]

_DECODERS = {"yuyv": rs.yuy_decoder, "uyvy": lambda: rs.uyvy_converter(rs.format.rgb8)}
_TURNED = ("bgr8", "bgra8")


class Darkroom:
    """Develops the sets of one session. ``profiles``: the streams that are on, by the names of the rig's file."""

    def __init__(self, spec: CameraSpec, profiles: Mapping[str, Any]) -> None:
        self._profiles = profiles
        self._near, self._far = spec.depth_min, spec.depth_max
        self._format = profiles["color"].format().name if "color" in profiles else ""
        self._decoder = _DECODERS[self._format]() if self._format in _DECODERS else None
        self._align = None
        if "color" in profiles and "depth" in profiles:
            self._align = rs.align(rs.stream.depth if spec.align == "depth" else rs.stream.color)
        self._to_depth = spec.align == "depth"
        self._metres: NDArray[np.float32] | None = None
        self._unit = 0.0
        self.cropping = {
            name: Cropping(target.width(), target.height(), spec.width, spec.height)
            for name in profiles
            for target in (profiles[self.view_of(name)],)
        }

    def view_of(self, stream: str) -> str:
        """The stream whose view the pictures of ``stream`` are handed out in."""
        if self._align is None or stream not in ("color", "depth"):
            return stream
        return "depth" if self._to_depth else "color"

    def frames_of(self, frames: Any) -> dict[str, Any] | None:
        """The frame of each stream, as the camera sent it; None where one is missing."""
        found: dict[str, Any] = {}
        for name, profile in self._profiles.items():
            if name == "color":
                frame = frames.get_color_frame()
            elif name == "depth":
                frame = frames.get_depth_frame()
            else:
                frame = frames.get_infrared_frame(profile.stream_index())
            if not frame:
                return None
            found[name] = frame
        return found

    def develop(self, frames: Any, single: Mapping[str, Any], into: Images) -> None:
        """Write the pictures of a set; ``single`` are its frames as :meth:`frames_of` gave them."""
        found = dict(single)
        if self._decoder is not None and self._to_depth:
            frames = self._decoder.process(frames).as_frameset()  # colour is aligned as RGB or not at all
        if self._align is not None:
            aligned = self._align.process(frames)
            moved = "color" if self._to_depth else "depth"
            found[moved] = aligned.get_color_frame() if self._to_depth else aligned.get_depth_frame()
        for name, image in into.items():
            if name == "depth":
                self._put_depth(found[name], image)
            elif name == "color":
                self._put_color(found[name], image)
            else:
                self._put(name, np.asanyarray(found[name].get_data()), image)

    def _put_depth(self, frame: Any, into: NDArray[np.float32]) -> None:
        """Metres, and 0 outside the range: both by one table, 0.2 ms for 640x480."""
        raw = np.asanyarray(frame.get_data())
        crop = self.cropping["depth"]
        table = self._table(frame.get_units())
        np.take(table, raw if crop.is_identity else crop.depth(raw), out=into, mode="clip")  # clip: without a buffer

    def _table(self, unit: float) -> NDArray[np.float32]:
        """Metres for each raw value."""
        if self._metres is None or unit != self._unit:
            metres = np.arange(1 << 16) * unit
            metres[(metres < self._near) | (metres > self._far)] = 0.0
            self._metres, self._unit = metres.astype(np.float32), unit
        return self._metres

    def _put_color(self, frame: Any, into: NDArray[np.uint8]) -> None:
        if self._decoder is not None and not self._to_depth:
            frame = self._decoder.process(frame)
        image = np.asanyarray(frame.get_data())
        if image.shape[2] == 4:
            image = image[..., :3]
        crop = self.cropping["color"]
        if not crop.is_identity:
            image = crop.color(np.ascontiguousarray(image))
        if self._format in _TURNED:
            for k in range(3):  # one channel at a time: a third of the time that a view with a negative step takes
                into[..., k] = image[..., 2 - k]
        else:
            np.copyto(into, image)

    def _put(self, name: str, image: NDArray[np.uint8], into: NDArray[np.uint8]) -> None:
        crop = self.cropping[name]
        np.copyto(into, image if crop.is_identity else crop.color(image))
