"""Paces of a group's cycle: periodic, by a device, by steps in lock-step; and suspension of the computer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from hal.host import main
from hal.host.main import DevicePace, PeriodicPace, StepPace, SuspensionWatch
from hal.host.records import AppRecord


@dataclass
class FakeCycle:
    """As much of a cycle as a pace looks at."""

    dt: float = 0.01
    ticks: int = 0
    paces_itself: bool = False
    lost_cycles: int = 0
    waits: list[int] = field(default_factory=list)

    def wait(self) -> None:
        self.waits.append(self.ticks)


def test_steps_wait_for_the_app_and_go_as_far_as_it_says() -> None:
    cycle = FakeCycle()
    asked: list[float] = []

    def attend(timeout: float) -> None:
        asked.append(timeout)
        steps.grant(2)

    steps = StepPace(cycle, attend)
    assert steps.pausing
    for expected in (0.01, 0.02):
        assert steps.wait() == pytest.approx(expected)
        cycle.ticks += 1
    assert steps.pausing
    assert len(asked) == 1
    assert steps.wait() == pytest.approx(0.03)
    assert len(asked) == 2
    assert not cycle.waits, "nothing here sets the pace by itself"


def test_steps_tell_the_app_is_there_at_the_time_of_the_step() -> None:
    cycle = FakeCycle(ticks=9)
    steps = StepPace(cycle, lambda timeout: None)
    assert steps.adjust_heartbeat(AppRecord(12345.0, 3)) == AppRecord(pytest.approx(0.1), 3)
    assert steps.now() == pytest.approx(0.09)


def test_steps_of_a_device_read_it_once_each() -> None:
    cycle = FakeCycle(paces_itself=True)
    steps = StepPace(cycle, lambda timeout: None)
    steps.grant(3)
    for _ in range(3):
        steps.wait()
        cycle.ticks += 1
    assert cycle.waits == [0, 1, 2]


def test_without_the_app_steps_go_on_by_themselves() -> None:
    steps = StepPace(FakeCycle(), lambda timeout: None)
    steps.run_free()
    assert not steps.pausing
    assert steps.wait() > 0.0


def test_a_device_sets_the_pace_and_counts_what_it_lost() -> None:
    cycle = FakeCycle(paces_itself=True, lost_cycles=4)
    pace = DevicePace(cycle)
    before = time.monotonic()
    for _ in range(3):
        assert pace.wait() >= before
    assert len(cycle.waits) == 3
    assert pace.missed == 4
    assert pace.periods.count == 2


def test_a_suspension_is_noticed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asleep = [100.0]
    monkeypatch.setattr(time, "CLOCK_BOOTTIME", 7, raising=False)
    monkeypatch.setattr(time, "clock_gettime", lambda clock: time.monotonic() + asleep[0])
    suspension = SuspensionWatch()
    assert not suspension.was_suspended()
    asleep[0] += 60.0
    assert suspension.was_suspended()
    assert not suspension.was_suspended()


def test_where_the_system_cannot_say_nothing_was_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(time, "CLOCK_BOOTTIME", raising=False)
    suspension = SuspensionWatch()
    assert not suspension.was_suspended()


PERIOD = 0.004


class FakeTime:
    """A clock that advances only by sleeping and by work."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def advance(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    made = FakeTime()
    monkeypatch.setattr(main, "time", SimpleNamespace(monotonic=made.monotonic, sleep=made.advance))
    return made


def test_work_that_fits_delays_nothing(clock: FakeTime) -> None:
    pace = PeriodicPace(PERIOD)
    for turn in range(1, 501):
        assert pace.wait() == pytest.approx(100.0 + turn * PERIOD)
        clock.advance(0.9 * PERIOD)
    assert pace.missed == 0


def test_cycles_that_come_too_late_are_skipped_and_counted(clock: FakeTime) -> None:
    pace = PeriodicPace(PERIOD)
    pace.wait()
    clock.advance(3.5 * PERIOD)
    assert pace.wait() == pytest.approx(100.0 + 4.5 * PERIOD), "at once"
    assert pace.missed == 2
    assert pace.wait() == pytest.approx(100.0 + 5.0 * PERIOD), "the grid is the old one"
    assert pace.missed == 2


@pytest.mark.parametrize("request_s", [0.2 * PERIOD, 1.3 * PERIOD])
def test_requests_do_not_slow_the_pace(clock: FakeTime, request_s: float) -> None:
    pace = PeriodicPace(PERIOD)
    for turn in range(500):
        pace.wait()
        if turn % 8 == 0:
            clock.advance(request_s)
            pace.restart()
    assert clock.now == pytest.approx(100.0 + 500 * PERIOD)
    assert pace.missed == 0


def test_a_request_that_takes_long_is_a_pause(clock: FakeTime) -> None:
    pace = PeriodicPace(PERIOD)
    pace.wait()
    clock.advance(100.5 * PERIOD)
    pace.restart()
    assert pace.wait() <= 100.0 + 102.5 * PERIOD
    assert pace.missed == 0
    before = pace.wait()
    assert pace.wait() - before == pytest.approx(PERIOD), "nothing is caught up"
    assert pace.periods.summary()["max"] == pytest.approx(PERIOD, rel=0.6), "and the pause was no period"
