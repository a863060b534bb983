"""What the driver asks of a Franka Hand, against the emulated fingers and a clock that only counts."""

from __future__ import annotations

import importlib.util
import random
import sys
from dataclasses import dataclass, field

import pytest

from hal import registry
from hal.drivers.franka import hand_faults
from hal.drivers.franka.emulator.hand_fingers import Fingers, Kind, Motion
from hal.drivers.franka.emulator.hand_wire import Status
from hal.drivers.franka.hand_calls import Answer, Call, Seen
from hal.drivers.franka.hand_errands import Range, is_holding
from hal.drivers.franka.hand_pilot import HandPilot, Order
from hal.errors import DriverMissing
from hal.types import Fault, GripperOutcome

DT = 0.01
ABORTED = Fault("hand_aborted", "it was stopped", "")
ANSWERS: dict[Status, Answer] = {
    Status.SUCCESS: True,
    Status.UNSUCCESSFUL: False,
    Status.ABORTED: ABORTED,
    Status.FAIL: Fault("hand_failed", "it failed", ""),
}


@dataclass
class Bench:
    """A pilot and the emulated fingers, with nothing but time between them."""

    fingers: Fingers
    period: float = 0.02
    """s between two states."""
    delay: float = 0.0
    """s that everything takes on its way to the hand."""
    deaf: bool = False
    """Does the hand ignore stops?"""
    mute: bool = False
    """Does it never answer a motion?"""
    now: float = 0.0
    calls: list[Call] = field(default_factory=list)
    stops: int = 0
    reconnects: int = 0
    narrowest: float = 1.0
    """Width that the fingers had at least, m."""
    widest: float = 0.0
    """And at most."""

    def __post_init__(self) -> None:
        self.pilot = HandPilot(Range(0.08, 0.002))
        self._waiting = False
        self._mail: list[tuple[float, Call | Order]] = []
        self._next_state = 0.0
        self.pass_time(self.period)

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self.now += DT
            self._hand()
            order = self.pilot.next_order(self.now)
            if order is None:
                continue
            if isinstance(order, Call):
                assert not self._waiting, "two motions at a time"
                self._waiting = True
                self.calls.append(order)
            elif order is Order.STOP:
                assert self._waiting, "a stop without a motion"
                assert self.pilot.seen is not None
                pressing = self.calls[-1].method == "grasp" and is_holding(self.pilot.seen)
                assert self.pilot.moving or not pressing, "a stop for what is held"
                self.stops += 1
            else:
                self.reconnects += 1
                self._waiting, self.fingers.motion, self._mail = False, None, []
                continue
            self._mail.append((self.now + self.delay, order))

    def _hand(self) -> None:
        status = self.fingers.advance(DT)
        self.narrowest = min(self.narrowest, self.fingers.width)
        self.widest = max(self.widest, self.fingers.width)
        while self._mail and self._mail[0][0] <= self.now:
            order = self._mail.pop(0)[1]
            if isinstance(order, Call):
                holds = self.fingers.is_grasped and self.fingers.width > 0.001
                assert order.method == "move" or not holds, "a second grasp lets go, and so does homing"
                status = self.fingers.start(motion_of(order))
            elif not self.deaf and self.fingers.motion is not None:
                self.fingers.halt(False)
                status = Status.ABORTED
        if self.now >= self._next_state:
            self._next_state += self.period
            fingers = self.fingers
            self.pilot.see(Seen(self.now, self.now, fingers.width, fingers.max_width, fingers.is_grasped, 30))
        if status is not None and not self.mute and self._waiting:
            self._waiting = False
            self.pilot.answer(ANSWERS[status], self.now)

    def finish(self, limit: float = 10.0) -> GripperOutcome:
        """Until the newest command is over."""
        for _ in range(round(limit / DT)):
            if self.pilot.outcome is not GripperOutcome.RUNNING:
                break
            self.pass_time(DT)
        return self.pilot.outcome


def motion_of(call: Call) -> Motion:
    if call.method == "move":
        return Motion(Kind.MOVE, *call.arguments)
    if call.method == "grasp":
        return Motion(Kind.GRASP, *call.arguments)
    return Motion(Kind.HOMING)


@pytest.fixture(params=[False, True], ids=["closes all the way", "ends at its width"])
def bench(request: pytest.FixtureRequest) -> Bench:
    """A hand that is homed, with nothing in its fingers; it is not known what a grasp of nothing does."""
    fingers = Fingers()
    fingers.grasp_ends_at_width = request.param
    return Bench(fingers)


def test_opening_is_a_move_and_closing_is_a_grasp(bench):
    bench.pilot.reach(0.07, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert [call[:2] for call in bench.calls] == [("move", (0.07, 0.1))]
    bench.pilot.reach(0.02, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert bench.calls[1][:2] == ("grasp", (0.02, 0.1, 40.0, 0.0, 0.08))
    assert bench.fingers.width == pytest.approx(0.02, abs=0.002)
    assert bench.narrowest > 0.01
    assert not bench.fingers.is_grasped


def test_what_is_met_while_closing_is_held_with_the_force_that_was_asked_for(bench):
    bench.fingers.put(0.03)
    bench.pilot.reach(0.01, 0.1, 25.0)
    assert bench.finish() is GripperOutcome.MISSED
    assert (bench.fingers.is_grasped, bench.fingers.force, bench.fingers.width) == (True, 25.0, 0.03)
    assert bench.pilot.fault is None


def test_closing_further_on_what_is_held_sends_nothing(bench):
    """A second grasp would let go."""
    bench.fingers.put(0.03)
    bench.pilot.reach(0.01, 0.1, 40.0)
    bench.finish()
    for width in (0.02, 0.0):
        bench.pilot.reach(width, 0.1, 40.0)
        assert bench.finish() is GripperOutcome.MISSED
    assert len(bench.calls) == 1
    assert bench.fingers.is_grasped
    bench.pilot.reach(0.08, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert bench.calls[1][:2] == ("move", (0.08, 0.1))


def test_something_narrower_than_the_width_is_not_held(bench):
    bench.fingers.put(0.01)
    bench.pilot.reach(0.03, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert bench.fingers.width == pytest.approx(0.03, abs=0.002)
    assert not bench.fingers.is_grasped


def test_fingers_that_were_stopped_just_before_they_shut_still_press(bench):
    """Something as thin as a card may lie between them."""
    bench.fingers.put(0.001)
    bench.fingers.width = 0.0018
    bench.pass_time(0.05)
    bench.pilot.reach(0.0, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert bench.fingers.force == 40.0
    calls = len(bench.calls)
    bench.fingers.put(None)
    bench.fingers.width = 0.0
    bench.pass_time(0.05)
    bench.pilot.reach(0.0, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert len(bench.calls) == calls


def test_a_trigger_that_is_pulled_and_let_go_needs_few_stops(bench):
    for steps in (range(30), range(30, -1, -1)):
        before = len(bench.calls)
        for k in steps:
            bench.pilot.reach(0.07 * (1.0 - k / 30), 0.1, 40.0)
            bench.pass_time(0.02)
        assert bench.finish() is GripperOutcome.DONE
        assert len(bench.calls) - before <= 12
    assert bench.stops <= 6
    assert bench.fingers.width == pytest.approx(0.07, abs=0.002)


def test_a_command_that_had_not_begun_is_dropped(bench):
    bench.delay = 0.2
    bench.pilot.reach(0.08, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.pilot.grasp(0.03, 0.1, 40.0, 0.005, 0.005)
    bench.pass_time(0.05)
    bench.pilot.reach(0.06, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert [call.method for call in bench.calls] == ["move", "move"]
    assert bench.fingers.width == pytest.approx(0.06, abs=0.002)


@pytest.mark.parametrize(("thing", "outcome"), [(0.03, "DONE"), (0.05, "MISSED"), (0.01, "MISSED"), (None, "MISSED")])
def test_a_grasp_is_judged_by_the_hand(thing, outcome):
    bench = Bench(Fingers(thing))
    bench.fingers.width = 0.07
    bench.pilot.grasp(0.03, 0.1, 40.0, 0.005, 0.005)
    assert bench.finish() is GripperOutcome[outcome]
    assert bench.fingers.is_grasped is (outcome == "DONE")


def test_a_hold_takes_neither_another_force_nor_homing(bench):
    bench.fingers.put(0.03)
    bench.pilot.grasp(0.03, 0.1, 35.0, 0.005, 0.005)
    bench.finish()
    bench.pilot.grasp(0.03, 0.1, 35.0, 0.005, 0.005)
    assert bench.finish() is GripperOutcome.DONE
    bench.pilot.grasp(0.02, 0.1, 35.0, 0.005, 0.005)
    assert bench.finish() is GripperOutcome.MISSED
    bench.pilot.grasp(0.03, 0.1, 60.0, 0.005, 0.005)
    assert bench.finish() is GripperOutcome.FAILED
    bench.pilot.home()
    assert bench.finish() is GripperOutcome.FAILED
    assert bench.pilot.fault is not None
    assert bench.pilot.fault.code == "holding"
    bench.pilot.lost("the cable was pulled")  # from here on nobody knows with which force it holds
    bench.pass_time(0.1)
    bench.pilot.grasp(0.03, 0.1, 35.0, 0.005, 0.005)
    assert bench.finish() is GripperOutcome.FAILED
    assert len(bench.calls) == 1
    assert bench.fingers.is_grasped


def test_fingers_that_open_stop_where_a_newer_command_says(bench):
    bench.pilot.reach(0.08, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.pilot.reach(0.05, 0.05, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert bench.stops == 1
    assert bench.widest < 0.055


def test_a_command_that_failed_may_be_tried_again():
    pilot = HandPilot(Range(0.08, 0.002))
    for t in (0.0, 1.0):
        pilot.see(Seen(t, t, 0.04, 0.08, False, 30))
        pilot.reach(0.06, 0.1, 40.0)
        assert isinstance(pilot.next_order(t), Call)
        pilot.answer(ABORTED, t + 0.1)
        pilot.see(Seen(t + 0.2, t + 0.2, 0.04, 0.08, False, 30))
        assert pilot.next_order(t + 0.2) is None
        assert (pilot.outcome, pilot.fault) == (GripperOutcome.FAILED, ABORTED)


def test_a_hand_that_is_not_homed_does_nothing_else(bench):
    bench.fingers.homed = False
    bench.pass_time(0.05)
    for command in (lambda: bench.pilot.reach(0.08, 0.1, 40.0), lambda: bench.pilot.grasp(0.03, 0.1, 40.0, 0.0, 0.01)):
        command()
        assert bench.finish() is GripperOutcome.FAILED
        assert bench.pilot.fault is not None
        assert bench.pilot.fault.code == "not_homed"
    assert not bench.calls
    bench.pilot.home()
    assert bench.finish() is GripperOutcome.DONE
    bench.pilot.reach(0.02, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE


def test_homing_that_fails_says_so(bench):
    bench.fingers.put(0.03)
    bench.pilot.home()
    assert bench.finish() is GripperOutcome.FAILED
    assert bench.pilot.fault is not None
    assert bench.pilot.fault.code == "hand_failed"


def test_a_stop_is_sent_only_to_fingers_that_move_and_hold_nothing(bench):
    pilot = bench.pilot
    pilot.stop()
    bench.pass_time(0.1)
    assert pilot.outcome is GripperOutcome.NONE
    pilot.reach(0.08, 0.05, 40.0)
    bench.pass_time(0.2)
    pilot.stop()
    assert pilot.outcome is GripperOutcome.STOPPED
    bench.pass_time(0.1)
    width = bench.fingers.width
    bench.pass_time(2.0)
    assert bench.fingers.width == width < 0.055
    assert bench.stops == 1
    assert pilot.fault is None
    bench.fingers.put(0.03)
    pilot.reach(0.0, 0.1, 40.0)
    bench.finish()
    pilot.stop()
    bench.pass_time(0.5)
    assert bench.stops == 1
    assert bench.fingers.is_grasped


def test_a_grasp_that_presses_but_is_not_answered_yet_is_not_stopped(bench):
    bench.fingers.put(0.03)
    bench.mute = True
    bench.pilot.reach(0.0, 0.1, 40.0)
    bench.pass_time(1.0)
    bench.pilot.stop()
    bench.pass_time(0.5)
    assert bench.stops == 0
    assert bench.fingers.is_grasped


def test_a_stop_that_does_nothing_is_told_and_the_next_command_waits_for_the_end(bench):
    bench.deaf = True
    bench.pilot.reach(0.08, 0.02, 40.0)
    bench.pass_time(0.2)
    bench.pilot.stop()
    bench.pass_time(1.2)
    assert bench.pilot.fault == hand_faults.stop_ignored()
    bench.pilot.reach(0.02, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE
    assert bench.fingers.width == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize("lets_go", [False, True])
def test_a_stop_that_lets_go_is_told(lets_go):
    """The fingers met something just before the stop: the states had not shown it yet, and the answer tells."""

    def see(t: float, width: float, grasped: bool) -> None:
        pilot.see(Seen(t, t, width, 0.08, grasped, 30))

    pilot = HandPilot(Range(0.08, 0.002))
    see(0.0, 0.05, False)
    pilot.reach(0.0, 0.1, 40.0)
    assert isinstance(pilot.next_order(0.0), Call)
    see(0.1, 0.04, False)
    pilot.stop()
    assert pilot.next_order(0.1) is Order.STOP
    pilot.answer(True, 0.15)
    for k in range(2, 14):
        see(0.1 * k, 0.037 if lets_go else 0.035, not lets_go)
        assert pilot.next_order(0.1 * k) is None
    assert pilot.fault == (hand_faults.stop_released() if lets_go else None)
    assert pilot.outcome is GripperOutcome.STOPPED


def test_a_hold_that_is_never_answered_is_not_stopped_until_it_is_to_open(bench):
    bench.mute = True
    bench.fingers.put(0.03)
    bench.pilot.grasp(0.03, 0.1, 40.0, 0.005, 0.005)
    assert bench.finish() is GripperOutcome.FAILED
    bench.pass_time(3.0)
    assert (bench.stops, bench.reconnects) == (0, 0)
    assert bench.fingers.is_grasped
    bench.pilot.reach(0.08, 0.1, 40.0)
    bench.pass_time(0.1)
    assert bench.stops == 1


def test_a_motion_that_is_never_answered_is_given_up(bench):
    bench.mute = True
    bench.pilot.reach(0.08, 0.1, 40.0)
    bound = bench.calls[0].bound if bench.calls else 4.0
    assert bench.finish(bound + 1.0) is GripperOutcome.FAILED
    assert bench.pilot.fault is not None
    assert bench.pilot.fault.code == "no_answer"
    assert (bench.stops, bench.reconnects) == (1, 0)
    bench.pass_time(3.0)
    assert bench.reconnects == 1
    bench.mute = False
    bench.pilot.reach(0.02, 0.1, 40.0)
    assert bench.finish() is GripperOutcome.DONE


def test_a_command_is_lost_with_the_connection_and_never_sent_again(bench):
    bench.pilot.reach(0.08, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.pilot.lost("the cable was pulled")
    assert bench.pilot.outcome is GripperOutcome.FAILED
    assert bench.pilot.fault is not None
    assert "the cable was pulled" in bench.pilot.fault.cause
    bench.fingers.motion = None
    bench.pass_time(1.0)
    assert len(bench.calls) == 1


@pytest.mark.parametrize("seed", range(100))
def test_whatever_is_asked_in_whatever_order_it_comes_to_an_end(seed):
    """The bench looks: one motion at a time, no stop without a motion or for what is held, no second grasp.

    And the last command is what counts.
    """
    dice = random.Random(seed)
    fingers = Fingers(dice.choice([None, 0.02, 0.05]))
    fingers.grasp_ends_at_width = dice.random() < 0.5
    bench = Bench(
        fingers, period=dice.choice([0.02, 0.1]), delay=dice.choice([0.0, 0.05, 0.3]), deaf=dice.random() < 0.3
    )
    pilot = bench.pilot
    for _ in range(40):
        width, speed = dice.uniform(0.0, 0.08), dice.choice([0.02, 0.1])
        act = dice.random()
        if act < 0.6:
            pilot.reach(width, speed, 40.0)
        elif act < 0.75:
            pilot.grasp(width, speed, dice.choice([30.0, 40.0]), 0.005, 0.005)
        elif act < 0.85:
            pilot.stop()
        elif act < 0.9:
            pilot.home()
        else:
            fingers.put(dice.choice([None, fingers.width]) if fingers.width > 0.0 else None)
        bench.pass_time(dice.choice([0.01, 0.05, 0.3]))
    fingers.put(None)
    bench.pass_time(1.0)
    pilot.reach(0.08, 0.1, 40.0)
    if bench.finish(40.0) is GripperOutcome.FAILED:  # an interrupted homing
        assert pilot.fault is not None
        assert pilot.fault.code in ("not_homed", "lost", "no_answer")
        pilot.home()
        assert bench.finish(40.0) is GripperOutcome.DONE
        return
    assert pilot.outcome is GripperOutcome.DONE
    assert fingers.width == pytest.approx(0.08, abs=0.002)


@pytest.mark.parametrize(
    "fault",
    [
        hand_faults.not_homed(-1.23456e-10, 0.08),
        hand_faults.holding("take another force"),
        hand_faults.no_answer("homing", 30.0),
        hand_faults.stop_ignored(),
        hand_faults.stop_released(),
        hand_faults.lost(""),
    ],
    ids=lambda fault: fault.code,
)
def test_faults_fit_into_a_state(fault):
    """The bytes that hal/host/records.py has for them."""
    for text, size in zip((fault.code, fault.cause, fault.remedy), (48, 160, 240), strict=True):
        assert len(text.encode()) <= size


def test_without_the_client_library_its_name_is_told(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "panda_py" else find(name))
    monkeypatch.delitem(sys.modules, "hal.drivers.franka.hand", raising=False)
    with pytest.raises(DriverMissing, match=r"robot-hal\[panda\]"):
        registry.load("franka", "gripper")
