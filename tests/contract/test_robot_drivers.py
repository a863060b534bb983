"""What every RobotDriver owes to the servo above it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from hal.errors import CommandError, ConnectionLost, NotSupported
from hal.robot import Reading, Setpoint

from .benches import ROBOTS, RobotBench

JOINT = 3
STILL = 2e-3  # rad; an arm that nobody moves may settle by this


@pytest.fixture(params=ROBOTS)
def bench(request: pytest.FixtureRequest) -> Iterator[RobotBench]:
    with ROBOTS[request.param]() as bench:
        yield bench


def cycles(bench: RobotBench, count: int) -> list[Reading]:
    return [bench.driver.read(bench.pass_time()) for _ in range(count)]


def ramp(bench: RobotBench, rise: float, seconds: float = 0.5) -> list[Reading]:
    """Raise one joint by ``rise`` rad along a smooth curve, as a servo would, and stay there a little."""
    start = np.array(bench.driver.read(bench.pass_time()).q)
    readings = []
    steps = round(seconds / bench.dt)
    for k in range(1, steps + 1):
        s, ds = k / steps, 1.0 / seconds
        q, dq = start.copy(), np.zeros_like(start)
        q[JOINT] += rise * (3 * s**2 - 2 * s**3)
        dq[JOINT] = rise * (6 * s - 6 * s**2) * ds
        bench.driver.write(Setpoint(tuple(q), tuple(dq), (0.0,) * len(q)))
        readings += cycles(bench, 1)
    return readings


def test_what_it_declares(bench: RobotBench) -> None:
    assert bench.driver.modes
    assert bench.driver.modes <= {"position", "velocity", "torque"}


def test_open_moves_nothing_and_reads(bench: RobotBench) -> None:
    bench.driver.open()
    first, *_, last = cycles(bench, 100)
    assert np.abs(np.subtract(last.q, first.q)).max() < STILL
    assert first.q == pytest.approx(bench.driver.spec.initial, abs=STILL)


def test_readings_are_whole_finite_and_stamped(bench: RobotBench) -> None:
    bench.driver.open()
    n = len(bench.driver.spec.joints)
    readings = ramp(bench, 0.1)
    for reading in readings:
        for values in (reading.q, reading.dq, reading.tau, reading.q_commanded, reading.dq_commanded, reading.tau_ext):
            assert values is None or (len(values) == n and np.isfinite(values).all())
        assert reading.wrench_ext is None or len(reading.wrench_ext) == 6
        assert reading.fault is None
    for before, after in itertools.pairwise(readings):
        assert after.t - before.t == pytest.approx(bench.dt)
        assert after.t_device > before.t_device
        assert after.seq > before.seq


def test_it_follows_set_points(bench: RobotBench) -> None:
    bench.driver.open()
    before = np.array(bench.driver.read(bench.pass_time()).q)
    readings = ramp(bench, 0.2)
    moved = np.array(readings[-1].q) - before
    assert moved[JOINT] == pytest.approx(0.2, abs=0.01)
    assert np.abs(np.delete(moved, JOINT)).max() < 0.01
    middle = readings[len(readings) // 2]
    assert middle.dq[JOINT] == pytest.approx(0.2 * 1.5 / 0.5, rel=0.1), "rad/s, at the steepest place of the curve"


def test_it_says_what_it_was_commanded(bench: RobotBench) -> None:
    bench.driver.open()
    reading = ramp(bench, 0.1)[-1]
    if reading.q_commanded is not None:
        assert reading.q_commanded[JOINT] == pytest.approx(bench.driver.spec.initial[JOINT] + 0.1, abs=STILL)


def test_without_new_set_points_it_rests(bench: RobotBench) -> None:
    bench.driver.open()
    ramp(bench, 0.2)
    first, *_, last = cycles(bench, 100)
    assert np.abs(np.subtract(last.q, first.q)).max() < STILL


def test_halt_holds_and_may_be_repeated(bench: RobotBench) -> None:
    bench.driver.open()
    start = bench.driver.read(bench.pass_time()).q[JOINT]
    ramp(bench, 0.2)
    bench.driver.halt()
    bench.driver.halt()
    readings = cycles(bench, 100)
    assert readings[-1].q[JOINT] == pytest.approx(start + 0.2, abs=0.01)
    assert np.abs(readings[-1].dq).max() < 0.01
    assert ramp(bench, -0.2)[-1].q[JOINT] == pytest.approx(start, abs=0.01), "it follows again afterwards"


def test_close_may_be_repeated_or_come_first(bench: RobotBench) -> None:
    bench.driver.close()
    bench.driver.open()
    bench.driver.close()
    bench.driver.close()


def test_it_can_be_opened_again_and_has_not_moved(bench: RobotBench) -> None:
    bench.driver.open()
    there = ramp(bench, 0.2)[-1].q
    bench.driver.close()
    for _ in range(100):
        bench.pass_time()
    bench.driver.open()
    assert cycles(bench, 2)[-1].q == pytest.approx(there, abs=0.01)


def test_a_lost_link_is_an_error_at_every_use_and_never_at_close(bench: RobotBench) -> None:
    bench.driver.open()
    reading = cycles(bench, 2)[-1]
    bench.lose()
    with pytest.raises(ConnectionLost):
        bench.driver.read(bench.pass_time())
    with pytest.raises(ConnectionLost):
        bench.driver.write(Setpoint(reading.q, (0.0,) * len(reading.q), (0.0,) * len(reading.q)))
    bench.driver.close()


def test_a_fault_has_a_cause_and_a_remedy_and_ends_with_recover(bench: RobotBench) -> None:
    if not bench.driver.simulated:
        with pytest.raises(NotSupported):
            bench.driver.inject(fault="too hot")
        return
    bench.driver.open()
    bench.driver.inject(fault="too hot")
    fault = cycles(bench, 1)[-1].fault
    assert fault is not None
    assert "too hot" in fault.cause
    assert fault.remedy
    before = cycles(bench, 1)[-1].q
    assert ramp(bench, 0.2)[-1].q == pytest.approx(before, abs=STILL), "a faulted arm does not move"
    bench.driver.recover()
    assert cycles(bench, 1)[-1].fault is None
    assert ramp(bench, 0.2)[-1].q[JOINT] == pytest.approx(before[JOINT] + 0.2, abs=0.01)


def test_an_unknown_fault_is_refused(bench: RobotBench) -> None:
    with pytest.raises((CommandError, NotSupported)):
        bench.driver.inject(no_such_knob=True)


# Of those that take torques.


@pytest.fixture
def torqued(bench: RobotBench) -> RobotBench:
    if "torque" not in bench.driver.modes:
        pytest.skip("takes no torques")
    bench.driver.open()
    cycles(bench, 2)
    return bench


def drive(bench: RobotBench, joint: int, tau: float, seconds: float) -> list[Reading]:
    """One torque, and none on the other joints, with set-points that say what was measured, as a servo's do."""
    readings = cycles(bench, 1)
    still = (0.0,) * len(readings[0].q)
    for _ in range(round(seconds / bench.dt)):
        torques = tuple(tau if k == joint else 0.0 for k in range(len(still)))
        bench.driver.write(Setpoint(readings[-1].q, readings[-1].dq, still, torques))
        readings += cycles(bench, 1)
    return readings


def test_it_knows_its_inertia(torqued: RobotBench) -> None:
    q = cycles(torqued, 1)[-1].q
    mass = np.array(torqued.driver.mass_matrix(q), float)
    assert mass.shape == (len(q), len(q))
    assert mass == pytest.approx(mass.T, abs=1e-9)
    assert (np.linalg.eigvalsh(mass) > 0.0).all()


def test_without_torque_it_carries_itself(torqued: RobotBench) -> None:
    first, *_, last = drive(torqued, 0, 0.0, 1.0)
    assert np.abs(np.subtract(last.q, first.q)).max() < STILL


def test_a_torque_turns_its_joint_as_the_inertia_says(torqued: RobotBench) -> None:
    first, second, *_ = drive(torqued, JOINT, 1.0, 0.2)
    mass = np.array(torqued.driver.mass_matrix(first.q), float)
    expected = np.linalg.solve(mass, np.eye(len(first.q))[JOINT])[JOINT] * torqued.dt
    assert second.dq[JOINT] - first.dq[JOINT] == pytest.approx(expected, rel=0.2)
    assert second.fault is None
    assert cycles(torqued, 1)[-1].q[JOINT] > first.q[JOINT]


def test_without_new_torques_it_holds_by_itself(torqued: RobotBench) -> None:
    drive(torqued, JOINT, 1.0, 0.1)
    readings = cycles(torqued, round(0.5 / torqued.dt))
    assert np.abs(readings[-1].dq).max() < 5e-3
    assert np.abs(np.subtract(readings[-1].q, readings[-20].q)).max() < STILL


def test_after_torques_halt_holds_and_set_points_are_followed_again(torqued: RobotBench) -> None:
    drive(torqued, JOINT, 1.0, 0.1)
    torqued.driver.halt()
    at_halt = cycles(torqued, 1)[-1].q
    rest = cycles(torqued, 60)[-1].q
    assert rest == pytest.approx(at_halt, abs=0.01)
    assert ramp(torqued, 0.2)[-1].q[JOINT] == pytest.approx(rest[JOINT] + 0.2, abs=0.01)
