"""RealSense cameras on a bench: the unmodified driver and librealsense, on a camera in software and on recordings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hal.specs import CameraSpec
from hal.testing import CameraBench, camera_spec

__all__ = ["played_realsense", "recording", "software_realsense"]


def _spec(**options: Any) -> CameraSpec:
    pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")
    streams = ("color", "depth", "infrared")
    return camera_spec(driver="realsense", width=424, height=240, depth_max=10.0, streams=streams, options=options)


@contextmanager
def software_realsense() -> Iterator[CameraBench]:
    """A camera in software, which streams by itself."""
    spec = _spec(emulated={}, warm_up_s=0.0, stall_s=0.5)
    from hal.drivers.realsense.camera import RealSenseCamera

    driver = RealSenseCamera(spec)
    yield CameraBench(
        driver=driver,
        patience=5.0,
        lose=lambda: driver.inject(disconnect=True),
        restore=lambda: driver.inject(disconnect=False),
        freeze=lambda: driver.inject(freeze=True),
    )
    driver.close()


def recording(folder: Path) -> str:
    """A recording of two seconds."""
    from hal.drivers.realsense.emulator import write_recording

    file = folder / "recorded.db3"
    write_recording(file, _spec(), 60)
    return str(file)


@contextmanager
def played_realsense(file: str, *, paced: bool) -> Iterator[CameraBench]:
    """A recording, over and over: as fast as it was taken, or as fast as it is read."""
    from hal.drivers.realsense.camera import RealSenseCamera

    driver = RealSenseCamera(_spec(play=file, paced=paced, warm_up_s=0.0))
    yield CameraBench(driver=driver)
    driver.close()
