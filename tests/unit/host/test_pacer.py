"""When a process in real time begins its cycles, on a made-up clock."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hal.host import main
from hal.host.main import PeriodicPace

PERIOD = 0.004


class Time:
    """Goes on while somebody sleeps or works."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def go_on(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    made = Time()
    monkeypatch.setattr(main, "time", SimpleNamespace(monotonic=made.monotonic, sleep=made.go_on))
    return made


def test_work_that_fits_delays_nothing(time: Time) -> None:
    pace = PeriodicPace(PERIOD)
    for turn in range(1, 501):
        assert pace.wait() == pytest.approx(100.0 + turn * PERIOD)
        time.go_on(0.9 * PERIOD)
    assert pace.missed == 0


def test_cycles_that_come_too_late_are_skipped_and_counted(time: Time) -> None:
    pace = PeriodicPace(PERIOD)
    pace.wait()
    time.go_on(3.5 * PERIOD)
    assert pace.wait() == pytest.approx(100.0 + 4.5 * PERIOD), "at once"
    assert pace.missed == 2
    assert pace.wait() == pytest.approx(100.0 + 5.0 * PERIOD), "the grid is the old one"
    assert pace.missed == 2


@pytest.mark.parametrize("request_s", [0.2 * PERIOD, 1.3 * PERIOD])
def test_requests_do_not_slow_the_pace(time: Time, request_s: float) -> None:
    pace = PeriodicPace(PERIOD)
    for turn in range(500):
        pace.wait()
        if turn % 8 == 0:
            time.go_on(request_s)
            pace.restart()
    assert time.now == pytest.approx(100.0 + 500 * PERIOD)
    assert pace.missed == 0


def test_a_request_that_takes_long_is_a_pause(time: Time) -> None:
    pace = PeriodicPace(PERIOD)
    pace.wait()
    time.go_on(100.5 * PERIOD)
    pace.restart()
    assert pace.wait() <= 100.0 + 102.5 * PERIOD
    assert pace.missed == 0
    before = pace.wait()
    assert pace.wait() - before == pytest.approx(PERIOD), "nothing is caught up"
    assert pace.periods.summary()["max"] == pytest.approx(PERIOD, rel=0.6), "and the pause was no period"
