"""What sets the pace of a group's cycle: requests in lock-step, a device, a computer that was suspended."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import pytest

from hal.host.main import DevicePace, StepPace, SuspensionWatch
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
    assert steps.heard(AppRecord(12345.0, 3)) == AppRecord(pytest.approx(0.1), 3)
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
    assert not suspension.ended()
    asleep[0] += 60.0
    assert suspension.ended()
    assert not suspension.ended()


def test_where_the_system_cannot_say_nothing_was_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(time, "CLOCK_BOOTTIME", raising=False)
    suspension = SuspensionWatch()
    assert not suspension.ended()
