"""Mailboxes in shared memory: the newest whole record, the last seconds of a device, and the states in between."""

from __future__ import annotations

import itertools
import struct
import threading

import numpy as np
import pytest

import hal
from hal.errors import StaleStateError
from hal.host.memory import History, Mailbox, SeriesBox
from hal.host.process import SharedMemory
from hal.types import Stamp


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


class Sample:
    def __init__(self, record: bytes) -> None:
        t, self.value = struct.unpack("<dd", record)
        self.stamp = Stamp(t, t, 0)


def ring(slots: int) -> tuple[Mailbox, History[Sample]]:
    memory = memoryview(bytearray(Mailbox.size("dd", slots)))
    return Mailbox(memory, "dd", slots), History(Mailbox(memory, "dd", slots), Sample)


def test_the_last_states_stay_and_older_ones_go() -> None:
    box, history = ring(8)
    assert history.read_since(0.0) == []
    assert history.find_around(0.0) is None
    for k in range(1, 101):
        box.write(float(k), 2.0 * k)
        found = [sample.stamp.t for sample in history.read_since(0.0)]
        assert found == [float(j) for j in range(max(1, k - 6), k + 1)], "all but the one that is written over next"
    assert [sample.value for sample in history.read_since(97.5)] == [196.0, 198.0, 200.0]
    assert history.read_since(100.0) == []
    assert box.read() == (100, (100.0, 200.0)), "the newest one as ever"


def test_neighbours_of_a_time() -> None:
    box, history = ring(8)
    for k in range(1, 21):
        box.write(float(k), 0.0)
    for t, expected in ((17.5, (17.0, 18.0)), (17.0, (17.0, 18.0)), (20.0, (20.0, 20.0)), (25.0, (20.0, 20.0))):
        found = history.find_around(t)
        assert (found[0].stamp.t, found[1].stamp.t) == expected
    assert history.find_around(5.0) is None, "too old"


def test_the_number_of_slots_is_a_power_of_two() -> None:
    for slots in (0, 1, 3, 100):
        with pytest.raises(ValueError, match="power of two"):
            Mailbox.size("d", slots)


def test_a_reader_never_sees_a_torn_state_while_the_writer_laps_it() -> None:
    box, history = ring(16)
    done = threading.Event()
    trouble: list[str] = []

    def read() -> None:
        while not done.is_set():
            found = history.read_since(0.0)
            if any(sample.value != 2.0 * sample.stamp.t for sample in found):
                trouble.append("torn")
            if any(a.stamp.t >= b.stamp.t for a, b in itertools.pairwise(found)):
                trouble.append("out of order")

    thread = threading.Thread(target=read)
    thread.start()
    for k in range(1, 30_001):
        box.write(float(k), 2.0 * k)
    done.set()
    thread.join()
    assert not trouble


def test_an_arm_between_two_samples() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm = rig.robots["panda"]
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist([0.1, 0.0, 0.0], [0.0, 0.0, 0.5]), grip=0.5)
                if tick.elapsed > 0.6:
                    break
            states = arm.states(rig.clock.now() - 0.3)
            assert len(states) == pytest.approx(15, abs=1), "in lock-step, one for each wait"
            before, after = states[10], states[11]
            t = 0.25 * before.stamp.t + 0.75 * after.stamp.t
            state = arm.state_at(t)
            assert state.stamp.t == pytest.approx(t)
            assert state.q == pytest.approx(0.25 * before.q + 0.75 * after.q)
            assert np.abs(after.q - before.q).max() > 1e-5, "it moves"
            assert state.tcp.distance(arm.fk(state.q)) == pytest.approx((0.0, 0.0), abs=1e-5), "20 ms apart"
            assert arm.state_at(before.stamp.t).q == pytest.approx(before.q)
            assert arm.state_at(rig.clock.now() + 0.02).q == pytest.approx(arm.state().q)
            for nobody_knows in (rig.clock.now() - 100.0, rig.clock.now() + 0.2):
                with pytest.raises(StaleStateError):
                    arm.state_at(nobody_knows)
            hand = arm.gripper
            first, second = hand.states(rig.clock.now() - 0.3)[:2]
            middle = hand.state_at((first.stamp.t + second.stamp.t) / 2)
            assert middle.width == pytest.approx((first.width + second.width) / 2)


def test_in_real_time_every_cycle_is_kept() -> None:
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        arm = rig.robots["panda"]
        rig.clock.sleep(0.1)
        start = rig.clock.now()
        while len(states := arm.states(start)) <= 50:
            rig.clock.sleep(0.05)
        numbers = [state.stamp.seq for state in states]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "no gaps"
        between = arm.state_at((states[3].stamp.t + states[4].stamp.t) / 2)
        assert states[3].stamp.t < between.stamp.t < states[4].stamp.t
