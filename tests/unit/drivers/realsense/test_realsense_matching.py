"""Which sets of pictures are captures."""

from __future__ import annotations

import pytest

pytest.importorskip("hal.drivers.realsense.matching")

from hal.drivers.realsense.matching import Matcher, Numbering, Taken, Verdict, skew

NEW, REPEATED, MISMATCHED = Verdict.NEW, Verdict.REPEATED, Verdict.MISMATCHED


def pair(depth: int, color: int, late: float = 0.0, domain: str = "hardware") -> dict[str, Taken]:
    """Pictures of a camera at 30 Hz whose numbers are those."""
    return {"depth": Taken(depth, depth / 30.0, "hardware"), "color": Taken(color, color / 30.0 + late, domain)}


def judged(*sets: dict[str, Taken]) -> list[Verdict]:
    matcher = Matcher({"depth": 30.0, "color": 30.0})
    return [matcher.judge(one) for one in sets]


def test_each_capture_counts_once() -> None:
    assert judged(pair(1, 1), pair(2, 2), pair(2, 2), pair(3, 3)) == [NEW, NEW, REPEATED, NEW]


def test_a_filled_in_picture_is_no_capture_and_does_not_use_up_the_other() -> None:
    assert judged(pair(1, 1), pair(2, 1), pair(2, 2), pair(2, 3), pair(3, 3)) == [NEW, MISMATCHED, NEW, REPEATED, NEW]


def test_half_a_period_is_the_bound() -> None:
    assert judged(pair(1, 1, 0.016), pair(2, 2, 0.017), pair(3, 3, -0.017)) == [NEW, MISMATCHED, MISMATCHED]


def test_two_clocks_are_not_compared() -> None:
    one = pair(1, 1, 1000.0, "system")
    assert judged(one) == [NEW]
    assert skew(one) is None
    assert skew(pair(1, 1, 0.004)) == pytest.approx(0.004)
    assert skew({"color": Taken(1, 0.0, "system")}) is None


def test_pictures_without_metadata_are_matched_by_arrival_and_number() -> None:
    def arrived(depth: int, color: int, late: float) -> dict[str, Taken]:
        return {"depth": Taken(depth, depth / 30.0, "system"), "color": Taken(color, depth / 30.0 + late, "system")}

    sets = (
        arrived(1, 7, 0.025),
        arrived(2, 8, 0.020),
        arrived(3, 8, -0.013),
        arrived(3, 9, 0.030),
        arrived(4, 11, 0.034),
    )
    assert judged(*sets) == [NEW, NEW, MISMATCHED, NEW, MISMATCHED]
    assert skew(sets[0]) is None, "how late they were taken does not follow from how late they came"


def test_the_slowest_stream_leads() -> None:
    matcher = Matcher({"depth": 30.0, "color": 15.0})
    assert matcher.lead == "color"
    sets = [pair(1, 1), pair(2, 1), pair(3, 1)]
    sets = [{"depth": one["depth"], "color": Taken(1, 1 / 30.0, "hardware")} for one in sets]
    assert [matcher.judge(one) for one in sets] == [NEW, REPEATED, REPEATED]
    nxt = {"depth": Taken(3, 3 / 30.0, "hardware"), "color": Taken(2, 3 / 30.0, "hardware")}
    assert matcher.judge(nxt) is NEW
    assert Matcher({"color": 30.0, "depth": 30.0}).lead == "depth"


def test_numbers_that_begin_anew_are_captures_too() -> None:
    assert judged(pair(90, 90), pair(1, 1)) == [NEW, NEW]
    number = Numbering()
    assert [number(k) for k in (5, 6, 9, 1, 2, 4, 4)] == [5, 6, 9, 10, 11, 13, 14]
