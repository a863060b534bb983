"""A gripper in its group's cycle, with a driver that misbehaves: everything is told, and nothing else is stopped."""

from __future__ import annotations

from typing import Any

import pytest

from hal.driver import GripperDriver, GripperReading
from hal.errors import CommandError, ConnectionLost, Fault, RobotFault
from hal.host.gripper_unit import GripperUnit
from hal.host.records import AppRecord, GripperAct, GripperCommand, GripperMail, GripperRecord
from hal.specs import GripperSpec
from hal.types import GripperOutcome


class Scripted(GripperDriver):
    """Reports what the test says, and notes what it is told."""

    def __init__(self, spec: GripperSpec) -> None:
        super().__init__(spec)
        self.calls: list[tuple[Any, ...]] = []
        self.error: Exception | None = None
        """Raised by the next calls."""
        self.deaf: Exception | None = None
        """Raised by ``read``."""
        self.reading = GripperReading(0.0, 0.0, 1, 0.08, 0.08, False)

    def _told(self, *call: Any) -> None:
        self.calls.append(call)
        if self.error is not None:
            raise self.error

    def open(self) -> None:
        self._told("open")

    def read(self, now: float) -> GripperReading:
        if self.deaf is not None:
            raise self.deaf
        return self.reading

    def move(self, width: float, speed: float, force: float) -> None:
        self._told("move", width, speed, force)

    def home(self) -> None:
        self._told("home")

    def stop(self) -> None:
        self._told("stop")

    def close(self) -> None:
        self._told("close")


class Bench:
    """A unit and the app's side of its mailboxes."""

    def __init__(self, spec: GripperSpec) -> None:
        memory = memoryview(bytearray(GripperMail.size()))
        self.driver = Scripted(spec)
        self.unit = GripperUnit(self.driver, GripperMail(memory), lambda now: self.allowed)
        self.mail = GripperMail(memory)
        self.seq = self.stops = self.session = self.allowed = 0
        self.silence = 0.0
        """Age of the app's sign of life, s."""

    def tell(self, act: GripperAct, *numbers: float) -> None:
        self.seq += 1
        self.mail.put_command(GripperCommand(self.seq, self.stops, self.session, act, *numbers))

    def report(self, **changes: Any) -> GripperRecord:
        """One cycle, in which the device has a new sample."""
        old = self.driver.reading
        self.driver.reading = old._replace(t=old.t + 0.01, seq=old.seq + 1, **changes)
        return self.turn()

    def turn(self) -> GripperRecord:
        now = self.driver.reading.t
        self.unit.serve(now, AppRecord(now - self.silence, self.stops))
        self.unit.publish(self.driver.reading.t)
        found = self.mail.get()
        assert found is not None
        return found

    def outcome(self, **changes: Any) -> GripperOutcome:
        return self.report(**changes).state.outcome


@pytest.fixture
def bench(gripper_spec: GripperSpec) -> Bench:
    return Bench(gripper_spec)


def test_a_state_arrives_as_it_was_reported(bench: Bench) -> None:
    state = bench.report(width=0.03, width_target=0.02, moving=True, grasped=True, force=12.5).state
    assert (state.stamp.t, state.stamp.seq) == (0.01, 2)
    assert (state.width, state.width_target, state.moving, state.grasped, state.force) == (0.03, 0.02, True, True, 12.5)
    assert (state.outcome, state.fault, state.target_seq) == (GripperOutcome.NONE, None, 0)
    unknown = bench.report(grasped=None, force=None).state
    assert (unknown.grasped, unknown.force) == (None, None)


def test_every_command_reaches_its_method_once(bench: Bench) -> None:
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.report(moving=True)
    bench.report()
    bench.tell(GripperAct.GRASP, 0.03, 0.05, 10.0, 0.002, 0.004)  # this driver has no grasp of its own
    bench.report()
    bench.tell(GripperAct.HOME)
    bench.report()
    bench.tell(GripperAct.STOP)
    bench.report()
    assert bench.driver.calls == [
        ("move", 0.02, 0.05, 10.0),
        ("move", 0.0, 0.05, 10.0),
        ("home",),
        ("stop",),
    ]


def test_the_width_tells_how_it_ended_where_the_driver_does_not(bench: Bench) -> None:
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.outcome(moving=True) is GripperOutcome.RUNNING
    assert bench.outcome(moving=False, width=0.0209) is GripperOutcome.DONE
    assert bench.outcome(width=0.05) is GripperOutcome.DONE, "that is over, whatever happens to the fingers later"
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.outcome() is GripperOutcome.MISSED


def test_a_reading_from_before_the_command_says_nothing_of_it(bench: Bench) -> None:
    bench.report(width=0.02)
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.turn().state.outcome is GripperOutcome.RUNNING
    assert bench.report().state.outcome is GripperOutcome.DONE


@pytest.mark.parametrize(
    ("width", "grasped", "outcome"),
    [
        (0.03, True, GripperOutcome.DONE),
        (0.03, None, GripperOutcome.DONE),
        (0.03, False, GripperOutcome.MISSED),
        (0.0275, True, GripperOutcome.MISSED),
        (0.0345, True, GripperOutcome.MISSED),
        (0.0335, True, GripperOutcome.DONE),
    ],
)
def test_a_grasp_is_judged_by_its_tolerance(bench, width, grasped, outcome):
    bench.tell(GripperAct.GRASP, 0.03, 0.05, 10.0, 0.002, 0.004)
    assert bench.outcome(width=width, grasped=grasped) is outcome


def test_a_driver_that_knows_is_believed(bench: Bench) -> None:
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.outcome(outcome=GripperOutcome.RUNNING) is GripperOutcome.RUNNING
    hot = Fault("hot", "it is too hot", "let it cool down")
    state = bench.report(outcome=GripperOutcome.FAILED, fault=hot).state
    assert (state.outcome, state.fault) == (GripperOutcome.FAILED, hot)
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    state = bench.report(outcome=GripperOutcome.DONE, fault=None).state
    assert (state.outcome, state.fault, state.target_seq) == (GripperOutcome.DONE, None, 2)


@pytest.mark.parametrize(
    ("error", "cause", "remedy"),
    [
        (RobotFault("it is too hot", "let it cool down"), "it is too hot", "let it cool down"),
        (ConnectionLost("no answer"), "no answer", "check that it is on and connected"),
        (CommandError("too wide"), "too wide", ""),
        (OSError("broken pipe"), "OSError: broken pipe", "this is a bug in the driver"),
    ],
)
def test_a_call_that_raises_is_a_failure_that_is_told(bench, capfd, error, cause, remedy):
    bench.driver.error = error
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    state = bench.report().state
    assert (state.outcome, state.target_seq) == (GripperOutcome.FAILED, 1)
    assert (state.fault.cause, state.fault.remedy) == (cause, remedy)
    assert str(error) in capfd.readouterr().err
    bench.driver.error = None
    bench.report()
    assert bench.driver.calls == [("move", 0.02, 0.05, 10.0)], "it must not move when it comes back"
    bench.tell(GripperAct.MOVE, 0.08, 0.05, 10.0)
    state = bench.report().state
    assert (state.outcome, state.fault) == (GripperOutcome.DONE, None)


def test_a_gripper_that_does_not_answer_has_an_old_state_and_says_why(bench: Bench) -> None:
    stamp = bench.report(width=0.05).state.stamp
    bench.driver.deaf = ConnectionLost("the cable")
    found = bench.turn()
    assert found.lost
    assert (found.state.stamp, found.state.width) == (stamp, 0.05)
    assert found.state.fault == Fault("lost", "the cable", "check that it is on and connected")
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.turn().state.outcome is GripperOutcome.RUNNING
    bench.driver.deaf = None
    found = bench.report(width=0.02)
    assert (found.lost, found.state.fault, found.state.outcome) == (False, None, GripperOutcome.DONE)


def test_a_width_that_cannot_be_is_no_answer(bench: Bench) -> None:
    bench.report(width=0.05)
    found = bench.report(width=float("nan"))
    assert found.lost
    assert found.state.width == 0.05


def test_a_stop_ends_what_is_under_way_and_only_that(bench: Bench) -> None:
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.outcome(moving=True, outcome=GripperOutcome.RUNNING) is GripperOutcome.RUNNING
    bench.stops += 1
    assert bench.outcome() is GripperOutcome.STOPPED
    assert bench.outcome(outcome=GripperOutcome.DONE) is GripperOutcome.STOPPED
    assert bench.driver.calls[1:] == [("stop",)]
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)  # after the stop: it counts
    assert bench.outcome(moving=False) is GripperOutcome.DONE
    bench.stops += 1
    assert bench.outcome() is GripperOutcome.DONE


def test_a_command_that_was_sent_before_a_stop_moves_nothing_after_it(bench: Bench) -> None:
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.stops += 1  # both are seen in the same cycle
    assert bench.outcome() is GripperOutcome.STOPPED
    bench.report()
    assert bench.driver.calls == [("stop",)]


@pytest.mark.parametrize("session", [0, 7])
def test_a_motion_ends_with_the_app(bench: Bench, session: int) -> None:
    bench.session = bench.allowed = session
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.silence = 0.14
    assert bench.outcome(moving=True) is GripperOutcome.RUNNING
    bench.silence = 0.16
    assert bench.outcome(moving=True) is GripperOutcome.STOPPED
    bench.tell(GripperAct.MOVE, 0.03, 0.05, 10.0)
    bench.report()
    assert [call[0] for call in bench.driver.calls] == ["move", "stop"]


def test_fingers_that_move_although_their_command_failed_are_stopped(bench: Bench) -> None:
    bench.session = bench.allowed = 7
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.outcome(moving=True, outcome=GripperOutcome.FAILED) is GripperOutcome.FAILED
    bench.allowed = 0
    bench.driver.deaf = ConnectionLost("the cable")
    bench.turn()
    bench.turn()
    bench.driver.deaf = None
    bench.report()
    assert bench.outcome(moving=False) is GripperOutcome.FAILED
    bench.report()
    stops = [call[0] for call in bench.driver.calls][1:]
    assert stops == ["stop"] * 5, "one while they moved, one while it does not answer, and then one in each cycle"


def test_a_motion_ends_when_its_session_may_not_move_any_more(bench: Bench) -> None:
    bench.session = bench.allowed = 7
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    assert bench.outcome(moving=True) is GripperOutcome.RUNNING
    bench.allowed = 0
    assert bench.outcome(moving=True) is GripperOutcome.STOPPED
    bench.report()
    assert [call[0] for call in bench.driver.calls] == ["move", "stop"]
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.allowed = 7
    assert bench.outcome(moving=False, width=0.02) is GripperOutcome.DONE
    bench.allowed = 0
    assert bench.outcome() is GripperOutcome.DONE, "what it holds stays held"
    assert [call[0] for call in bench.driver.calls] == ["move", "stop", "move"]


@pytest.mark.parametrize("seconds", [0.1, 0.2])
def test_a_command_waits_a_moment_for_its_session(bench: Bench, seconds: float) -> None:
    bench.session = 7
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    for _ in range(round(seconds / 0.01)):
        bench.report()
    bench.allowed = 7
    outcome = bench.outcome(moving=True)
    assert outcome is (GripperOutcome.RUNNING if seconds < 0.15 else GripperOutcome.STOPPED)
    assert len(bench.driver.calls) == (outcome is GripperOutcome.RUNNING)


def test_a_stop_that_fails_is_told(bench: Bench) -> None:
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.report(moving=True)
    bench.driver.error = RobotFault("it does not stop", "pull the plug")
    bench.stops += 1
    state = bench.report().state
    assert state.outcome is GripperOutcome.FAILED
    assert state.fault.cause == "it does not stop"


@pytest.mark.parametrize("raises", [True, False])
@pytest.mark.parametrize("how", ["the rig", "the session", "a command"])
def test_a_stop_that_a_lost_gripper_does_not_hear_is_given_again(bench: Bench, how: str, raises: bool) -> None:
    bench.session = bench.allowed = 7
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.report(moving=True)
    bench.driver.deaf = ConnectionLost("the cable")
    bench.driver.error = bench.driver.deaf if raises else None
    bench.turn()
    if how == "the rig":
        bench.stops += 1
    elif how == "the session":
        bench.allowed = 0
    else:
        bench.tell(GripperAct.STOP)
    for _ in range(3):
        bench.report()
    assert len(bench.driver.calls) == 2, "a gripper that does not answer is asked once"
    bench.driver.deaf = bench.driver.error = None
    bench.allowed = 7
    for _ in range(100):
        assert bench.outcome(moving=False) is (GripperOutcome.FAILED if raises else GripperOutcome.STOPPED)
    stops = len(bench.driver.calls) - 2
    assert 40 < stops < 60, "for half a second, until the driver has seen what moves"


def test_a_newer_command_takes_the_place_of_a_stop_that_was_not_heard(bench: Bench) -> None:
    bench.report()
    bench.driver.error = ConnectionLost("the cable")
    bench.tell(GripperAct.STOP)
    bench.report()
    bench.tell(GripperAct.MOVE, 0.02, 0.05, 10.0)
    bench.report()
    bench.driver.error = None
    bench.tell(GripperAct.MOVE, 0.03, 0.05, 10.0)
    bench.report(moving=True)
    calls = [call[0] for call in bench.driver.calls]
    assert calls == ["stop", "stop", "move", "stop", "move"], "a command that fails does not"


def test_an_error_at_opening_says_how_to_do_without_it(bench: Bench) -> None:
    bench.driver.error = OSError("connection refused")
    with pytest.raises(ConnectionLost, match=r"arm.gripper cannot be opened: OSError: .* `gripper: {enabled: false}`"):
        bench.unit.open()
    bench.driver.error = CommandError("it needs a world")
    with pytest.raises(CommandError, match="^it needs a world$"):
        bench.unit.open()
