"""Frames and rows through shared memory: whole or not at all, and neither side waits for the other."""

from __future__ import annotations

import mmap
import multiprocessing
import struct
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pictures_kit import STREAMS, camera

from hal.driver import CameraTally, RawFrame
from hal.errors import ConnectionLost
from hal.geometry import Pose
from hal.host.ring import ArrayRing, FrameRing, frame_rings, frame_rings_size
from hal.specs import CameraSpec

WIDE = camera(64, 48, name="wide", streams=("color", "depth", "infrared", "segmentation"))
SMALL = camera(20, 10, name="small", streams=("color", "depth", "infrared_right"))
SLOTS = 4


def frame(spec: CameraSpec, value: int, **more: Any) -> RawFrame:
    """A frame in which every pixel has the same value."""
    flat = (spec.height, spec.width)
    images = {
        "color": np.full((*flat, 3), value % 256, np.uint8),
        "depth": np.full(flat, value, np.float32),
        "infrared": np.full(flat, value % 256, np.uint8),
        "infrared_right": np.full(flat, value % 256, np.uint8),
        "segmentation": np.full(flat, value, np.int32),
    }
    kept = {name: image for name, image in images.items() if name in spec.streams}
    plain = RawFrame(float(value), value + 0.5, 0)
    return plain._replace(**kept, **more)


def pair(spec: CameraSpec = SMALL) -> tuple[FrameRing, FrameRing, memoryview]:
    """A writer and a reader on the same memory."""
    buffer = memoryview(mmap.mmap(-1, FrameRing.size(spec)))
    return FrameRing(buffer, spec), FrameRing(buffer, spec), buffer


def pixels(found: RawFrame) -> set[float]:
    images = (found.color, found.depth, found.infrared, found.infrared_right, found.segmentation)
    return {float(value) for image in images if image is not None for value in np.unique(image)}


def test_a_frame_arrives_as_it_was_written() -> None:
    specs = [WIDE, SMALL]
    rings = frame_rings(memoryview(bytearray(frame_rings_size(specs))), specs)
    assert rings["wide"].read(0) is None
    pose = Pose((7.0, 0.0, 0.0))
    assert rings["wide"].write(frame(WIDE, 7, T_world_camera=pose, skew=0.003)) == 1
    assert rings["small"].read(0) is None
    rings["small"].write(frame(SMALL, 9))
    number, got = rings["wide"].read(0) or pytest.fail("no frame")
    assert (number, got.t, got.t_device, got.seq, got.skew) == (1, 7.0, 7.5, 1, 0.003)
    assert got.T_world_camera == pose
    assert got.infrared_right is None
    for stream in WIDE.streams:
        image, sent = getattr(got, stream), getattr(frame(WIDE, 7), stream)
        assert (image.dtype, image.tolist()) == (sent.dtype, sent.tolist())
    _, small = rings["small"].read(0) or pytest.fail("no frame")
    assert (small.skew, small.T_world_camera, pixels(small)) == (None, None, {9.0})


def test_the_newest_frame_is_read_once_and_belongs_to_its_reader() -> None:
    writer, reader, _ = pair()
    for value in range(1, 12):
        writer.write(frame(SMALL, value))
    number, got = reader.read(3) or pytest.fail("no frame")
    assert (number, got.seq, got.t) == (11, 11, 11.0)
    assert reader.read(number) is None
    assert reader.wait(number, 0.01) is None
    for value in range(12, 30):
        writer.write(frame(SMALL, value))
    assert pixels(got) == {11.0}


def test_every_frame_is_read_in_turn() -> None:
    writer, reader, _ = pair()
    for value in range(SLOTS):
        assert not writer.is_full
        writer.write(frame(SMALL, value + 1))
    assert writer.is_full
    assert [found[1].t for after in range(3) if (found := reader.read(after, every=True))] == [1.0, 2.0, 3.0]
    assert (writer.waiting, writer.is_full) == (1, False)
    assert writer.release_all() == SLOTS
    assert writer.waiting == 0


@pytest.mark.parametrize("finished", [True, False])
def test_a_frame_that_was_written_over_is_an_error_for_a_reader_of_every_frame(finished: bool) -> None:
    writer, reader, _ = pair()
    for value in range(SLOTS + finished):
        writer.write(frame(SMALL, value + 1))
    if not finished:
        writer.open_slot()
    with pytest.raises(ConnectionLost) as caught:
        reader.read(0, every=True)
    assert caught.value.code == "frame_overwritten"
    assert reader.read(0) is not None


def test_the_number_and_the_tally_of_the_driver_are_kept() -> None:
    writer, reader, _ = pair()
    assert reader.tally == CameraTally(0, 0)
    writer.tally = CameraTally(3, 4)
    for image in writer.open_slot().values():
        image[:] = 5
    assert writer.publish(1.0, 101.0, 10, 0.003) == 1
    _, got = reader.read(0) or pytest.fail("no frame")
    assert (got.t, got.t_device, got.seq, got.skew, pixels(got)) == (1.0, 101.0, 10, 0.003, {5.0})
    assert reader.tally == CameraTally(3, 4)


def test_a_reader_that_waits_gets_the_next_frame() -> None:
    writer, reader, _ = pair()
    writing = threading.Timer(0.02, lambda: writer.write(frame(SMALL, 5)))
    writing.start()
    got = reader.wait(0, 5.0)
    writing.join()
    assert got.t == 5.0


def test_a_writer_killed_in_the_middle_does_not_block_the_reader() -> None:
    """The announced slot stays unfinished, as after a kill between two stores in the wrong order."""
    writer, reader, buffer = pair()
    writer.write(frame(SMALL, 1))
    struct.pack_into("<Q", buffer, 0, 2)  # announced, never finished
    assert reader.wait(0, 0.05) is None


def test_frames_are_never_torn_while_the_writer_overtakes() -> None:
    big = camera(200, 160, name="big", streams=STREAMS)
    writer, reader, _ = pair(big)
    stop = threading.Event()

    def write() -> None:
        value = 0
        while not stop.is_set():
            value = value % 255 + 1  # the same in every type
            writer.write(frame(big, value))

    thread = threading.Thread(target=write)
    thread.start()
    after = 0
    try:
        for _ in range(60):
            got = reader.wait(after, 5.0)
            after = got.seq
            assert pixels(got) == {got.t}
    finally:
        stop.set()
        thread.join()


class _Interrupted(np.ndarray[Any, Any]):
    """A picture; something happens after it was copied, before the next one is."""

    then: Callable[[], None]

    def copy(self, order: Any = "C") -> Any:
        copied = np.array(self, order=order, subok=False)
        self.then()
        return copied


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("first", range(1, SLOTS + 1))
def test_a_copy_during_which_the_writer_overtakes_is_thrown_away(first: int, finished: bool) -> None:
    writer, reader, _ = pair()
    for value in range(1, first + 1):
        writer.write(frame(SMALL, value))
    images = reader.slots[first % SLOTS]
    plain = images["color"]
    interrupted = plain.view(_Interrupted)

    def overtake() -> None:
        images["color"] = plain
        for value in range(first + 1, first + SLOTS):
            writer.write(frame(SMALL, value))
        for image in writer.open_slot().values():  # over the one that is being copied
            image[:] = first + SLOTS
        if finished:
            writer.publish(float(first + SLOTS), 0.0, 0, None)

    interrupted.then = overtake
    images["color"] = interrupted
    number, got = reader.read(0) or pytest.fail("no frame")
    assert number == first + SLOTS - 1 + finished
    assert pixels(got) == {float(number)}


def test_slots_are_used_in_place_and_in_turn() -> None:
    arrays = {"row": ((3,), np.float64), (0, "color"): ((2, 2), np.uint8)}
    memory = memoryview(bytearray(ArrayRing.count_bytes(arrays, 2)))
    writer, reader = ArrayRing(memory, arrays, 2), ArrayRing(memory, arrays, 2)
    assert reader.oldest() is None
    for value in (1, 2):
        for array in writer.open_slot().values():
            array[:] = value
        writer.publish()
    assert writer.is_full
    for value in (1, 2):
        slot = reader.oldest()
        assert {float(x) for array in slot.values() for x in array.flat} == {value}
        reader.release_oldest()
        assert not writer.is_full
    assert reader.oldest() is None


def publish_rows(ring: ArrayRing[str]) -> None:
    for _ in range(300_000):
        ring.open_slot()
        ring.publish()


def test_the_number_of_the_newest_slot_never_goes_back() -> None:
    """In two processes: a number that is stored in two steps is zero between them, and a reader runs ahead for ever."""
    arrays = {"row": ((1,), np.float64)}
    memory = memoryview(mmap.mmap(-1, ArrayRing.count_bytes(arrays, 8)))
    writer, reader = ArrayRing(memory, arrays, 8), ArrayRing(memory, arrays, 8)
    process = multiprocessing.get_context("fork").Process(target=publish_rows, args=(writer,), daemon=True)
    process.start()
    newest = 0
    while process.is_alive():
        number = reader.written
        assert number >= newest
        newest = number
    assert reader.written == 300_000
