"""What a RobotDriver that takes torques owes on top of that."""

from __future__ import annotations

import numpy as np
import pytest

from .benches import RobotBench
from .contract import needs
from .moving import RISE, STILL, cycles, drive, ramp

__all__ = ["TorqueChecks"]


class TorqueChecks:
    """Part of :class:`~hal.testing.RobotContract`; left out with the ability ``torque``."""

    @pytest.fixture
    def torqued(self, bench: RobotBench) -> RobotBench:
        """Open, and read."""
        bench.driver.open()
        cycles(bench, 2)
        return bench

    @needs("torque")
    def test_it_knows_its_inertia(self, torqued: RobotBench) -> None:
        q = cycles(torqued, 1)[-1].q
        mass = np.array(torqued.driver.mass_matrix(q), float)
        assert mass.shape == (len(q), len(q)), "mass_matrix: joint-space inertia (n, n), kg m2"
        assert mass == pytest.approx(mass.T, abs=1e-9), "an inertia is symmetric"
        assert (np.linalg.eigvalsh(mass) > 0.0).all(), "an inertia is positive in every direction"

    @needs("torque")
    def test_without_torque_it_carries_itself(self, torqued: RobotBench) -> None:
        first, *_, last = drive(torqued, 0, 0.0, 1.0)
        assert np.abs(np.subtract(last.q, first.q)).max() < STILL, "torques come on top of what carries the arm"

    @needs("torque")
    def test_a_torque_turns_its_joint_as_the_inertia_says(self, torqued: RobotBench) -> None:
        joint = torqued.joint
        first, second, *_ = drive(torqued, joint, 1.0, 0.2)
        mass = np.array(torqued.driver.mass_matrix(first.q), float)
        expected = np.linalg.solve(mass, np.eye(len(first.q))[joint])[joint] * torqued.dt
        assert second.dq[joint] - first.dq[joint] == pytest.approx(expected, rel=0.2), (
            "Nm, kg m2 and rad/s fit together"
        )
        assert second.fault is None
        assert cycles(torqued, 1)[-1].q[joint] > first.q[joint]

    @needs("torque", "rest")
    def test_without_new_torques_it_holds_by_itself(self, torqued: RobotBench) -> None:
        drive(torqued, torqued.joint, 1.0, 0.1)
        readings = cycles(torqued, len(torqued.turns(0.5)))
        assert np.abs(readings[-1].dq).max() < 5e-3, "torques are kept up for 20 ms, and then the arm holds by itself"
        assert np.abs(np.subtract(readings[-1].q, readings[-20].q)).max() < STILL

    @needs("torque")
    def test_after_torques_halt_holds_and_set_points_are_followed_again(self, torqued: RobotBench) -> None:
        joint = torqued.joint
        drive(torqued, joint, 1.0, 0.1)
        torqued.driver.halt()
        at_halt = cycles(torqued, 1)[-1].q
        rest = cycles(torqued, 60)[-1].q
        assert rest == pytest.approx(at_halt, abs=0.01), "halt holds where the arm is, at once"
        assert ramp(torqued, RISE)[-1].q[joint] == pytest.approx(rest[joint] + RISE, abs=0.01)
