"""What every RobotDriver owes to the servo above it."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest

from ..driver import Setpoint
from ..errors import CommandError, ConnectionLost, HalError, NotSupported, StaleStateError
from .benches import RobotBench
from .contract import Contract, needs
from .hosting import Hosted
from .moving import MIDDLE, RISE, STEEPEST, STILL, cycles, ramp, settle
from .torque import TorqueChecks
from .waiting import comes_back, in_thread, is_lost

__all__ = ["RobotContract"]

_SLOW = 0.005
"""s; a call that takes longer, most of the time, blocks. Far more than a cycle may have, for busy machines."""
_TOO_OLD = 0.3
"""s; a state as old as that is one to act on no more: ``Robot.state()`` allows 0.1 s."""


def _sent(bench: RobotBench, call: Callable[[Setpoint], object]) -> Callable[[], object]:
    """A set-point that moves nothing, if nothing has moved."""
    still = (0.0,) * len(bench.initial)
    return lambda: call(Setpoint(tuple(bench.initial), still, still))


class RobotContract(TorqueChecks, Contract):
    """Checks of an arm's driver. The bench is a :class:`~hal.testing.RobotBench`.

    ``left_out`` may name ``lose``, ``restore``, ``freeze``, ``fail`` (a fault that ``recover`` clears), ``torque`` (the
    driver takes none), ``rest`` (it faults when set-points stop coming, instead of holding) and ``returns`` (a lost
    device is found again only by opening it anew, not by reading).
    """

    abilities = ("lose", "restore", "freeze", "fail", "torque", "rest", "returns")

    # What it is.

    def test_it_declares_what_set_points_it_takes(self, bench: RobotBench) -> None:
        known = {"position", "velocity", "torque"}
        assert bench.driver.modes, f"modes must name what the driver takes: some of {', '.join(sorted(known))}"
        assert bench.driver.modes <= known, f"modes may only name {', '.join(sorted(known))}"
        assert bench.driver.modes & {"position", "velocity"}, "torques alone hold no arm: take positions or velocities"

    # Opening and reading.

    def test_open_moves_nothing_and_reads(self, bench: RobotBench) -> None:
        bench.driver.open()
        first, *_, last = cycles(bench, 100)
        assert np.abs(np.subtract(last.q, first.q)).max() < STILL, "open must not move the arm, nor must reading"
        assert first.q == pytest.approx(bench.initial, abs=STILL), "q: measured joint positions, rad, base to tip"

    def test_readings_are_whole_finite_and_stamped(self, bench: RobotBench) -> None:
        bench.driver.open()
        n = len(bench.driver.spec.joints)
        readings = ramp(bench, RISE / 2)
        for reading in readings:
            for name in ("q", "dq", "tau", "q_commanded", "dq_commanded", "tau_ext", "tau_commanded"):
                values = getattr(reading, name)
                assert values is not None or name not in ("q", "dq"), f"{name} is always known"
                assert values is None or len(values) == n, f"{name} has a number for each of the {n} joints, or is None"
                assert values is None or np.isfinite(values).all(), f"{name}: what you cannot know is None"
            assert reading.wrench_ext is None or len(reading.wrench_ext) == 6
            assert reading.fault is None, f"nothing went wrong, and it reports {reading.fault}"
        for before, after in itertools.pairwise(readings):
            assert after.t_device > before.t_device, "t_device is the device's own clock, which goes on"
            assert after.seq > before.seq, "seq counts the device's samples: each new one is greater"
            if bench.real_time:
                assert before.t - bench.dt < after.t < bench.now + bench.dt, (
                    "t is on the clock of `now`, and not ahead of it"
                )
            else:
                assert after.t - before.t == pytest.approx(bench.dt), "t is the `now` of the read that measured it"
        share = (readings[-1].t_device - readings[0].t_device) / (bench.dt * (len(readings) - 1))
        assert 0.5 < share < 2.0 or bench.real_time, "t_device is in seconds"

    def test_reading_and_writing_do_not_block(self, bench: RobotBench) -> None:
        bench.driver.open()
        took: dict[str, list[float]] = {"read": [], "write": []}
        send = _sent(bench, bench.driver.write)
        for _ in range(30):
            now = bench.pass_time()
            for name, call in (("read", lambda: bench.driver.read(now)), ("write", send)):  # noqa: B023  # called here
                began = time.perf_counter()
                call()
                took[name].append(time.perf_counter() - began)
        for name, times in took.items():
            median = statistics.median(times)
            assert median < _SLOW, f"{name} took {1e3 * median:.1f} ms: the servo's cycle waits for it; never block"

    @needs("freeze")
    def test_a_device_that_freezes_shows_by_its_old_stamps(self, bench: RobotBench) -> None:
        bench.driver.open()
        cycles(bench, 5)
        bench.freeze()
        cycles(bench, 3)  # what was on its way
        first, *_, last = cycles(bench, 20)
        repeat = "when nothing new came, return the last reading again: its age is how the servo notices"
        assert (last.t, last.t_device, last.seq) == (first.t, first.t_device, first.seq), repeat

    # Moving.

    def test_it_follows_set_points(self, bench: RobotBench) -> None:
        bench.driver.open()
        before = np.array(bench.driver.read(bench.pass_time()).q)
        readings = ramp(bench, RISE)
        moved = np.array(readings[-1].q) - before
        assert moved[bench.joint] == pytest.approx(RISE, abs=0.01), "set-points are joint positions in rad"
        assert np.abs(np.delete(moved, bench.joint)).max(initial=0.0) < 0.01, "the other joints stay"
        fastest = max(reading.dq[bench.joint] for reading in readings)
        assert fastest == pytest.approx(STEEPEST, rel=MIDDLE), "dq: measured joint velocities, rad/s"

    def test_it_says_what_it_was_commanded(self, bench: RobotBench) -> None:
        bench.driver.open()
        reading = ramp(bench, RISE / 2)[-1]
        if reading.q_commanded is not None:
            there = bench.initial[bench.joint] + RISE / 2
            assert reading.q_commanded[bench.joint] == pytest.approx(there, abs=STILL), (
                "q_commanded is the set-point that the device took last; None where it cannot say"
            )

    @needs("rest")
    def test_without_new_set_points_it_rests(self, bench: RobotBench) -> None:
        bench.driver.open()
        ramp(bench, RISE)
        first, *_, last = cycles(bench, 100)
        assert np.abs(np.subtract(last.q, first.q)).max() < STILL, "it must hold by itself: a host may be killed"

    def test_halt_holds_and_may_be_repeated(self, bench: RobotBench) -> None:
        bench.driver.open()
        start = bench.driver.read(bench.pass_time()).q[bench.joint]
        ramp(bench, RISE)
        bench.driver.halt()
        bench.driver.halt()
        readings = cycles(bench, 100)
        assert readings[-1].q[bench.joint] == pytest.approx(start + RISE, abs=0.01), "halt holds where the arm is"
        assert np.abs(readings[-1].dq).max() < 0.01
        again = ramp(bench, -RISE)[-1].q[bench.joint]
        assert again == pytest.approx(start, abs=0.01), "after halt it follows the next set-points"

    # Closing.

    def test_close_may_be_repeated_or_come_first(self, bench: RobotBench) -> None:
        bench.driver.close()
        bench.driver.open()
        bench.driver.close()
        bench.driver.close()

    def test_another_thread_may_close_it(self, bench: RobotBench) -> None:
        bench.driver.open()
        cycles(bench, 2)
        in_thread(bench.driver.close)

    def test_it_can_be_opened_again_and_has_not_moved(self, bench: RobotBench) -> None:
        bench.driver.open()
        ramp(bench, RISE)
        bench.driver.halt()
        there = settle(bench).q
        bench.driver.close()
        if not bench.driver.paces_itself:
            for _ in range(100):
                bench.pass_time()
        bench.driver.open()
        assert cycles(bench, 2)[-1].q == pytest.approx(there, abs=0.01), "close and open move nothing"

    def test_what_is_not_open_is_an_error_and_takes_no_set_point(self, bench: RobotBench) -> None:
        for _ in range(2):
            with pytest.raises(HalError):
                bench.driver.read(bench.now)
            with pytest.raises(HalError):
                _sent(bench, bench.driver.write)()
            bench.driver.open()
            bench.driver.close()

    # Losing it.

    @needs("lose")
    def test_a_lost_link_is_an_error_at_every_use_and_never_at_close(self, bench: RobotBench) -> None:
        bench.driver.open()
        cycles(bench, 2)
        bench.lose()
        is_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        send = _sent(bench, bench.driver.write)
        for _ in range(3):
            with pytest.raises(ConnectionLost):
                bench.driver.read(bench.pass_time())
            with pytest.raises(ConnectionLost):
                send()
        bench.driver.close()
        bench.driver.close()

    @needs("lose", "restore")
    def test_a_link_that_is_mended_can_be_opened_again(self, bench: RobotBench) -> None:
        bench.driver.open()
        there = cycles(bench, 2)[-1].q
        bench.lose()
        is_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        bench.driver.close()
        bench.restore()
        comes_back(bench, bench.driver.open)
        assert cycles(bench, 2)[-1].q == pytest.approx(there, abs=STILL), "it is where it was, and says so"
        assert ramp(bench, RISE)[-1].q[bench.joint] == pytest.approx(there[bench.joint] + RISE, abs=0.01)

    # Faults.

    @needs("fail")
    def test_a_fault_has_a_cause_and_a_remedy_and_ends_with_recover(self, bench: RobotBench) -> None:
        bench.driver.open()
        cycles(bench, 2)
        word = bench.fail()
        fault = next((r.fault for r in (cycles(bench, 1)[-1] for _ in range(100)) if r.fault is not None), None)
        assert fault is not None, "the device has a fault: put it into Reading.fault"
        assert word in fault.cause, f"the cause says what happened: {word!r} is not in {fault.cause!r}"
        assert fault.code, "a fault has a code by which it can be looked up"
        assert fault.remedy, "a fault's remedy says what a person can do about it"
        before = cycles(bench, 1)[-1].q
        assert ramp(bench, RISE)[-1].q == pytest.approx(before, abs=STILL), "a faulted arm does not move"
        bench.driver.recover()
        assert cycles(bench, 2)[-1].fault is None, "recover clears the fault"
        assert ramp(bench, RISE)[-1].q[bench.joint] == pytest.approx(before[bench.joint] + RISE, abs=0.01)

    def test_an_unknown_knob_is_refused(self, bench: RobotBench) -> None:
        with pytest.raises((CommandError, NotSupported)):
            bench.driver.inject(no_such_knob=True)

    # As a program sees it, through the public class.

    def test_a_program_reads_its_state(self, bench: RobotBench) -> None:
        with Hosted(bench) as hosted:
            state = hosted.turn(5)
            assert state.q == pytest.approx(bench.initial, abs=STILL)
            assert not state.q.flags.writeable

    @needs("freeze")
    def test_a_program_learns_that_it_froze(self, bench: RobotBench) -> None:
        with Hosted(bench) as hosted:
            hosted.turn(5)
            bench.freeze()
            with pytest.raises((StaleStateError, ConnectionLost)):
                hosted.turn(round(_TOO_OLD / bench.dt))

    @needs("lose")
    def test_a_program_learns_that_it_is_lost(self, bench: RobotBench) -> None:
        with Hosted(bench) as hosted:
            hosted.turn(5)
            bench.lose()
            is_lost(bench, lambda: hosted.turn(2))

    @needs("lose", "restore", "returns")
    def test_a_program_learns_that_it_is_back(self, bench: RobotBench) -> None:
        with Hosted(bench) as hosted:
            hosted.turn(5)
            bench.lose()
            is_lost(bench, lambda: hosted.turn(2))
            bench.restore()
            state = comes_back(bench, lambda: hosted.turn(2))
            assert state.q == pytest.approx(bench.initial, abs=STILL), "read finds the device again by itself"
