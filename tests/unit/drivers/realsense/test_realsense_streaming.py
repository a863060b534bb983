"""Capture times, and the matching of frame sets."""

from __future__ import annotations

import random

import numpy as np
import pytest

pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")

from hal.drivers.realsense.streaming import (  # isort: skip
    GLOBAL,
    HARDWARE,
    SYSTEM,
    CaptureNumbers,
    CaptureTimes,
    ClockUnwrapper,
    FrameMatch,
    FrameMatcher,
    FrameStamp,
    measure_skew,
)

WRAP = 2**32 * 1e-6
EPOCH = 1.7e9
"""Time of day when the monotonic clock began."""


def arrivals(seconds: float, delay: float = 0.01, jitter: float = 0.02, seed: int = 1) -> list[tuple[float, float]]:
    """(capture, arrival) of a camera at 30 Hz, on the monotonic clock."""
    chance = random.Random(seed)
    return [(50.0 + k / 30.0, 50.0 + k / 30.0 + delay + jitter * chance.random()) for k in range(int(seconds * 30))]


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6])
def test_hardware_times_are_steady_and_late_by_the_shortest_delay(drift: float) -> None:
    times = CaptureTimes()
    errors = []
    for taken, arrival in arrivals(60.0):
        t, _ = times((taken - 50.0) * (1.0 + drift) + 3.0, HARDWARE, arrival, EPOCH + arrival)
        assert t <= arrival
        errors.append(t - taken)
    settled = np.array(errors[30:])
    assert (abs(settled - 0.01) < 0.003).all()
    assert np.ptp(np.diff(settled)) < 0.002, "the arrival jitters, not the stamp"


def test_the_hardware_counter_may_wrap() -> None:
    times = CaptureTimes()
    out = [times((WRAP - 1.0 + taken) % WRAP, HARDWARE, arrival, 0.0) for taken, arrival in arrivals(3.0)]
    t, t_device = np.array(out).T
    assert np.allclose(np.diff(t_device), 1 / 30.0, atol=1e-5)
    assert (abs(t - [taken for taken, _ in arrivals(3.0)] - 0.01) < 0.021).all()
    unwrap = ClockUnwrapper()
    assert unwrap(10.0) == 10.0
    assert unwrap(9.9) == 9.9, "a step back is not a wrap"


def test_times_continue_after_a_reset_or_when_a_recording_repeats() -> None:
    times = CaptureTimes(played=True)
    first = [times(1000.0 + k / 30.0, HARDWARE, 50.0 + k / 30.0, 0.0)[0] for k in range(60)]
    again = [times(1000.0 + k / 30.0, HARDWARE, 52.0 + k / 30.0, 0.0)[0] for k in range(60)]
    assert np.allclose(first + again, 50.0 + np.arange(120) / 30.0, atol=0.001)


@pytest.mark.parametrize("domain", [GLOBAL, HARDWARE])
def test_a_repeating_recording_of_less_than_a_second_is_never_old(domain: str) -> None:
    times = CaptureTimes(played=True)
    ages = []
    for k in range(600):
        arrival = 50.0 + k / 30.0
        ages.append(arrival - times(1000.0 + (k % 20) / 30.0, domain, arrival, 0.0)[0])
    assert max(ages) < 0.001


@pytest.mark.parametrize("domain", [GLOBAL, SYSTEM])
def test_the_time_of_day_is_converted_to_the_monotonic_clock(domain: str) -> None:
    times = CaptureTimes()
    for taken, arrival in arrivals(2.0):
        t, t_device = times(EPOCH + taken, domain, arrival, EPOCH + arrival)
        assert (t, t_device) == (pytest.approx(taken, abs=1e-6), EPOCH + taken)


def test_setting_the_clock_moves_no_capture_far() -> None:
    times = CaptureTimes()
    for k, (taken, arrival) in enumerate(arrivals(6.0)):
        late = 3600.0 if k >= 90 else 0.0  # the library's stamps follow at once or later: here later
        t, _ = times(EPOCH + taken + (late if k >= 120 else 0.0), GLOBAL, arrival, EPOCH + arrival + late)
        assert arrival - 0.2 <= t <= arrival


def test_the_time_of_day_of_a_recording_is_not_the_present_one() -> None:
    times = CaptureTimes(played=True)
    t, _ = times(EPOCH - 5000.0, GLOBAL, 50.0, EPOCH)
    assert t == pytest.approx(50.0)


def test_times_always_increase() -> None:
    times = CaptureTimes()
    stamps = [times(1.0, HARDWARE, 50.0, 0.0), times(1.0, HARDWARE, 50.001, 0.0), times(1.01, HARDWARE, 50.0105, 0.0)]
    t = [stamp[0] for stamp in stamps]
    assert t[0] < t[1] < t[2]


# Matching.

NEW, REPEATED, MISMATCHED = FrameMatch.NEW, FrameMatch.REPEATED, FrameMatch.MISMATCHED


def pair(depth: int, color: int, late: float = 0.0, domain: str = "hardware") -> dict[str, FrameStamp]:
    """Frames with these numbers, of a camera at 30 Hz."""
    return {
        "depth": FrameStamp(depth, depth / 30.0, "hardware"),
        "color": FrameStamp(color, color / 30.0 + late, domain),
    }


def arrived(depth: int, color: int, late: float) -> dict[str, FrameStamp]:
    """Frames without metadata, whose stamps are times of arrival."""
    return {
        "depth": FrameStamp(depth, depth / 30.0, "system"),
        "color": FrameStamp(color, depth / 30.0 + late, "system"),
    }


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        pytest.param(
            [pair(1, 1), pair(2, 2), pair(2, 2), pair(3, 3)], [NEW, NEW, REPEATED, NEW], id="each capture once"
        ),
        pytest.param(
            [pair(1, 1), pair(2, 1), pair(2, 2), pair(2, 3), pair(3, 3)],
            [NEW, MISMATCHED, NEW, REPEATED, NEW],
            id="a filled-in frame does not use up the other",
        ),
        pytest.param(
            [pair(1, 1, 0.016), pair(2, 2, 0.017), pair(3, 3, -0.017)],
            [NEW, MISMATCHED, MISMATCHED],
            id="half a period is the limit",
        ),
        pytest.param([pair(1, 1, 1000.0, "system")], [NEW], id="stamps of two clocks are not compared"),
        pytest.param([pair(90, 90), pair(1, 1)], [NEW, NEW], id="numbers that restart"),
        pytest.param(
            [
                arrived(1, 7, 0.025),
                arrived(2, 8, 0.02),
                arrived(3, 8, -0.013),
                arrived(3, 9, 0.03),
                arrived(4, 11, 0.034),
            ],
            [NEW, NEW, MISMATCHED, NEW, MISMATCHED],
            id="without metadata by arrival and number",
        ),
    ],
)
def test_which_frame_sets_are_captures(sets: list[dict[str, FrameStamp]], expected: list[FrameMatch]) -> None:
    matcher = FrameMatcher({"depth": 30.0, "color": 30.0})
    assert [matcher.classify(frames) for frames in sets] == expected


def test_skew_is_known_for_capture_times_of_one_clock_only() -> None:
    assert measure_skew(pair(1, 1, 0.004)) == pytest.approx(0.004)
    assert measure_skew(pair(1, 1, 1000.0, "system")) is None
    assert measure_skew(arrived(1, 7, 0.025)) is None
    assert measure_skew({"color": FrameStamp(1, 0.0, "system")}) is None


def test_the_slowest_stream_leads() -> None:
    matcher = FrameMatcher({"depth": 30.0, "color": 15.0})
    assert matcher.lead == "color"
    sets = [{"depth": pair(k, k)["depth"], "color": FrameStamp(1, 1 / 30.0, "hardware")} for k in (1, 2, 3)]
    assert [matcher.classify(frames) for frames in sets] == [NEW, REPEATED, REPEATED]
    following = {"depth": FrameStamp(3, 3 / 30.0, "hardware"), "color": FrameStamp(2, 3 / 30.0, "hardware")}
    assert matcher.classify(following) is NEW
    assert FrameMatcher({"color": 30.0, "depth": 30.0}).lead == "depth"


def test_capture_numbers_continue_when_the_cameras_restart() -> None:
    number = CaptureNumbers()
    assert [number(k) for k in (5, 6, 9, 1, 2, 4, 4)] == [5, 6, 9, 10, 11, 13, 14]
