"""The link between two computers, without processes: clocks that differ, frames that are lost or wrong, times."""

from __future__ import annotations

import json
import math
import random
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest
from errors_kit import raises_code

from hal.commands import CHUNK_AHEAD, CommandRecord, DeadmanRecord, Kind, SessionRecord
from hal.driver import PadReading
from hal.errors import ConnectionLost
from hal.host.records import GripperAct, GripperCommand, GroupMemory
from hal.remote.boxes import boxes_of_program
from hal.remote.link import MOST_ROUND_TRIP, ClockOffset, RigLink
from hal.remote.pads import ReceivedReadings

N = 7
LONGEST = 0.3
"""Deadline of the arm's commands, s."""


class Clocks:
    """Two computers that send each other frames: offset and drift of their clocks, and what each way takes, s."""

    def __init__(self, offset: float, drift: float, seed: int = 0) -> None:
        self.random = random.Random(seed)
        self.offset, self.drift = offset, drift
        self.there, self.back, self.jitter = 0.001, 0.001, 0.0
        self.bounds = ClockOffset()
        self.t = 0.0

    def true(self, t: float) -> float:
        """Offset of our clock to theirs at our time, s."""
        return self.offset + self.drift * t

    def exchange(self) -> None:
        """Send a frame there, and get one back."""
        sent = self.t
        arrived = sent + self.there + self.jitter * self.random.random()
        left = arrived + 0.01 * self.random.random()
        back = left + self.back + self.jitter * self.random.random()
        self.bounds.note(back, left - self.true(left), sent, arrived - self.true(arrived))
        self.t = max(self.t + 0.02, back)


@pytest.mark.parametrize("seed", range(20))
def test_the_offset_is_known_to_within_half_a_round_trip_whatever_the_clocks_and_the_ways(seed: int) -> None:
    chance = random.Random(seed)
    clocks = Clocks(chance.uniform(-1e6, 1e6), chance.uniform(-1e-3, 1e-3), seed)
    clocks.there, clocks.back = chance.uniform(0.0, 0.05), chance.uniform(0.0, 0.05)
    clocks.jitter = chance.choice([0.0, 0.001, 0.1])
    for _ in range(2000):
        clocks.exchange()
        true, bounds = clocks.true(clocks.t), clocks.bounds
        assert bounds.low - 1e-6 <= true <= bounds.high + 1e-6
        assert bounds.value - true <= min(bounds.round_trip, MOST_ROUND_TRIP) / 2.0 + 1e-6
    assert bounds.round_trip <= clocks.there + clocks.back + 2 * clocks.jitter + 1e-3


def test_a_way_that_becomes_slow_makes_no_sign_of_life_newer_by_more_than_its_bound() -> None:
    clocks = Clocks(1000.0, 0.0)
    for _ in range(100):
        clocks.exchange()
    clocks.back = 2.0
    for _ in range(2000):
        clocks.exchange()
        assert clocks.bounds.value - clocks.true(clocks.t) <= MOST_ROUND_TRIP / 2.0 + 1e-9


@pytest.mark.parametrize("step", [3600.0, -3600.0, 0.5, -0.5])
def test_a_clock_that_steps_ends_the_link(step: float) -> None:
    clocks = Clocks(5.0, 0.0)
    for _ in range(10):
        clocks.exchange()
    clocks.offset += step
    with raises_code(ConnectionLost, "clock_stepped"):
        clocks.exchange()


class Ends:
    """Both ends of a link, each with the memory of an arm and its gripper."""

    def __init__(self) -> None:
        left, right = _tcp_pair()
        self.raw = right.dup()
        self.here, self.there = RigLink(left, "there", 0.0), RigLink(right, "here", 0.0)
        self.memories = [_memory(), _memory()]
        self.arm, self.served = (memory.robots["arm"] for memory in self.memories)
        for link in (self.here, self.there):
            link.post("hello")
        for _ in range(3):
            self.exchange()
        own, far = self.memories
        self.here.outgoing = boxes_of_program([own], own.robots, own.grippers)
        self.there.incoming = boxes_of_program([far], far.robots, far.grippers, {"arm": LONGEST})

    def exchange(self) -> None:
        """Send what is new, both ways."""
        for sender, reader in ((self.here, self.there), (self.there, self.here)):
            sender._t_sent = -math.inf
            sender.send()
            reader.wait(1.0)
            reader.receive()

    def frames(self, *records: Any) -> list[bytes]:
        """Return the frame after each of these commands, none of which arrives by itself."""
        found = []
        for record in records:
            self.arm.put_command(record)
            self.here.send()
            found.append(self.raw.recv(1 << 16))
        return found

    def arrive(self, data: bytes) -> None:
        """Let these bytes arrive."""
        self.there._buffer += data
        self.there.receive()


def _tcp_pair() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        left = socket.create_connection(server.getsockname())
        return left, server.accept()[0]


def _memory() -> GroupMemory:
    size = GroupMemory.size([("arm", N)], ["arm.gripper"])
    return GroupMemory(memoryview(bytearray(size)), [("arm", N)], ["arm.gripper"])


@pytest.fixture
def ends() -> Iterator[Ends]:
    """Both ends of a link."""
    made = Ends()
    yield made
    made.here.close()
    made.there.close()


def _command(seq: int, kind: Kind = Kind.JOINT_VELOCITY, values: tuple[float, ...] = (0.1,) * N) -> CommandRecord:
    now = time.monotonic()
    return CommandRecord(seq, 1, now, now + 0.1, kind, values)


def test_every_record_of_the_program_arrives_as_it_is(ends: Ends) -> None:
    now = time.monotonic()
    chunk = _command(3, Kind.JOINT_CHUNK, tuple(float(k) for k in range(4 * (N + 1))))
    ends.arm.put_command(chunk)
    ends.arm.put_deadman(DeadmanRecord(True, True, 5, now))
    ends.arm.put_session(SessionRecord(2, 1, 4))
    ends.memories[0].grippers["arm.gripper"].put_command(GripperCommand(1, 0, 2, GripperAct.MOVE, 0.01, 0.1, 20.0))
    ends.memories[0].app.write(now, 3)
    ends.exchange()
    arrived = ends.served.get_command()
    assert arrived is not None
    assert arrived.values == chunk.values
    half = ends.there.offset.round_trip / 2.0 + 1e-9
    deadman = ends.served.get_deadman()
    assert deadman is not None
    assert deadman[:3] == (True, True, 5)
    for t, sent in ((arrived.t, chunk.t), (arrived.deadline, chunk.deadline), (deadman.t_alive, now)):
        assert abs(t - sent) <= half, "one computer has one clock"
    assert ends.served.get_session() == SessionRecord(2, 1, 4)
    assert ends.memories[1].grippers["arm.gripper"].get_command() == GripperCommand(
        1, 0, 2, GripperAct.MOVE, 0.01, 0.1, 20.0
    )
    assert ends.memories[1].get_app().stops == 3


@pytest.mark.parametrize("seed", range(5))
def test_lost_repeated_and_swapped_frames_leave_the_newest_record_that_came(ends: Ends, seed: int) -> None:
    frames = list(enumerate(ends.frames(*(_command(seq) for seq in range(1, 21))), 1))
    chance = random.Random(seed)
    came = chance.sample(frames, 12) + chance.sample(frames, 6)
    newest = 0
    for seq, frame in came:
        ends.arrive(frame)
        newest = max(newest, seq)
        arrived = ends.served.get_command()
        assert arrived is not None
        assert arrived.seq == newest


def test_no_time_is_later_than_its_arrival_and_no_deadline_too_far(ends: Ends) -> None:
    far = time.monotonic() + 1000.0
    ends.arm.put_command(_command(1)._replace(t=far, deadline=math.inf, t_event=far))
    ends.arm.put_deadman(DeadmanRecord(True, True, 1, far))
    ends.memories[0].app.write(far, 0)
    ends.exchange()
    now, arrived, deadman = time.monotonic(), ends.served.get_command(), ends.served.get_deadman()
    assert arrived is not None
    assert deadman is not None
    assert max(arrived.t, arrived.t_event, deadman.t_alive, ends.memories[1].get_app().t) <= now
    assert arrived.deadline <= now + LONGEST
    ends.arm.put_command(_command(2, Kind.JOINT_CHUNK, (0.0,) * (N + 1))._replace(deadline=math.inf))
    ends.arm.put_deadman(DeadmanRecord(False, False, 1, -math.inf))
    ends.exchange()
    arrived, deadman = ends.served.get_command(), ends.served.get_deadman()
    assert arrived is not None
    assert arrived.deadline <= time.monotonic() + CHUNK_AHEAD
    assert deadman == DeadmanRecord(False, False, 1, -math.inf)


@pytest.mark.parametrize(
    "change",
    [
        lambda frame: struct.pack("<I", 1 << 30) + frame[4:],  # a length that no frame has
        lambda frame: frame[:36] + b"\xff\xff" + frame[38:],  # more records than there are
        lambda frame: frame[:36] + b"\x01\x00" + frame[38:],  # fewer
        lambda frame: frame.replace(struct.pack("<id", Kind.JOINT_VELOCITY, 0.0), struct.pack("<id", 99, 0.0)),
    ],
    ids=["length", "count", "few", "kind"],
)
def test_frames_that_make_no_sense_end_the_link(ends: Ends, change: Any) -> None:
    (frame,) = ends.frames(_command(1))
    changed = change(frame)
    assert changed != frame
    with raises_code(ConnectionLost, "bad_frame"):
        ends.arrive(changed)
    assert ends.served.get_command() is None


@pytest.mark.parametrize("of", ["command", "deadline", "deadman", "program"])
def test_a_time_that_is_no_number_ends_the_link(ends: Ends, of: str) -> None:
    if of == "deadman":
        ends.arm.put_deadman(DeadmanRecord(True, True, 1, math.nan))
    elif of == "program":
        ends.memories[0].app.write(math.nan, 0)
    else:
        ends.arm.put_command(_command(1)._replace(**{"t" if of == "command" else "deadline": math.nan}))
    with raises_code(ConnectionLost, "bad_frame"):
        ends.exchange()


def test_a_silent_end_is_gone(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    later = time.monotonic() + 2.1
    monkeypatch.setattr(time, "monotonic", lambda: later)
    with raises_code(ConnectionLost, "link_silent"):
        ends.there.receive()


def _arrive(reading: PadReading) -> ReceivedReadings:
    """Let a reading arrive at 10 s, from a clock that is 2 s behind."""
    box = ReceivedReadings()
    box.take(1, json.dumps([reading, ["a pad"]]).encode(), 2.0, 10.0)
    return box


def test_a_pad_gives_no_sign_of_life_later_than_its_arrival() -> None:
    for sent, arrived in ((7.0, 9.0), (9.0, 10.0)):
        reading = _arrive(PadReading(sent, sent, 0.0, 1, {"l2": 1.0}, ["l2"], True)).reading  # type: ignore[arg-type]
        assert reading is not None
        assert (reading.t, reading.t_alive, reading.buttons) == (arrived, arrived, {"l2"})


@pytest.mark.parametrize(
    "wrong", [{"t_alive": math.nan}, {"axes": {"l2": math.nan}}, {"connected": 1}, {"buttons": ["up"]}]
)
def test_a_reading_of_a_pad_that_makes_no_sense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="a reading"):
        _arrive(PadReading(1.0, 1.0, 0.0, 1, {}, [], True)._replace(**wrong))  # type: ignore[arg-type]
