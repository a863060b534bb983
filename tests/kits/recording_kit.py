"""Small recordings of mock rigs, and what every recording must keep (:mod:`recording_layout`)."""

from __future__ import annotations

import time
from typing import Any

import pytest

import hal
from hal.rig import Rig

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

from recording_layout import check_layout, check_stamps

from hal.recording import Recorder

__all__ = ["CAMERAS", "SIZE", "check_layout", "check_stamps", "drive", "kill_writer", "mock_rig", "record", "small"]

CAMERAS = ("scene", "wrist")
SIZE = (64, 48)


def small(width: int = SIZE[0], height: int = SIZE[1]) -> list[str]:
    """Overrides that make both cameras' pictures small."""
    return [
        f"cameras.{name}.output.{key}={value}"
        for name in CAMERAS
        for key, value in (("width", width), ("height", height))
    ]


def mock_rig(clock: str = "lock_step", *overrides: str, **more: Any) -> Rig:
    """A mock of the built-in rig."""
    return hal.open("panda_table", driver="mock", clock=clock, overrides=[*small(), *overrides], **more)


def drive(rig: Rig, seconds: float) -> None:
    """Move the arm a little."""
    arm = rig.robots["panda"]
    with arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            if tick.elapsed > seconds:
                break
            control.send(hal.Twist([0.0, 0.0, 0.05]), grip=0.5)


def record(recorder: Recorder, seconds: float, success: bool | None = True) -> None:
    """One episode."""
    recorder.start(seed=1)
    drive(recorder.rig, seconds)
    recorder.save(success, wait=True)


def kill_writer(recorder: Recorder) -> None:
    """Kill the process that writes the present episode, once some rows are on the disk."""
    (rows,) = recorder.root.glob("episodes/*.partial/rows.arrow")
    deadline = time.monotonic() + 30.0
    while rows.stat().st_size < 20_000 and time.monotonic() < deadline:
        time.sleep(0.01)
    recorder._child.process.kill()
    recorder._child.process.wait()
