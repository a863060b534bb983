"""A rig with a RealSense, its pre-flight check, and the reset of a camera that does not start."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

import hal
from hal import registry
from hal.errors import ConfigError, ConnectionLost

from .realsense_bench import (
    PATIENCE,
    RealSenseCamera,
    opened,
    read_again,
    read_until_lost,
    recording,
    software,
    spec,
)

from hal_emulators.realsense import read_number  # isort: skip  # needs the library
from hal.drivers.realsense.options import RealSenseSettings  # isort: skip
from hal.drivers.realsense.preflight import preflight  # isort: skip


def rig(**real: Any) -> dict[str, Any]:
    return {
        "sim": False,
        "cameras": {
            "wrist": {
                "model": "realsense_d435",
                "capture": {"width": 640, "height": 480, "rate_hz": 30},
                "output": {"width": 256, "height": 256},
                "pose": {"position": [0.0, 0.0, 1.0], "orientation": [0.0, 0.0, 0.0, 1.0]},
                "real": real,
            }
        },
    }


def test_a_rig_opens_an_emulated_camera() -> None:
    with hal.open(rig(emulated=True, warm_up_s=0.0)) as bench:
        cam = bench.cameras["wrist"]
        frame = cam.read(timeout=PATIENCE)
        assert frame.color.shape == (256, 256, 3)
        assert read_number(frame.color) > 0
        assert cam.info.serial is not None
        assert frame.T_world_camera is not None


def test_a_rig_with_mistakes_lists_all_of_them() -> None:
    with pytest.raises(ConfigError) as caught:
        hal.open(rig(serial=123, stall_s=-1.0))
    assert {problem.key for problem in caught.value.problems} == {
        "cameras.wrist.real.serial",
        "cameras.wrist.real.stall_s",
    }


def test_preflight() -> None:
    found = {result.name: result for result in preflight(software(emulated={"usb": "2.1"}), 1.0)}
    assert found["camera"].level == "ok"
    assert "firmware 5.16.0.1" in found["camera"].found
    assert found["USB"].level == "warn"
    assert "of 30 Hz" in found["frames"].found
    missing = list(preflight(spec(serial="0123"), 1.0))
    assert [(result.name, result.level) for result in missing] == [("camera", "fail")]
    assert missing[0].remedy


def test_no_camera_is_connected() -> None:
    assert RealSenseCamera.list_plugged() == ()
    assert registry.load("realsense", "camera") is RealSenseCamera


def test_a_camera_that_starts_and_sends_nothing_is_reset_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RealSenseSettings, "is_real", True)  # an emulated one is otherwise never reset
    with opened(software(stall_s=0.4)) as cam:
        cam.read(timeout=PATIENCE)
        cam.inject(freeze=True)
        assert read_until_lost(cam).code == "stalled"
        errors: list[ConnectionLost] = []

        def was_reset() -> bool:
            with pytest.raises(ConnectionLost) as caught:
                cam.read(timeout=0.1)
            errors.append(caught.value)
            return "could not be reset: hardware_reset is not implemented" in str(caught.value)

        wait_until(was_reset, timeout=60.0)
        first = next(error for error in errors if error.code == "no_frames")
        assert "reset" not in str(first), "the first failed start is not followed by a reset"
        cam.inject(freeze=False)
        read_again(cam)


def test_the_same_rig_runs_on_a_recording(tmp_path: Path) -> None:
    file = recording(tmp_path, spec())
    with hal.open(rig(play=file, paced=False, repeat=False)) as bench:
        cam = bench.cameras["wrist"]
        frame = cam.read(timeout=PATIENCE)
        assert frame.color.shape == (256, 256, 3)
        assert cam.read(timeout=PATIENCE).stamp.seq == frame.stamp.seq + 1
