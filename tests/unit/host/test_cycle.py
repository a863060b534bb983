"""An arm in its group's cycle, driven by the mock: its tool, lost links, and drives that must be switched on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from drives import ArmWithDrives
from specs import panda

from hal import registry
from hal.commands import CommandRecord, Kind, PathSection, Session, SessionRecord
from hal.errors import ConnectionLost, RobotFault
from hal.geometry import Pose
from hal.host.cycle import LOWER_LIMIT, TCP_APART, TCP_TURNED, ArmUnit, Cycle
from hal.host.records import AppRecord, GroupMemory, RobotMail
from hal.specs import GroupSpec
from hal.types import RobotStatus, Trip

DT = 1.0 / 240.0


def unit(**changes: object) -> ArmUnit:
    spec = panda(driver="mock", **changes)
    return ArmUnit(spec, DT, RobotMail(memoryview(bytearray(RobotMail.size(7))), 7), None)


def report_tcp(arm: ArmUnit, monkeypatch: pytest.MonkeyPatch, moved: float = 0.0, turned: float = 0.0) -> None:
    """Let the device report the model's tcp, moved along its x, m, and turned about its z, rad."""
    there = arm.kinematics.pose(arm.spec.initial)
    other = there @ Pose.from_rpy((moved, 0.0, 0.0), (0.0, 0.0, turned))
    matrix = tuple(other.matrix().T.ravel().tolist())
    monkeypatch.setattr(arm.driver, "own_tcp", lambda: matrix)


@pytest.mark.parametrize(
    ("moved", "turned", "same"),
    [
        (0.0, 0.0, True),
        (0.9 * TCP_APART, 0.9 * TCP_TURNED, True),
        (1.1 * TCP_APART, 0.0, False),
        (0.0, 1.1 * TCP_TURNED, False),
        (0.0, -1.1 * TCP_TURNED, False),
    ],
)
def test_an_arm_with_another_tool_than_its_model_is_refused(
    moved: float, turned: float, same: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = unit()
    report_tcp(arm, monkeypatch, moved, turned)
    if same:
        arm.open(0.0)
        return
    with pytest.raises(ConnectionLost) as caught:
        arm.open(0.0)
    assert caught.value.code == "tcp_mismatch"


def cycle(arm: ArmUnit, now: float, late: bool = False) -> None:
    app = AppRecord(now, 0)
    arm.mail.put_command(CommandRecord(round(now / DT), 1, now, now + 0.1, Kind.JOINT_VELOCITY, (0.1,) + (0.0,) * 6))
    arm.read(now)
    arm.tick(now, app, late)
    arm.write(now)
    arm.publish(now)


def never() -> None:
    raise AssertionError("this arm needs no cycle to be ready")


def driving() -> tuple[ArmUnit, float]:
    """An arm that follows velocities, and the time."""
    arm = unit()
    arm.open(1.0)
    arm.mail.put_session(SessionRecord(1, 0, 0))
    arm.open_session(Session(1, 1.0, 100.0, False), AppRecord(1.0, 0), never)
    for k in range(1, 20):
        cycle(arm, 1.0 + k * DT)
    assert arm.servo.report.status is RobotStatus.FOLLOWING
    return arm, 1.0 + 20 * DT


def test_nothing_is_written_to_an_arm_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, now = driving()
    written = len(arm.driver.log)
    with monkeypatch.context() as patched:
        patched.setattr(arm.driver, "read", lambda now: (_ for _ in ()).throw(ConnectionLost("no answer")))
        for k in range(3):
            cycle(arm, now + k * DT)
        state = arm.mail.get_state()
        assert (state.status, state.trip) == (RobotStatus.LOST, Trip.DEVICE_LOST)
        assert len(arm.driver.log) == written
    cycle(arm, now + 3 * DT)  # it answers again, and is held by set-points
    state = arm.mail.get_state()
    assert (state.status, state.trip) == (RobotStatus.TRIPPED, Trip.DEVICE_LOST)
    assert len(arm.driver.log) == written + 1


def test_an_arm_that_comes_back_with_another_tool_stays_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, now = driving()
    arm.driver.inject(disconnect=True)
    cycle(arm, now)
    report_tcp(arm, monkeypatch, moved=0.05)
    arm.driver.inject(disconnect=False)
    cycle(arm, now + DT)
    assert arm.mail.get_state().status is RobotStatus.LOST
    monkeypatch.undo()
    cycle(arm, now + 2 * DT)
    assert arm.mail.get_state().status is RobotStatus.TRIPPED


def test_a_pause_of_the_process_trips_the_arm() -> None:
    arm, now = driving()
    cycle(arm, now, late=True)
    assert arm.mail.get_state().trip is Trip.HOST_LATE


# Drives that must be switched on. Two arms share one group, as they do on one serial adapter.


class TwoArms:
    """A group of a left arm that is driven and a right arm whose drives are off, both with a user in front of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(registry, "load", lambda name, kind: ArmWithDrives)
        arms = tuple(panda(name, driver="mock", gripper=None, attended=True) for name in ("left", "right"))
        spec = GroupSpec("bus", "real_time", 1.0 / DT, arms)
        memory = GroupMemory.of(memoryview(bytearray(GroupMemory.size_of(spec))), spec)
        self.cycle = Cycle(spec, memory)
        self.cycle.turn = self.turn
        self.cycle.open(1.0)
        self.left, self.right = self.cycle.arms["left"], self.cycle.arms["right"]
        self.seq = 0

    def turn(self) -> None:
        now = self.cycle.t + DT
        self.seq += 1
        velocity = (0.05,) + (0.0,) * 6
        for arm in (self.left, self.right):
            arm.mail.put_command(CommandRecord(self.seq, 1, now, now + 0.1, Kind.JOINT_VELOCITY, velocity))
        self.cycle.step(now, AppRecord(now, 0))

    def begin(self, name: str, path: tuple[PathSection, ...] | None = None) -> None:
        self.cycle.arms[name].mail.put_session(SessionRecord(1, 0, 0))
        session = Session(1, 1.0, 100.0, False, path=path)
        self.cycle.request("begin", {"robot": name, "session": list(session)})

    def drive(self, arm: ArmUnit) -> None:
        """Run cycles until the arm follows its commands."""
        for _ in range(30):
            self.turn()
        assert arm.servo.report.status is RobotStatus.FOLLOWING


def test_another_arm_of_the_group_moves_on_while_drives_are_switched_on(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    arms.begin("left")
    arms.drive(arms.left)
    ticks, written = arms.cycle.ticks, len(arms.left.driver.log)
    arms.begin("right")
    taken = arms.cycle.ticks - ticks
    assert taken == 8  # one to read the arm, and one for each drive
    assert len(arms.left.driver.log) == written + taken
    arms.drive(arms.right)
    assert arms.left.servo.report.trip is Trip.NONE


def test_another_arm_of_the_group_moves_on_while_a_long_path_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hal.host.cycle._SHARE", 0.0)  # as if each piece of the work took so long
    arms = TwoArms(monkeypatch)
    arms.begin("left")
    arms.drive(arms.left)
    knots, start = 100, arms.right.spec.initial
    q = tuple((start[0] + 1e-3 * k, *start[1:]) for k in range(knots))
    path = (PathSection(tuple(map(float, range(knots))), q),)
    ticks, written = arms.cycle.ticks, len(arms.left.driver.log)
    arms.begin("right", path)
    taken = arms.cycle.ticks - ticks
    assert taken > knots
    assert len(arms.left.driver.log) == written + taken
    assert arms.left.servo.report.trip is Trip.NONE
    for _ in range(200):
        arms.turn()
    assert arms.right.servo.report.progress > 0.01


def test_a_session_begins_where_the_arm_is_once_its_drives_are_on(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    monkeypatch.setattr(arms.right.driver, "engage", lambda: sink(arms.right.driver))

    def sink(driver: ArmWithDrives) -> None:
        driver._follows = driver._follows._replace(q=tuple(x + 0.01 for x in driver._follows.q))
        ArmWithDrives.engage(driver)

    arms.begin("right")
    assert arms.right.servo.report.q_set == pytest.approx(arms.right.driver.read(arms.cycle.t).q, abs=1e-12)
    assert arms.right.servo.report.q_set[0] == pytest.approx(arms.right.spec.initial[0] + 0.07)


@pytest.mark.parametrize(("broken", "code"), [(3, "drive_off"), (None, "not_engaged")])
def test_without_its_drives_no_session_opens(broken: int | None, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    arms.right.driver.broken = broken
    if broken is None:
        monkeypatch.setattr(arms.right.driver, "engage", lambda: None)
    with pytest.raises(RobotFault) as caught:
        arms.begin("right")
    assert caught.value.code == code
    arms.turn()
    assert not arms.right.servo.active
    assert arms.cycle.stop_sessions()


def test_drives_that_went_off_are_switched_on_again_when_the_arm_has_to_move(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    arms.begin("right")
    arms.drive(arms.right)
    driver = arms.right.driver
    driver.inject(fault="too hot")
    arms.turn()
    driver.recover()
    written = len(driver.log)
    for _ in range(60):
        arms.turn()
    assert arms.right.servo.report.trip is Trip.FAULT  # not before a user agrees
    assert (driver.engaged, len(driver.log)) == (False, written)
    arms.right.mail.put_session(SessionRecord(1, 0, 1))
    arms.drive(arms.right)
    assert driver.engaged


def test_drives_that_went_off_without_a_fault_come_on_only_after_a_rearm(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    arms.begin("right")
    arms.drive(arms.right)
    driver = arms.right.driver
    driver._switch_off()
    for _ in range(60):
        arms.turn()
    assert (arms.right.servo.report.trip, driver.engaged) == (Trip.DEVICE_LOST, False)
    arms.right.mail.put_session(SessionRecord(1, 0, 1))
    arms.drive(arms.right)
    assert driver.engaged


def test_drives_that_do_not_switch_on_during_a_session_stop_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    arms.begin("right")
    arms.drive(arms.right)
    arms.right.driver._switch_off()
    arms.right.driver.broken = 2
    for _ in range(60):
        arms.turn()
    report = arms.right.servo.report
    assert (report.status, report.trip) == (RobotStatus.TRIPPED, Trip.DEVICE_LOST)


# The end.


def test_arms_are_lowered_at_the_same_time_before_one_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    calls: list[tuple[str, str]] = []
    monkeypatch.setattr("hal.host.cycle.time", SimpleNamespace(monotonic=lambda: 1.0 + DT * len(calls), sleep=abs))
    for name, steps in (("left", 2), ("right", 4)):
        driver = arms.cycle.arms[name].driver

        def lower(name: str = name, steps: int = steps) -> bool:
            calls.append((name, "lower"))
            return calls.count((name, "lower")) == steps

        monkeypatch.setattr(driver, "lower", lower)
        monkeypatch.setattr(driver, "close", lambda name=name: calls.append((name, "close")))
    arms.cycle.close()
    left, right = ("left", "lower"), ("right", "lower")
    assert calls == [left, right, left, right, right, right, ("left", "close"), ("right", "close")]


@pytest.mark.parametrize("wrong", [lambda: False, lambda: 1 / 0], ids=["never_down", "an_error"])
def test_an_arm_that_cannot_be_lowered_is_closed_anyway(wrong: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    arms = TwoArms(monkeypatch)
    now = [1.0]
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds))
    monkeypatch.setattr("hal.host.cycle.time", clock)
    closed: list[str] = []
    for name in ("left", "right"):
        monkeypatch.setattr(arms.cycle.arms[name].driver, "close", lambda name=name: closed.append(name))
    monkeypatch.setattr(arms.left.driver, "lower", wrong)
    arms.cycle.close()
    assert closed == ["left", "right"]
    assert now[0] < 1.0 + LOWER_LIMIT + 2.0 * DT
