"""What an arm reports of its set-points is late, noisy or measured: the drive is the same, or a named fault ends it.

The vendor's own library between the servo and the emulator; one drive, once with true reports and once with each fault.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

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
    with Emulator("--lockstep", "--plant", "lag") as emulator:
        yield emulator


def drive(emulator: Emulator, *faults: str) -> tuple[Pose, float, dict[str, Any], str]:
    """Where the same drive ends, how far the tcp went (m), the arm's statistics, and what ended the drive."""
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
    return end, travel, statistics, ended


@pytest.mark.parametrize(
    ("fault", "lag", "noise"),
    [
        ("report-lag 0", 0, 2e-7),
        ("report-lag 1", 1, 2e-7),
        ("report-lag 2", 2, 2e-7),
        ("report-lag 5", 5, 2e-7),
        ("report-noise 1e-6", 0, 2e-5),
    ],
)
def test_late_and_noisy_reports_are_recognised(fr3: Emulator, fault: str, lag: int, noise: float) -> None:
    clean, travelled, _, ended = drive(fr3)
    assert travelled > 0.2
    assert not ended
    end, travel, statistics, ended = drive(fr3, fault)
    assert not ended
    assert end.distance(clean)[0] <= APART
    assert travel == pytest.approx(travelled, rel=0.05)
    assert statistics["report_lag"] == lag
    assert statistics["report_noise"] <= noise
    assert statistics["reanchored"] <= 20
    assert max(statistics["peak"].values()) <= 1.0


def test_measured_positions_are_recognised(lagging: Emulator) -> None:
    clean, travelled, _, _ = drive(lagging)
    end, travel, statistics, ended = drive(lagging, "report-measured on")
    assert not ended
    assert travel == pytest.approx(travelled, rel=0.05)
    assert end.distance(clean)[0] <= APART
    assert statistics["reports"] == "measured positions"
    assert statistics["reanchored"] <= 20


def test_reports_that_fit_nothing_are_a_fault_with_a_name(fr3: Emulator) -> None:
    _, _, statistics, ended = drive(fr3, "report-lag 9")
    assert "was sent" in ended
    assert "reported" in ended
    assert statistics["mismatches"] > 20
    assert max(statistics["peak"].values()) <= 1.0
    _, travel, _, ended = drive(fr3)  # nothing is left of it
    assert travel > 0.2
    assert not ended
