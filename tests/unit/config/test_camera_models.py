"""What the camera models that come with the hal say, against what cameras report, and what a rig may ask of them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hal.config import load
from hal.config.data_files import find_data, list_data
from hal.drivers.mock.camera import MockCamera
from hal.errors import ConfigError, Problem
from hal.specs import CameraSpec

LOOK = {"target": [0, 0, 0], "distance": 1.0}
D435 = "realsense_d435"
STEREO = {"color": {"format": "bgr8"}, "depth": {"format": "z16"}, "infrared": {"format": "y8"}, "infrared_right": {}}


def rig(model: str = D435, **keys: Any) -> dict[str, Any]:
    return {"cameras": {"eye": {"model": model, "look_at": LOOK, **keys}}}


def camera(model: str = D435, **keys: Any) -> CameraSpec:
    (spec,) = load(rig(model, **keys)).resolve().cameras
    return spec


def problems(config: dict[str, Any] | str, **arguments: Any) -> list[Problem]:
    with pytest.raises(ConfigError) as caught:
        load(config, **arguments)
    return list(caught.value.problems)


def mode(text: str) -> dict[str, Any]:
    """``640x480@30``."""
    size, rate = text.split("@")
    width, height = size.split("x")
    return {"width": int(width), "height": int(height), "rate_hz": float(rate)}


REPORTED = [  # fx, pixels, as cameras report it; where, stands in the models' files
    ("realsense_d435", "color", "1280x720@30", [918.6, 908.8, 908.1]),
    ("realsense_d435", "color", "1920x1080@30", [1362.1]),
    ("realsense_d435", "color", "848x480@30", [605.4]),
    ("realsense_d435", "color", "640x480@30", [612.4, 607.3, 605.4]),
    ("realsense_d435", "color", "640x360@30", [454.0, 459.3]),
    ("realsense_d435", "depth", "1280x720@30", [644.9, 631.3]),
    ("realsense_d435", "depth", "848x480@30", [427.3, 418.3]),
    ("realsense_d435", "depth", "640x480@30", [384.2, 385.2, 378.8]),
    ("realsense_d435", "depth", "640x360@30", [319.1, 320.2]),
    ("realsense_d435", "depth", "424x240@30", [211.4, 212.1]),
    ("realsense_d435", "infrared", "1280x800@30", [644.9, 631.3]),
    ("realsense_d455", "color", "1280x800@30", [636.5]),
    ("realsense_d455", "color", "1280x720@30", [636.5]),
    ("realsense_d455", "color", "848x480@30", [421.6]),
    ("realsense_d455", "color", "640x480@30", [381.9]),
    ("realsense_d405", "color", "1280x720@30", [646.8]),
    ("realsense_d405", "color", "848x480@30", [431.2]),
    ("realsense_d405", "color", "640x480@30", [431.2]),
    ("realsense_d405", "color", "640x360@30", [323.4]),
    ("realsense_d405", "depth", "1280x720@30", [636.4]),
    ("realsense_d405", "depth", "848x480@30", [421.6, 426.6]),
    ("realsense_d405", "depth", "640x480@30", [380.4, 382.3]),
    ("realsense_l515", "color", "1280x720@30", [898.2]),
]


@pytest.mark.parametrize(("model", "stream", "at", "reported"), REPORTED)
def test_a_nominal_camera_sees_as_real_ones_do(model: str, stream: str, at: str, reported: list[float]) -> None:
    spec = camera(model, capture=mode(at), streams=[stream])
    sensor = spec.sensors[stream]
    for fx in reported:
        assert sensor.K[0][0] == pytest.approx(fx, rel=0.03)
        assert sensor.K[1][1] == pytest.approx(fx, rel=0.03)
    assert (sensor.K[0][2], sensor.K[1][2]) == ((sensor.width - 1) / 2, (sensor.height - 1) / 2)


MODELS = [name for name in list_data("sensors", "cameras") if name.startswith("realsense")]


def data(model: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(find_data("sensors", "cameras", f"{model}.yaml").read_text())
    return found


def test_there_are_these_models() -> None:
    names = {"realsense_d405", "realsense_d435", "realsense_d435i", "realsense_d455", "realsense_l515"}
    assert set(MODELS) == names
    assert {**data("realsense_d435"), "description": ""} == {**data("realsense_d435i"), "description": ""}


@pytest.mark.parametrize("model", MODELS)
def test_every_mode_of_a_model_can_be_taken(model: str) -> None:
    streams = data(model)["streams"]
    for stream, figures in streams.items():
        for size in figures.get("modes", ()):
            for rate in size["rates_hz"]:
                at = {"width": size["width"], "height": size["height"], "rate_hz": rate}
                spec = camera(model, capture=at, streams={stream: {"format": figures["formats"][-1]}})
                assert (spec.width, spec.height, spec.rate_hz) == (size["width"], size["height"], rate)
                if stream == "depth":
                    assert spec.depth_min == size.get("depth_min", data(model)["depth"]["min"])
    everything = camera(model, streams=list(streams))
    assert set(everything.sensors) == set(streams)


@pytest.mark.parametrize(
    ("model", "depth", "right"),
    [
        ("realsense_d435", (0.015, 0, 0), (0.065, 0, 0)),
        ("realsense_d455", (-0.059, 0, 0), (0.036, 0, 0)),
        ("realsense_d405", (0, 0, 0), (0.018, 0, 0)),
    ],
)
def test_where_the_imagers_are(model: str, depth: tuple[float, ...], right: tuple[float, ...]) -> None:
    spec = camera(model, streams=STEREO)
    places = {name: sensor.position for name, sensor in spec.sensors.items()}
    assert places == {"color": (0, 0, 0), "depth": depth, "infrared": depth, "infrared_right": right}
    assert spec.depth_sensor is not None
    assert spec.depth_sensor.baseline == pytest.approx(right[0] - depth[0])
    info = MockCamera(spec).nominal_info()
    assert info.streams["infrared_right"].T_color_stream.position[0] == right[0]
    assert {name: stream.format for name, stream in info.streams.items()} == {
        "color": "bgr8",
        "depth": "z16",
        "infrared": "y8",
        "infrared_right": None,
    }


class TestStreams:
    """What each stream takes, and what is handed out."""

    def test_one_may_be_smaller_and_slower(self) -> None:
        own = {"color": {"rate_hz": 60}, "depth": {"width": 848, "height": 480}, "infrared": {}}
        spec = camera(streams=own)
        taken = {name: (s.width, s.height, s.rate_hz) for name, s in spec.sensors.items()}
        # Infrared is made by the same sensor as depth, and goes with it.
        assert taken == {"color": (640, 480, 60), "depth": (848, 480, 30), "infrared": (848, 480, 30)}
        assert spec.rate_hz == 30
        assert (spec.width, spec.height, spec.capture_width) == (640, 480, 640)
        assert spec.depth_min == 0.195

    def test_output_is_that_of_the_view_that_is_handed_out(self) -> None:
        own = {"color": {"width": 1280, "height": 720}, "depth": {}, "infrared": {}}
        by_color, by_depth = camera(streams=own), camera(streams=own, align="depth")
        assert (by_color.width, by_color.height, by_color.align) == (1280, 720, "color")
        assert (by_depth.width, by_depth.height, by_depth.align) == (640, 480, "depth")
        assert by_color.K == by_color.sensors["color"].K
        assert by_depth.K == by_depth.sensors["depth"].K
        assert by_depth.K_infrared is None  # the left imager has the very view of depth

    def test_infrared_goes_through_its_own_crop(self) -> None:
        spec = camera(streams=STEREO, output={"width": 256, "height": 256})
        own = np.array(spec.sensors["infrared"].K)
        ray = (0.3, -0.2, 1.0)
        u, v, _ = own @ ray
        x, y, _ = np.array(spec.K_infrared) @ ray
        assert (x + 0.5) / 256 == pytest.approx((u + 0.5 - 80) / 480)
        assert (y + 0.5) / 256 == pytest.approx((v + 0.5) / 480)
        assert spec.K_infrared != spec.K

    def test_without_colour_the_view_is_depths(self) -> None:
        spec = camera(streams=["depth", "segmentation"])
        assert spec.align == "depth"
        assert spec.K == spec.sensors["depth"].K
        assert set(spec.sensors) == {"depth"}  # a segmentation is nothing that a camera takes
        only = camera(streams=["infrared_right"])
        assert only.K == only.sensors["infrared_right"].K
        assert only.K_infrared is None
        assert only.rate_hz == 30

    def test_an_ideal_camera_has_one_view(self) -> None:
        spec = camera("pinhole", streams=["color", "depth", "infrared", "segmentation"], align="depth")
        assert spec.K_infrared is None
        assert {(s.K, s.position) for s in spec.sensors.values()} == {(spec.K, (0, 0, 0))}
        assert spec.options == {}

    @pytest.mark.parametrize("rates", [(30, 30), (60, 30), (60, 15), (15, 90), (6, 30), (60, 6)])
    def test_rates_that_fit(self, rates: tuple[float, float]) -> None:
        spec = camera(streams={"color": {"rate_hz": rates[0]}, "depth": {"rate_hz": rates[1]}})
        assert spec.rate_hz == min(rates)


AT = {"width": 640, "height": 480, "rate_hz": 30}


@pytest.mark.parametrize(
    ("keys", "key", "code"),
    [
        # The same in simulation and for real.
        ({"streams": {"color": {"format": "bgr9"}}}, "streams.color.format", "unknown_format"),
        ({"streams": {"depth": {"format": "rgb8"}}}, "streams.depth.format", "unknown_format"),
        ({"streams": {"infrared_right": {"format": "z16"}}}, "streams.infrared_right.format", "unknown_format"),
        ({"streams": {"color": {}, "depht": {}}}, "streams.depht", "invalid_choice"),
        ({"streams": {"depth": {"rate_hz": 29}}}, "streams.depth", "unknown_mode"),
        ({"streams": {"depth": {"width": 1920, "height": 1080}}}, "streams.depth", "unknown_mode"),
        ({"capture": {**AT, "rate_hz": 90}}, "capture", "unknown_mode"),
        ({"streams": {"depth": {"width": 640}}}, "streams.depth", "missing_key"),
        ({"streams": {"depth": {"width": 640, "hight": 480}}}, "streams.depth.hight", "unknown_key"),
        ({"streams": {"color": {"rate_hz": 15}, "depth": {"rate_hz": 6}}}, "streams", "conflict"),
        ({"streams": {"depth": {}, "infrared": {"width": 848, "height": 480}}}, "streams", "conflict"),
        ({"streams": ["depth"], "align": "color"}, "align", "conflict"),
        ({"align": "colour"}, "align", "invalid_choice"),
        ({"streams": {"depth": {}, "segmentation": {"rate_hz": 3}}}, "streams.segmentation", "conflict"),
        # Keys of simulated cameras only.
        ({"simulated": {"depth_nois": True}}, "simulated.depth_nois", "unknown_key"),
        ({"simulated": {"depth_noise": "yes"}}, "simulated.depth_noise", "wrong_type"),
        ({"simulated": {"depth_noise": {"subpixl": 0.1}}}, "simulated.depth_noise.subpixl", "unknown_key"),
        ({"simulated": {"depth_noise": {"subpixel": -1}}}, "simulated.depth_noise.subpixel", "out_of_range"),
        ({"model": "pinhole", "simulated": {"depth_noise": True}}, "simulated.depth_noise", "conflict"),
        (
            {"model": "realsense_l515", "simulated": {"depth_noise": {"subpixel": 0.1}}},
            "simulated.depth_noise.subpixel",
            "unknown_key",
        ),
        ({"model": "realsense_l515", "streams": ["infrared_right"]}, "streams.infrared_right", "unknown_stream"),
        ({"model": "realsense_l515", "sim": False}, "", "no_driver"),
    ],
)
def test_one_mistake_is_one_problem(keys: dict[str, Any], key: str, code: str) -> None:
    (problem,) = problems(rig(**keys))
    assert (problem.key, problem.code) == (f"cameras.eye.{key}".rstrip("."), code)


def test_a_capture_that_no_stream_has_is_one_problem() -> None:
    (problem,) = problems(rig(capture=mode("641x480@30")))
    assert problem.key == "cameras.eye.capture"
    assert "641x480 at 30 Hz of color" in problem.message
    assert "641x480 at 30 Hz of depth" in problem.message


def test_a_real_camera_is_checked_alike() -> None:
    real = {"sim": False, "drivers": {"real": "mock"}, "look_at": None}
    assert camera(**real, streams=STEREO).sensors == camera(streams=STEREO).sensors
    keys = [problem.key for problem in problems(rig(**real, streams={"color": {"format": "bgr9"}, "segmentation": {}}))]
    assert keys == ["cameras.eye.streams.segmentation", "cameras.eye.streams.color.format"]


# A driver's own checks.

LAB = """
from hal.registry import DriverSpec

DRIVER = DriverSpec(name="lab", camera="hal.drivers.mock.camera:MockCamera", checks={"camera": "lab_eyes:check"})

def check(spec):
    if "serial" not in spec.options:
        yield "real.serial", "is missing"
    if spec.options.get("preset") == "odd":
        yield "real.preset", "is odd"
    if spec.rate_hz > 30:
        yield "capture.rate_hz", "is too fast"
"""


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A model of one's own with a driver of one's own."""
    (tmp_path / "lab_eyes.py").write_text(LAB)
    monkeypatch.syspath_prepend(tmp_path)
    model = {**data(D435), "drivers": {"sim": "pybullet", "real": "lab_eyes:DRIVER"}, "real": {"preset": "odd"}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(model))
    yield str(tmp_path / "mine.yaml")
    sys.modules.pop("lab_eyes", None)


def places(config: dict[str, Any], **arguments: Any) -> set[tuple[str, str]]:
    return {(Path(problem.file).name, problem.key) for problem in problems(config, **arguments)}


def test_what_a_driver_finds_stands_where_it_was_written(lab: str) -> None:
    real = rig(lab, sim=False)
    assert places(real) == {("<dict>", "cameras.eye.real.serial"), ("mine.yaml", "real.preset")}
    mine = rig(lab, sim=False, real={"serial": "1", "preset": "odd"}, capture=mode("640x480@60"))
    assert places(mine) == {("<dict>", "cameras.eye.real.preset"), ("<dict>", "cameras.eye.capture.rate_hz")}
    assert load(rig(lab, sim=False, real={"serial": "1", "preset": "even"})).resolve().cameras[0].driver != "pybullet"
    load(rig(lab))  # in simulation the real driver is not consulted


# Models of one's own.


def own(folder: Path, **keys: Any) -> str:
    model = {"drivers": {"sim": "pybullet"}, "capture": AT, "depth": {"min": 0.1, "max": 2.0}, **keys}
    (folder / "own.yaml").write_text(yaml.safe_dump(model))
    return str(folder / "own.yaml")


def test_a_model_with_one_view_for_all(tmp_path: Path) -> None:
    model = own(tmp_path, field_of_view={"horizontal_deg": 60}, streams=["color", "depth"])
    spec = camera(model)
    assert spec.sensors["color"].K == spec.sensors["depth"].K == spec.K


@pytest.mark.parametrize(
    ("keys", "key", "code"),
    [
        ({"streams": ["color"]}, "", "missing_key"),
        (
            {"field_of_view": {"horizontal_deg": 60}, "streams": {"color": {}, "colour": {}}},
            "streams.colour",
            "invalid_choice",
        ),
        (
            {"field_of_view": {"horizontal_deg": 60}, "depth_sensor": {"kind": "stereo", "unit": 0.001}},
            "",
            "missing_key",
        ),
        (
            {"field_of_view": {"horizontal_deg": 60}, "depth_sensor": {"kind": "sterio", "unit": 0.001}},
            "depth_sensor.kind",
            "invalid_choice",
        ),
    ],
)
def test_mistakes_in_a_model(tmp_path: Path, keys: dict[str, Any], key: str, code: str) -> None:
    (problem,) = problems(rig(own(tmp_path, **keys), streams=["color"]))
    assert (Path(problem.file).name, problem.key, problem.code) == ("own.yaml", key, code)
