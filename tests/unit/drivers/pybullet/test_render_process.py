"""The renderer's own process, beside the process that steps the world."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest
from pictures_kit import box, camera, look_at
from specs import data, world_spec

from hal.camera import RawFrame
from hal.drivers.pybullet.camera import PyBulletCamera, PyBulletPictures
from hal.errors import ConnectionLost
from hal.host.hosts import RemoteHost
from hal.specs import GroupSpec, ViewSpec

ABOVE = look_at((0.0, 0.0, 1.2), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
VIEW = ViewSpec(tuple(ABOVE.position), tuple(ABOVE.orientation))


def newest(driver: PyBulletCamera, after: float) -> RawFrame:
    """A frame that shows the world later than ``after``."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        frame = driver.grab(0.5)
        if frame is not None and frame.t > after:
            return frame
    raise AssertionError("no frame came")


def test_pictures_edits_and_the_death_of_the_renderer() -> None:
    data("plane.urdf")  # skips where PyBullet is not installed
    spec = world_spec(box("floor", (2.0, 2.0, 0.05), (0.0, 0.0, -0.05)), box("block", (0.1, 0.1, 0.1), (0.0, 0.0, 0.1)))
    cameras = [camera(64, 48, name=name, view=VIEW) for name in ("one", "two")]
    host = RemoteHost(GroupSpec("world", "real_time", 240.0, (), spec))
    pictures = PyBulletPictures(host, cameras, "tiny")
    try:
        pictures.wait_ready()
        host.wait_ready()
        assert "TinyRenderer" in pictures.describe()
        assert "one" in pictures
        drivers = [PyBulletCamera(camera, pictures.source(camera.name)) for camera in cameras]
        start = time.monotonic()
        for driver in drivers:
            driver.open()
            frame = newest(driver, start - 1.0)
            assert frame.t <= time.monotonic()
            assert frame.color is not None
            assert 1 in np.unique(frame.segmentation)
            again = newest(driver, frame.t)
            assert again.seq > frame.seq

        paint = {"name": "block", "rgba": [0.0, 0.0, 1.0, 1.0]}
        pictures.edited("set_color", paint, host.request("world.set_color", paint))
        blue = newest(drivers[0], time.monotonic())
        assert blue.color is not None
        red, _, strong = blue.color[blue.segmentation == 1].mean(axis=0)
        assert strong > red + 50

        assert pictures._child is not None
        os.kill(pictures._child.process.pid, signal.SIGKILL)
        with pytest.raises(ConnectionLost):
            newest(drivers[0], time.monotonic())
    finally:
        pictures.close()
        pictures.close()
        host.close()
