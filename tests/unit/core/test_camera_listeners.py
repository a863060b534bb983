"""Whoever wants every frame of a camera, and what happens when that fails."""

from __future__ import annotations

import logging
import threading

import pytest

import hal
from hal.types import Frame


def test_a_listener_hears_every_frame_and_one_that_fails_is_logged_and_dropped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    heard: list[int] = []
    failures = []
    enough = threading.Event()

    def hear(frame: Frame) -> None:
        heard.append(frame.stamp.seq)
        if len(heard) >= 5:
            enough.set()

    def fail(frame: Frame) -> None:
        failures.append(frame.stamp.seq)
        raise RuntimeError("the disk is full")

    with (
        caplog.at_level(logging.ERROR, "hal.camera"),
        hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig,
    ):
        camera = rig.cameras["scene"]
        detach = camera.on_frame(hear)
        camera.on_frame(fail)
        assert enough.wait(20.0)
        detach()
        count = len(heard)
        camera.read(timeout=20.0)
        camera.read(timeout=20.0)
    assert len(failures) == 1
    assert "the disk is full" in caplog.text
    assert len(heard) <= count + 1
