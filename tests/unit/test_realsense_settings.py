"""What a rig may say of a RealSense. None of it needs the vendor's library."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest

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
        {"play": "~/today.db3", "repeat": False, "paced": False},
        {"emulated": True},
        {"emulated": {"pattern": "scene", "drift_ppm": 20.0}},
        {"emulated": False, "serial": None},
    ],
)
def test_what_is_right(options: dict[str, Any]) -> None:
    assert list(problems(camera(**options))) == []
    RealSenseSettings.of(camera(**options))


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
        ({"stall_s": 0}, "real.stall_s", "greater than 0"),
        ({"warm_up_s": -1}, "real.warm_up_s", "greater than or equal to 0"),
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


def test_alignment_to_depth_needs_both() -> None:
    assert dict(problems(replace(camera(), streams=("depth",), align="depth"))).keys() == {"align"}
    assert not list(problems(replace(camera(), align="depth")))


def test_it_needs_no_library() -> None:
    program = (
        "import sys; sys.modules['pyrealsense2'] = None\n"
        "from hal.drivers.realsense import settings\n"
        "assert list(settings.FORMATS) == ['color', 'depth', 'infrared', 'infrared_right']"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
