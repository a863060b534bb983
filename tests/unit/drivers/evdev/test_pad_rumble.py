"""The motors of a pad: the effect is uploaded once and played with one write, without blocking a caller."""

from __future__ import annotations

import fcntl
import math
import os
import struct
import threading
import time
from collections.abc import Iterator

import pytest
from evdev_kit import DS4, FakeInput, MakePad, poll, poll_until
from waiting import wait_until

from hal.drivers.evdev.pad import EvdevPad
from hal.drivers.evdev.rumble import Rumble
from hal.gamepad import RUMBLE_SECONDS, RUMBLE_STRONG, RUMBLE_WEAK, Gamepad
from hal.pads.codes import EV_FF, FF_RUMBLE

EVENT = struct.Struct("@llHHi")


class Kernel:
    """Takes effects, which it records, and play events, which the test reads."""

    def __init__(self) -> None:
        self.reader, self.writer = os.pipe()
        os.set_blocking(self.reader, False)
        self.effects: list[tuple[int, int, int, int]] = []
        """Type, number, strong and weak magnitude."""
        self.lengths: list[int] = []
        """ms"""
        self.asked = 0
        self.answer = threading.Event()
        self.answer.set()
        self.error: OSError | None = None

    def ioctl(self, fd: int, request: int, data: bytearray) -> int:
        assert (request & 0xFF, request >> 8 & 0xFF) == (0x80, ord("E"))
        assert request >> 16 & 0x3FFF == len(data)
        self.asked += 1
        assert self.answer.wait(10.0)
        if self.error is not None:
            raise self.error
        kind, number = struct.unpack_from("@Hh", data, 0)
        strong, weak = struct.unpack_from("@HH", data, 16)
        self.effects.append((kind, number, strong, weak))
        self.lengths.append(struct.unpack_from("@H", data, 10)[0])
        struct.pack_into("@h", data, 2, 5)
        return 0

    def played(self) -> list[tuple[int, int, int]]:
        """Return type, number and count of every event since the last call."""
        try:
            data = os.read(self.reader, 65536)
        except BlockingIOError:
            return []
        return [EVENT.unpack_from(data, at)[2:] for at in range(0, len(data), EVENT.size)]

    def close(self) -> None:
        self.answer.set()
        os.close(self.reader)
        os.close(self.writer)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Iterator[Kernel]:
    made = Kernel()
    monkeypatch.setattr(fcntl, "ioctl", made.ioctl)
    yield made
    made.close()


def is_ready(rumble: Rumble) -> bool:
    """Wait for an upload to end; return whether an effect is ready."""
    wait_until(lambda: not rumble._busy.locked())
    return rumble._ready is not None


def test_effect_has_the_layout_of_the_kernel(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """python-evdev has the same sizeof(struct ff_effect)."""
    evdev_ff = pytest.importorskip("evdev.ff", reason="needs python-evdev: pip install evdev-binary")
    import ctypes

    seen: list[int] = []

    def note(fd: int, request: int, data: bytearray) -> int:
        seen.append(len(data))
        return kernel.ioctl(fd, request, data)

    monkeypatch.setattr(fcntl, "ioctl", note)
    assert is_ready(Rumble(kernel.writer, 1.0, 0.5))
    assert (seen, evdev_ff.Effect.u.offset) == ([ctypes.sizeof(evdev_ff.Effect)], 16)


def test_effect_is_uploaded_once_and_played_with_one_write(kernel: Kernel) -> None:
    rumble = Rumble(kernel.writer, 1.0, 0.5)
    assert is_ready(rumble)
    assert (kernel.effects, kernel.played()) == ([(FF_RUMBLE, -1, 0xFFFF, 0x8000)], [])
    assert rumble.play(1.0, 0.5, RUMBLE_SECONDS)
    assert rumble.play(1.0, 0.5, RUMBLE_SECONDS)
    assert (kernel.played(), len(kernel.effects)) == ([(EV_FF, 5, 1), (EV_FF, 5, 1)], 1)


def test_other_strength_or_length_changes_the_effect_and_plays_it(kernel: Kernel) -> None:
    rumble = Rumble(kernel.writer, 1.0, 0.5)
    assert is_ready(rumble)
    assert rumble.play(0.0, 1.0, RUMBLE_SECONDS)
    assert is_ready(rumble)
    assert kernel.effects[1] == (FF_RUMBLE, 5, 0, 0xFFFF)
    assert kernel.played() == [(EV_FF, 5, 1)]
    assert rumble.play(0.0, 1.0, 0.2)
    assert is_ready(rumble)
    assert kernel.lengths == [round(1000 * RUMBLE_SECONDS)] * 2 + [200], "ms"
    assert kernel.played() == [(EV_FF, 5, 1)]


def test_slow_upload_blocks_no_caller(kernel: Kernel) -> None:
    """A pad that another program makes may take half a minute for an upload."""
    kernel.answer.clear()
    start = time.monotonic()
    rumble = Rumble(kernel.writer, 1.0, 0.5)
    assert not rumble.play(1.0, 0.5, RUMBLE_SECONDS)
    assert time.monotonic() - start < 5.0
    kernel.answer.set()
    assert is_ready(rumble)
    assert rumble.play(1.0, 0.5, RUMBLE_SECONDS)


def test_pad_without_room_for_an_effect_does_not_rumble(kernel: Kernel) -> None:
    kernel.error = OSError(28, "no room for another effect")
    rumble = Rumble(kernel.writer, 1.0, 0.5)
    assert not is_ready(rumble)
    rumble.close()
    assert not rumble.play(1.0, 0.5, 0.5)
    assert kernel.played() == []


# Behind the driver.


def test_polling_thread_plays_the_rumble(system: FakeInput, make_pad: MakePad, kernel: Kernel) -> None:
    node = system.plug(DS4)
    node.can_rumble = True
    pad = make_pad()
    wait_until(lambda: kernel.effects)
    assert kernel.effects == [(FF_RUMBLE, -1, round(RUMBLE_STRONG * 0xFFFF), round(RUMBLE_WEAK * 0xFFFF))]
    asked: list[bool] = []

    def shaken() -> bytes:
        caller = threading.Thread(target=lambda: asked.append(Gamepad(pad).rumble()))
        caller.start()
        caller.join(10.0)
        assert node.written() == b"", "not in the caller's thread"
        poll(pad)
        return node.written()

    wait_until(shaken)  # the effect may be ready a moment later
    assert all(asked)
    assert Gamepad(pad).rumble()
    poll(pad)
    assert EVENT.unpack(node.written())[2:] == (EV_FF, 5, 1)
    assert len(kernel.effects) == 1, "nothing is uploaded to play it"


def test_read_only_or_absent_pad_does_not_rumble(system: FakeInput, make_pad: MakePad) -> None:
    pad = make_pad()
    assert not Gamepad(pad).rumble()
    node = system.plug(DS4)
    poll_until(pad, lambda reading: reading.connected)
    assert pad.details()["rumbles"] == "no"
    assert not Gamepad(pad).rumble()
    system.unplug(node)
    assert not poll(pad).connected
    assert not Gamepad(pad).rumble()


def test_rumble_of_an_unplugged_pad_is_dropped(system: FakeInput, make_pad: MakePad, kernel: Kernel) -> None:
    node = system.plug(DS4)
    node.can_rumble = True
    pad: EvdevPad = make_pad()
    assert pad.rumble(1.0, 0.5, 0.5)
    system.unplug(node)
    assert not poll(pad).connected
    assert pad._rumble is None


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan])
def test_rumble_needs_a_positive_duration(system: FakeInput, make_pad: MakePad, kernel: Kernel, seconds: float) -> None:
    system.plug(DS4).can_rumble = True
    assert not Gamepad(make_pad()).rumble(seconds=seconds)
