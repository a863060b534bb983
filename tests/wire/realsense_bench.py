"""RealSense cameras without hardware, for tests: emulated ones, and recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

from hal.camera import Camera
from hal.clock import RealClock
from hal.errors import ConnectionLost, HalError
from hal.specs import CameraSpec, SensorSpec
from hal.testing import camera_spec
from hal.types import Frame

pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")

from realsense_kit import write_recording

from hal.drivers.realsense.camera import RealSenseCamera
from hal_emulators.realsense.pictures import EmulatedImages, make_streams

SIZE = (640, 480)
PATIENCE = 15.0
"""s until a test gives up, on a busy computer."""


def spec(
    *streams: str,
    name: str = "wrist",
    size: tuple[int, int] = SIZE,
    output: tuple[int, int] | None = None,
    rate_hz: float = 30.0,
    align: str = "color",
    formats: dict[str, str] | None = None,
    **options: Any,
) -> CameraSpec:
    """Return a camera whose streams all have one size; by default colour and depth."""
    streams = streams or ("color", "depth")
    K = ((600.0, 0.0, (size[0] - 1) / 2), (0.0, 600.0, (size[1] - 1) / 2), (0.0, 0.0, 1.0))
    width, height = output or size
    sensors = {
        stream: SensorSpec(*size, rate_hz, K, format, (0.015 * (stream != "color"), 0.0, 0.0))
        for stream, format in (formats or {}).items()
    }
    captured = {"capture_width": size[0], "capture_height": size[1], "width": width, "height": height, "K": K}
    depth = {"depth_min": 0.2, "depth_max": 5.0, "align": align, "sensors": sensors}
    return camera_spec(
        name=name,
        model="realsense_d435",
        driver="realsense",
        rate_hz=rate_hz,
        streams=streams,
        view=None,
        options=options,
        **captured,
        **depth,
    )


@contextmanager
def opened(camera: CameraSpec) -> Iterator[Camera]:
    """Open the public camera, as a rig in real time does."""
    it = Camera(RealSenseCamera(camera), RealClock(), threaded=True)
    it.open()
    try:
        yield it
    finally:
        it.close()


def open_error(camera: CameraSpec) -> HalError:
    """Return the error with which a camera does not open."""
    driver = RealSenseCamera(camera)
    try:
        with pytest.raises(HalError) as caught:
            driver.open()
        return caught.value
    finally:
        driver.close()


def software(*streams: str, emulated: Any = True, warm_up_s: float = 0.0, **changes: Any) -> CameraSpec:
    """Return an emulated camera."""
    return spec(*streams, emulated=emulated, warm_up_s=warm_up_s, **changes)


def recording(folder: Path, camera: CameraSpec, frames: int = 40, **how: Any) -> str:
    """Write a recording of a camera; the library plays it from frame 2 on."""
    file = folder / f"{camera.name}.db3"
    write_recording(file, camera, frames, **how)
    return str(file)


def sent(camera: CameraSpec, stream: str, number: int, pattern: str = "test") -> Any:
    """Return exactly what the emulated camera, or the recording, has as a frame of a stream."""
    streams = make_streams(camera)
    return EmulatedImages(streams, pattern, 0).expected(stream, streams[stream].mode, number)


def read_until_lost(camera: Camera) -> ConnectionLost:
    """Read until the camera is lost, and return the error."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            camera.read(timeout=PATIENCE)
        except ConnectionLost as error:
            return error
    raise AssertionError(f"the camera was not lost within {PATIENCE} s")


def wait_for_code(camera: Camera, code: str) -> None:
    """Wait until a lost camera's error has a code: the attempts to reconnect name what they find."""

    def named() -> bool:
        with pytest.raises(ConnectionLost) as caught:
            camera.read(timeout=PATIENCE)
        return caught.value.code == code

    wait_until(named)


def read_again(camera: Camera) -> Frame:
    """Return the first frame of a camera that was lost."""
    wait_until(lambda: camera.connected)
    return camera.read(timeout=PATIENCE)
