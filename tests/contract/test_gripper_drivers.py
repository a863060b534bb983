"""What every GripperDriver owes to the host."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import pytest

from hal.gripper import GripperReading
from hal.host.gripper_mail import GripperAct, GripperCommand, GripperMail
from hal.host.gripper_unit import GripperUnit
from hal.host.records import AppRecord
from hal.types import GripperOutcome, GripperState

from .benches import GRIPPERS, GripperBench


@pytest.fixture(params=GRIPPERS)
def bench(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    with GRIPPERS[request.param]() as bench:
        yield bench


def cycles(bench: GripperBench, seconds: float) -> list[GripperReading]:
    return [bench.driver.read(bench.pass_time()) for _ in range(round(seconds / bench.dt))]


def half(bench: GripperBench) -> float:
    return bench.driver.spec.width_max / 2


def test_open_moves_nothing(bench: GripperBench) -> None:
    bench.driver.open()
    first, *_, last = cycles(bench, 0.3)
    assert last.width == pytest.approx(first.width, abs=1e-3)
    assert not last.moving


def test_readings_are_in_range_and_stamped(bench: GripperBench) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    readings = cycles(bench, 0.5)
    for reading in readings:
        assert -1e-3 <= reading.width <= spec.width_max + 1e-3
        assert reading.width_target == half(bench)
        assert reading.force is None or math.isfinite(reading.force)
    for before, after in itertools.pairwise(readings):
        assert after.t - before.t == pytest.approx(bench.dt)
        assert after.t_device > before.t_device
        assert after.seq > before.seq


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_it_moves_to_a_width_at_the_speed_asked_for(bench: GripperBench, share: float) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width == pytest.approx(half(bench), abs=2e-3)
    target = share * spec.width_max
    speed = spec.speed / 2
    bench.driver.move(target, speed, spec.force)
    readings = cycles(bench, 2.0)
    assert readings[5].moving
    assert (readings[-1].width, readings[-1].moving) == (pytest.approx(target, abs=2e-3), False)
    widths = [reading.width for reading in readings]
    steepest = max(abs(b - a) for a, b in itertools.pairwise(widths)) / bench.dt
    assert 0.5 * speed < steepest < 1.2 * speed
    assert not readings[-1].grasped, "there was nothing to grasp"


def test_the_newest_command_wins(bench: GripperBench) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width < 0.6 * spec.width_max
    bench.driver.move(0.0, spec.speed, spec.force)
    cycles(bench, 0.1)
    bench.driver.move(spec.width_max, spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width == pytest.approx(spec.width_max, abs=2e-3)


def test_stop_stays_where_it_is(bench: GripperBench) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    start = bench.driver.read(bench.pass_time()).width
    bench.driver.move(half(bench), spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width != pytest.approx(start, abs=0.01)
    bench.driver.move(0.0, spec.speed / 2, spec.force)
    at = cycles(bench, 0.2)[-1].width
    bench.driver.stop()
    stopped = cycles(bench, 1.0)[-1]
    assert stopped.width == pytest.approx(at, abs=3e-3)
    assert stopped.width > 0.01, "it stopped on the way"
    assert not stopped.moving


def test_close_does_not_move_the_fingers_and_may_be_repeated(bench: GripperBench) -> None:
    bench.driver.close()
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    there = cycles(bench, 2.0)[-1].width
    assert there == pytest.approx(half(bench), abs=2e-3)
    bench.driver.close()
    bench.driver.close()
    for _ in range(100):
        bench.pass_time()
    bench.driver.open()
    assert cycles(bench, 0.1)[-1].width == pytest.approx(there, abs=2e-3)


class Hand:
    """The driver as the host runs it, which judges how each command ends."""

    def __init__(self, bench: GripperBench) -> None:
        memory = memoryview(bytearray(GripperMail.size()))
        self.bench = bench
        self.mail = GripperMail(memory)
        self.unit = GripperUnit(bench.driver, GripperMail(memory))
        self.stops = 0
        self._seq = 0
        self.unit.open()
        self.pass_time(bench.dt)

    def tell(self, act: GripperAct, width: float = 0.0, force: float = 0.0, tolerance: float = 0.005) -> int:
        self._seq += 1
        spec = self.bench.driver.spec
        force = force or spec.force
        self.mail.put_command(
            GripperCommand(self._seq, self.stops, act, width, spec.speed, force, tolerance, tolerance)
        )
        return self._seq

    def pass_time(self, seconds: float) -> GripperState:
        for _ in range(max(1, round(seconds / self.bench.dt))):
            now = self.bench.pass_time()
            self.unit.serve(AppRecord(now, self.stops))
            self.unit.publish(now)
        record = self.mail.get()
        assert record is not None
        assert not record.lost
        return record.state

    def wait(self, seconds: float = 5.0) -> GripperState:
        """Until the newest command is over."""
        for _ in range(round(seconds / self.bench.dt)):
            state = self.pass_time(self.bench.dt)
            if state.target_seq == self._seq and state.outcome is not GripperOutcome.RUNNING:
                return state
        raise AssertionError(f"still on its way: {state}")


def test_a_motion_runs_and_is_done(bench: GripperBench) -> None:
    hand = Hand(bench)
    assert (hand.pass_time(0.1).outcome, hand.pass_time(0.1).target_seq) == (GripperOutcome.NONE, 0)
    seq = hand.tell(GripperAct.MOVE, half(bench))
    state = hand.pass_time(3 * bench.dt)
    assert (state.outcome, state.target_seq) == (GripperOutcome.RUNNING, seq)
    state = hand.wait()
    assert state.outcome is GripperOutcome.DONE
    assert state.width == pytest.approx(half(bench), abs=2e-3)
    assert hand.pass_time(0.2).outcome is GripperOutcome.DONE
    hand.tell(GripperAct.MOVE, half(bench))
    assert hand.wait().outcome is GripperOutcome.DONE, "it is there already"


def test_a_newer_command_is_the_one_that_is_judged(bench: GripperBench) -> None:
    hand = Hand(bench)
    hand.tell(GripperAct.MOVE, 0.0)
    hand.pass_time(0.1)
    seq = hand.tell(GripperAct.MOVE, bench.driver.spec.width_max)
    state = hand.wait()
    assert (state.target_seq, state.outcome) == (seq, GripperOutcome.DONE)
    assert state.width == pytest.approx(bench.driver.spec.width_max, abs=2e-3)


def test_a_grasp_holds_what_is_there_and_misses_what_is_not(bench: GripperBench) -> None:
    hand = Hand(bench)
    hand.tell(GripperAct.GRASP, half(bench))
    state = hand.wait()
    assert state.outcome is GripperOutcome.MISSED, "there was nothing to hold"
    assert not state.grasped
    hand.tell(GripperAct.MOVE, bench.driver.spec.width_max)
    assert hand.wait().outcome is GripperOutcome.DONE
    bench.put_object(0.03)
    hand.tell(GripperAct.GRASP, 0.03)
    state = hand.wait()
    assert state.outcome is GripperOutcome.DONE
    assert state.grasped is not False
    assert state.width == pytest.approx(0.03, abs=3e-3)
    assert hand.pass_time(0.5).width == pytest.approx(0.03, abs=3e-3)


@pytest.mark.parametrize("expected", [0.01, 0.05])
def test_a_grasp_of_something_else_is_missed(bench: GripperBench, expected: float) -> None:
    hand = Hand(bench)
    bench.put_object(0.03)
    hand.tell(GripperAct.GRASP, expected, tolerance=0.008)
    assert hand.wait().outcome is GripperOutcome.MISSED


def test_closing_on_something_is_not_where_it_should_be(bench: GripperBench) -> None:
    hand = Hand(bench)
    bench.put_object(0.03)
    hand.tell(GripperAct.MOVE, 0.0)
    state = hand.wait()
    assert state.outcome is GripperOutcome.MISSED
    assert state.width == pytest.approx(0.03, abs=3e-3)


def test_homing_ends(bench: GripperBench) -> None:
    hand = Hand(bench)
    seq = hand.tell(GripperAct.HOME)
    state = hand.wait(20.0)
    assert (state.target_seq, state.outcome) == (seq, GripperOutcome.DONE)


@pytest.mark.parametrize("how", ["command", "rig"])
def test_a_stop_ends_a_motion_and_keeps_a_grip(bench: GripperBench, how: str) -> None:
    hand = Hand(bench)

    def stop() -> None:
        if how == "rig":
            hand.stops += 1
        else:
            hand.tell(GripperAct.STOP)

    hand.tell(GripperAct.MOVE, 0.0)
    at = hand.pass_time(0.2).width
    stop()
    state = hand.pass_time(1.0)
    assert state.outcome is GripperOutcome.STOPPED
    assert state.width == pytest.approx(at, abs=5e-3)
    hand.tell(GripperAct.MOVE, bench.driver.spec.width_max)
    hand.wait()
    bench.put_object(0.03)
    hand.tell(GripperAct.GRASP, 0.03)
    assert hand.wait().outcome is GripperOutcome.DONE
    stop()
    held = hand.pass_time(1.0)
    assert held.width == pytest.approx(0.03, abs=3e-3)
    assert held.grasped is not False
    assert held.outcome is (GripperOutcome.DONE if how == "rig" else GripperOutcome.STOPPED)


def test_a_command_from_before_a_stop_moves_nothing_later(bench: GripperBench) -> None:
    hand = Hand(bench)
    seq = hand.tell(GripperAct.MOVE, 0.0)
    hand.stops += 1
    state = hand.pass_time(0.5)
    assert (state.target_seq, state.outcome) == (seq, GripperOutcome.STOPPED)
    assert state.width == pytest.approx(bench.driver.spec.width_max, abs=2e-3)
