"""An emulated RealSense through the unmodified library: images, calibration, stamps."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from hal.driver import CameraInfo
from hal.images import Cropping
from hal.specs import CameraSpec

from .realsense_bench import PATIENCE, opened, read_again, read_until_lost, sent, software

from hal_emulators.realsense import SoftwareCamera, read_number  # isort: skip  # needs the library

COLOR_FORMATS = ("rgb8", "bgr8", "rgba8", "bgra8", "yuyv", "uyvy")


@pytest.mark.parametrize("format", COLOR_FORMATS)
def test_color_is_rgb_in_every_format(format: str) -> None:
    camera = software("color", formats={"color": format})
    truth = software("color", formats={"color": "rgb8"})
    tolerance = 24 if format in ("yuyv", "uyvy") else 0  # two pixels share their colour there
    with opened(camera) as cam:
        assert cam.info.streams["color"].format == format
        for _ in range(5):
            frame = cam.read(timeout=PATIENCE)
            wanted = sent(truth, "color", read_number(frame.color))
            difference = np.abs(frame.color.astype(int) - wanted)
            assert np.percentile(difference[30:], 98) <= tolerance


def test_every_stream_is_exact_to_the_pixel() -> None:
    camera = software("color", "infrared", "infrared_right")
    depth_alone = software("depth")
    with opened(camera) as cam, opened(depth_alone) as deep:
        for _ in range(10):
            frame = cam.read(timeout=PATIENCE)
            number = read_number(frame.color)
            for stream, image in (
                ("color", frame.color),
                ("infrared", frame.infrared),
                ("infrared_right", frame.infrared_right),
            ):
                assert np.array_equal(image, sent(camera, stream, number)), stream
            frame = deep.read(timeout=PATIENCE)
            raw = sent(depth_alone, "depth", read_number(frame.depth))
            assert frame.depth.dtype == np.float32
            assert np.allclose(frame.depth, raw * 0.001, atol=1e-6)
            assert (frame.depth[raw == 0] == 0.0).all()


def test_depth_outside_the_range_is_zero() -> None:
    camera = software("depth")
    near, far = 0.5995, 1.0505  # of 0.5 to 1.5 m
    with opened(replace(camera, depth_min=near, depth_max=far)) as cam:
        frame = cam.read(timeout=PATIENCE)
    truth = sent(camera, "depth", read_number(frame.depth)) * 0.001
    too_near, too_far = (truth > 0.0) & (truth < near), truth > far
    assert too_near.any()
    assert too_far.any()
    assert np.allclose(frame.depth, np.where(too_near | too_far, 0.0, truth), atol=1e-6)


@pytest.mark.parametrize("align", ["color", "depth"])
def test_aligned_images_show_the_scene(align: str) -> None:
    camera = software(emulated={"pattern": "scene"}, align=align)
    truth = SoftwareCamera(camera, pattern="scene")
    try:
        with opened(camera) as cam:
            frame = cam.read(timeout=PATIENCE)
            info = cam.info
            if align == "color":
                number = read_number(frame.color)
                exact = truth.truth(number, "color")
                seen = (frame.depth > 0.0) & (exact > 0.0)
                assert seen.mean() > 0.5
                assert np.percentile(np.abs(frame.depth - exact)[seen], 95) <= 0.005
                assert np.array_equal(info.K, info.streams["color"].K)
            else:
                number = read_number(frame.depth)
                assert np.allclose(frame.depth, sent(camera, "depth", number, "scene") * 0.001, atol=1e-6)
                assert np.array_equal(info.K, info.streams["depth"].K)
                warped = _colors_seen_from_depth(sent(camera, "color", number, "scene"), frame.depth, info)
                both = warped.any(axis=2) & frame.color.any(axis=2)
                assert both.mean() > 0.3
                difference = np.abs(warped.astype(int) - frame.color).max(axis=2)[both]
                assert np.percentile(difference, 90) <= 8
            assert frame.skew == 0.0
    finally:
        truth.close()


def _colors_seen_from_depth(colors: np.ndarray, depth: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Return each depth pixel's colour by the reported calibration, without the library."""
    v, u = np.indices(depth.shape)
    K, lens = info.streams["depth"].K, info.streams["color"].K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(depth)], axis=-1)
    points = info.streams["depth"].T_color_stream.transform((rays * depth[..., None]).reshape(-1, 3))
    points = points.reshape(*depth.shape, 3)
    z = np.where(points[..., 2] > 0.0, points[..., 2], 1.0)
    columns = np.round(points[..., 0] / z * lens[0, 0] + lens[0, 2]).astype(int)
    rows = np.round(points[..., 1] / z * lens[1, 1] + lens[1, 2]).astype(int)
    inside = (depth > 0) & (columns >= 0) & (rows >= 0) & (columns < colors.shape[1]) & (rows < colors.shape[0])
    found = np.zeros((*depth.shape, 3), np.uint8)
    found[inside] = colors[rows[inside], columns[inside]]
    return found


def test_output_is_the_scaled_middle_with_its_K() -> None:
    camera = software("color", "depth", "infrared", output=(256, 256))
    with opened(camera) as cam:
        frame, info = cam.read(timeout=PATIENCE), cam.info
        assert frame.color.shape == (256, 256, 3)
        assert frame.depth.shape == frame.infrared.shape == (256, 256)
        number = read_number(frame.color)
        crop = Cropping(*camera_size(camera), 256, 256)
        assert np.array_equal(frame.color, crop.color(sent(camera, "color", number)))
        assert np.array_equal(frame.infrared, crop.color(sent(camera, "infrared", number)))
        assert np.allclose(info.K, crop.matrix(info.streams["color"].K))
        assert np.allclose(info.K_infrared, crop.matrix(info.streams["infrared"].K))
        assert np.array_equal(frame.K, info.K)


def camera_size(camera: CameraSpec) -> tuple[int, int]:
    return camera.capture_width, camera.capture_height


def test_info_describes_the_camera() -> None:
    with opened(software(emulated={"serial": "012345678901", "usb": "2.1"})) as cam:
        info = cam.info
        assert (info.serial, info.usb, info.firmware) == ("012345678901", "2.1", "5.16.0.1")
        assert info.depth_scale == pytest.approx(0.001)
        assert np.allclose(info.streams["depth"].T_color_stream.position, [0.015, 0.0, 0.0], atol=1e-6)
        assert info.options["color.white_balance"] == 4600.0


@pytest.mark.parametrize("clock", ["hardware", "global", "system"])
def test_stamps_are_times_of_capture_and_never_in_the_future(clock: str) -> None:
    camera = software(emulated={"clock": clock, "clock_at": 4294.0, "drift_ppm": 50.0})  # wraps after a second
    with opened(camera) as cam:
        assert cam.info.clock == clock
        frames = [cam.read(timeout=PATIENCE)]
        while frames[-1].stamp.t < frames[0].stamp.t + 2.5:
            frames.append(cam.read(timeout=PATIENCE))
            assert frames[-1].stamp.t <= time.monotonic()
        t = np.array([frame.stamp.t for frame in frames])
        t_device = np.array([frame.stamp.t_device for frame in frames])
        assert (np.diff(t) > 0.0).all()
        assert (np.diff(t_device) > 0.0).all(), "the counter's wrap does not show"
        # However late a frame arrives, its time is that of its stamp, by the best guess so far.
        apart = t - t_device
        assert np.percentile(np.abs(apart - np.median(apart)), 80) < 0.01


def test_gaps_in_the_numbers_are_lost_frames() -> None:
    with opened(software()) as cam:
        cam.read(timeout=PATIENCE)
        cam.inject(drop=3)
        frames = [cam.read(timeout=PATIENCE) for _ in range(20)]
        numbers = [read_number(frame.color) for frame in frames]
        seqs = [frame.stamp.seq for frame in frames]
        assert np.array_equal(np.diff(numbers), np.diff(seqs))
        assert all(number % 3 for number in numbers[2:])
        assert cam.counts().dropped >= 5


def test_frames_of_two_moments_are_not_handed_out() -> None:
    with opened(software(stall_s=2.0)) as cam:
        assert cam.read(timeout=PATIENCE).skew == 0.0
        cam.inject(skew=0.01)
        time.sleep(0.1)
        assert cam.read(timeout=PATIENCE, after=time.monotonic()).skew == pytest.approx(0.01, abs=1e-6)
        before = cam.counts().mismatched
        cam.inject(drop=2, drop_stream="color")
        numbers = {read_number(cam.read(timeout=PATIENCE).color) % 2 for _ in range(15)}
        assert numbers == {1} or len(numbers) == 2  # one may have been on its way
        assert cam.counts().mismatched > before


def test_two_cameras_at_once() -> None:
    with opened(software(name="left")) as left, opened(software(name="right")) as right:
        assert left.info.serial != right.info.serial
        for _ in range(5):
            for cam in (left, right):
                frame = cam.read(timeout=PATIENCE)
                assert np.array_equal(frame.color, sent(cam.spec, "color", read_number(frame.color)))
        left.inject(disconnect=True)
        assert read_until_lost(left).code == "unplugged"
        assert right.read(timeout=PATIENCE).stamp.t > time.monotonic() - 1.0


def test_frames_without_metadata_are_matched_by_arrival_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    """As from a stock kernel: stamps are times of arrival, and colour arrives 25 ms after depth."""
    with opened(software(emulated={"clock": "system", "metadata": False})) as cam:
        cam.inject(skew=0.025)
        cam.read(timeout=PATIENCE, after=time.monotonic())
        before = cam.counts().mismatched
        frames = [cam.read(timeout=PATIENCE) for _ in range(30)]
        assert all(frame.skew is None for frame in frames)
        assert cam.counts().mismatched - before < 10
        cam.inject(disconnect=True)
        read_until_lost(cam)
        cam.inject(disconnect=False)
        read_again(cam)
    assert sum("carry no metadata" in record.message for record in caplog.records) == 1
