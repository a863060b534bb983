"""Pictures through shared memory: whole or not at all, newest first, and nobody waits for a dead writer."""

from __future__ import annotations

import mmap
import struct
import threading

import numpy as np
import pytest
from pictures_kit import STREAMS, camera

from hal.camera import RawFrame
from hal.geometry import Pose
from hal.host.frames import FrameRing
from hal.specs import CameraSpec

WIDE = camera(64, 48, name="wide", streams=("color", "depth", "infrared", "segmentation"))
SMALL = camera(20, 10, name="small", streams=("depth",))


def frame(spec: CameraSpec, value: int) -> RawFrame:
    """A picture whose every pixel says which one it is."""
    flat = (spec.height, spec.width)
    return RawFrame(
        float(value),
        value + 0.5,
        0,
        np.full((*flat, 3), value % 256, np.uint8) if "color" in spec.streams else None,
        np.full(flat, value, np.float32) if "depth" in spec.streams else None,
        np.full(flat, value % 256, np.uint8) if "infrared" in spec.streams else None,
        np.full(flat, value, np.int32) if "segmentation" in spec.streams else None,
        Pose((value, 0.0, 0.0)),
    )


def ring(*specs: CameraSpec) -> tuple[FrameRing, FrameRing, memoryview]:
    """A writer and a reader on the same anonymous memory."""
    buffer = memoryview(mmap.mmap(-1, FrameRing.size(specs)))
    return FrameRing(buffer, specs), FrameRing(buffer, specs), buffer


def test_a_picture_arrives_as_it_was() -> None:
    writer, reader, _ = ring(WIDE, SMALL)
    assert reader.take("wide", 0, 0.0) is None
    assert writer.put("wide", frame(WIDE, 7)) == 1
    assert reader.take("small", 0, 0.0) is None
    writer.put("small", frame(SMALL, 9))
    got = reader.take("wide", 0, 0.0)
    assert got is not None
    assert (got.t, got.t_device, got.seq) == (7.0, 7.5, 1)
    assert got.T_world_camera == Pose((7.0, 0.0, 0.0))
    for stream in ("color", "depth", "infrared", "segmentation"):
        image, sent = getattr(got, stream), getattr(frame(WIDE, 7), stream)
        assert image.dtype == sent.dtype
        assert np.array_equal(image, sent)
    small = reader.take("small", 0, 0.0)
    assert small is not None
    assert small.color is None
    assert (small.depth == 9).all()


def test_only_the_newest_and_only_once() -> None:
    writer, reader, _ = ring(SMALL)
    for value in range(1, 12):
        writer.put("small", frame(SMALL, value))
    got = reader.take("small", 3, 0.0)
    assert got is not None
    assert (got.seq, got.t) == (11, 11.0)
    assert reader.take("small", got.seq, 0.0) is None
    assert reader.take("small", got.seq, 0.01) is None


def test_a_picture_belongs_to_its_reader() -> None:
    writer, reader, _ = ring(SMALL)
    writer.put("small", frame(SMALL, 1))
    got = reader.take("small", 0, 0.0)
    for value in range(2, 20):
        writer.put("small", frame(SMALL, value))
    assert got is not None
    assert (got.depth == 1).all()


def test_a_reader_that_waits_gets_the_next_picture() -> None:
    writer, reader, _ = ring(SMALL)
    writing = threading.Timer(0.02, lambda: writer.put("small", frame(SMALL, 5)))
    writing.start()
    got = reader.take("small", 0, 5.0)
    writing.join()
    assert got is not None
    assert got.t == 5.0


def test_a_writer_killed_in_the_middle_hangs_nobody() -> None:
    """The announced slot is unfinished for ever, as after a kill between two stores in the wrong order."""
    writer, reader, buffer = ring(SMALL)
    writer.put("small", frame(SMALL, 1))
    struct.pack_into("<Q", buffer, 0, 2)  # announced, never finished
    assert reader.take("small", 0, 0.05) is None


def test_no_torn_picture_while_a_writer_overtakes() -> None:
    """A writer at full speed against a reader: every picture that the reader gets is of one piece."""
    big = camera(200, 160, name="big", streams=STREAMS)
    writer, reader, _ = ring(big)
    stop = threading.Event()

    def write() -> None:
        value = 0
        while not stop.is_set():
            value += 1
            writer.put("big", frame(big, value))

    thread = threading.Thread(target=write)
    thread.start()
    seen, after = 0, 0
    try:
        while seen < 60:
            got = reader.take("big", after, 5.0)
            assert got is not None
            after, value = got.seq, int(got.t)
            assert (got.depth == value).all()
            assert (got.color == value % 256).all()
            assert (got.segmentation == value).all()
            seen += 1
    finally:
        stop.set()
        thread.join()


class Overtaken:
    """An image in the ring during whose copy the writer goes once around."""

    def __init__(self, image: np.ndarray, writer: FrameRing) -> None:
        self.image = image
        self.writer = writer
        self.copies = 0

    def copy(self) -> np.ndarray:
        self.copies += 1
        if self.copies == 1:
            for value in range(100, 104):
                self.writer.put("small", frame(SMALL, value))
        return self.image.copy()


@pytest.mark.parametrize("place", range(4))
def test_a_slot_that_is_written_again_during_the_copy_is_thrown_away(place: int) -> None:
    writer, reader, _ = ring(SMALL)
    for value in range(1, place + 2):
        writer.put("small", frame(SMALL, value))
    slot = reader._cameras["small"]._images[(place + 1) % 4]
    overtaken = Overtaken(slot["depth"], writer)
    slot["depth"] = overtaken  # type: ignore[assignment]
    got = reader.take("small", 0, 0.0)
    assert overtaken.copies >= 1
    assert got is not None
    assert got.t == 103.0
    assert (got.depth == 103).all()
