"""The contract of a CameraDriver: what the public Camera and its users rely on."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest

from ..camera import Camera
from ..driver import RawFrame
from ..errors import CommandError, ConnectionLost, HalError, NotSupported, StaleStateError
from ..types import STREAMS, Frame
from .benches import CameraBench, Contract, needs, run_in_thread, wait_lost, wait_restored

_FIRST = 10.0
"""s for the first frame after ``open``, on a busy machine."""
_WAIT = 0.2
"""s; a time-out that the checks try."""
_SLACK = 2.0
"""s that a call may exceed its time-out, on a busy machine."""
_UNDER_WAY = 20
"""Frames that may be under way when the device goes silent."""
_READ = 15.0
"""s within which ``read`` must return a frame, on a busy machine."""
_APP_WAIT = 0.3
"""s; a time-out of ``read`` that the checks try."""
_CLOCKS = ("hardware", "global", "system", "kernel", "video", "simulated")


def _images(frame: RawFrame) -> dict[str, np.ndarray]:
    """Return the images that a frame has, by stream."""
    found = {stream: getattr(frame, stream) for stream in STREAMS}
    return {stream: image for stream, image in found.items() if image is not None}


def _grab(bench: CameraBench) -> RawFrame:
    deadline = time.monotonic() + _FIRST
    while True:
        if not bench.real_time:
            bench.pass_time()
        frame = bench.driver.grab(1.0)
        if frame is not None:
            return frame
        assert time.monotonic() < deadline, f"no frame within {_FIRST:g} s: grab gives every new frame once"


def _check_matrix(K: np.ndarray, width: int, height: int, name: str) -> None:
    """Fail if K cannot be the camera matrix of an image of that size."""
    assert np.shape(K) == (3, 3), f"{name} is a (3, 3) matrix"
    assert np.isfinite(K).all(), f"{name} is finite"
    assert min(K[0][0], K[1][1]) > 0.0, f"{name} has focal lengths, pixels"
    assert 0.0 < K[0][2] < width, f"{name}: the principal point is inside the image"
    assert 0.0 < K[1][2] < height, f"{name}: the principal point is inside the image"
    assert tuple(K[2]) == (0.0, 0.0, 1.0), f"{name}: the last row is 0, 0, 1"


class _ListeningCamera:
    """The public camera in front of a bench's driver, and the calls of its ``on_connection`` callback."""

    def __init__(self, bench: CameraBench) -> None:
        self.bench = bench
        self.camera = Camera(bench.driver, bench.clock, threaded=bench.real_time)
        self.news: list[ConnectionLost | None] = []
        self.camera.on_connection(self.news.append)

    def read(self, limit: float = _READ) -> Frame:
        if not self.bench.real_time:
            self.bench.pass_time()
        return self.camera.read(limit)

    def wait_news(self, times: int) -> ConnectionLost | None:
        """Wait for a call of the callback, which may be a moment after ``read`` raised, and return its argument."""
        deadline = time.monotonic() + _SLACK
        while len(self.news) < times:
            assert time.monotonic() < deadline, f"on_connection was called {len(self.news)} times, not {times}"
            time.sleep(0.005)
        return self.news[times - 1]


class CameraContract(Contract):
    """Checks of a camera's driver. The bench is a :class:`~hal.testing.CameraBench`.

    ``left_out`` may name ``lose``, ``restore`` and ``freeze``.
    """

    abilities = ("lose", "restore", "freeze")

    # Frames.

    def test_frames_have_the_streams_size_and_units_of_the_spec(self, bench: CameraBench) -> None:
        bench.driver.open()
        spec, frame = bench.driver.spec, _grab(bench)
        found = _images(frame)
        assert set(found) == set(spec.streams), "a frame has the streams of its spec, and None for all others"
        for stream, image in found.items():
            kind = STREAMS[stream]
            shape, dtype = (spec.height, spec.width, *kind.shape), np.dtype(kind.dtype)
            assert (image.shape, image.dtype) == (shape, dtype), f"{stream}: must be {shape} of {dtype.name}"
            assert image.min() >= kind.lowest, f"{stream}: a value is at least {kind.lowest}"
            assert kind.highest is None or image.max() <= kind.highest, f"{stream}: a value is at most {kind.highest}"
        if frame.depth is not None:
            assert np.isfinite(frame.depth).all(), "depth is 0 without a measurement, never NaN"
            measured = frame.depth[frame.depth != 0.0]
            assert measured.size, "the camera measures something"
            assert (measured >= spec.depth_min).all(), "depth is in metres; below depth_min it is 0"
            assert (measured <= spec.depth_max).all(), "depth is in metres; above depth_max it is 0"
        assert frame.skew is None or {"color", "depth"} <= set(found), "skew is the time from depth to colour"

    def test_frames_are_new_and_stamped(self, bench: CameraBench) -> None:
        bench.driver.open()
        frames = []
        for _ in range(8):
            frames.append(_grab(bench))
            assert frames[-1].t <= bench.clock.now() + 1e-3, (
                "t is the time of capture on the host's clock, and not ahead of it"
            )
            if bench.paced:
                assert bench.clock.now() - frames[-1].t < _SLACK, (
                    "t is the time of capture on the host's monotonic clock"
                )
        for before, after in itertools.pairwise(frames):
            assert after.seq > before.seq, "seq counts captures: each frame is handed out once, and in order"
            assert after.t > before.t
            assert after.t_device > before.t_device, "t_device is the camera's own clock, and must advance"
        if bench.paced:
            period = (frames[-1].t_device - frames[0].t_device) / (frames[-1].seq - frames[0].seq)
            share = period * bench.driver.spec.rate_hz
            assert 0.5 < share < 2.0, f"t_device (in s) and seq give {1 / period:.1f} frames per second"

    def test_a_returned_frame_is_never_written_to_again(self, bench: CameraBench) -> None:
        bench.driver.open()
        frame = _grab(bench)
        kept = {stream: image.copy() for stream, image in _images(frame).items()}
        later = [_grab(bench) for _ in range(5)]
        for stream, image in _images(frame).items():
            assert np.array_equal(image, kept[stream]), f"{stream} of an old frame changed: return copies"
            for other in later:
                assert not np.shares_memory(image, _images(other)[stream]), f"two frames share their {stream}"

    def test_info_describes_the_camera(self, bench: CameraBench) -> None:
        bench.driver.open()
        info, spec = bench.driver.info, bench.driver.spec
        assert info.title, "title: make and model"
        assert info.clock in _CLOCKS, f"clock names the clock of t_device: one of {', '.join(_CLOCKS)}"
        assert info.depth_scale is None or info.depth_scale > 0.0, "depth_scale: metres in one unit"
        _check_matrix(info.K, spec.width, spec.height, "K")
        infrared = [name for name in spec.streams if STREAMS[name].unaligned]
        assert info.K_infrared is not None or not infrared, "K_infrared: required with infrared"
        if info.K_infrared is not None:
            _check_matrix(info.K_infrared, spec.width, spec.height, "K_infrared")
        assert np.shape(info.distortion) == (5,), "distortion: k1, k2, p1, p2, k3"
        for name, stream in info.streams.items():
            assert min(stream.width, stream.height, stream.rate_hz) > 0, f"streams[{name!r}] has a size and a rate"
            _check_matrix(stream.K, stream.width, stream.height, f"streams[{name!r}].K")
            assert np.shape(stream.distortion) == (5,)
            assert np.linalg.norm(stream.T_color_stream.position) < 1.0, "T_color_stream is in metres"

    # Waiting.

    def test_grab_returns_as_soon_as_there_is_a_frame(self, bench: CameraBench) -> None:
        bench.driver.open()
        _grab(bench)
        patience = 30.0
        began = time.monotonic()
        for _ in range(3):
            if not bench.real_time:
                bench.pass_time()
            bench.driver.grab(patience)
        took = time.monotonic() - began
        assert took < patience, f"three frames took {took:.1f} s: return each as soon as it has arrived"

    @needs("freeze")
    def test_without_a_frame_grab_returns_in_time(self, bench: CameraBench) -> None:
        bench.driver.open()
        _grab(bench)
        bench.freeze()
        for _ in range(_UNDER_WAY):
            if bench.driver.grab(0.0) is None:
                break
        began = time.monotonic()
        try:
            frame = bench.driver.grab(_WAIT)
        except ConnectionLost:
            frame = None  # so silent that it must be opened again
        took = time.monotonic() - began
        assert frame is None, "without a new frame grab returns None, never an old one again"
        assert took < _WAIT + _SLACK, f"grab({_WAIT:g}) took {took:.1f} s"

    # Threads, and closing.

    def test_another_thread_may_grab_and_close(self, bench: CameraBench) -> None:
        bench.driver.open()
        run_in_thread(lambda: _grab(bench))
        run_in_thread(lambda: _grab(bench))
        run_in_thread(bench.driver.close)

    def test_close_may_be_repeated_and_followed_by_open(self, bench: CameraBench) -> None:
        bench.driver.close()
        bench.driver.open()
        _grab(bench)
        bench.driver.close()
        bench.driver.close()
        bench.driver.open()
        _grab(bench)

    def test_a_driver_that_is_not_open_raises(self, bench: CameraBench) -> None:
        for _ in range(2):
            with pytest.raises(HalError):
                bench.driver.grab(0.0)
            bench.driver.open()
            bench.driver.close()

    # Lost links.

    @needs("lose")
    def test_a_lost_link_raises_except_at_close(self, bench: CameraBench) -> None:
        bench.driver.open()
        _grab(bench)
        bench.lose()
        wait_lost(bench, lambda: bench.driver.grab(_WAIT))
        began = time.monotonic()
        bench.driver.close()
        bench.driver.close()
        assert time.monotonic() - began < 10.0, "close is bounded in time whatever the device does"

    @needs("lose", "restore")
    def test_a_restored_camera_can_be_opened_again(self, bench: CameraBench) -> None:
        bench.driver.open()
        _grab(bench)
        bench.lose()
        wait_lost(bench, lambda: bench.driver.grab(_WAIT))
        bench.driver.close()
        bench.restore()
        wait_restored(bench, bench.driver.open)
        first, second = _grab(bench), _grab(bench)
        assert second.seq > first.seq

    @needs("lose")
    def test_a_lost_camera_cannot_be_opened(self, bench: CameraBench) -> None:
        bench.driver.open()
        _grab(bench)
        bench.lose()
        wait_lost(bench, lambda: bench.driver.grab(_WAIT))
        bench.driver.close()
        began = time.monotonic()
        try:
            bench.driver.open()
        except HalError:
            pass
        except Exception as error:
            pytest.fail(f"a device that does not answer must raise hal.errors.ConnectionLost, not {error!r}")
        else:
            wait_lost(bench, lambda: bench.driver.grab(_WAIT))  # at the latest when a frame is requested
        assert time.monotonic() - began < 20.0, "open is bounded: it must raise after some seconds"
        bench.driver.close()

    def test_an_unknown_fault_to_inject_is_refused(self, bench: CameraBench) -> None:
        bench.driver.open()
        with pytest.raises((CommandError, NotSupported)):
            bench.driver.inject(no_such_fault=True)

    # Behind the public Camera.

    @pytest.fixture
    def app(self, bench: CameraBench) -> Iterator[_ListeningCamera]:
        """The public camera, open."""
        app = _ListeningCamera(bench)
        app.camera.open()
        yield app
        app.camera.close()

    def test_an_app_reads_frames(self, bench: CameraBench, app: _ListeningCamera) -> None:
        first, second = app.read(), app.read()
        assert second.stamp.seq > first.stamp.seq
        for name in bench.driver.spec.streams:
            assert not getattr(second, name).flags.writeable
        assert app.camera.connected
        assert app.camera.read_latest(_READ).stamp.seq >= second.stamp.seq
        began = time.monotonic()
        app.camera.close()
        app.camera.close()
        assert time.monotonic() - began < 10.0, "close is bounded in time"

    @needs("freeze")
    def test_an_app_notices_a_frozen_camera(self, bench: CameraBench, app: _ListeningCamera) -> None:
        app.read()
        bench.freeze()
        began = time.monotonic()
        with pytest.raises((StaleStateError, ConnectionLost)):
            for _ in range(20):  # frames that were under way
                app.read(_APP_WAIT)
        assert time.monotonic() - began < 20 * _APP_WAIT + _SLACK
        with pytest.raises((StaleStateError, ConnectionLost)):
            app.camera.read_latest(_APP_WAIT / 2)

    @needs("lose")
    def test_an_app_notices_a_lost_camera(self, bench: CameraBench, app: _ListeningCamera) -> None:
        app.read()
        bench.lose()
        error = wait_lost(bench, lambda: app.read(_APP_WAIT), _SLACK)
        assert str(error)
        assert not app.camera.connected
        with pytest.raises(ConnectionLost):
            app.camera.read_latest(_READ)
        assert isinstance(app.wait_news(1), ConnectionLost), "on_connection reports the loss"

    @needs("lose", "restore")
    def test_an_app_reads_again_after_the_camera_is_restored(self, bench: CameraBench, app: _ListeningCamera) -> None:
        before = app.read()
        bench.lose()
        wait_lost(bench, lambda: app.read(_APP_WAIT), _SLACK)
        bench.restore()
        after = wait_restored(bench, lambda: app.read(_APP_WAIT), _READ)
        assert after.stamp.seq > before.stamp.seq, "seq continues"
        assert after.stamp.t > before.stamp.t
        assert app.camera.connected
        assert app.camera.counts().reconnects == 1
        assert app.wait_news(2) is None, "on_connection reports the return"
        assert app.read().stamp.seq > after.stamp.seq
