"""What an arm reports of its set-points is late, noisy or measured: the drive is the same, or a named fault ends it.

The vendor's own library between the servo and the emulator; one drive, once with true reports and once with each fault.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

import hal
from hal.geometry import Pose

from .franka_kit import Emulator
from .rig_kit import arm_of, rig_of

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytestmark = pytest.mark.slow

APART = 0.003
"""By how much the ends may differ, m."""


@pytest.fixture(scope="module")
def lagging() -> Iterator[Emulator]:
    """An arm that is measured 10 ms behind what it is commanded."""
    with Emulator("--lockstep", "--unpaced", "--plant", "lag") as emulator:
        yield emulator


class Driven(NamedTuple):
    """How a drive went."""

    end: Pose
    travel: float
    """Way of the tcp, m."""
    statistics: dict[str, Any]
    error: str
    """The fault that ended it, if one did."""


@pytest.fixture(scope="module")
def clean(_lockstep_fr3: Emulator) -> Driven:
    """The drive with true reports."""
    driven = drive(_lockstep_fr3)
    assert driven.travel > 0.2
    assert not driven.error
    return driven


def drive(emulator: Emulator, *faults: str) -> Driven:
    """Drive along always the same path."""
    emulator.refresh()
    reflexes = len(emulator.events("reflex"))
    with rig_of(emulator.host, "fr3", lock_step=True) as rig:
        arm = arm_of(rig)
        for fault in faults:
            emulator.control.send(fault)
        rig.clock.sleep(0.1)
        before, travel, ended = arm.state().tcp, 0.0, ""
        with arm.control(rate_hz=50, unattended=True) as control:
            start = rig.clock.now()
            for tick in rig.clock.rate(50):
                t = tick.t - start
                if t > 3.0:
                    break
                velocity = np.array([0.1 * np.sin(2 * t), 0.1 * np.cos(3 * t), -0.05 * np.sin(t)])
                try:
                    control.send(hal.Twist(velocity, [0.0, 0.0, 0.3 * np.sin(2 * t)]))
                except hal.RobotFault as fault:
                    ended = str(fault)
                    break
                tcp = arm.state(max_age=1.0).tcp
                travel += before.distance(tcp)[0]
                before = tcp
        end = arm.state(max_age=1.0).tcp
        statistics = rig.statistics()["arm"]["robots"]["arm"]
    assert len(emulator.events("reflex")) == reflexes
    return Driven(end, travel, statistics, ended)


@pytest.mark.parametrize("fault", ["report-lag 5", "report-noise 1e-6"])
def test_late_and_noisy_reports_change_nothing(fr3: Emulator, clean: Driven, fault: str) -> None:
    end, travel, statistics, error = drive(fr3, fault)
    assert not error
    assert end.distance(clean.end)[0] <= APART
    assert travel == pytest.approx(clean.travel, rel=0.05)
    assert statistics["mismatches"] == 0
    assert statistics["reanchored"] <= 20
    assert max(statistics["peak"].values()) <= 1.0


def test_measured_positions_are_recognised(lagging: Emulator) -> None:
    true = drive(lagging)
    end, travel, statistics, error = drive(lagging, "report-measured on")
    assert not error
    assert travel == pytest.approx(true.travel, rel=0.05)
    assert end.distance(true.end)[0] <= APART
    assert statistics["mismatches"] == 0
    assert statistics["reanchored"] <= 20


def test_reports_that_fit_nothing_are_a_fault_with_a_name(fr3: Emulator) -> None:
    _, _, statistics, error = drive(fr3, "report-lag 9")
    assert "was sent" in error
    assert "reported" in error
    assert statistics["mismatches"] > 20
    assert max(statistics["peak"].values()) <= 1.0
    again = drive(fr3)  # nothing is left of it
    assert again.travel > 0.2
    assert not again.error


def test_numbers_that_are_not_finite_stop_the_arm(fr3: Emulator) -> None:
    with rig_of(fr3.host, lock_step=True) as rig:
        arm = arm_of(rig)
        for field in ("q", "dq", "tau_J", "q_d", "dq_d", "tau_ext_hat_filtered", "O_F_ext_hat_K"):
            for value in ("nan", "inf"):
                with (
                    pytest.warns(RuntimeWarning, match="impossible"),
                    arm.control(rate_hz=10, unattended=True) as control,
                ):
                    control.send(hal.Twist([0.0, 0.05, 0.0]))
                    rig.clock.sleep(0.05)
                    assert control.trip is hal.Trip.NONE
                    fr3.control.send(f"spoil {field} {value}")
                    rig.clock.sleep(0.01)
                    assert control.trip is hal.Trip.BAD_READING, (field, value)
                    fr3.control.send(f"spoil {field} off")
    assert not fr3.events("reflex")
