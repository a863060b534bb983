"""Command logic of the Franka Hand, against the emulated fingers in simulated time."""

from __future__ import annotations

import importlib.util
import random
import sys
from dataclasses import dataclass, field

import pytest

from hal import registry
from hal.drivers.franka import hand_motions
from hal.drivers.franka.arm import create_link
from hal.drivers.franka.hand_motions import (
    CallAnswer,
    GripperCall,
    HandAction,
    HandController,
    HandState,
    WidthRange,
    is_holding,
)
from hal.errors import DriverMissing, Fault
from hal.types import GripperOutcome
from hal_emulators.franka.hand_fingers import FingerMotion, FingerMotionKind, Fingers
from hal_emulators.franka.hand_network import HandStatus

DT = 0.01
ABORTED = Fault("hand_aborted", "it was stopped", "")
ANSWERS: dict[HandStatus, CallAnswer] = {
    HandStatus.SUCCESS: True,
    HandStatus.UNSUCCESSFUL: False,
    HandStatus.ABORTED: ABORTED,
    HandStatus.FAIL: Fault("hand_failed", "it failed", ""),
}


@dataclass
class Bench:
    """A controller and the emulated fingers."""

    fingers: Fingers
    period: float = 0.02
    """s between two states."""
    delay: float = 0.0
    """Delay of everything sent to the hand, s."""
    deaf: bool = False
    """Whether the hand ignores stops."""
    mute: bool = False
    """Whether the hand never answers a motion."""
    now: float = 0.0
    calls: list[GripperCall] = field(default_factory=list)
    stops: int = 0
    stray_stops: int = 0
    reconnects: int = 0
    narrowest: float = 1.0
    """Smallest width of the fingers, m."""
    widest: float = 0.0
    """Largest width of the fingers, m."""

    def __post_init__(self) -> None:
        self.controller = HandController(WidthRange(0.08, 0.002))
        self._waiting = False
        self._mail: list[tuple[float, GripperCall | HandAction]] = []
        self._t_moved = 0.0
        self._next_state = self._back_at = 0.0
        self.pass_time(self.period)

    def lose(self, seconds: float) -> None:
        """Cut the connection for a time; the hand goes on with what has reached it."""
        self._waiting, self._mail = False, []
        self._back_at = self.now + seconds
        self.controller.connection_lost("the cable was pulled")

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self.now += DT
            self._hand()
            order = self.controller.next_action(self.now)
            if order is None:
                continue
            if isinstance(order, GripperCall):
                assert not self._waiting, "two motions at a time"
                self._waiting = True
                self.calls.append(order)
            elif order is HandAction.STOP:
                assert self._waiting, "a stop without a motion"
                assert self.controller.state is not None
                pressing = self.calls[-1].method == "grasp" and is_holding(self.controller.state)
                assert self.controller.moving or not pressing, "a stop for what is held"
                self.stops += 1
            elif order is HandAction.STOP_STRAY:
                assert not self._waiting
                call = self.calls[-1]
                blocked = call.method == "move" and abs(call.arguments[0] - self.fingers.width) > 0.002
                assert blocked or self.now - self._t_moved < 0.3 + self.delay, "a stop for fingers at rest"
                assert not self.fingers.is_grasped, "a stop for what is held"
                self.stray_stops += 1
            else:
                self.reconnects += 1
                self.lose(1.0)
                continue
            self._mail.append((self.now + self.delay, order))

    def _hand(self) -> None:
        before = self.fingers.width
        status = self.fingers.advance(DT)
        if self.fingers.width != before:
            self._t_moved = self.now
        self.narrowest = min(self.narrowest, self.fingers.width)
        self.widest = max(self.widest, self.fingers.width)
        while self._mail and self._mail[0][0] <= self.now:
            order = self._mail.pop(0)[1]
            if isinstance(order, GripperCall):
                holds = self.fingers.is_grasped and self.fingers.width > 0.001
                assert order.method == "move" or not holds, "a second grasp lets go, and so does homing"
                status = self.fingers.start(motion_of(order))
            elif not self.deaf and self.fingers.motion is not None:
                self.fingers.motion = None
                status = HandStatus.ABORTED
        if self.now < self._back_at:
            return
        if self.now >= self._next_state:
            self._next_state += self.period
            f = self.fingers
            self.controller.update(HandState(self.now, self.now, f.width, f.max_width, f.is_grasped, 30))
        if status is not None and not self.mute and self._waiting:
            self._waiting = False
            self.controller.call_ended(ANSWERS[status], self.now)

    def do(self, command: str, *arguments: float) -> GripperOutcome:
        """Give a command and wait until it has ended."""
        getattr(self.controller, command)(*arguments)
        return self.finish()

    def finish(self, limit: float = 10.0) -> GripperOutcome:
        """Wait until the newest command has ended."""
        for _ in range(round(limit / DT)):
            if self.controller.outcome is not GripperOutcome.RUNNING:
                break
            self.pass_time(DT)
        return self.controller.outcome


def motion_of(call: GripperCall) -> FingerMotion:
    if call.method == "move":
        return FingerMotion(FingerMotionKind.MOVE, *call.arguments)
    if call.method == "grasp":
        return FingerMotion(FingerMotionKind.GRASP, *call.arguments)
    return FingerMotion(FingerMotionKind.HOMING)


@pytest.fixture(params=[False, True], ids=["closes all the way", "ends at its width"])
def bench(request: pytest.FixtureRequest) -> Bench:
    """A homed hand without an object; both assumptions about a grasp that meets nothing."""
    fingers = Fingers()
    fingers.grasp_ends_at_width = request.param
    return Bench(fingers)


def test_opening_is_a_move_and_closing_is_a_grasp(bench):
    assert bench.do("move", 0.07, 0.1, 40.0) is GripperOutcome.DONE
    assert [call[:2] for call in bench.calls] == [("move", (0.07, 0.1))]
    assert bench.do("move", 0.02, 0.1, 40.0) is GripperOutcome.DONE
    assert bench.calls[1][:2] == ("grasp", (0.02, 0.1, 40.0, 0.0, 0.08))
    assert bench.fingers.width == pytest.approx(0.02, abs=0.002)
    assert bench.narrowest > 0.01
    assert not bench.fingers.is_grasped


def test_what_is_met_while_closing_is_held_with_the_force_that_was_asked_for(bench):
    bench.fingers.put(0.03)
    assert bench.do("move", 0.01, 0.1, 25.0) is GripperOutcome.MISSED
    assert (bench.fingers.is_grasped, bench.fingers.force, bench.fingers.width) == (True, 25.0, 0.03)
    assert bench.controller.fault is None


def test_closing_further_on_what_is_held_sends_nothing(bench):
    """A second grasp would let go."""
    bench.fingers.put(0.03)
    bench.do("move", 0.01, 0.1, 40.0)
    for width in (0.02, 0.0):
        assert bench.do("move", width, 0.1, 40.0) is GripperOutcome.MISSED
    assert len(bench.calls) == 1
    assert bench.fingers.is_grasped
    assert bench.do("move", 0.08, 0.1, 40.0) is GripperOutcome.DONE
    assert bench.calls[1][:2] == ("move", (0.08, 0.1))


def test_something_narrower_than_the_width_is_not_held(bench):
    bench.fingers.put(0.01)
    assert bench.do("move", 0.03, 0.1, 40.0) is GripperOutcome.DONE
    assert bench.fingers.width == pytest.approx(0.03, abs=0.002)
    assert not bench.fingers.is_grasped


def test_fingers_that_were_stopped_just_before_they_shut_still_press(bench):
    """Something as thin as a card may lie between them."""
    bench.fingers.put(0.001)
    bench.fingers.width = 0.0018
    bench.pass_time(0.05)
    assert bench.do("move", 0.0, 0.1, 40.0) is GripperOutcome.DONE
    assert bench.fingers.force == 40.0
    calls = len(bench.calls)
    bench.fingers.put(None)
    bench.fingers.width = 0.0
    bench.pass_time(0.05)
    assert bench.do("move", 0.0, 0.1, 40.0) is GripperOutcome.DONE
    assert len(bench.calls) == calls


def test_pulling_and_releasing_a_trigger_needs_few_stops(bench):
    for steps in (range(30), range(30, -1, -1)):
        before = len(bench.calls)
        for k in steps:
            bench.controller.move(0.07 * (1.0 - k / 30), 0.1, 40.0)
            bench.pass_time(0.02)
        assert bench.finish() is GripperOutcome.DONE
        assert len(bench.calls) - before <= 12
    assert bench.stops <= 6
    assert bench.fingers.width == pytest.approx(0.07, abs=0.002)


def test_a_command_that_had_not_begun_is_dropped(bench):
    bench.delay = 0.2
    bench.controller.move(0.08, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.controller.grasp(0.03, 0.1, 40.0, 0.005, 0.005)
    bench.pass_time(0.05)
    assert bench.do("move", 0.06, 0.1, 40.0) is GripperOutcome.DONE
    assert [call.method for call in bench.calls] == ["move", "move"]
    assert bench.fingers.width == pytest.approx(0.06, abs=0.002)


@pytest.mark.parametrize(("thing", "outcome"), [(0.03, "DONE"), (0.05, "MISSED"), (0.01, "MISSED"), (None, "MISSED")])
def test_a_grasp_is_judged_by_the_hand(thing, outcome):
    bench = Bench(Fingers(thing))
    bench.fingers.width = 0.07
    assert bench.do("grasp", 0.03, 0.1, 40.0, 0.005, 0.005) is GripperOutcome[outcome]
    assert bench.fingers.is_grasped is (outcome == "DONE")


def test_a_hold_takes_neither_another_force_nor_homing(bench):
    bench.fingers.put(0.03)
    bench.do("grasp", 0.03, 0.1, 35.0, 0.005, 0.005)
    assert bench.do("grasp", 0.03, 0.1, 35.0, 0.005, 0.005) is GripperOutcome.DONE
    assert bench.do("grasp", 0.02, 0.1, 35.0, 0.005, 0.005) is GripperOutcome.MISSED
    assert bench.do("grasp", 0.03, 0.1, 60.0, 0.005, 0.005) is GripperOutcome.FAILED
    assert bench.do("home") is GripperOutcome.FAILED
    assert bench.controller.fault.code == "holding"
    bench.controller.connection_lost("the cable was pulled")  # from here on nobody knows with which force it holds
    bench.pass_time(0.1)
    assert bench.do("grasp", 0.03, 0.1, 35.0, 0.005, 0.005) is GripperOutcome.FAILED
    assert len(bench.calls) == 1
    assert bench.fingers.is_grasped


def test_fingers_that_open_stop_where_a_newer_command_says(bench):
    bench.controller.move(0.08, 0.05, 40.0)
    bench.pass_time(0.1)
    assert bench.do("move", 0.05, 0.05, 40.0) is GripperOutcome.DONE
    assert bench.stops == 1
    assert bench.widest < 0.055


def test_a_command_that_failed_may_be_tried_again():
    controller = HandController(WidthRange(0.08, 0.002))
    for t in (0.0, 1.0):
        controller.update(HandState(t, t, 0.04, 0.08, False, 30))
        controller.move(0.06, 0.1, 40.0)
        assert isinstance(controller.next_action(t), GripperCall)
        controller.call_ended(ABORTED, t + 0.1)
        controller.update(HandState(t + 0.2, t + 0.2, 0.04, 0.08, False, 30))
        assert controller.next_action(t + 0.2) is None
        assert (controller.outcome, controller.fault) == (GripperOutcome.FAILED, ABORTED)


def test_states_that_arrive_in_a_bunch_are_no_motion():
    controller = HandController(WidthRange(0.08, 0.002))
    for arrival, t_hand, width in ((1.0, 1.0, 0.04), (2.0, 1.033, 0.04003), (2.0001, 1.066, 0.04)):
        controller.update(HandState(arrival, t_hand, width, 0.08, False, 30))
        assert not controller.moving


def test_a_hand_that_is_not_homed_does_nothing_else(bench):
    bench.fingers.homed = False
    bench.pass_time(0.05)
    controller = bench.controller
    for command in (lambda: controller.move(0.08, 0.1, 40.0), lambda: controller.grasp(0.03, 0.1, 40.0, 0.0, 0.01)):
        command()
        assert bench.finish() is GripperOutcome.FAILED
        assert bench.controller.fault.code == "not_homed"
    assert not bench.calls
    assert bench.do("home") is GripperOutcome.DONE
    assert bench.do("move", 0.02, 0.1, 40.0) is GripperOutcome.DONE


def test_failed_homing_is_a_fault(bench):
    bench.fingers.put(0.03)
    assert bench.do("home") is GripperOutcome.FAILED
    assert bench.controller.fault.code == "hand_failed"


def test_a_stop_is_sent_only_to_fingers_that_move_and_hold_nothing(bench):
    controller = bench.controller
    controller.stop()
    bench.pass_time(0.1)
    assert controller.outcome is GripperOutcome.NONE
    controller.move(0.08, 0.05, 40.0)
    bench.pass_time(0.2)
    controller.stop()
    assert controller.outcome is GripperOutcome.STOPPED
    bench.pass_time(0.1)
    width = bench.fingers.width
    bench.pass_time(2.0)
    assert bench.fingers.width == width < 0.055
    assert bench.stops == 1
    assert controller.fault is None
    bench.fingers.put(0.03)
    controller.move(0.0, 0.1, 40.0)
    bench.finish()
    controller.stop()
    bench.pass_time(0.5)
    assert bench.stops == 1
    assert bench.fingers.is_grasped


def test_a_grasp_that_presses_but_is_not_answered_yet_is_not_stopped(bench):
    bench.fingers.put(0.03)
    bench.mute = True
    bench.controller.move(0.0, 0.1, 40.0)
    bench.pass_time(1.0)
    bench.controller.stop()
    bench.pass_time(0.5)
    assert bench.stops == 0
    assert bench.fingers.is_grasped


def test_an_ignored_stop_is_a_fault_and_the_next_command_waits_for_the_end(bench):
    bench.deaf = True
    bench.controller.move(0.08, 0.02, 40.0)
    bench.pass_time(0.2)
    bench.controller.stop()
    bench.pass_time(1.2)
    assert bench.controller.fault.code == "stop_ignored"
    assert bench.do("move", 0.02, 0.1, 40.0) is GripperOutcome.DONE
    assert bench.fingers.width == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize("lets_go", [False, True])
def test_a_stop_that_releases_the_object_is_a_fault(lets_go):
    """The fingers met something just before the stop: the states had not shown it yet, and the answer tells."""

    def see(t: float, width: float, grasped: bool) -> None:
        controller.update(HandState(t, t, width, 0.08, grasped, 30))

    controller = HandController(WidthRange(0.08, 0.002))
    see(0.0, 0.05, False)
    controller.move(0.0, 0.1, 40.0)
    assert isinstance(controller.next_action(0.0), GripperCall)
    see(0.1, 0.04, False)
    controller.stop()
    assert controller.next_action(0.1) is HandAction.STOP
    controller.call_ended(True, 0.15)
    for k in range(2, 14):
        see(0.1 * k, 0.037 if lets_go else 0.035, not lets_go)
        assert controller.next_action(0.1 * k) is None
    assert (controller.fault and controller.fault.code) == ("stop_released" if lets_go else None)
    assert controller.outcome is GripperOutcome.STOPPED


def test_a_hold_that_is_never_answered_is_not_stopped_until_it_is_to_open(bench):
    bench.mute = True
    bench.fingers.put(0.03)
    assert bench.do("grasp", 0.03, 0.1, 40.0, 0.005, 0.005) is GripperOutcome.FAILED
    bench.pass_time(3.0)
    assert (bench.stops, bench.reconnects) == (0, 0)
    assert bench.fingers.is_grasped
    bench.controller.move(0.08, 0.1, 40.0)
    bench.pass_time(0.1)
    assert bench.stops == 1


def test_a_motion_without_an_answer_is_ended(bench):
    bench.mute = True
    bench.controller.move(0.08, 0.1, 40.0)
    bound = bench.calls[0].bound if bench.calls else 4.0
    assert bench.finish(bound + 1.0) is GripperOutcome.FAILED
    assert bench.controller.fault.code == "no_answer"
    assert (bench.stops, bench.reconnects) == (1, 0)
    bench.pass_time(3.0)
    assert bench.reconnects == 1
    bench.mute = False
    assert bench.do("move", 0.02, 0.1, 40.0) is GripperOutcome.DONE


def test_a_command_is_lost_with_the_connection_and_never_sent_again(bench):
    bench.controller.move(0.08, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.lose(0.5)
    assert bench.controller.outcome is GripperOutcome.FAILED
    assert (bench.controller.fault.code, bench.controller.fault.cause) == ("lost", "the cable was pulled")
    bench.pass_time(5.0)
    assert len(bench.calls) == 1
    assert (bench.stops, bench.stray_stops, bench.fingers.width) == (0, 0, 0.08)


@pytest.mark.parametrize("when", ["before", "while", "after"])
def test_a_stop_that_the_loss_of_the_connection_kept_from_the_hand_is_sent_again(bench, when):
    bench.controller.move(0.08, 0.02, 40.0)
    bench.pass_time(0.1)
    if when == "before":
        bench.deaf = True
        bench.controller.stop()
        bench.pass_time(0.05)
    bench.lose(0.5)
    if when == "while":
        bench.controller.stop()
    bench.deaf = False
    bench.pass_time(0.7)
    if when == "after":
        bench.controller.stop()
    bench.pass_time(0.1)
    width = bench.fingers.width
    bench.pass_time(5.0)
    assert bench.fingers.width == width < 0.06
    assert bench.stray_stops == 1
    assert bench.do("move", 0.07, 0.1, 40.0) is GripperOutcome.DONE


def test_a_command_after_a_lost_connection_first_stops_what_still_runs(bench):
    bench.controller.move(0.08, 0.01, 40.0)
    bench.pass_time(0.1)
    bench.lose(0.5)
    bench.pass_time(0.6)
    assert bench.do("move", 0.02, 0.1, 40.0) is GripperOutcome.DONE
    assert bench.stray_stops == 1
    assert bench.widest < 0.06


@pytest.mark.parametrize("again", [False, True])
def test_what_was_grasped_while_the_connection_was_lost_gets_no_stop(bench, again):
    bench.fingers.put(0.03)
    bench.controller.move(0.0, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.lose(1.0)
    bench.controller.stop()
    if again:
        bench.pass_time(0.5)
        bench.lose(0.5)
    bench.pass_time(5.0)
    assert (bench.stops, bench.stray_stops) == (0, 0)
    assert (bench.fingers.is_grasped, bench.fingers.width) == (True, 0.03)


def test_a_soft_object_that_yields_to_the_fingers_gets_no_stop_either(bench):
    bench.controller.move(0.0, 0.05, 40.0)
    bench.pass_time(0.1)
    bench.controller.stop()
    bench.controller.connection_lost("the cable was pulled")
    for k in range(10):
        bench.controller.update(HandState(9.0 + k / 50, 9.0 + k / 50, 0.03 - 1e-4 * k, 0.08, True, 30))
        assert bench.controller.next_action(9.0 + k / 50) is None


def test_fingers_that_are_blocked_get_the_stop_that_the_loss_of_the_connection_kept_from_them(bench):
    bench.controller.move(0.08, 0.02, 40.0)
    bench.pass_time(0.1)
    bench.lose(0.3)
    bench.controller.stop()
    bench.fingers.advance = lambda dt: None  # the wall of a box is in their way
    bench.pass_time(1.0)
    del bench.fingers.advance
    width = bench.fingers.width
    bench.pass_time(5.0)
    assert bench.stray_stops == 1
    assert bench.fingers.width == width < 0.06


@pytest.mark.parametrize("seed", range(100))
def test_random_commands_come_to_an_end(seed):
    """The bench looks: one motion at a time, no stop without a motion or for what is held, no second grasp.

    And the last command is what counts.
    """
    dice = random.Random(seed)
    fingers = Fingers(dice.choice([None, 0.02, 0.05]))
    fingers.grasp_ends_at_width = dice.random() < 0.5
    bench = Bench(
        fingers, period=dice.choice([0.02, 0.1]), delay=dice.choice([0.0, 0.05, 0.3]), deaf=dice.random() < 0.3
    )
    controller = bench.controller
    for _ in range(40):
        width, speed = dice.uniform(0.0, 0.08), dice.choice([0.02, 0.1])
        act = dice.random()
        if act < 0.6:
            controller.move(width, speed, 40.0)
        elif act < 0.75:
            controller.grasp(width, speed, dice.choice([30.0, 40.0]), 0.005, 0.005)
        elif act < 0.85:
            controller.stop()
        elif act < 0.9:
            controller.home()
        elif act < 0.93:
            bench.lose(dice.choice([0.1, 1.0]))
        else:
            fingers.put(dice.choice([None, fingers.width]) if fingers.width > 0.0 else None)
        bench.pass_time(dice.choice([0.01, 0.05, 0.3]))
    fingers.put(None)
    bench.pass_time(1.0)
    controller.move(0.08, 0.1, 40.0)
    if bench.finish(40.0) is GripperOutcome.FAILED:  # an interrupted homing
        assert controller.fault.code in ("not_homed", "lost", "no_answer")
        controller.home()
        assert bench.finish(40.0) is GripperOutcome.DONE
        return
    assert controller.outcome is GripperOutcome.DONE
    assert fingers.width == pytest.approx(0.08, abs=0.002)


@pytest.mark.parametrize(
    "fault",
    [
        hand_motions._not_homed_fault(-1.23456e-10, 0.08),
        hand_motions._holding_fault("change its force"),
        hand_motions._no_answer_fault("homing", 30.0),
        hand_motions._STOP_IGNORED,
        hand_motions._STOP_RELEASED,
        hand_motions._lost_fault(""),
    ],
    ids=lambda fault: fault.code,
)
def test_faults_fit_into_a_state(fault):
    """Sizes of hal/host/records.py."""
    for text, size in zip((fault.code, fault.cause, fault.remedy), (48, 160, 240), strict=True):
        assert len(text.encode()) <= size


def test_a_missing_client_library_is_reported(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "panda_py" else find(name))
    monkeypatch.delitem(sys.modules, "hal.drivers.franka.hand", raising=False)
    with pytest.raises(DriverMissing, match="panda"):
        registry.load("franka", "gripper")


def test_the_remedy_for_a_missing_library_of_an_fr3_names_the_pythons_that_have_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "hal.drivers.franka.fr3", None)
    with pytest.raises(DriverMissing, match=r"Python 3.10 to 3.12"):
        create_link("fr3")
