from __future__ import annotations

import math

import pytest

from hal.servo.audit import SetpointAudit
from hal.specs import LimitsSpec

LIMITS = LimitsSpec((-1.0, 0.0), (1.0, 4.0), (2.0, 1.0), (10.0, 5.0), (100.0, 50.0))
DT = 0.01


def test_ratios_of_a_known_motion() -> None:
    audit = SetpointAudit(LIMITS, DT)
    w = 2.0
    for k in range(1000):
        audit.add((0.5 * math.sin(w * k * DT), 2.0))
    peaks = audit.peaks()
    assert peaks["position"] == pytest.approx(0.5, rel=1e-3)
    assert peaks["velocity"] == pytest.approx(0.5 * w / 2.0, rel=1e-3)
    assert peaks["acceleration"] == pytest.approx(0.5 * w**2 / 10.0, rel=1e-3)
    assert peaks["jerk"] == pytest.approx(0.5 * w**3 / 100.0, rel=1e-3)


def test_one_step_breaks_every_derivative() -> None:
    audit = SetpointAudit(LIMITS, DT)
    for x in (0.0, 0.0, 0.0, 0.0, 0.1):
        audit.add((x, 2.0))
    peaks = audit.peaks()
    assert peaks["velocity"] == pytest.approx(0.1 / DT / 2.0)
    assert peaks["acceleration"] == pytest.approx(0.1 / DT**2 / 10.0)
    assert peaks["jerk"] == pytest.approx(0.1 / DT**3 / 100.0)


def test_a_reset_forgives_a_leap_and_keeps_the_peaks() -> None:
    audit = SetpointAudit(LIMITS, DT)
    for k in range(10):
        audit.add((0.01 * k, 2.0))
    before = audit.peaks()
    audit.reset()
    for _ in range(10):
        audit.add((-0.05, 3.0))
    assert audit.peaks() == before | {"position": 0.5}


def test_an_excursion_shows_in_the_position() -> None:
    audit = SetpointAudit(LIMITS, DT)
    audit.add((0.0, 4.2))
    assert audit.peaks()["position"] == pytest.approx(2.2 / 2.0)


def test_a_set_point_that_is_no_number_breaks_every_limit() -> None:
    audit = SetpointAudit(LIMITS, DT)
    for k in range(10):
        audit.add((math.nan if k == 5 else 0.0, 2.0))
    assert set(audit.peaks().values()) == {math.inf}
    audit.add((0.0, 2.0))
    assert set(audit.peaks().values()) == {math.inf}, "and is not forgotten"
