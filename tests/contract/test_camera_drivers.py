"""What every CameraDriver owes to the public Camera."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from hal.camera import RawFrame
from hal.errors import ConnectionLost

from .benches import CAMERAS, CameraBench


@pytest.fixture(params=CAMERAS)
def bench(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    with CAMERAS[request.param]() as bench:
        yield bench


def grab(bench: CameraBench) -> RawFrame:
    frame = bench.driver.grab(2.0)
    assert frame is not None, "no frame within two seconds"
    return frame


def test_a_frame_has_the_streams_the_size_and_the_units_of_its_spec(bench: CameraBench) -> None:
    bench.driver.open()
    spec, frame = bench.driver.spec, grab(bench)
    size = (spec.height, spec.width)
    expected = {"color": ((*size, 3), np.uint8), "depth": (size, np.float32)}
    expected |= {"infrared": (size, np.uint8), "segmentation": (size, np.int32)}
    for stream, (shape, dtype) in expected.items():
        image = getattr(frame, stream)
        assert (image is not None) == (stream in spec.streams), stream
        if image is not None:
            assert (image.shape, image.dtype) == (shape, np.dtype(dtype))
    if frame.depth is not None:
        measured = frame.depth[frame.depth != 0.0]
        assert measured.size, "the camera sees something"
        assert (measured >= spec.depth_min).all()
        assert (measured <= spec.depth_max).all()


def test_frames_are_new_and_stamped(bench: CameraBench) -> None:
    bench.driver.open()
    frames = [grab(bench) for _ in range(5)]
    for before, after in itertools.pairwise(frames):
        assert after.seq > before.seq
        assert after.t > before.t
        assert after.t_device > before.t_device
        if before.color is not None and after.color is not None:
            assert not np.shares_memory(before.color, after.color), "a frame handed out is never written to again"


def test_another_thread_may_grab(bench: CameraBench) -> None:
    bench.driver.open()
    frames: list[RawFrame] = []
    thread = threading.Thread(target=lambda: frames.append(grab(bench)))
    thread.start()
    thread.join(10.0)
    assert len(frames) == 1


def test_a_lost_link_is_an_error_and_never_at_close(bench: CameraBench) -> None:
    bench.driver.open()
    grab(bench)
    bench.lose()
    with pytest.raises(ConnectionLost):
        bench.driver.grab(2.0)
    bench.driver.close()


def test_close_may_be_repeated_or_come_first_and_open_follow_it(bench: CameraBench) -> None:
    bench.driver.close()
    bench.driver.open()
    grab(bench)
    bench.driver.close()
    bench.driver.close()
    bench.driver.open()
    grab(bench)
