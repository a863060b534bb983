"""From the bytes of a camera to the images of a frame: decoded, undistorted, cropped and scaled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from hal.arguments import freeze
from hal.driver import CameraInfo
from hal.errors import DriverMissing
from hal.images import Cropping
from hal.specs import CameraSpec

from .settings import FORMATS


class PictureDecoder:
    """Decodes the frames of one of :data:`.settings.FORMATS`.

    ``matrix`` (``ITU601`` or ``ITU709``) is how colours are encoded in formats that do not say it themselves, ``full``
    whether their values use the full range of 0..255.
    """

    def __init__(self, name: str, width: int, height: int, matrix: str = "ITU601", full: bool = False) -> None:
        _, codec, pixels = FORMATS[name]
        create: Any = av.CodecContext.create
        self._codec = create(codec, "r")
        self.sequential = name == "h264"
        """Whether a frame is only decoded after those before it."""
        self._size, self._bytes, self._how = (width, height), 0, {}
        if pixels:
            self._codec.width, self._codec.height, self._codec.pix_fmt = width, height, pixels
            self._bytes = {"nv12": 12, "rgb24": 24, "bgr24": 24}.get(pixels, 16) * width * height // 8
            if pixels not in ("rgb24", "bgr24"):
                self._how = {"src_colorspace": matrix, "src_color_range": "JPEG" if full else "MPEG"}
        elif name == "mjpeg":
            self._codec.options = {"err_detect": "explode"}  # else it guesses what a damaged picture lacks
        elif self.sequential:
            self._codec.thread_count = 1  # several threads would delay each frame
            self._codec.flags |= av.codec.context.Flags.low_delay

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """Return the image (H, W, 3), RGB. Raises ValueError for a frame that is damaged or of another size."""
        if self._bytes and len(data) != self._bytes:
            raise ValueError(f"a frame has {len(data)} bytes, not {self._bytes}")
        if self._codec.name == "mjpeg" and b"\xff\xd9" not in data:  # its end, which ffmpeg does without
            raise ValueError("a frame is cut off")
        try:
            frames = self._codec.decode(av.Packet(data))
        except av.FFmpegError as error:
            raise ValueError(f"a frame cannot be decoded: {error}") from None
        if not frames or (frames[-1].width, frames[-1].height) != self._size:
            raise ValueError("a frame has no image of its size")
        return to_rgb(frames[-1], **self._how)


def to_rgb(frame: Any, **how: str) -> NDArray[np.uint8]:
    """Return a decoded frame as an image (H, W, 3), RGB; ``how`` are arguments of PyAV's ``reformat``."""
    image: NDArray[np.uint8] = frame.reformat(format="rgb24", **how).to_ndarray()
    return image


class PictureOutput:
    """Makes the images of a camera's frames from those that it captures. Raises DriverMissing without OpenCV."""

    def __init__(self, spec: CameraSpec, undistort: bool) -> None:
        width, height = spec.capture_width, spec.capture_height
        self._cropping, self._maps = Cropping(width, height, spec.width, spec.height), None
        self._distortion = (0.0,) * 5 if undistort else spec.distortion
        if undistort:
            try:
                import cv2
            except ImportError as error:
                text = f"images are undistorted with OpenCV: {error}; pip install 'robot-hal[calibration]'"
                raise DriverMissing(text, name="cv2") from error
            K = np.array(spec.sensors["color"].K if "color" in spec.sensors else spec.K)
            self._cv2: Any = cv2
            self._maps = cv2.initUndistortRectifyMap(
                K, np.array(spec.distortion), np.eye(3), K, (width, height), cv2.CV_16SC2
            )

    def finish(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image of a frame, a new array (H, W, 3), for a captured one."""
        if self._maps is not None:
            image = self._cv2.remap(image, *self._maps, self._cv2.INTER_LINEAR)
        return self._cropping.color(image)

    def describe(self, info: CameraInfo, **known: Any) -> CameraInfo:
        """Return a camera's description with the distortion of its images and what is ``known`` besides."""
        return replace(info, distortion=freeze(self._distortion), **known)
