"""What a rig file may set for a RealSense; the check needs no library."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hal.config import load
from hal.drivers.realsense.options import RealSenseSettings, problems
from hal.errors import ConfigError
from hal.specs import CameraSpec, SensorSpec
from hal.testing import camera_spec

K = ((600.0, 0.0, 319.5), (0.0, 600.0, 239.5), (0.0, 0.0, 1.0))


def camera(**options: Any) -> CameraSpec:
    streams = ("color", "depth")
    return camera_spec(name="wrist", driver="realsense", width=640, height=480, streams=streams, options=options)


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
def test_valid_options(options: dict[str, Any]) -> None:
    assert list(problems(camera(**options))) == []
    RealSenseSettings.of(camera(**options))


def test_options_of_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    options = {"play": "~/today.db3", "repeat": False, "paced": False}
    assert [(key, code) for key, _, code in problems(camera(**options))] == [("real.play", "missing_file")]
    (tmp_path / "today.db3").touch()
    assert list(problems(camera(**options))) == []
    assert RealSenseSettings.of(camera(**options)).play == str(tmp_path / "today.db3")


def test_the_folder_of_a_recording_must_exist(tmp_path: Path) -> None:
    assert list(problems(camera(record=str(tmp_path / "today.db3")))) == []
    found = problems(camera(record=str(tmp_path / "none" / "today.db3")))
    assert [(key, code) for key, _, code in found] == [("real.record", "missing_folder")]


WRONG: dict[str, list[dict[str, Any]]] = {
    "serial": [{"serial": 123456789}, {"serial": ""}],
    "serail": [{"serail": "1"}],
    "record": [{"record": "today.bag"}],
    "play": [{"play": "today"}],
    "": [{"play": "a.db3", **more} for more in ({"record": "b.db3"}, {"emulated": True}, {"options": {"gain": 1}})],
    "stall_s": [{"stall_s": 0}],
    "warm_up_s": [{"warm_up_s": -1}],
    "options": [{"options": k} for k in ([1], {"gain": None}, {"color": 3}, {"depth": {"gain": [1]}})],
    "emulated": [{"emulated": {"patern": "test"}}, {"emulated": "yes"}],
    "paced": [{"paced": "no"}],
}
WRONG[""] += [{"paced": False}, {"repeat": True, "emulated": True}, {"overwrite": True}]


@pytest.mark.parametrize(
    ("options", "key"), [(one, f"real.{key}".rstrip(".")) for key, wrong in WRONG.items() for one in wrong]
)
def test_wrong_options(options: dict[str, Any], key: str) -> None:
    ((place, _, code),) = problems(camera(**options))
    assert place == key
    assert code != "invalid"
    with pytest.raises(ConfigError) as caught:
        RealSenseSettings.of(camera(**options))
    assert {problem.file for problem in caught.value.problems} == {"cameras.wrist.real"}


def test_streams_and_formats_must_be_known() -> None:
    wrong = replace(
        camera(), streams=("color", "segmentation"), sensors={"color": SensorSpec(640, 480, 30.0, K, "y16")}
    )
    assert {key: code for key, _, code in problems(wrong)} == {
        "streams.segmentation": "unknown_stream",
        "streams.color.format": "unknown_format",
    }


@pytest.mark.parametrize("align", ["color", "depth"])
def test_the_stream_to_align_to_must_be_on(align: str) -> None:
    other = "depth" if align == "color" else "color"
    pose = {"position": [0, 0, 1], "orientation": [0, 0, 0, 1]}
    wrong = {"sim": False, "model": "realsense_d435", "streams": [other], "align": align, "pose": pose}
    with pytest.raises(ConfigError) as caught:
        load({"cameras": {"wrist": wrong}}).resolve()
    assert [problem.key for problem in caught.value.problems] == ["cameras.wrist.align"]


def test_the_check_needs_no_library() -> None:
    program = (
        "import sys; sys.modules['pyrealsense2'] = None\n"
        "from hal.drivers.realsense import options\n"
        "assert list(options.FORMATS) == ['color', 'depth', 'infrared', 'infrared_right']"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
