"""The contract of a RobotDriver: what the servo relies on."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest

from ..driver import Reading, Setpoint
from ..errors import CommandError, ConnectionLost, HalError, NotSupported, RobotFault, StaleStateError
from .benches import Contract, RobotBench, needs, run_in_thread, wait_lost, wait_restored
from .hosting import HostedRobot

_SLOW = 0.005
"""s; a call whose median is longer blocks. Far more than a cycle allows, for busy machines."""
_TOO_OLD = 0.3
"""s; age at which a state must be refused. ``Robot.state()`` allows 0.1 s."""
_RISE, _SECONDS = 0.2, 0.5
"""Distance that the checks move a joint, rad, and the time for it, s."""
_PEAK_SPEED = 1.875 * _RISE / _SECONDS
"""Speed in the middle of that motion, rad/s."""
_SPEED_TOLERANCE = 0.1
"""Relative tolerance of that speed."""
_STILL = 2e-3
"""rad; an arm without commands may settle by this."""
_ENGAGE_LIMIT = 1.0
"""s in which the drives must be on; that of the host."""
_SETTLING = 0.05
"""s in which an arm that lags a little reaches its last set-point."""


def _run(bench: RobotBench, count: int) -> list[Reading]:
    """Run cycles without a new set-point, and return their readings."""
    return [bench.driver.read(bench.pass_time()) for _ in range(count)]


def _engage(bench: RobotBench) -> None:
    """Switch the drives on as the host does, if they are off."""
    for _ in bench.turns(_ENGAGE_LIMIT):
        if bench.driver.engaged:
            return
        bench.driver.engage()
        _run(bench, 1)
    assert bench.driver.engaged, f"engage, called once per cycle, must end with engaged = True in {_ENGAGE_LIMIT:g} s"


def _ramp(bench: RobotBench, rise: float) -> list[Reading]:
    """Move one joint by ``rise`` rad along a smooth curve, from rest to rest, as a servo would.

    It starts at the set-point that the device reports, as every control session does.
    """
    _engage(bench)
    return _write_ramp(bench, rise)


def _write_ramp(bench: RobotBench, rise: float) -> list[Reading]:
    first = bench.driver.read(bench.pass_time())
    start = np.array(first.q if first.q_commanded is None else first.q_commanded)
    readings = []
    steps = round(_SECONDS / bench.dt)
    for k in range(1, steps + 1):
        s = k / steps
        q, dq, ddq = start.copy(), np.zeros_like(start), np.zeros_like(start)
        q[bench.joint] += rise * s**3 * (10 - 15 * s + 6 * s**2)
        dq[bench.joint] = rise * 30 * s**2 * (1 - s) ** 2 / _SECONDS
        ddq[bench.joint] = rise * 60 * s * (1 - 3 * s + 2 * s**2) / _SECONDS**2
        bench.driver.write(Setpoint(tuple(q.tolist()), tuple(dq.tolist()), tuple(ddq.tolist())))
        readings += _run(bench, 1)
    return readings


def _settle(bench: RobotBench) -> Reading:
    """Let an arm that holds come to rest, and return its last reading."""
    return _run(bench, round(_SETTLING / bench.dt) + 1)[-1]


def _apply_torque(bench: RobotBench, joint: int, tau: float, seconds: float) -> list[Reading]:
    """Apply a torque (Nm) to one joint, with the measured state as set-point, as a servo does."""
    _engage(bench)
    readings = _run(bench, 1)
    still = (0.0,) * len(readings[0].q)
    for _ in bench.turns(seconds):
        torques = tuple(tau if k == joint else 0.0 for k in range(len(still)))
        bench.driver.write(Setpoint(readings[-1].q, readings[-1].dq, still, torques))
        readings += _run(bench, 1)
    return readings


def _hold(bench: RobotBench, write: Callable[[Setpoint], object]) -> Callable[[], object]:
    """Return a call that writes the initial position as set-point."""
    still = (0.0,) * len(bench.initial)
    return lambda: write(Setpoint(tuple(bench.initial), still, still))


class RobotContract(Contract):
    """Checks of an arm's driver. The bench is a :class:`~hal.testing.RobotBench`.

    ``left_out`` may name ``lose``, ``restore``, ``freeze``, ``fail`` (a fault that ``recover`` clears), ``torque`` (the
    driver takes none), ``rest`` (it faults when set-points stop coming, instead of holding), ``holds`` (an arm without
    brakes, which sinks when the program that drives it is gone) and ``returns`` (a lost device is found again only by
    opening it again, not by reading).
    """

    abilities = ("lose", "restore", "freeze", "fail", "torque", "rest", "holds", "returns")

    # Opening and reading.

    def test_modes_are_declared(self, bench: RobotBench) -> None:
        known = {"position", "velocity", "torque"}
        assert bench.driver.modes, f"modes must name what the driver takes: some of {', '.join(sorted(known))}"
        assert bench.driver.modes <= known, f"modes may only name {', '.join(sorted(known))}"
        assert bench.driver.modes & {"position", "velocity"}, "torques alone hold no arm: take positions or velocities"

    def test_open_does_not_move_the_arm(self, bench: RobotBench) -> None:
        bench.driver.open()
        first, *_, last = _run(bench, 100)
        assert np.abs(np.subtract(last.q, first.q)).max() < _STILL, "neither open nor read may move the arm"
        assert first.q == pytest.approx(bench.initial, abs=_STILL), "q: measured joint positions, rad, base to tip"

    def test_readings_are_complete_finite_and_stamped(self, bench: RobotBench) -> None:
        bench.driver.open()
        n = len(bench.driver.spec.joints)
        readings = _ramp(bench, _RISE / 2)
        for reading in readings:
            for name in ("q", "dq", "tau", "q_commanded", "dq_commanded", "tau_ext", "tau_commanded"):
                values = getattr(reading, name)
                assert values is not None or name not in ("q", "dq"), f"{name} must not be None"
                assert values is None or len(values) == n, f"{name} has a number for each of the {n} joints, or is None"
                assert values is None or np.isfinite(values).all(), f"{name}: an unknown value is None"
            assert reading.wrench_ext is None or len(reading.wrench_ext) == 6
            assert reading.fault is None, f"no fault occurred, and it reports {reading.fault}"
        for before, after in itertools.pairwise(readings):
            assert after.t_device > before.t_device, "t_device is the device's own clock, and must advance"
            assert after.seq > before.seq, "seq counts the device's samples: each new one is greater"
            if bench.real_time:
                assert before.t - bench.dt < after.t < bench.now + bench.dt, (
                    "t is on the clock of `now`, and not ahead of it"
                )
            else:
                assert after.t - before.t == pytest.approx(bench.dt), "t is the `now` of the read that measured it"
        share = (readings[-1].t_device - readings[0].t_device) / (bench.dt * (len(readings) - 1))
        assert 0.5 < share < 2.0 or bench.real_time, "t_device is in seconds"

    def test_read_and_write_do_not_block(self, bench: RobotBench) -> None:
        bench.driver.open()
        _engage(bench)
        took: dict[str, list[float]] = {"read": [], "write": []}
        write = _hold(bench, bench.driver.write)
        for _ in range(30):
            now = bench.pass_time()
            for name, call in (("read", lambda: bench.driver.read(now)), ("write", write)):  # noqa: B023  # called here
                began = time.perf_counter()
                call()
                took[name].append(time.perf_counter() - began)
        for name, times in took.items():
            median = statistics.median(times)
            assert median < _SLOW, f"{name} took {1e3 * median:.1f} ms: the servo's cycle waits for it; never block"

    @needs("freeze")
    def test_a_frozen_device_repeats_its_stamps(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 5)
        bench.freeze()
        _run(bench, 3)  # samples that were under way
        first, *_, last = _run(bench, 20)
        repeat = "without a new sample return the last reading again: its age is how the servo notices"
        assert (last.t, last.t_device, last.seq) == (first.t, first.t_device, first.seq), repeat

    # Moving.

    def test_engage_moves_nothing_and_halt_keeps_it(self, bench: RobotBench) -> None:
        bench.driver.open()
        first, *_ = _run(bench, 3)
        took: list[float] = []
        while not bench.driver.engaged and len(took) < len(bench.turns(_ENGAGE_LIMIT)):
            began = time.perf_counter()
            bench.driver.engage()
            took.append(time.perf_counter() - began)
            _run(bench, 1)
        assert bench.driver.engaged, "engage must switch the drives on"
        assert not took or statistics.median(took) < _SLOW, "engage must not block: the host calls it again"
        last = _run(bench, 100)[-1]
        assert np.abs(np.subtract(last.q, first.q)).max() < _STILL, "engage holds the arm where it is"
        bench.driver.halt()
        assert _run(bench, 2)[-1].fault is None
        assert bench.driver.engaged, "halt keeps the drives on"

    def test_set_points_are_followed(self, bench: RobotBench) -> None:
        bench.driver.open()
        before = np.array(bench.driver.read(bench.pass_time()).q)
        readings = _ramp(bench, _RISE)
        moved = np.array(readings[-1].q) - before
        assert moved[bench.joint] == pytest.approx(_RISE, abs=0.01), "set-points are joint positions in rad"
        assert np.abs(np.delete(moved, bench.joint)).max(initial=0.0) < 0.01, "the other joints must not move"
        fastest = max(reading.dq[bench.joint] for reading in readings)
        assert fastest == pytest.approx(_PEAK_SPEED, rel=_SPEED_TOLERANCE), "dq: measured joint velocities, rad/s"

    def test_the_commanded_position_is_the_last_set_point(self, bench: RobotBench) -> None:
        bench.driver.open()
        reading = _ramp(bench, _RISE / 2)[-1]
        if reading.q_commanded is not None:
            target = bench.initial[bench.joint] + _RISE / 2
            assert reading.q_commanded[bench.joint] == pytest.approx(target, abs=_STILL), (
                "q_commanded is the last set-point that the device took; None if it is unknown"
            )

    @needs("rest")
    def test_without_new_set_points_the_arm_holds(self, bench: RobotBench) -> None:
        bench.driver.open()
        _ramp(bench, _RISE)
        first, *_, last = _run(bench, 100)
        assert np.abs(np.subtract(last.q, first.q)).max() < _STILL, "read must keep it holding while nothing is written"

    @needs("holds")
    def test_without_a_host_the_arm_holds(self, bench: RobotBench) -> None:
        bench.driver.open()
        _ramp(bench, _RISE)
        bench.driver.halt()
        before = _settle(bench).q
        for _ in bench.turns(1.0):
            bench.pass_time()
        assert _run(bench, 1)[-1].q == pytest.approx(before, abs=_STILL), "it must hold by itself: a host may be killed"

    def test_halt_holds_and_may_be_repeated(self, bench: RobotBench) -> None:
        bench.driver.open()
        start = bench.driver.read(bench.pass_time()).q[bench.joint]
        _ramp(bench, _RISE)
        bench.driver.halt()
        bench.driver.halt()
        readings = _run(bench, 100)
        assert readings[-1].q[bench.joint] == pytest.approx(start + _RISE, abs=0.01), "halt holds where the arm is"
        assert np.abs(readings[-1].dq).max() < 0.01
        again = _ramp(bench, -_RISE)[-1].q[bench.joint]
        assert again == pytest.approx(start, abs=0.01), "after halt it follows the next set-points"

    # Torques.

    @needs("torque")
    def test_the_mass_matrix_is_symmetric_and_positive(self, bench: RobotBench) -> None:
        bench.driver.open()
        q = _run(bench, 3)[-1].q
        mass = np.array(bench.driver.mass_matrix(q), float)
        assert mass.shape == (len(q), len(q)), "mass_matrix: joint-space inertia (n, n), kg m2"
        assert mass == pytest.approx(mass.T, abs=1e-9), "an inertia is symmetric"
        assert (np.linalg.eigvalsh(mass) > 0.0).all(), "an inertia is positive definite"

    @needs("torque")
    def test_zero_torque_compensates_gravity(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        first, *_, last = _apply_torque(bench, 0, 0.0, 1.0)
        assert np.abs(np.subtract(last.q, first.q)).max() < _STILL, "torques are added to the gravity compensation"

    @needs("torque")
    def test_a_torque_accelerates_its_joint_by_the_mass_matrix(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        joint = bench.joint
        first, second, *_ = _apply_torque(bench, joint, 1.0, 0.2)
        mass = np.array(bench.driver.mass_matrix(first.q), float)
        expected = np.linalg.solve(mass, np.eye(len(first.q))[joint])[joint] * bench.dt
        assert second.dq[joint] - first.dq[joint] == pytest.approx(expected, rel=0.2), (
            "torques in Nm, inertia in kg m2 and velocities in rad/s must agree"
        )
        assert second.fault is None
        assert _run(bench, 1)[-1].q[joint] > first.q[joint]

    @needs("torque", "rest")
    def test_without_new_torques_the_arm_holds(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        _apply_torque(bench, bench.joint, 1.0, 0.1)
        readings = _run(bench, len(bench.turns(0.5)))
        assert np.abs(readings[-1].dq).max() < 5e-3, "torques last for 20 ms, and then the arm must hold by itself"
        assert np.abs(np.subtract(readings[-1].q, readings[-20].q)).max() < _STILL

    @needs("torque")
    def test_after_torques_halt_holds_and_set_points_are_followed_again(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        joint = bench.joint
        _apply_torque(bench, joint, 1.0, 0.1)
        bench.driver.halt()
        at_halt = _run(bench, 1)[-1].q
        rest = _run(bench, 60)[-1].q
        assert rest == pytest.approx(at_halt, abs=0.01), "halt holds where the arm is, at once"
        assert _ramp(bench, _RISE)[-1].q[joint] == pytest.approx(rest[joint] + _RISE, abs=0.01)

    # Closing.

    def test_close_may_be_repeated_or_come_before_open(self, bench: RobotBench) -> None:
        bench.driver.close()
        bench.driver.open()
        bench.driver.close()
        bench.driver.close()

    def test_another_thread_may_close(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        run_in_thread(bench.driver.close)

    @needs("holds")
    def test_close_and_open_do_not_move_the_arm(self, bench: RobotBench) -> None:
        bench.driver.open()
        _ramp(bench, _RISE)
        bench.driver.halt()
        before = _settle(bench).q
        bench.driver.close()
        if not bench.driver.paces_itself:
            for _ in range(100):
                bench.pass_time()
        bench.driver.open()
        assert _run(bench, 2)[-1].q == pytest.approx(before, abs=0.01), "close and open must not move the arm"

    def test_a_driver_that_is_not_open_raises(self, bench: RobotBench) -> None:
        for _ in range(2):
            with pytest.raises(HalError):
                bench.driver.read(bench.now)
            with pytest.raises(HalError):
                _hold(bench, bench.driver.write)()
            bench.driver.open()
            bench.driver.close()

    # Lost links.

    @needs("lose")
    def test_a_lost_link_raises_at_every_call_except_close(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        bench.lose()
        wait_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        write = _hold(bench, bench.driver.write)
        for _ in range(3):
            with pytest.raises(ConnectionLost):
                bench.driver.read(bench.pass_time())
            with pytest.raises(ConnectionLost):
                write()
        bench.driver.close()
        bench.driver.close()

    @needs("lose", "restore")
    def test_a_restored_link_can_be_opened_again(self, bench: RobotBench) -> None:
        bench.driver.open()
        before = _run(bench, 2)[-1].q
        bench.lose()
        wait_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        bench.driver.close()
        bench.restore()
        wait_restored(bench, bench.driver.open)
        assert _run(bench, 2)[-1].q == pytest.approx(before, abs=_STILL), "the arm must be where it was"
        assert _ramp(bench, _RISE)[-1].q[bench.joint] == pytest.approx(before[bench.joint] + _RISE, abs=0.01)

    # Faults.

    @needs("fail")
    def test_a_fault_has_cause_code_and_remedy_until_recover(self, bench: RobotBench) -> None:
        bench.driver.open()
        _run(bench, 2)
        word = bench.fail()
        fault = next((r.fault for r in (_run(bench, 1)[-1] for _ in range(100)) if r.fault is not None), None)
        assert fault is not None, "the device has a fault: report it in Reading.fault"
        assert word in fault.cause, f"the cause must contain what happened: {word!r} is not in {fault.cause!r}"
        assert fault.code, "a fault has a code by which it can be looked up"
        assert fault.remedy, "a fault has a remedy: what a user can do about it"
        before = _run(bench, 1)[-1].q
        if bench.driver.engaged:
            assert _write_ramp(bench, _RISE)[-1].q == pytest.approx(before, abs=_STILL), "a faulted arm does not move"
        else:
            with pytest.raises(RobotFault):
                _engage(bench)
        bench.driver.recover()
        assert _run(bench, 2)[-1].fault is None, "recover clears the fault"
        reached = _ramp(bench, _RISE)[-1].q[bench.joint]
        assert reached == pytest.approx(before[bench.joint] + _RISE, abs=0.01), (
            "after recover the arm follows from where it stopped; set-points of the time of the fault are not kept"
        )

    def test_an_unknown_fault_to_inject_is_refused(self, bench: RobotBench) -> None:
        with pytest.raises((CommandError, NotSupported)):
            bench.driver.inject(no_such_fault=True)

    # Behind the public Robot.

    def test_an_app_reads_the_state(self, bench: RobotBench) -> None:
        with HostedRobot(bench) as hosted:
            state = hosted.run_cycles(5)
            assert state.q == pytest.approx(bench.initial, abs=_STILL)
            assert not state.q.flags.writeable

    @needs("freeze")
    def test_an_app_notices_a_frozen_device(self, bench: RobotBench) -> None:
        with HostedRobot(bench) as hosted:
            hosted.run_cycles(5)
            bench.freeze()
            with pytest.raises((StaleStateError, ConnectionLost)):
                hosted.run_cycles(round(_TOO_OLD / bench.dt))

    @needs("lose")
    def test_an_app_notices_a_lost_link(self, bench: RobotBench) -> None:
        with HostedRobot(bench) as hosted:
            hosted.run_cycles(5)
            bench.lose()
            wait_lost(bench, lambda: hosted.run_cycles(2))

    @needs("lose", "restore", "returns")
    def test_an_app_reads_again_after_the_link_is_restored(self, bench: RobotBench) -> None:
        with HostedRobot(bench) as hosted:
            hosted.run_cycles(5)
            bench.lose()
            wait_lost(bench, lambda: hosted.run_cycles(2))
            bench.restore()
            state = wait_restored(bench, lambda: hosted.run_cycles(2))
            assert state.q == pytest.approx(bench.initial, abs=_STILL), "read must find the device again by itself"
