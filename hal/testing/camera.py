"""What every CameraDriver owes to the public Camera."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

from ..driver import RawFrame
from ..errors import CommandError, ConnectionLost, HalError, NotSupported
from .benches import CameraBench
from .contract import Contract, needs
from .waiting import comes_back, in_thread, is_lost
from .watching import WatchChecks

__all__ = ["CameraContract"]

_FIRST = 10.0
"""s within which a camera that was just opened takes its first frame, on a busy machine."""
_WAIT = 0.2
"""s; a time-out that is tried."""
_SLACK = 2.0
"""s that a call may take longer than it was told to, on a busy machine."""
_WAY = 20
"""Frames that may be on their way when the device falls silent."""
_CLOCKS = ("hardware", "global", "system", "simulated")


def images(frame: RawFrame) -> dict[str, np.ndarray]:
    """Stream -> picture, of those that the frame has."""
    streams = ("color", "depth", "infrared", "infrared_right", "segmentation")
    found = {stream: getattr(frame, stream) for stream in streams}
    return {stream: image for stream, image in found.items() if image is not None}


def grab(bench: CameraBench) -> RawFrame:
    """The next frame."""
    deadline = time.monotonic() + _FIRST
    while True:
        if not bench.real_time:
            bench.pass_time()
        frame = bench.driver.grab(1.0)
        if frame is not None:
            return frame
        assert time.monotonic() < deadline, f"no frame within {_FIRST:g} s: grab gives every new frame once"


class CameraContract(WatchChecks, Contract):
    """Checks of a camera's driver. The bench is a :class:`~hal.testing.CameraBench`.

    ``left_out`` may name ``lose``, ``restore`` and ``freeze``.
    """

    abilities = ("lose", "restore", "freeze")

    # Frames.

    def test_a_frame_has_the_streams_the_size_and_the_units_of_its_spec(self, bench: CameraBench) -> None:
        bench.driver.open()
        spec, frame = bench.driver.spec, grab(bench)
        size = (spec.height, spec.width)
        expected = {"color": ((*size, 3), np.uint8), "depth": (size, np.float32), "segmentation": (size, np.int32)}
        expected |= {"infrared": (size, np.uint8), "infrared_right": (size, np.uint8)}
        found = images(frame)
        assert set(found) == set(spec.streams), "a frame has the streams of its spec, and None for all others"
        for stream, image in found.items():
            shape, dtype = expected[stream]
            assert (image.shape, image.dtype) == (shape, np.dtype(dtype)), (
                f"{stream}: wants {shape} of {dtype.__name__}"
            )
        if frame.depth is not None:
            assert np.isfinite(frame.depth).all(), "depth is 0 where there is no measurement, never NaN"
            measured = frame.depth[frame.depth != 0.0]
            assert measured.size, "the camera sees something"
            assert (measured >= spec.depth_min).all(), "depth is in metres; what is too near is 0"
            assert (measured <= spec.depth_max).all(), "depth is in metres; what is too far is 0"
        assert frame.skew is None or {"color", "depth"} <= set(found), "skew is that of colour against depth"

    def test_frames_are_new_and_stamped(self, bench: CameraBench) -> None:
        bench.driver.open()
        frames = []
        for _ in range(8):
            frames.append(grab(bench))
            assert frames[-1].t <= bench.clock.now() + 1e-3, (
                "t is when it was taken, on the host's clock: not ahead of it"
            )
            if bench.paced:
                assert bench.clock.now() - frames[-1].t < _SLACK, (
                    "t is when it was taken, on the host's monotonic clock"
                )
        for before, after in itertools.pairwise(frames):
            assert after.seq > before.seq, "seq counts captures: each frame is handed out once, and in order"
            assert after.t > before.t
            assert after.t_device > before.t_device, "t_device is the camera's own clock, which goes on"
        if bench.paced:
            period = (frames[-1].t_device - frames[0].t_device) / (frames[-1].seq - frames[0].seq)
            share = period * bench.driver.spec.rate_hz
            assert 0.5 < share < 2.0, f"t_device in s, and seq, make {1 / period:.1f} frames a second"

    def test_a_frame_that_was_handed_out_is_never_written_to_again(self, bench: CameraBench) -> None:
        bench.driver.open()
        frame = grab(bench)
        kept = {stream: image.copy() for stream, image in images(frame).items()}
        later = [grab(bench) for _ in range(5)]
        for stream, image in images(frame).items():
            assert np.array_equal(image, kept[stream]), f"{stream} of an old frame changed: hand out copies"
            for other in later:
                assert not np.shares_memory(image, images(other)[stream]), f"two frames share their {stream}"

    def test_it_says_what_it_is(self, bench: CameraBench) -> None:
        bench.driver.open()
        info, spec = bench.driver.info, bench.driver.spec
        assert info.title, "title: make and model, for people"
        assert info.clock in _CLOCKS, f"clock says what t_device counts: one of {', '.join(_CLOCKS)}"
        assert info.depth_scale is None or info.depth_scale > 0.0, "depth_scale: metres in one unit"
        is_matrix(info.K, spec.width, spec.height, "K")
        infrared = {"infrared", "infrared_right"} & set(spec.streams)
        assert info.K_infrared is not None or not infrared, "K_infrared: with infrared, say how it sees"
        if info.K_infrared is not None:
            is_matrix(info.K_infrared, spec.width, spec.height, "K_infrared")
        assert np.shape(info.distortion) == (5,), "distortion: k1, k2, p1, p2, k3"
        for name, stream in info.streams.items():
            assert min(stream.width, stream.height, stream.rate_hz) > 0, f"streams[{name!r}] has a size and a rate"
            is_matrix(stream.K, stream.width, stream.height, f"streams[{name!r}].K")
            assert np.shape(stream.distortion) == (5,)
            assert np.linalg.norm(stream.T_color_stream.position) < 1.0, "T_color_stream is in metres"

    # Waiting.

    def test_grab_comes_back_with_the_frame_and_does_not_sleep_its_time_out(self, bench: CameraBench) -> None:
        bench.driver.open()
        grab(bench)
        patience = 30.0
        began = time.monotonic()
        for _ in range(3):
            if not bench.real_time:
                bench.pass_time()
            bench.driver.grab(patience)
        took = time.monotonic() - began
        assert took < patience, f"three frames took {took:.1f} s: return each as soon as it is there"

    @needs("freeze")
    def test_without_a_frame_grab_ends_in_time(self, bench: CameraBench) -> None:
        bench.driver.open()
        grab(bench)
        bench.freeze()
        for _ in range(_WAY):
            if bench.driver.grab(0.0) is None:
                break
        began = time.monotonic()
        try:
            frame = bench.driver.grab(_WAIT)
        except ConnectionLost:
            frame = None  # so silent that it must be opened anew
        took = time.monotonic() - began
        assert frame is None, "no new frame came: grab returns None, and never an old one again"
        assert took < _WAIT + _SLACK, f"grab({_WAIT:g}) took {took:.1f} s"

    # Threads, and closing.

    def test_another_thread_may_grab_and_close(self, bench: CameraBench) -> None:
        bench.driver.open()
        in_thread(lambda: grab(bench))
        in_thread(lambda: grab(bench))
        in_thread(bench.driver.close)

    def test_close_may_be_repeated_or_come_first_and_open_follow_it(self, bench: CameraBench) -> None:
        bench.driver.close()
        bench.driver.open()
        grab(bench)
        bench.driver.close()
        bench.driver.close()
        bench.driver.open()
        grab(bench)

    def test_what_is_not_open_is_an_error(self, bench: CameraBench) -> None:
        for _ in range(2):
            with pytest.raises(HalError):
                bench.driver.grab(0.0)
            bench.driver.open()
            bench.driver.close()

    # Losing it.

    @needs("lose")
    def test_a_lost_link_is_an_error_and_never_at_close(self, bench: CameraBench) -> None:
        bench.driver.open()
        grab(bench)
        bench.lose()
        is_lost(bench, lambda: bench.driver.grab(_WAIT))
        began = time.monotonic()
        bench.driver.close()
        bench.driver.close()
        assert time.monotonic() - began < 10.0, "close is bounded in time, whatever the device does"

    @needs("lose", "restore")
    def test_a_camera_that_is_back_can_be_opened_again(self, bench: CameraBench) -> None:
        bench.driver.open()
        grab(bench)
        bench.lose()
        is_lost(bench, lambda: bench.driver.grab(_WAIT))
        bench.driver.close()
        bench.restore()
        comes_back(bench, bench.driver.open)
        first, second = grab(bench), grab(bench)
        assert second.seq > first.seq

    @needs("lose")
    def test_a_camera_that_is_not_there_cannot_be_opened(self, bench: CameraBench) -> None:
        bench.driver.open()
        grab(bench)
        bench.lose()
        is_lost(bench, lambda: bench.driver.grab(_WAIT))
        bench.driver.close()
        began = time.monotonic()
        try:
            bench.driver.open()
        except HalError:
            pass
        except Exception as error:
            pytest.fail(f"a device that does not answer must raise hal.errors.ConnectionLost, not {error!r}")
        else:
            is_lost(bench, lambda: bench.driver.grab(_WAIT))  # at the latest, when a frame is asked for
        assert time.monotonic() - began < 20.0, "open is bounded: what cannot be had within some seconds is an error"
        bench.driver.close()

    def test_an_unknown_knob_is_refused(self, bench: CameraBench) -> None:
        bench.driver.open()
        with pytest.raises((CommandError, NotSupported)):
            bench.driver.inject(no_such_knob=True)


def is_matrix(K: np.ndarray, width: int, height: int, name: str) -> None:
    """Fails where K cannot be the camera matrix of a picture of that size."""
    assert np.shape(K) == (3, 3), f"{name} is a (3, 3) matrix"
    assert np.isfinite(K).all(), f"{name} is finite"
    assert min(K[0][0], K[1][1]) > 0.0, f"{name} has focal lengths, pixels"
    assert 0.0 < K[0][2] < width, f"{name}: the principal point is in the picture"
    assert 0.0 < K[1][2] < height, f"{name}: the principal point is in the picture"
    assert tuple(K[2]) == (0.0, 0.0, 1.0), f"{name}: the last row is 0, 0, 1"
