"""The clock of a lock-step rig, and the rate of a loop on any clock."""

import itertools

import pytest

from hal.clock import Clock, LockStepClock, RealClock


class Simulated:
    """Time that goes on only when asked to."""

    def __init__(self) -> None:
        self.t = 0.0

    def advance_to(self, t: float) -> None:
        self.t = max(self.t, t)


def lock_step() -> tuple[LockStepClock, Simulated]:
    world = Simulated()
    return LockStepClock(lambda: world.t, world.advance_to), world


def test_simulated_time_stands_still_until_somebody_waits() -> None:
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


def test_turns_that_came_too_late_are_skipped_and_told() -> None:
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
    clock.sleep_until(clock.now() - 1.0)  # the past is no error


@pytest.mark.parametrize("hz", [0.0, -1.0, float("nan")])
def test_a_rate_must_be_positive(hz: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        next(lock_step()[0].rate(hz))
