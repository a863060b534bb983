"""From a camera's stamps to the host's clock."""

from __future__ import annotations

import random

import numpy as np
import pytest

from hal.drivers.realsense.stamps import GLOBAL, HARDWARE, SYSTEM, CaptureTimes, Unwrapped

WRAP = 2**32 * 1e-6
EPOCH = 1.7e9
"""Time of day when the monotonic clock began."""


def arrivals(seconds: float, way: float = 0.01, jitter: float = 0.02, seed: int = 1) -> list[tuple[float, float]]:
    """(capture, arrival) of a camera at 30 Hz, on the monotonic clock."""
    chance = random.Random(seed)
    return [(50.0 + k / 30.0, 50.0 + k / 30.0 + way + jitter * chance.random()) for k in range(int(seconds * 30))]


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6])
def test_the_sensors_own_clock_is_late_by_the_shortest_way_and_steady(drift: float) -> None:
    times = CaptureTimes()
    errors = []
    for taken, arrival in arrivals(60.0):
        t, _ = times((taken - 50.0) * (1.0 + drift) + 3.0, HARDWARE, arrival, EPOCH + arrival)
        assert t <= arrival
        errors.append(t - taken)
    settled = np.array(errors[30:])
    assert (abs(settled - 0.01) < 0.003).all()
    assert np.ptp(np.diff(settled)) < 0.002, "what jitters is the arrival, not the stamp"


def test_its_counter_may_begin_anew() -> None:
    times = CaptureTimes()
    out = [times((WRAP - 1.0 + taken) % WRAP, HARDWARE, arrival, 0.0) for taken, arrival in arrivals(3.0)]
    t, t_device = np.array(out).T
    assert np.allclose(np.diff(t_device), 1 / 30.0, atol=1e-5)
    assert (abs(t - [taken for taken, _ in arrivals(3.0)] - 0.01) < 0.021).all()
    unwrapped = Unwrapped()
    assert unwrapped(10.0) == 10.0
    assert unwrapped(9.9) == 9.9, "a step back is no wrap"


def test_a_camera_that_was_reset_or_a_recording_that_repeats_goes_on() -> None:
    times = CaptureTimes(played=True)
    first = [times(1000.0 + k / 30.0, HARDWARE, 50.0 + k / 30.0, 0.0)[0] for k in range(60)]
    again = [times(1000.0 + k / 30.0, HARDWARE, 52.0 + k / 30.0, 0.0)[0] for k in range(60)]
    assert np.allclose(first + again, 50.0 + np.arange(120) / 30.0, atol=0.001)


@pytest.mark.parametrize("domain", [GLOBAL, HARDWARE])
def test_a_recording_of_less_than_a_second_repeats_and_is_never_old(domain: str) -> None:
    times = CaptureTimes(played=True)
    ages = []
    for k in range(600):
        arrival = 50.0 + k / 30.0
        ages.append(arrival - times(1000.0 + (k % 20) / 30.0, domain, arrival, 0.0)[0])
    assert max(ages) < 0.001


@pytest.mark.parametrize("domain", [GLOBAL, SYSTEM])
def test_the_time_of_day_is_brought_to_the_monotonic_clock(domain: str) -> None:
    times = CaptureTimes()
    for taken, arrival in arrivals(2.0):
        t, t_device = times(EPOCH + taken, domain, arrival, EPOCH + arrival)
        assert t == pytest.approx(taken, abs=1e-6)
        assert t_device == EPOCH + taken


def test_a_clock_that_is_set_meanwhile_moves_no_capture_far() -> None:
    times = CaptureTimes()
    for k, (taken, arrival) in enumerate(arrivals(6.0)):
        late = 3600.0 if k >= 90 else 0.0  # the library's stamps follow at once or never: both are looked at
        t, _ = times(EPOCH + taken + (late if k >= 120 else 0.0), GLOBAL, arrival, EPOCH + arrival + late)
        assert arrival - 0.2 <= t <= arrival


def test_a_recordings_time_of_day_is_not_todays() -> None:
    times = CaptureTimes(played=True)
    t, _ = times(EPOCH - 5000.0, GLOBAL, 50.0, EPOCH)
    assert t == pytest.approx(50.0)


def test_times_only_go_forward() -> None:
    times = CaptureTimes()
    stamps = [times(1.0, HARDWARE, 50.0, 0.0), times(1.0, HARDWARE, 50.001, 0.0), times(1.01, HARDWARE, 50.0105, 0.0)]
    t = [stamp[0] for stamp in stamps]
    assert t[0] < t[1] < t[2]
