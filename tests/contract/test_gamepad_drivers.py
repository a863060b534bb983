"""What every GamepadDriver owes to the public Gamepad, and to the dead-man behind it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from hal.gamepad import PadReading
from hal.types import AXES, BUTTONS

from .benches import PADS, PadBench


@pytest.fixture(params=PADS)
def bench(request: pytest.FixtureRequest) -> Iterator[PadBench]:
    with PADS[request.param]() as bench:
        yield bench


def poll(bench: PadBench) -> PadReading:
    return bench.driver.poll(bench.pass_time(), 0.0)


def poll_until_pressed(bench: PadBench) -> list[PadReading]:
    bench.press_south()
    readings = []
    for _ in range(3000):
        readings.append(poll(bench))
        if "south" in readings[-1].buttons:
            return readings
    raise AssertionError("south was never pressed")


def test_names_and_ranges(bench: PadBench) -> None:
    bench.driver.open()
    for reading in poll_until_pressed(bench):
        assert set(reading.axes) <= set(AXES)
        assert reading.buttons <= set(BUTTONS)
        for name, value in reading.axes.items():
            assert (0.0 if name in ("l2", "r2") else -1.0) <= value <= 1.0


def test_stamps(bench: PadBench) -> None:
    bench.driver.open()
    readings = poll_until_pressed(bench)
    for reading in readings:
        assert reading.connected
        assert reading.t <= bench.now
        assert reading.t_alive <= bench.now
    for before, after in itertools.pairwise(readings):
        assert after.t >= before.t
        assert after.t_alive >= before.t_alive
        assert after.seq >= before.seq
    assert readings[-1].seq > readings[0].seq or len(readings) == 1


def test_a_pad_that_is_there_shows_life_without_events(bench: PadBench) -> None:
    bench.driver.open()
    if not bench.driver.proves_liveness:
        return
    poll_until_pressed(bench)
    readings = [poll(bench) for _ in range(20)]
    assert readings[-1].t_alive - readings[0].t_alive == pytest.approx(19 * bench.dt, abs=0.05)


def test_nothing_is_pressed_on_a_pad_that_is_unplugged(bench: PadBench) -> None:
    if bench.unplug is None or bench.replug is None:
        return
    bench.driver.open()
    pressed = poll_until_pressed(bench)[-1]
    bench.unplug()
    poll(bench)
    gone = poll(bench)
    assert (gone.connected, gone.buttons) == (False, frozenset())
    assert not any(gone.axes.values())
    assert gone.t_alive <= pressed.t_alive + 2 * bench.dt
    bench.replug()
    assert any(poll(bench).connected for _ in range(20)), "it comes back by itself"


def test_close_may_be_repeated_or_come_first(bench: PadBench) -> None:
    bench.driver.close()
    bench.driver.open()
    assert poll(bench).connected
    bench.driver.close()
    bench.driver.close()


def test_it_says_what_it_is(bench: PadBench) -> None:
    assert bench.driver.describe()
