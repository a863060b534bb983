"""The clock of a lock-step rig, and the rate of a loop on any clock."""

import itertools
import os
import threading

import pytest

import hal
from hal import CommandError
from hal.clock import Clock, LockStepClock, RealClock, describe_load


class Simulated:
    """Time that only advances on request."""

    def __init__(self) -> None:
        self.t = 0.0

    def advance_to(self, t: float) -> None:
        self.t = max(self.t, t)


def lock_step() -> tuple[LockStepClock, Simulated]:
    world = Simulated()
    return LockStepClock(lambda: world.t, world.advance_to), world


def test_simulated_time_stands_still_until_the_program_waits() -> None:
    clock, world = lock_step()
    assert clock.now() == clock.now() == 0.0
    clock.sleep(0.5)
    assert clock.now() == world.t == 0.5


def test_a_rate_turns_at_once_and_then_every_period() -> None:
    clock, _ = lock_step()
    clock.sleep(1.0)
    ticks = list(itertools.islice(clock.rate(50.0), 4))
    assert [tick.t for tick in ticks] == pytest.approx([1.0, 1.02, 1.04, 1.06])
    assert [tick.elapsed for tick in ticks] == pytest.approx([0.0, 0.02, 0.04, 0.06])


def test_late_turns_are_skipped_and_counted() -> None:
    clock, world = lock_step()
    turns = []
    for tick in clock.rate(10.0):
        turns.append((round(tick.t, 6), tick.missed, round(tick.dt, 6)))
        if len(turns) == 2:
            world.t += 0.35  # three and a half periods: the turns of 0.2 and 0.3 are over, that of 0.4 is late
        if len(turns) == 4:
            break
    assert turns == [(0.0, 0, 0.1), (0.1, 0, 0.1), (0.45, 2, 0.3), (0.5, 0, 0.1)]


def test_real_time_waits() -> None:
    clock: Clock = RealClock()
    before = clock.now()
    clock.sleep(0.01)
    assert clock.now() - before >= 0.01
    clock.sleep_until(clock.now() - 1.0)  # a time in the past is no error


def test_an_event_wakes_a_loop_between_its_turns() -> None:
    woken = threading.Event()
    ticks = []
    for tick in RealClock().rate(0.1, wake=woken):
        ticks.append(tick)
        if len(ticks) == 3:
            break
        woken.set()
    assert not woken.is_set()
    assert ticks[2].elapsed < 10.0
    assert [tick.dt for tick in ticks[1:]] == pytest.approx([b.t - a.t for a, b in itertools.pairwise(ticks)])


def test_an_event_wakes_a_loop_in_lock_step_4_ms_after_the_last_turn_at_the_earliest() -> None:
    clock, _ = lock_step()
    woken = threading.Event()
    clock.call_every(0.031, woken.set)
    ticks = list(itertools.islice(clock.rate(50.0, wake=woken), 5))
    assert [tick.elapsed for tick in ticks] == pytest.approx([0.0, 0.02, 0.031, 0.04, 0.06])
    woken.set()
    ticks = list(itertools.islice(clock.rate(50.0, wake=woken), 3))
    assert [tick.elapsed for tick in ticks] == pytest.approx([0.0, 0.004, 0.02])
    assert [tick.dt for tick in ticks[1:]] == pytest.approx([0.004, 0.016])


@pytest.mark.parametrize("hz", [0.0, -1.0, float("nan")])
def test_a_rate_must_be_positive(hz: float) -> None:
    with pytest.raises(CommandError):
        next(lock_step()[0].rate(hz))


class Looker:
    """Notes when it was called."""

    def __init__(self, clock: LockStepClock) -> None:
        self.clock = clock
        self.seen: list[float] = []

    def __call__(self) -> None:
        self.seen.append(round(self.clock.now(), 6))


def test_calls_come_at_their_times_however_long_the_wait() -> None:
    clock, world = lock_step()
    clock.sleep(1.0)
    slow, fast = Looker(clock), Looker(clock)
    clock.call_every(0.5, slow)
    end = clock.call_every(0.2, fast)
    clock.sleep(0.3)
    clock.sleep(0.7)
    assert slow.seen == [1.5, 2.0]
    assert fast.seen == [1.2, 1.4, 1.6, 1.8, 2.0]
    end()
    end()
    clock.sleep(1.0)
    assert slow.seen[2:] == [2.5, 3.0]
    assert len(fast.seen) == 5
    assert world.t == pytest.approx(3.0)


@pytest.mark.parametrize("first", [0, 1])
def test_calls_may_be_ended_in_any_order(first: int) -> None:
    clock, _ = lock_step()
    lookers = [Looker(clock), Looker(clock)]
    ends = [clock.call_every(0.1, looker) for looker in lookers]
    clock.sleep(0.25)
    ends[first]()
    clock.sleep(0.25)
    ends[1 - first]()
    clock.sleep(0.25)
    assert lookers[first].seen == [0.1, 0.2]
    assert lookers[1 - first].seen == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])


def test_a_call_may_end_itself_and_may_wait() -> None:
    clock, _ = lock_step()
    once = Looker(clock)

    def look() -> None:
        once()
        end()
        clock.sleep(0.05)
        once()

    end = clock.call_every(0.1, look)
    clock.sleep(1.0)
    assert once.seen == [0.1, 0.15]
    assert clock.now() == pytest.approx(1.0)


def test_overdue_calls_are_skipped() -> None:
    clock, world = lock_step()
    looker = Looker(clock)
    clock.call_every(0.1, looker)
    world.t = 0.35  # time went on in another thread meanwhile
    clock.sleep(0.1)
    assert looker.seen == pytest.approx([0.35, 0.4])


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
def test_the_period_of_calls_must_be_positive(seconds: float) -> None:
    with pytest.raises(CommandError):
        lock_step()[0].call_every(seconds, lambda: None)


def test_short_sleeps_of_a_rig_add_up() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        before = rig.clock.now()
        for _ in range(100):
            rig.clock.sleep(0.001)
        assert rig.clock.now() > before + 0.09


@pytest.mark.parametrize(("share", "told"), [(0.9, False), (2.0, True)])
def test_a_message_names_a_busy_computer(monkeypatch: pytest.MonkeyPatch, share: float, told: bool) -> None:
    monkeypatch.setattr("os.getloadavg", lambda: (share * (os.cpu_count() or 1), 0.0, 0.0))
    assert ("busy" in describe_load()) is told
