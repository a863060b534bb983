"""What a rig may say of a RealSense. None of it needs the vendor's library."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hal.config import load
from hal.drivers.realsense.settings import RealSenseSettings, problems
from hal.errors import ConfigError
from hal.specs import CameraSpec, SensorSpec

K = ((600.0, 0.0, 319.5), (0.0, 600.0, 239.5), (0.0, 0.0, 1.0))


def camera(**options: Any) -> CameraSpec:
    return CameraSpec(
        name="wrist",
        model="realsense_d435",
        driver="realsense",
        capture_width=640,
        capture_height=480,
        width=640,
        height=480,
        rate_hz=30.0,
        K=K,
        distortion=(0.0,) * 5,
        depth_min=0.2,
        depth_max=5.0,
        streams=("color", "depth"),
        view=None,
        options=options,
    )


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"serial": "0123456789"},
        {"options": {"laser_power": 150, "depth": {"exposure": 8500, "enable_auto_exposure": False}}},
        {"options": {"visual_preset": "high_accuracy"}, "warm_up_s": 0, "stall_s": 0.5},
        {"record": "today.db3", "overwrite": True},
        {"emulated": True},
        {"emulated": {"pattern": "scene", "drift_ppm": 20.0}},
        {"emulated": False, "serial": None},
    ],
)
def test_what_is_right(options: dict[str, Any]) -> None:
    assert list(problems(camera(**options))) == []
    RealSenseSettings.of(camera(**options))


def test_a_recording_and_how_it_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    options = {"play": "~/today.db3", "repeat": False, "paced": False}
    assert list(problems(camera(**options))) == [("real.play", "there is no recording ~/today.db3")]
    (tmp_path / "today.db3").touch()
    assert list(problems(camera(**options))) == []
    assert RealSenseSettings.of(camera(**options)).play == str(tmp_path / "today.db3")


def test_a_folder_to_record_to_is_there(tmp_path: Path) -> None:
    assert list(problems(camera(record=str(tmp_path / "today.db3")))) == []
    (found,) = problems(camera(record=str(tmp_path / "none" / "today.db3")))
    assert found == ("real.record", f"there is no folder {tmp_path / 'none'} for the recording")


@pytest.mark.parametrize(
    ("options", "key", "words"),
    [
        ({"serial": 123456789}, "real.serial", "zeros at its start count: write it in quotes"),
        ({"serial": ""}, "real.serial", "in quotes"),
        ({"serail": "1"}, "real.serail", "did you mean 'serial'"),
        ({"record": "today.bag"}, "real.record", "ends in .db3"),
        ({"play": "today"}, "real.play", "ends in .db3"),
        ({"play": "a.db3", "record": "b.db3"}, "real", "give play or record"),
        ({"play": "a.db3", "emulated": True}, "real", "give play or emulated"),
        ({"play": "a.db3", "options": {"laser_power": 150}}, "real", "leave options out"),
        ({"paced": False}, "real", "has paced, which says nothing without play"),
        ({"repeat": True, "emulated": True}, "real", "has repeat, which says nothing without play"),
        ({"overwrite": True}, "real", "has overwrite, which says nothing without record"),
        ({"stall_s": 0}, "real.stall_s", "above 0"),
        ({"warm_up_s": -1}, "real.warm_up_s", "0 to 60 s"),
        ({"options": [1]}, "real.options", "names and values"),
        ({"options": {"gain": None}}, "real.options", "gain must be a number, true, false or a word"),
        ({"options": {"color": 3}}, "real.options", "color must hold names"),
        ({"options": {"depth": {"gain": [1]}}}, "real.options", "depth.gain must be a number"),
        ({"emulated": {"patern": "test"}}, "real.emulated", "did you mean 'pattern'"),
        ({"emulated": "yes"}, "real.emulated", "must be true or a mapping"),
        ({"paced": "no"}, "real.paced", "true or false"),
    ],
)
def test_what_is_wrong(options: dict[str, Any], key: str, words: str) -> None:
    found = list(problems(camera(**options)))
    assert [place for place, _ in found] == [key]
    assert words in found[0][1]
    with pytest.raises(ConfigError, match="cameras.wrist.real"):
        RealSenseSettings.of(camera(**options))


def test_streams_and_formats_are_those_of_the_cameras() -> None:
    wrong = replace(
        camera(),
        streams=("color", "segmentation"),
        sensors={"color": SensorSpec(640, 480, 30.0, K, "y16")},
    )
    found = dict(problems(wrong))
    assert "color, depth, infrared, infrared_right" in found["streams.segmentation"]
    assert "'y16' is none of rgb8, bgr8" in found["streams.color.format"]


@pytest.mark.parametrize("align", ["color", "depth"])
def test_alignment_is_to_a_stream_that_is_on(align: str) -> None:
    other = "depth" if align == "color" else "color"
    pose = {"position": [0, 0, 1], "orientation": [0, 0, 0, 1]}
    wrong = {"sim": False, "model": "realsense_d435", "streams": [other], "align": align, "pose": pose}
    with pytest.raises(ConfigError, match=f"is {align}, which is none of the streams that are on: {other}"):
        load({"cameras": {"wrist": wrong}}).resolve()


def test_it_needs_no_library() -> None:
    program = (
        "import sys; sys.modules['pyrealsense2'] = None\n"
        "from hal.drivers.realsense import settings\n"
        "assert list(settings.FORMATS) == ['color', 'depth', 'infrared', 'infrared_right']"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
