"""Pictures in the memory that the camera's process and the app share."""

from __future__ import annotations

import numpy as np
import pytest

from hal.camera_driver import CameraTally
from hal.drivers.realsense.ring import SLOTS, PictureRing
from hal.specs import CameraSpec

from .test_realsense_settings import camera


@pytest.fixture
def ring() -> PictureRing:
    spec = small()
    return PictureRing(memoryview(bytearray(PictureRing.size(spec))), spec)


def small() -> CameraSpec:
    from dataclasses import replace

    return replace(camera(), width=8, height=6, streams=("color", "depth", "infrared_right"))


def put(ring: PictureRing, number: int, skew: float | None = None) -> int:
    images = ring.begin()
    for image in images.values():
        image[:] = number
    return ring.end(float(number), 100.0 + number, 10 * number, skew)


def test_a_picture_comes_out_as_it_was_put_in(ring: PictureRing) -> None:
    assert ring.take(0) is None
    assert put(ring, 1, 0.003) == 1
    number, frame = ring.take(0) or pytest.fail("there is one")
    assert (number, frame.t, frame.t_device, frame.seq, frame.skew) == (1, 1.0, 101.0, 10, 0.003)
    assert frame.color is not None
    assert frame.depth is not None
    assert frame.color.shape == (6, 8, 3)
    assert frame.depth.dtype == np.float32
    assert (frame.infrared is None, frame.segmentation is None) == (True, True)
    put(ring, 1 + SLOTS)
    assert (frame.color == 1).all(), "it is the reader's own"
    assert ring.take(number + 1) is None


def test_the_newest_or_every_one(ring: PictureRing) -> None:
    for k in range(1, 4):
        put(ring, k)
    assert [taken[1].t for after in (0, 1, 2) if (taken := ring.take(after, every=True))] == [1.0, 2.0, 3.0]
    assert (taken := ring.take(1)) is not None
    assert taken[0] == 3
    assert taken[1].skew is None


def test_it_is_full_until_somebody_reads(ring: PictureRing) -> None:
    for k in range(SLOTS):
        assert not ring.is_full
        put(ring, k + 1)
    assert ring.is_full
    ring.take(0, every=True)
    assert not ring.is_full
    put(ring, SLOTS + 1)
    assert ring.is_full
    assert ring.forget() == SLOTS + 1
    assert not ring.is_full


def test_a_slot_that_is_written_to_is_not_read(ring: PictureRing) -> None:
    for k in range(1, SLOTS + 1):
        put(ring, k)
    ring.begin()["color"][:] = 99  # over the oldest
    assert (taken := ring.take(SLOTS - 1)) is not None
    assert (taken[1].color == SLOTS).all()  # type: ignore[union-attr]


def test_what_was_not_handed_out_is_counted(ring: PictureRing) -> None:
    assert ring.tally == CameraTally(0, 0)
    ring.count(CameraTally(3, 4))
    put(ring, 1)
    ring.take(0)
    assert ring.tally == CameraTally(3, 4)
