"""The driver of webcams on the kernel's own test cameras (vivid): two alike ones, unplugged by unbinding them."""

from __future__ import annotations

import gc
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from kit import Measured, eventually

from hal.drivers.webcam import kernel, preflight
from hal.drivers.webcam.capture import V4l2Camera
from hal.errors import ControlTaken, DeviceNotFound, NotSupported
from hal.specs import CameraSpec
from hal.testing import CameraBench, CameraContract, camera_spec

_DRIVER = Path("/sys/bus/platform/drivers/vivid")
_DEVICE = "vivid.0"
_SIZE = (320, 180)
"""The smallest of vivid's webcam: the machine is slow."""
_RATE = 10.0
_DROPPED = "percentage_of_dropped_buffers"


def _bind() -> None:
    if not (_DRIVER / _DEVICE).exists():
        (_DRIVER / "bind").write_text(_DEVICE)
    eventually(lambda: len(_paths()) == 2, "both cameras are there")


def _unbind() -> None:
    if (_DRIVER / _DEVICE).exists():
        (_DRIVER / "unbind").write_text(_DEVICE)


def _paths() -> list[str]:
    return [camera.path for camera in kernel.find_cameras() if Path(camera.path).exists()]


def _spec(rate_hz: float = _RATE, size: tuple[int, int] = _SIZE, **options: Any) -> CameraSpec:
    width, height = size
    options = {"name": "vivid-000", "stall_s": 3.0} | options
    options["options"] = {"timestamp_source": 1} | options.get("options", {})  # of the start, not of an end to come
    return camera_spec(driver="v4l2", streams=("color",), width=width, height=height, rate_hz=rate_hz, options=options)


@pytest.fixture
def cameras() -> Iterator[None]:
    """Both cameras, plugged in."""
    _bind()
    yield
    gc.collect()  # what a check that failed has left open
    _bind()


@contextmanager
def _open(**controls: int) -> Iterator[V4l2Camera]:
    driver = V4l2Camera(_spec(options=controls))
    try:
        driver.open()
        yield driver
    finally:
        driver.close()


class TestWebcam(CameraContract, left_out={"freeze": "vivid does not fall silent"}):
    """The contract of cameras."""

    @pytest.fixture
    def bench(self, cameras: None) -> Iterator[CameraBench]:
        driver = V4l2Camera(_spec())
        yield CameraBench(driver=driver, patience=10.0, lose=_unbind, restore=_bind)
        driver.close()


def check_cameras_are_listed_with_their_modes(cameras: None, measured: Measured) -> None:
    listed = V4l2Camera.list_plugged()
    assert len(listed) == 2
    assert "vivid-000" in listed[0]
    assert re.search(r"yuyv.*: 320x180 at", listed[0])
    measured(" | ".join(listed[0].splitlines()))


def check_alike_cameras_are_told_apart(cameras: None) -> None:
    with pytest.raises(DeviceNotFound) as caught:
        V4l2Camera(_spec(name="vivid")).open()
    assert caught.value.code == "several_devices"
    first, second = (V4l2Camera(_spec(name=None, device=path)) for path in _paths())
    first.open()
    second.open()
    assert (first.info.title, second.info.title) == ("vivid-000-vid-cap", "vivid-001-vid-cap")
    with pytest.raises(ControlTaken):
        V4l2Camera(_spec()).open()
    first.close()
    second.close()


def check_a_mode_that_it_lacks_is_refused_with_those_that_it_has(cameras: None) -> None:
    with pytest.raises(NotSupported, match="320x180 at"):
        V4l2Camera(_spec(size=(500, 300))).open()


@pytest.mark.parametrize("lost", [0, 30])
def check_stamps_and_numbers_fit(cameras: None, measured: Measured, lost: int) -> None:
    """Each stamp is that of its number, whatever is lost on the way or late to be read."""
    frames = []
    with _open(**{_DROPPED: lost}) as driver:
        assert driver.info.clock == "kernel"
        for k in range(60):
            frame = driver.grab(5.0)
            assert frame is not None
            assert frame.t <= time.monotonic()
            frames.append(frame)
            if k == 30:
                time.sleep(1.0)  # longer than the buffers last
    first = frames[0]
    off = [frame.t - first.t - (frame.seq - first.seq) / _RATE for frame in frames]
    gaps = frames[-1].seq - first.seq + 1 - len(frames)
    assert gaps >= (20 if lost else 3)
    assert max(map(abs, off)) < 0.5 / _RATE
    measured(f"{gaps} gaps; a stamp is off its number by at most {1e3 * max(map(abs, off)):.2f} ms")


def check_a_long_run_has_no_wrong_stamp(cameras: None, measured: Measured) -> None:
    """At 30 frames a second, for as long as the script was told; vivid itself is late on a busy computer."""
    seconds, rate = float(os.environ["HAL_KERNEL_SECONDS"]), 30.0
    driver = V4l2Camera(_spec(rate))
    driver.open()
    try:
        first = driver.grab(5.0)
        assert first is not None
        last = first
        count, wrong, farthest, oldest = 1, 0, 0.0, 0.0
        while last.t < first.t + seconds:
            frame = driver.grab(5.0)
            assert frame is not None
            off = abs(frame.t - first.t - (frame.seq - first.seq) / rate)
            wrong += not (off < 1.0 / rate and frame.seq > last.seq and frame.t > last.t)
            farthest, oldest = max(farthest, off), max(oldest, time.monotonic() - frame.t)
            count, last = count + 1, frame
    finally:
        driver.close()
    lost = last.seq - first.seq + 1 - count
    ages = f"off by at most {1e3 * farthest:.2f} ms, at most {1e3 * oldest:.0f} ms old"
    measured(f"{count} frames in {last.t - first.t:.0f} s, {lost} lost, {wrong} wrong stamps: {ages}")
    assert wrong == 0


def check_controls_are_set_and_their_automatics_switched_off(cameras: None) -> None:
    with _open(brightness=200, gain=77) as driver:
        options = driver.info.options
    assert (options["brightness"], options["gain"], options["gain_automatic"]) == (200, 77, 0)
    with pytest.raises(NotSupported, match="brightness"), _open(brightnes=1):
        pass


def check_the_preflight_measures_it(cameras: None, measured: Measured) -> None:
    camera, frames = preflight.check_v4l2(_spec(), 3.0)
    assert camera.level == "ok"
    assert frames.level in ("ok", "warn")
    measured(frames.found)
