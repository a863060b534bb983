"""Pictures in the memory that the camera's process and the app share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hal.driver import CameraTally
from hal.drivers.realsense.ring import SLOTS, PictureRing
from hal.errors import ConnectionLost
from hal.specs import CameraSpec

from .test_realsense_options import camera


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


class _Interrupted(np.ndarray[Any, Any]):
    """A picture; once it is copied, something happens before the next one is."""

    then: Callable[[], None]

    def copy(self, order: Any = "C") -> Any:
        copied = np.array(self, order=order, subok=False)
        self.then()
        return copied


def when_copied(ring: PictureRing, number: int, then: Callable[[], None]) -> None:
    """Have it happen in the middle of the reader's copy of that picture, once."""
    images = ring._images[number % SLOTS]
    plain = images["color"]
    interrupted = plain.view(_Interrupted)

    def once() -> None:
        images["color"] = plain
        then()

    interrupted.then = once
    images["color"] = interrupted


@pytest.mark.parametrize("finished", [True, False])
def test_a_copy_that_the_writer_laps_is_thrown_away(finished: bool) -> None:
    memory = memoryview(bytearray(PictureRing.size(small())))
    writer, reader = PictureRing(memory, small()), PictureRing(memory, small())
    put(writer, 1)

    def lap() -> None:
        for k in range(2, SLOTS + 1):
            put(writer, k)
        for image in writer.begin().values():  # over the one that is being copied
            image[:] = SLOTS + 1
        if finished:
            writer.end(SLOTS + 1.0, 0.0, 0, None)

    when_copied(reader, 1, lap)
    number, frame = reader.take(0) or pytest.fail("there is one")
    assert number == SLOTS + finished
    assert frame.color is not None
    assert frame.depth is not None
    assert frame.infrared_right is not None
    assert {*frame.color.flat, *frame.depth.flat, *frame.infrared_right.flat} == {number}, "all of one capture"


@pytest.mark.parametrize("finished", [True, False])
def test_who_wants_every_picture_is_told_that_one_was_written_over(ring: PictureRing, finished: bool) -> None:
    for k in range(1, SLOTS + 1):
        put(ring, k)
    if finished:
        put(ring, SLOTS + 1)
    else:
        ring.begin()
    with pytest.raises(ConnectionLost, match="picture 1 was written over"):
        ring.take(0, every=True)
    assert ring.take(0) is not None


def test_what_was_not_handed_out_is_counted(ring: PictureRing) -> None:
    assert ring.tally == CameraTally(0, 0)
    ring.count(CameraTally(3, 4))
    put(ring, 1)
    ring.take(0)
    assert ring.tally == CameraTally(3, 4)
