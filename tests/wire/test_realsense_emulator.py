"""The emulated RealSense, seen through the vendor's unmodified library."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")

from realsense_kit import write_recording  # noqa: E402

from hal.errors import CommandError  # noqa: E402
from hal.specs import SensorSpec  # noqa: E402
from hal_emulators.realsense import (  # noqa: E402
    Emulation,
    SoftwareCamera,
    read_number,
)

from .realsense_client import VGA, Bench, Client, Picture, played  # noqa: E402


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    """Make cameras in contexts; they and their clients are closed at the end of the test."""
    made: list[Bench] = []

    def make(*arguments: Any, **options: Any) -> Bench:
        made.append(Bench(*arguments, **options))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()


def differing(camera: SoftwareCamera, found: dict[str, Picture], number: int) -> list[str]:
    """Return the streams of a set whose pixels are not exactly those of a frame number."""
    expected = camera.expected(number)
    return [name for name, picture in found.items() if not np.array_equal(picture.pixels, expected[name])]


# Description.


def test_calibration_and_units_follow_the_spec(make_bench) -> None:
    turned = (0.0, float(np.sin(0.01)), 0.0, float(np.cos(0.01)))
    K = ((400.0, 0.0, 321.0), (0.0, 401.0, 238.5), (0.0, 0.0, 1.0))
    sensors = {
        "color": SensorSpec(640, 480, 30.0, ((610.0, 0.0, 318.0), (0.0, 611.0, 240.0), (0.0, 0.0, 1.0))),
        "depth": SensorSpec(640, 480, 30.0, K, position=(0.0148, 0.0002, -0.0003), orientation=turned),
    }
    bench = make_bench(replace(VGA, sensors=sensors))
    client = bench.client("depth", "color")
    depth, color = (
        client.profile.get_stream(kind).as_video_stream_profile() for kind in (rs.stream.depth, rs.stream.color)
    )
    for profile, f, c in ((depth, (400.0, 401.0), (321.0, 238.5)), (color, (610.0, 611.0), (318.0, 240.0))):
        lens = profile.get_intrinsics()
        assert (lens.fx, lens.fy, lens.ppx, lens.ppy) == pytest.approx((*f, *c))
        assert not any(lens.coeffs)
    there = depth.get_extrinsics_to(color)
    assert there.translation == pytest.approx((0.0148, 0.0002, -0.0003))
    point = rs.rs2_transform_point_to_point(there, [0.0, 0.0, 1.0])  # a turn of 0.02 rad about y
    assert point == pytest.approx((0.0148 + np.sin(0.02), 0.0002, np.cos(0.02) - 0.0003), abs=1e-6)
    assert client.profile.get_device().first_depth_sensor().get_depth_scale() == pytest.approx(0.001)


# Images.


def test_modes_other_than_that_of_the_spec(bench: Bench) -> None:
    client = bench.client("depth", "color", width=848, height=480, rate=60)
    first = client.whole()
    number = first["depth"].number
    assert first["color"].pixels.shape == (480, 848, 3)
    assert differing(bench.camera, first, number) == []
    client.stop()
    with pytest.raises(RuntimeError, match="resolve"):
        bench.client("depth", width=641)


def test_without_metadata_the_library_mixes_frames_of_two_moments(make_bench) -> None:
    bench = make_bench(metadata=False)
    client = bench.client()
    numbers = [{picture.number for picture in client.set().values()} for _ in range(40)]
    assert any(len(of_set) > 1 for of_set in numbers[5:])


@pytest.mark.parametrize("number", [0, 1, 12345, 2**24 - 1])
def test_the_number_can_be_read_from_a_scaled_crop(bench: Bench, number: int) -> None:
    color = bench.camera.expected(number)["color"]
    square = color[:, 80:560]
    assert read_number(square) == read_number(square[::2, ::2]) == number
    assert read_number(bench.camera.expected(number)["depth"].astype(np.float32) * np.float32(0.001)) == number
    with pytest.raises(ValueError, match="no number"):
        read_number(color[40:])


# Faults.


def test_repeated_replugging_leaks_no_thread(bench: Bench) -> None:
    def once() -> int:
        client = Client(bench.context, bench.camera.serial, "depth")  # the bench would keep it
        client.set()
        bench.camera.unplug()
        client.stop()
        bench.camera.replug()
        return len(os.listdir("/proc/self/task"))

    threads = [once() for _ in range(12)]
    assert threads[-1] <= threads[3] + 2


# Stamps.


def test_color_numbers_may_be_ahead(make_bench) -> None:
    bench = make_bench(color_ahead=40)
    client = bench.client()
    found = [client.set() for _ in range(15)][-1]
    assert found["color"].number == found["depth"].number + 40
    assert differing(bench.camera, found, found["depth"].number) == []


def test_jitter_delays_the_arrival_and_not_the_stamp(make_bench) -> None:
    bench = make_bench(arrival_jitter=0.02)
    client = bench.client()
    client.whole()
    delays, stamps = [], []
    for _ in range(20):
        number = client.set()["depth"].number
        sent = next(one for one in bench.camera.sent if one.number == number)
        delays.append(sent.t - sent.stamp)
        stamps.append((number, sent.stamp))
    assert np.ptp(delays) > 0.004
    if not bench.camera.late:
        steps = [(b - a) / (m - n) for (n, a), (m, b) in itertools.pairwise(stamps)]
        assert steps == pytest.approx([1 / 30] * len(steps), abs=1e-6)


# Recordings.


def test_a_recording_may_have_gaps(tmp_path: Path) -> None:
    path = tmp_path / "gaps.db3"
    write_recording(path, replace(VGA, streams=("depth",)), 20, lost=(7, 8, 15))
    numbers = [found["depth"].number for found in played(path, streams=("depth",))]
    assert numbers == [n for n in range(numbers[0], 21) if n not in (7, 8, 15)]
    assert numbers[0] <= 3


# Wrong options.


@pytest.mark.parametrize(
    "options",
    [
        {"patern": "test"},
        {"pattern": "noise"},
        {"arrival_jitter": float("nan")},
        {"seed": -1},
        {"metadata": 1},
        {"clock_at": -1.0},
    ],
)
def test_a_wrong_option_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(CommandError):
        SoftwareCamera(VGA, **options)
    with pytest.raises(CommandError):
        Emulation.from_options(options)


def test_a_wrong_fault_is_refused_and_changes_nothing(bench: Bench) -> None:
    faults: dict[str, object]
    for faults in ({"disconect": True}, {"drop": -1}, {"skew": None}, {"freeze": 1}):
        with pytest.raises(CommandError):
            bench.camera.inject(**faults)
    assert bench.camera.plugged
    client = Client(bench.context, bench.camera.serial)
    client.whole()


def run(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("end", ["pass", "del camera"])
def test_a_program_may_end_while_it_streams(end: str) -> None:
    done = run(
        f"""
        import pyrealsense2 as rs
        from hal_emulators.realsense import SoftwareCamera, emulated_context
        from hal.testing import camera_spec
        context = emulated_context()
        context.set_devices_changed_callback(lambda change: None)
        camera = SoftwareCamera(camera_spec(width=640, height=480))
        camera.attach(context)
        pipeline, config = rs.pipeline(context), rs.config()
        config.enable_device(camera.serial)
        pipeline.start(config)
        print(pipeline.wait_for_frames(10000).size() > 0, flush=True)
        {end}
        """
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")


def test_without_the_library_the_error_names_its_package() -> None:
    done = run(
        """
        import sys
        sys.modules["pyrealsense2"] = None
        from hal_emulators.realsense import SoftwareCamera, emulated_context
        from hal.errors import DriverMissing
        from hal.testing import camera_spec
        for call in (emulated_context, lambda: SoftwareCamera(camera_spec())):
            try:
                call()
            except DriverMissing as error:
                print(error.name)
        """
    )
    assert done.stdout == "pyrealsense2\n" * 2, done.stderr
