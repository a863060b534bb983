"""One arm in its group's cycle, driven by the mock: the comparison of the tools, and an arm that does not answer."""

from __future__ import annotations

import pytest
from specs import panda

from hal.commands import CommandRecord, Kind, Session
from hal.errors import ConnectionLost
from hal.geometry import Pose
from hal.host.cycle import TCP_APART, TCP_TURNED, ArmUnit
from hal.host.records import AppRecord, RobotMail
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


def driving() -> tuple[ArmUnit, float]:
    """An arm that follows velocities, and the time."""
    arm = unit()
    arm.open(1.0)
    arm.open_session(Session(1, 1.0, 100.0, False), AppRecord(1.0, 0))
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
