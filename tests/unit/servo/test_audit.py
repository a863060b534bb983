from __future__ import annotations

import math
from dataclasses import replace

import pytest

from hal.driver import Setpoint
from hal.servo.audit import SetpointAudit
from hal.specs import LimitsSpec

LIMITS = LimitsSpec((-1.0, 0.0), (1.0, 4.0), (2.0, 1.0), (10.0, 5.0), (100.0, 50.0))
WITH_TORQUES = replace(LIMITS, torque=(20.0, 10.0))
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


def torques(*tau: float) -> Setpoint:
    return Setpoint((0.3, 2.0), (1.0, 1.0), (0.0, 0.0), tau)


def at(x: float) -> Setpoint:
    return Setpoint((x, 2.0), (0.0, 0.0), (0.0, 0.0))


def test_torques_are_judged_by_their_limits_and_their_rate_from_none_on() -> None:
    audit = SetpointAudit(WITH_TORQUES, DT)
    audit.add_setpoint(torques(0.0, 2.0))
    audit.add_setpoint(torques(5.0, -1.0))
    audit.add_setpoint(torques(10.0, -1.0))
    peaks = audit.peaks()
    assert peaks["torque"] == pytest.approx(0.5)
    assert peaks["torque_rate"] == pytest.approx(5.0 / DT / 1000.0)
    assert peaks["position"] == 0.0, "where such an arm goes was not commanded"


@pytest.mark.parametrize("before", range(125, 131))
def test_a_leap_between_torques_shows_wherever_a_batch_of_them_ends(before: int) -> None:
    audit = SetpointAudit(WITH_TORQUES, DT)
    for k in range(before):
        audit.add_setpoint(torques(0.1 * k, 0.0))
    audit.add_setpoint(torques(0.1 * before + 3.0, 0.0))
    for _ in range(200):
        audit.add_setpoint(torques(0.1 * before + 3.0, 0.0))
    peaks = audit.peaks()
    assert peaks["torque_rate"] == pytest.approx(3.1 / DT / 1000.0)
    assert peaks["torque"] == pytest.approx((0.1 * before + 3.0) / 20.0)


def test_a_reset_amid_torques_judges_what_came_and_begins_from_none() -> None:
    audit = SetpointAudit(WITH_TORQUES, DT)
    for k in range(10):
        audit.add_setpoint(torques(0.5 * k, 0.0))
    audit.reset()
    audit.add_setpoint(torques(2.0, 0.0))
    peaks = audit.peaks()
    assert peaks["torque"] == pytest.approx(4.5 / 20.0), "the last one before the reset"
    assert peaks["torque_rate"] == pytest.approx(2.0 / DT / 1000.0), "from none, not from those before"


def test_positions_after_torques_begin_a_new_stream() -> None:
    audit = SetpointAudit(WITH_TORQUES, DT)
    for _ in range(10):
        audit.add_setpoint(at(0.0))
    audit.add_setpoint(torques(1.0, 1.0))
    for _ in range(10):
        audit.add_setpoint(at(0.5))
    assert audit.peaks()["velocity"] == 0.0
    assert "torque" not in SetpointAudit(LIMITS, DT).peaks()


@pytest.mark.parametrize("tau", [(math.nan, 0.0), (0.0, math.inf)])
def test_torques_that_are_no_numbers_break_their_limits(tau: tuple[float, float]) -> None:
    audit = SetpointAudit(WITH_TORQUES, DT)
    audit.add_setpoint(torques(*tau))
    assert audit.peaks()["torque"] == math.inf
