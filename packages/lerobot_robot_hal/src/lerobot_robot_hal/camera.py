"""A camera of LeRobot as a camera of a rig (``driver: lerobot``). What it does not tell, its stamps, stays unknown."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

from pydantic import Field

from hal.config.files import DeviceSettings
from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConnectionLost
from hal.images import Cropping
from hal.specs import CameraSpec

from .follower import find_config

__all__ = ["LeRobotCamera"]

_STALLED = 2.0
"""Time without a picture after which it is opened again, s."""


class CameraSettings(DeviceSettings):
    """Settings under ``real:`` of a camera."""

    type: str
    """Of the camera, as ``type`` in ``--robot.cameras``."""
    config: dict[str, Any] = Field(default_factory=dict)
    """The other keys there; width, height and rate are those of ``capture``."""


def check_camera(spec: CameraSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a camera's record: key in its entry of the rig file, message and code."""
    yield from CameraSettings.check(spec)[1]
    if set(spec.streams) != {"color"}:
        yield "streams", f"this camera has only color, not {', '.join(spec.streams)}", "unknown_stream"


class LeRobotCamera(CameraDriver):
    """A camera of LeRobot (settings: :class:`CameraSettings`); a frame's time is that of its arrival."""

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self.settings = CameraSettings.of(spec)
        self._cropping = Cropping(spec.capture_width, spec.capture_height, spec.width, spec.height)
        self._camera: Any = None
        self._seq, self._t = 0, 0.0

    @property
    def info(self) -> CameraInfo:
        """Figures of the model, and whose camera it is."""
        return replace(self.nominal_info(f"LeRobot's {self.settings.type}"), clock="system")

    def open(self) -> None:
        """Connect. Raises ConnectionLost."""
        from lerobot import cameras
        from lerobot.cameras.utils import make_cameras_from_configs

        self.close()
        spec, s = self.spec, self.settings
        size = {"width": spec.capture_width, "height": spec.capture_height, "fps": round(spec.rate_hz)}
        try:
            config = find_config("camera", cameras, cameras.CameraConfig, s.type)(**{**size, **s.config})
            self._camera = make_cameras_from_configs({spec.name: config})[spec.name]
            self._camera.connect(warmup=False)
        except Exception as error:
            self.close()
            raise ConnectionLost(f"camera {spec.name}: {s.type}: {error}", code="device_error") from error
        self._t = time.monotonic()

    def grab(self, timeout: float) -> RawFrame | None:
        """Return the newest picture that was not returned yet; None if none came in time. Raises ConnectionLost."""
        camera, spec = self._camera, self.spec
        if camera is None:
            raise ConnectionLost(f"camera {spec.name} is not open", code="not_open")
        try:
            image = camera.async_read(timeout_ms=1e3 * timeout)
        except TimeoutError:
            if time.monotonic() - self._t > _STALLED:
                raise ConnectionLost(f"camera {spec.name} sent nothing for {_STALLED:g} s", code="stalled") from None
            return None
        except Exception as error:
            raise ConnectionLost(f"camera {spec.name}: {error}", code="device_error") from error
        if image.shape != (spec.capture_height, spec.capture_width, 3):
            raise ConnectionLost(f"camera {spec.name}: its pictures are {image.shape} now", code="device_error")
        self._t, self._seq = time.monotonic(), self._seq + 1
        return RawFrame(self._t, self._t, self._seq, color=self._cropping.color(image))

    def close(self) -> None:
        """Disconnect. Idempotent."""
        camera, self._camera = self._camera, None
        if camera is not None and camera.is_connected:
            with suppress(Exception):
                camera.disconnect()
