"""Mailboxes: the newest whole record, whatever happens to the writer."""

import struct
import threading

import pytest

from hal.host.memory import Mailbox, SeriesBox
from hal.host.process import SharedMemory


def pair(layout: str) -> tuple[Mailbox, Mailbox, bytearray]:
    memory = bytearray(Mailbox.size(layout))
    return Mailbox(memoryview(memory), layout), Mailbox(memoryview(memory), layout), memory


def test_empty_then_newest() -> None:
    writer, reader, _ = pair("dQ")
    assert reader.read() is None
    assert reader.seq() == 0
    writer.write(1.5, 7)
    writer.write(2.5, 8)
    assert reader.read() == (2, (2.5, 8))
    assert reader.read() == (2, (2.5, 8)), "reading does not take a record away"


def test_a_record_that_does_not_fit_is_refused_and_nothing_is_announced() -> None:
    writer, reader, _ = pair("dQ")
    writer.write(1.0, 1)
    with pytest.raises(struct.error):
        writer.write(1.0)
    assert reader.read() == (1, (1.0, 1))


def test_a_writer_killed_in_mid_write_leaves_the_last_record() -> None:
    writer, reader, memory = pair("8d")
    writer.write(*range(8))
    free_slot = 8  # the second record goes into the first slot: the number's lowest bit chooses
    memory[free_slot : free_slot + 40] = b"\xff" * 40
    assert reader.read() == (1, tuple(float(k) for k in range(8)))


@pytest.mark.parametrize("damaged", [8 + 80, 8 + 80 + 16])  # the announced slot's number; its payload
def test_a_torn_record_is_never_handed_out(damaged: int) -> None:
    writer, reader, memory = pair("8d")
    assert len(memory) == 8 + 2 * 80
    writer.write(*range(8))
    memory[damaged] ^= 0xFF
    assert reader.read() is None
    writer.write(*range(8, 16))
    assert reader.read() == (2, tuple(float(k) for k in range(8, 16)))


def test_readers_only_ever_see_whole_records_in_order() -> None:
    layout = "32d"
    shared = SharedMemory(Mailbox.size(layout))
    writer = Mailbox(shared.buffer, layout)
    seen: list[int] = []
    done = threading.Event()

    def read() -> None:
        reader = Mailbox(shared.buffer, layout)
        while not done.is_set():
            found = reader.read()
            if found:
                assert len(set(found[1])) == 1
                seen.append(found[0])

    thread = threading.Thread(target=read)
    thread.start()
    for k in range(20_000):
        writer.write(*([float(k)] * 32))
    done.set()
    thread.join()
    assert seen == sorted(seen)
    assert len(set(seen)) > 1


def test_a_series_may_change_its_length() -> None:
    memory = memoryview(bytearray(SeriesBox.size(5)))
    writer, reader = SeriesBox(memory, 5), SeriesBox(memory, 5)
    assert reader.read() is None
    writer.write(0.5, 1, [1.0, 2.0, 3.0])
    number, t, revision, values = reader.read() or (0, 0.0, 0, [])
    assert (number, t, revision, list(values)) == (1, 0.5, 1, [1.0, 2.0, 3.0])
    writer.write(0.6, 2, [9.0])
    found = reader.read()
    assert list(found[3]) == [9.0]
    with pytest.raises(ValueError, match="6 numbers do not fit into 5"):
        writer.write(0.7, 3, [0.0] * 6)
