"""The emulated RealSense, seen through the vendor's unmodified library."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")

from hal.errors import CommandError  # noqa: E402
from hal.specs import SensorSpec  # noqa: E402
from hal_emulators.realsense import (  # noqa: E402
    Emulation,
    SoftwareCamera,
    emulated_context,
    read_number,
    write_recording,
)

from .realsense_client import VGA, Bench, Client, Picture, listed, played  # noqa: E402


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


def wait_until_idle(camera: SoftwareCamera) -> None:
    """Wait until the camera has noticed that no stream is on."""
    deadline = time.monotonic() + 5.0
    while camera.streaming:
        assert time.monotonic() < deadline, "it continues for a client that stopped"
        time.sleep(0.005)


# Description.


def test_it_is_listed_as_a_d435(bench: Bench) -> None:
    (device,) = bench.context.query_devices()
    info = rs.camera_info
    found = {key: device.get_info(getattr(info, key)) for key in ("name", "product_line", "usb_type_descriptor")}
    assert found == {"name": "Intel RealSense D435 (emulated)", "product_line": "D400", "usb_type_descriptor": "3.2"}
    assert device.get_info(info.serial_number) == bench.camera.serial
    assert len(bench.camera.serial) == 12
    assert device.get_info(info.firmware_version)
    assert device.get_info(info.physical_port)
    assert bench.announced == [([bench.camera.serial], [])]


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


def test_options_have_ranges_and_keep_their_values(bench: Bench) -> None:
    color = bench.context.query_devices()[0].sensors[1]
    assert color.get_option_range(rs.option.white_balance).max == 6500
    color.set_option(rs.option.exposure, 200)
    assert bench.context.query_devices()[0].sensors[1].get_option(rs.option.exposure) == 200
    with pytest.raises(RuntimeError):
        color.set_option(rs.option.exposure, 1e9)


# Images.


def test_sets_are_matched_and_exact_to_the_bit(bench: Bench) -> None:
    client = bench.client("depth", "color", "infrared", "infrared_right")
    numbers = []
    client.whole()
    for _ in range(20):
        found = client.set()
        (number,) = {picture.number for picture in found.values()}
        assert differing(bench.camera, found, number) == []
        assert {read_number(picture.pixels) for picture in found.values()} == {number}
        numbers.append(number)
    assert numbers == sorted(set(numbers)), "every one is new"


@pytest.mark.parametrize("format", ["rgb8", "bgr8", "rgba8", "bgra8", "yuyv", "uyvy"])
def test_every_color_format(bench: Bench, format: str) -> None:
    client = bench.client("color", color=format)
    found = client.set()
    assert differing(bench.camera, found, found["color"].number) == []
    assert read_number(found["color"].pixels, format) == found["color"].number


def test_packed_color_is_the_same_image(bench: Bench) -> None:
    """The library's own conversion restores the colours, apart from what two pixels share."""
    client = bench.client("color", color="yuyv")
    client.set()
    arrived, frames = client.pipeline.try_wait_for_frames(5000)
    assert arrived
    packed = frames.get_color_frame()
    rgb = np.asanyarray(rs.yuy_decoder().process(packed).get_data()).astype(int)
    mode = bench.camera.modes["color"]._replace(format="rgb8")
    meant = bench.camera.expected(packed.get_frame_number(), {"color": mode})["color"]
    assert np.median(np.abs(rgb - meant)) <= 3


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


def test_a_seed_tells_two_cameras_apart(make_bench) -> None:
    one, other = (make_bench(replace(VGA, name=f"camera_{seed}"), seed=seed) for seed in (0, 1))
    assert one.camera.serial != other.camera.serial
    assert all(
        not np.array_equal(one.camera.expected(3)[name], other.camera.expected(3)[name]) for name in ("depth", "color")
    )


@pytest.mark.parametrize("number", [0, 1, 12345, 2**24 - 1])
def test_the_number_can_be_read_from_a_scaled_crop(bench: Bench, number: int) -> None:
    color = bench.camera.expected(number)["color"]
    square = color[:, 80:560]
    assert read_number(square) == read_number(square[::2, ::2]) == number
    assert read_number(bench.camera.expected(number)["depth"].astype(np.float32) * np.float32(0.001)) == number
    with pytest.raises(ValueError, match="no number"):
        read_number(color[40:])


# The scene.


def test_depth_aligned_to_color_is_within_two_millimetres(make_bench) -> None:
    bench = make_bench(pattern="scene")
    client = bench.client("depth", "color")
    client.whole()
    align = rs.align(rs.stream.color)
    arrived, frames = client.pipeline.try_wait_for_frames(5000)
    assert arrived
    aligned = align.process(frames).get_depth_frame()
    measured = np.asanyarray(aligned.get_data()) * 0.001
    truth = bench.camera.truth(aligned.get_frame_number())
    both = measured > 0.0
    both[:20] = False  # the number
    error = np.abs(measured - truth)[both]
    # An aligned pixel has its neighbour's depth: on the slanted table that is some mm off, at the box's edges more.
    assert both.mean() > 0.9
    assert np.median(error) < 0.002
    assert np.percentile(error, 90) < 0.006
    box = bench.camera.expected(aligned.get_frame_number())["color"]
    reds = (box[..., 0].astype(int) - box[..., 2] > 100) | (box[..., 2].astype(int) - box[..., 0] > 100)
    assert reds.sum() > 2000, "the box is visible"


def test_the_box_moves(bench: Bench) -> None:
    scene = SoftwareCamera(VGA, pattern="scene")
    depths = [scene.truth(number) for number in range(8)]
    assert all(np.abs(a - b).max() > 0.03 for a, b in itertools.pairwise(depths))
    scene.close()


# Faults.


def test_a_restart_counts_from_one(bench: Bench) -> None:
    for _ in range(3):
        client = bench.client()
        number = client.whole()["depth"].number
        assert number < 30
        while number < 35:
            number = client.set()["depth"].number
        client.stop()
        wait_until_idle(bench.camera)


def test_a_stalled_camera_is_listed_and_silent(bench: Bench) -> None:
    client = bench.client()
    before = client.whole()["depth"].number
    bench.camera.inject(freeze=True)
    assert client.silent(0.4)
    assert listed(bench.context) == [bench.camera.serial]
    bench.camera.inject(freeze=False)
    assert client.whole()["depth"].number > before + 3, "it continued to take frames"


def test_lost_frames_leave_gaps_in_the_numbers(bench: Bench) -> None:
    bench.camera.inject(drop=3)
    client = bench.client()
    numbers = [client.whole()["depth"].number for _ in range(12)]
    assert not any(number % 3 == 0 for number in numbers)


def test_one_stream_alone_may_lose_frames(bench: Bench) -> None:
    """How the library combines the rest (sets of two moments, or half as many) varies from run to run."""
    bench.camera.inject(drop=2, drop_stream="color")
    for stream, has_even in (("color", False), ("depth", True)):
        client = bench.client(stream)
        numbers = [client.set()[stream].number for _ in range(20)]
        assert any(number % 2 == 0 for number in numbers) is has_even
        client.stop()


def test_unplugging_is_announced_and_ends_the_pipeline_and_replugging_brings_it_back(bench: Bench) -> None:
    camera = bench.camera
    bench.watched = list(bench.context.query_devices())
    client = bench.client()
    client.whole()
    camera.unplug()
    assert bench.announced[1:] == [([], [True])]
    assert listed(bench.context) == []
    assert client.silent(0.3)
    camera.unplug()
    assert len(bench.announced) == 2, "unplug is idempotent"
    camera.replug()
    assert bench.announced[2:] == [([camera.serial], [False])]
    assert listed(bench.context) == [camera.serial]
    assert client.silent(0.5), "the old pipeline never recovers"
    client.stop()
    again = bench.client()
    found = again.whole()
    assert differing(camera, found, found["depth"].number) == []


def test_in_a_plain_context_an_unplugged_camera_cannot_be_found_by_its_number(make_bench) -> None:
    bench = make_bench(context=rs.context())
    client = Client(bench.context, bench.camera.serial)  # the bench would keep it
    client.whole()
    bench.camera.unplug()
    assert listed(bench.context) == [""], "the pipeline still holds it"
    client.stop()
    del client
    assert listed(bench.context) == []
    bench.camera.replug()
    assert listed(bench.context) == [bench.camera.serial]
    assert bench.announced[-1] == ([bench.camera.serial], [])


def test_unplugging_one_camera_does_not_affect_another(make_bench) -> None:
    context = emulated_context()
    one, other = (make_bench(replace(VGA, name=name), context, seed=7 * k) for k, name in enumerate(("left", "right")))
    clients = [bench.client() for bench in (one, other)]
    before = [client.whole()["depth"].number for client in clients]
    one.camera.unplug()
    assert listed(context) == [other.camera.serial]
    after = clients[1].whole()
    assert after["depth"].number > before[1]
    assert differing(other.camera, after, after["depth"].number) == []


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


@pytest.mark.parametrize("clock", ["hardware", "global", "system"])
def test_stamps_are_on_the_reported_clock(clock: str, make_bench) -> None:
    bench = make_bench(clock=clock)
    client = bench.client()
    client.whole()
    found = [client.set()["depth"] for _ in range(10)]
    domain = {"hardware": "hardware_clock", "global": "global_time", "system": "system_time"}[clock]
    assert {picture.domain for picture in found} == {domain}
    steps = np.diff([picture.stamp for picture in found]) / np.diff([picture.number for picture in found])
    if clock == "hardware":
        assert 1000.0 < found[0].stamp < 1060.0
        if not bench.camera.late:
            assert steps == pytest.approx(1 / 30, abs=1e-6)
    else:
        assert abs(time.time() - found[-1].stamp) < 5.0
        assert np.median(steps) == pytest.approx(1 / 30, abs=0.02)


def test_skew_stamps_color_later_than_depth(bench: Bench) -> None:
    bench.camera.inject(skew=0.004)
    client = bench.client()
    found = client.whole()
    assert found["color"].stamp - found["depth"].stamp == pytest.approx(0.004, abs=1e-6)
    assert found["infrared"].stamp == found["depth"].stamp


def test_color_numbers_may_be_ahead(make_bench) -> None:
    bench = make_bench(color_ahead=40)
    client = bench.client()
    found = [client.set() for _ in range(15)][-1]
    assert found["color"].number == found["depth"].number + 40
    assert differing(bench.camera, found, found["depth"].number) == []


def test_the_sensor_clock_wraps_after_32_bits_of_microseconds(make_bench) -> None:
    bench = make_bench(clock_at=2**32 * 1e-6 - 1.5)
    client = bench.client("depth")
    stamps = []
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline and (not stamps or stamps[-1] > 1000.0):
        stamps.append(client.set()["depth"].stamp)
    assert stamps[0] > 4290.0
    assert stamps[-1] < 2.0


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


def test_a_recording_plays_exactly(tmp_path: Path) -> None:
    path = tmp_path / "some.db3"
    write_recording(path, VGA, 40)
    reference = SoftwareCamera(VGA)
    numbers = []
    for found in played(path):
        (number,) = {picture.number for picture in found.values()}
        assert differing(reference, found, number) == []
        numbers.append(number)
    assert numbers == list(range(numbers[0], 41))
    assert numbers[0] <= 3
    reference.close()


def test_a_recording_has_the_calibration_and_its_own_rate(tmp_path: Path) -> None:
    path = tmp_path / "some.db3"
    write_recording(path, VGA, 31, pattern="scene")
    context = rs.context()
    device = context.load_device(str(path))
    assert device.get_info(rs.camera_info.name) == "Intel RealSense D435 (emulated)"
    assert device.get_duration().total_seconds() == pytest.approx(1.0, abs=0.01)
    assert device.first_depth_sensor().get_depth_scale() == pytest.approx(0.001)
    depth, color = (
        next(p for sensor in device.sensors for p in sensor.profiles if p.stream_type() == kind)
        for kind in (rs.stream.depth, rs.stream.color)
    )
    assert color.as_video_stream_profile().get_intrinsics().fx == pytest.approx(612.0)
    assert depth.get_extrinsics_to(color).translation == pytest.approx((0.015, 0.0, 0.0))
    began = time.monotonic()
    assert sum(1 for _ in played(path, paced=True)) > 10
    assert time.monotonic() - began > 0.9


def test_a_recording_without_metadata_mixes_frames(tmp_path: Path) -> None:
    path = tmp_path / "bare.db3"
    write_recording(path, VGA, 40, metadata=False)
    assert any(len({picture.number for picture in found.values()}) > 1 for found in played(path))


def test_a_recording_may_have_gaps_and_overwrites_no_file(tmp_path: Path) -> None:
    path = tmp_path / "gaps.db3"
    write_recording(path, replace(VGA, streams=("depth",)), 20, lost=(7, 8, 15))
    numbers = [found["depth"].number for found in played(path, streams=("depth",))]
    assert numbers == [n for n in range(numbers[0], 21) if n not in (7, 8, 15)]
    assert numbers[0] <= 3
    for name in ("gaps.db3", "other.bag"):
        with pytest.raises(CommandError):
            write_recording(tmp_path / name, VGA, 1)


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


@pytest.mark.parametrize("end", ["pass", "raise SystemExit(0)", "camera.unplug()", "camera.close()", "del camera"])
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
