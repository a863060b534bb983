"""Which webcam is chosen, in which mode, and what its frames carry, on cameras in memory."""

from __future__ import annotations

import ctypes
import errno
import itertools
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("av", reason="needs PyAV: pip install 'robot-hal[record]'")

import av
from PIL import Image
from webcam_kit import AUTOGAIN, BRIGHTNESS, GAIN, FakeWebcam, grey, webcams, write_video

from hal import registry
from hal.camera import Camera
from hal.clock import RealClock
from hal.config import load
from hal.driver import RawFrame
from hal.drivers.webcam import kernel
from hal.drivers.webcam.capture import V4l2Camera
from hal.drivers.webcam.pictures import PictureDecoder, PictureOutput
from hal.drivers.webcam.preflight import check_v4l2
from hal.drivers.webcam.video import VideoCamera
from hal.errors import ConfigError, ConnectionLost, ControlTaken, DeviceNotFound, NotSupported
from hal.images import distort_points
from hal.testing import camera_spec


@pytest.fixture
def webcam(tmp_path: Path) -> Iterator[FakeWebcam]:
    with webcams(tmp_path) as (camera,):
        yield camera


def driver(**changes: Any) -> V4l2Camera:
    options = {name: changes.pop(name) for name in list(changes) if name not in ("width", "height", "rate_hz")}
    return V4l2Camera(camera_spec(driver="v4l2", streams=("color",), options=options, **changes))


def take(camera: V4l2Camera, count: int = 1) -> list[RawFrame]:
    frames = [camera.grab(2.0) for _ in range(count)]
    assert None not in frames
    return frames


def test_records_have_the_kernels_sizes() -> None:
    """Of linux/videodev2.h on 64 bits; they are a part of every request's number."""
    sizes = {kernel.Capability: 104, kernel.FormatDescription: 64, kernel.Format: 208, kernel.Buffer: 88}
    sizes |= {kernel.FrameSize: 44, kernel.FrameInterval: 52, kernel.StreamParameters: 204}
    sizes |= {kernel.BufferRequest: 20, kernel.Control: 8, kernel.ControlDescription: 68}
    assert {record: ctypes.sizeof(record) for record in sizes} == sizes
    assert (kernel.DEQUEUE, kernel.SET_FORMAT) == (0xC0585611, 0xC0D05605)


def test_a_frame_has_the_kernels_stamp_and_number_whenever_it_is_read(webcam: FakeWebcam) -> None:
    camera = Camera(driver(rate_hz=60.0), RealClock(), threaded=False)
    camera.open()
    frames = []
    for k in range(12):
        if k == 6:
            time.sleep(0.2)  # longer than its buffers last: frames are lost
        frames.append(camera.read())
    node = webcam.streaming
    assert node is not None
    for frame in frames:
        assert frame.stamp.t == pytest.approx(node.start + frame.stamp.seq / 60.0, abs=2e-6)
        assert abs(int(frame.color[20, 30, 1]) - grey(frame.stamp.seq)) <= 3
    gaps = frames[-1].stamp.seq - frames[0].stamp.seq + 1 - len(frames)
    assert camera.counts().dropped == gaps > 5
    camera.close()


def test_a_damaged_frame_is_a_gap(webcam: FakeWebcam) -> None:
    camera = driver(rate_hz=60.0)
    webcam.damaged = {3, 4}
    camera.open()
    numbers = [frame.seq for frame in take(camera, 5)]
    assert not {3, 4} & set(numbers)
    assert numbers[-1] >= 6


def test_frames_that_come_faster_than_they_are_decoded_are_skipped(
    webcam: FakeWebcam, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded, finished = [], []
    decode, finish = PictureDecoder.decode, PictureOutput.finish

    def decode_slowly(self: PictureDecoder, data: bytes) -> Any:
        decoded.append(data)
        assert len(decoded) < 40
        time.sleep(0.01)
        return decode(self, data)

    monkeypatch.setattr(PictureDecoder, "decode", decode_slowly)
    monkeypatch.setattr(PictureOutput, "finish", lambda *given: finished.append(given) or finish(*given))
    camera = driver(rate_hz=120.0)  # H.264, whose skipped frames are decoded, too
    camera.open()
    frames = take(camera, 4)
    camera.close()
    assert all(abs(int(frame.color[20, 30, 1]) - grey(frame.seq)) <= 4 for frame in frames)
    assert len(decoded) > len(finished) == 4


def test_a_camera_that_sends_only_damaged_frames_faster_than_they_are_read_ends_the_wait(
    webcam: FakeWebcam, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []

    def fail_slowly(*given: Any) -> Any:
        tries.append(given)
        assert len(tries) < 100
        time.sleep(0.02)
        raise ValueError("not an image")

    monkeypatch.setattr(PictureDecoder, "decode", fail_slowly)
    camera = driver(rate_hz=60.0)
    camera.open()
    assert camera.grab(0.1) is None
    camera.close()


def test_alike_cameras_are_told_apart_by_serial_or_port(tmp_path: Path) -> None:
    alike = [{"serial": "A1", "port": "1-1"}, {"port": "1-2"}, {"port": "1-3"}, {"name": "Other Cam", "port": "1-4"}]
    with webcams(tmp_path, *alike) as cameras:
        for changes, number in (({"serial": "A1"}, 0), ({"port": "1-3"}, 2), ({"name": "other"}, 3)):
            camera = driver(**changes)
            camera.open()
            assert cameras[number].streaming is not None
            with pytest.raises(ControlTaken):
                driver(**changes).open()
            camera.close()
        for changes in ({"name": "HD"}, {}, {"serial": "B"}, {"device": "/dev/video9"}):
            with pytest.raises(DeviceNotFound) as caught:
                driver(**changes).open()
            assert 'serial "A1", port 1-1, /dev/video0' in str(caught.value)
            assert (caught.value.code == "several_devices") == (changes in ({"name": "HD"}, {}))
            assert "select one" in str(caught.value), "the remedy"
        cameras[1].refused = errno.EACCES
        with pytest.raises(DeviceNotFound, match="usermod -aG video"):
            driver(device="/dev/video1").open()


def test_a_camera_comes_back_under_another_number(webcam: FakeWebcam) -> None:
    camera = driver(port="1-2")
    camera.open()
    take(camera)
    webcam.unplug()
    with pytest.raises(ConnectionLost) as caught:
        take(camera, 100)
    assert caught.value.code == "unplugged"
    webcam.renumber(7)
    webcam.plug()
    camera.open()
    take(camera)
    camera.close()


def test_another_camera_in_its_place_is_refused(tmp_path: Path) -> None:
    with webcams(tmp_path, {"serial": "A1", "port": "1-1"}, {"serial": "B2", "port": "1-2"}) as (first, other):
        other.unplug()
        camera = driver()
        camera.open()
        first.unplug()
        other.plug()
        with pytest.raises(DeviceNotFound, match='was HD Webcam, A1; now there is HD Webcam, serial "B2"') as caught:
            camera.open()
        assert caught.value.code == "other_device"
        other.unplug()
        first.plug()
        camera.open()
        take(camera)
        camera.close()


@pytest.mark.parametrize("offset", [-20.0, 0.5, 1.7e9])
def test_stamps_of_another_clock_are_replaced(
    webcam: FakeWebcam, caplog: pytest.LogCaptureFixture, offset: float
) -> None:
    webcam.clock_offset = offset
    camera = driver(rate_hz=60.0)
    camera.open()
    before = time.monotonic()
    frames = take(camera, 3)
    assert all(before <= frame.t == frame.t_device <= time.monotonic() for frame in frames)
    assert len(caplog.records) == 1
    camera.close()


def test_the_mode_is_one_that_the_camera_has(webcam: FakeWebcam) -> None:
    for rate, codec in ((60.0, b"YUYV"), (90.0, b"MJPG")):
        camera = driver(rate_hz=rate)
        camera.open()
        assert webcam.streaming is not None
        assert webcam.streaming.format[0].to_bytes(4, "little") == codec
        camera.close()
    for changes in ({"rate_hz": 45.0}, {"width": 60}, {"width": 128, "height": 96, "rate_hz": 60.0}):
        with pytest.raises(NotSupported) as caught:
            driver(**changes).open()
        assert "yuyv: 64x48 at 30/60 Hz" in str(caught.value)
        assert "mjpeg: 64x48 at 30/60/90 Hz, 128x96 at 30 Hz" in str(caught.value)


def test_the_list_has_what_a_rig_file_needs(webcam: FakeWebcam) -> None:
    (text,) = V4l2Camera.list_plugged()
    assert text.splitlines()[0] == "HD Webcam, no serial, port 1-2, /dev/video0"
    assert "yuyv: 64x48 at 30/60 Hz" in text
    for webcam.refused, why in ((errno.EACCES, "usermod"), (errno.EIO, "/dev/video0: Input/output error")):
        (text,) = V4l2Camera.list_plugged()
        assert why in text
    webcam.refused = errno.ENXIO  # unplugged in this moment
    assert V4l2Camera.list_plugged() == ()


def test_fixed_exposure_and_focus_switch_the_automatic_ones_off(webcam: FakeWebcam) -> None:
    camera = driver(exposure_s=0.005, focus=30, options={"brightness": -5, "gain": 20})
    camera.open()
    wanted = {kernel.EXPOSURE: 50, kernel.EXPOSURE_AUTO: 1, kernel.FOCUS: 30, kernel.FOCUS_AUTO: 0}
    wanted |= {BRIGHTNESS: -5, GAIN: 20, AUTOGAIN: 0}
    assert webcam.values == wanted
    assert camera.info.options["exposure_time_absolute"] == 50
    camera.close()
    for options, code in (({"brightnes": 1}, "unknown_option"), ({"brightness": 100}, "out_of_range")):
        with pytest.raises(NotSupported) as caught:
            driver(options=options).open()
        assert caught.value.code == code
        assert "-64 to 64" in str(caught.value)


def test_the_preflight_counts_frames(webcam: FakeWebcam) -> None:
    spec = driver(rate_hz=60.0).spec
    assert [result.level for result in check_v4l2(spec, 0.3)] == ["ok", "ok"]
    webcam.damaged = set(itertools.islice(itertools.count(3, 4), 100))
    frames = list(check_v4l2(spec, 0.3))[1]
    assert frames.level == "warn"
    assert "USB port" in frames.remedy
    webcam.unplug()
    assert [result.level for result in check_v4l2(spec, 0.3)] == ["fail"]


def test_the_preflight_of_a_video_plays_it(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mkv", 10, rate=60)
    for name, names, failed in (("v.mkv", ["camera", "frames"], False), ("other.mkv", ["camera"], True)):
        spec = camera_spec(driver="video", streams=("color",), rate_hz=60.0, options={"file": str(tmp_path / name)})
        check = registry.function("video", registry.driver("video").camera_preflight)
        assert check is not None
        found = list(check(spec, 0.2))
        assert [result.name for result in found] == names
        assert any(result.level == "fail" for result in found) == failed  # on a busy computer, frames may be lost


@pytest.mark.parametrize("codec", ["mjpeg", "libx264"])
def test_each_compressed_frame_is_decoded_at_once(codec: str) -> None:
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.framerate = 64, 48, 30
    context.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    context.options = {} if codec == "mjpeg" else {"tune": "zerolatency"}
    decoder = PictureDecoder("mjpeg" if codec == "mjpeg" else "h264", 64, 48)
    for value in (20, 90, 160, 230):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), value, np.uint8), format="rgb24")
        (packet,) = context.encode(frame)
        assert np.abs(decoder.decode(bytes(packet)).astype(int) - value).max() <= 3
    if codec == "mjpeg":
        with pytest.raises(ValueError, match="cut off"):
            decoder.decode(bytes(packet)[:-20])


def make_jpeg(width: int, height: int) -> bytes:
    file = BytesIO()
    values = np.random.default_rng(0).integers(0, 255, (height // 8, width // 8, 3), np.uint8)
    Image.fromarray(values).resize((width, height)).save(file, "JPEG")
    return file.getvalue()


def test_a_jpeg_that_is_damaged_in_the_middle_is_refused() -> None:
    decoder, good = PictureDecoder("mjpeg", 640, 480), make_jpeg(640, 480)
    part = len(good) // 3
    for middle in (b"", bytes(part)):
        decoder.decode(good + bytes(64))
        with pytest.raises(ValueError, match="frame"):
            decoder.decode(good[:part] + middle + good[2 * part :])
    at = good.index(b"\xff\xc4")
    while good[at : at + 2] == b"\xff\xc4":  # many cameras leave out the usual Huffman tables
        good = good[:at] + good[at + 2 + int.from_bytes(good[at + 2 : at + 4], "big") :]
    decoder.decode(good)


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        ("sizes.mjpeg", make_jpeg(64, 48) + make_jpeg(128, 96), "128x96 now, not 64x48"),
        ("raw.h264", None, "its frames have no times"),
    ],
)
def test_a_video_that_cannot_be_played_says_why(tmp_path: Path, name: str, data: bytes | None, why: str) -> None:
    if data is None:
        context = av.CodecContext.create("libx264", "w")
        context.width, context.height, context.framerate, context.pix_fmt = 64, 48, 25, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
        data = b"".join(map(bytes, [*context.encode(frame), *context.encode()]))
    (tmp_path / name).write_bytes(data)
    options = {"file": str(tmp_path / name)}
    camera = VideoCamera(camera_spec(driver="video", streams=("color",), rate_hz=25.0, options=options))
    camera.open()
    with pytest.raises(ConnectionLost, match=why) as caught:
        take(camera, 3)
    assert isinstance(caught.value.__cause__, ValueError)
    camera.close()


def test_colours_have_the_cameras_range_and_matrix() -> None:
    red = bytes([81, 90, 81, 240]) * (32 * 48)  # in BT.601, limited to 16..235
    assert np.abs(PictureDecoder("yuyv", 64, 48).decode(red)[0, 0].astype(int) - (255, 0, 0)).max() <= 4
    assert np.abs(PictureDecoder("yuyv", 64, 48, "ITU709").decode(red)[0, 0].astype(int) - (255, 0, 0)).max() > 10
    full = PictureDecoder("yuyv", 64, 48, full=True).decode(bytes([200, 128] * 64 * 48))
    assert np.abs(full.astype(int) - 200).max() <= 2
    with pytest.raises(ValueError, match="bytes"):
        PictureDecoder("yuyv", 64, 48).decode(red[:-4])


# The rig file.

INTRINSICS = {"width": 640, "height": 480, "fx": 600.0, "fy": 602.0, "cx": 310.0, "cy": 250.0}
LENS = [-0.3, 0.1, 0.001, -0.002, 0.0]


def rig(sim: bool = False, **camera: Any) -> Any:
    entry = {"model": "webcam", "pose": [0, 0, 1, 1, 0, 0, 0], "intrinsics": INTRINSICS | {"distortion": LENS}} | camera
    return load({"sim": sim, "cameras": {"cam": entry}}).resolve().cameras[0]


def test_intrinsics_of_the_rig_file_are_those_of_the_frames() -> None:
    real = rig(output={"width": 240, "height": 240})  # the middle 480x480, halved
    assert np.allclose(real.K, [[300.0, 0.0, (310 - 80 + 0.5) / 2 - 0.5], [0.0, 301.0, 250.5 / 2 - 0.5], [0, 0, 1]])
    assert real.distortion == tuple(LENS)
    assert real.driver == "v4l2"
    simulated = rig(sim=True)
    assert simulated.K[0] == (600.0, 0.0, 310.0)
    assert not any(simulated.distortion)


@pytest.mark.parametrize(
    ("camera", "key"),
    [
        ({"capture": {"width": 1280, "height": 720, "rate_hz": 30}}, "intrinsics"),
        ({"model": "realsense_d435"}, "intrinsics"),
        ({"real": {"undistort": True}, "intrinsics": INTRINSICS}, "real.undistort"),
        ({"real": {"exposure_s": 500}}, "real.exposure_s"),
        ({"streams": {"color": {"format": "z16"}}}, "streams.color.format"),
        ({"drivers": {"real": "video"}}, "real"),
        ({"drivers": {"real": "video"}, "real": {"file": "no.mp4"}}, "real.file"),
    ],
)
def test_mistakes_are_named_by_their_key(camera: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        rig(**camera)
    assert [problem.key for problem in caught.value.problems] == [f"cameras.cam.{key}"]


def test_undistorted_images_show_what_a_camera_without_distortion_sees() -> None:
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'robot-hal[calibration]'")
    spec = rig(real={"undistort": True}, output={"width": 320, "height": 240})
    K = np.array(spec.sensors["color"].K)
    ideal = np.array([[-0.35, 0.2], [0.3, -0.25], [0.0, 0.3]])
    image = np.zeros((480, 640, 3), np.uint8)
    for x, y in distort_points(ideal, LENS) @ K[:2, :2].T + K[:2, 2]:
        cv2.circle(image, (round(16 * x), round(16 * y)), 16 * 6, (255, 255, 255), -1, cv2.LINE_AA, 4)
    output = PictureOutput(spec, True)
    seen = output.finish(image)[..., 0]
    _, _, _, middles = cv2.connectedComponentsWithStats((seen > 127).astype(np.uint8))
    K = np.array(spec.K)
    wanted = ideal @ K[:2, :2].T + K[:2, 2]
    for middle in wanted:
        assert np.linalg.norm(middles[1:] - middle, axis=1).min() < 0.6
    assert not output.describe(V4l2Camera(spec).info).distortion.any()
