"""Commands and states on their way through shared memory: nothing is lost, made up, or decoded twice."""

from __future__ import annotations

import math

import pytest

from hal.commands import CommandRecord, DeadmanRecord, Kind, SessionRecord
from hal.driver import GripperReading, Reading
from hal.errors import Fault
from hal.host.records import GripperAct, GripperCommand, GripperMail, GroupMemory, RobotMail, ServoRecord
from hal.types import GripperOutcome, Limited, RobotStatus, Trip

N = 6
Q, DQ, Q_SET, DQ_SET = ([10.0 * k + i for i in range(N)] for k in range(4))
TCP, TCP_SET = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0), (0.4, 0.5, 0.6, 0.0, 0.0, 1.0, 0.0)
TWIST = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
SERVO = ServoRecord(
    RobotStatus.TRIPPED, Trip.STOP, Limited.SPEED | Limited.LEAD, 7, 2, True, 5, 1.5, 1.25, tuple(Q_SET), tuple(DQ_SET)
)


@pytest.fixture
def mails() -> tuple[RobotMail, RobotMail]:
    """The two sides of the same memory."""
    memory = memoryview(bytearray(RobotMail.size(N)))
    return RobotMail(memory, N), RobotMail(memory, N)


def test_a_state_arrives_as_it_was_sent(mails: tuple[RobotMail, RobotMail]) -> None:
    host, app = mails
    assert app.get_state() is None
    assert app.peek() is None
    tau, tau_ext, wrench = ([float(k + i) for i in range(6)] for k in (50, 60, 70))
    fault = Fault("e-stop", "the button is pressed \u2717", "r" * 300)
    host.put_state(Reading(3.0, 4.0, 9, Q, DQ, tau, Q, DQ, tau_ext, wrench, fault), SERVO, TCP, TCP_SET, TWIST)
    assert app.peek() == SERVO
    state = app.get_state()
    assert (state.stamp.t, state.stamp.t_device, state.stamp.seq) == (3.0, 4.0, 9)
    for array, values in (
        (state.q, Q),
        (state.dq, DQ),
        (state.tau, tau),
        (state.q_set, Q_SET),
        (state.dq_set, DQ_SET),
        (state.tcp.position, TCP[:3]),
        (state.tcp.orientation, TCP[3:]),
        (state.tcp_set.position, TCP_SET[:3]),
        (state.tcp_set.orientation, TCP_SET[3:]),
        (state.tcp_twist, TWIST),
        (state.tau_ext, tau_ext),
        (state.wrench_ext, wrench),
    ):
        assert array.tolist() == list(values)
        assert not array.flags.writeable
    assert (state.status, state.trip, state.limited, state.target_seq) == (*SERVO[:3], 7)
    assert state.fault == Fault("e-stop", fault.cause, "r" * 240)


def test_what_is_not_known_stays_unknown(mails: tuple[RobotMail, RobotMail]) -> None:
    host, app = mails
    host.put_state(Reading(3.0, 4.0, 9, Q, DQ), SERVO, TCP, TCP_SET, TWIST)
    state = app.get_state()
    assert (state.tau, state.tau_ext, state.wrench_ext, state.fault) == (None, None, None, None)


def test_a_record_is_decoded_once_and_kept_when_the_next_one_comes(mails: tuple[RobotMail, RobotMail]) -> None:
    host, app = mails
    host.put_state(Reading(3.0, 4.0, 9, Q, DQ), SERVO, TCP, TCP_SET, TWIST)
    first = app.get_state()
    assert app.get_state() is first
    host.put_state(Reading(4.0, 5.0, 10, DQ, Q), SERVO, TCP, TCP_SET, TWIST)
    second = app.get_state()
    assert (second.stamp.seq, second.q.tolist()) == (10, DQ)
    assert (first.stamp.seq, first.q.tolist()) == (9, Q), "arrays of an old state do not change"


def test_a_command_a_deadman_and_a_session_arrive(mails: tuple[RobotMail, RobotMail]) -> None:
    app, host = mails
    assert (host.get_command(), host.get_deadman(), host.get_session()) == (None, None, (0, 0, 0))
    twist = CommandRecord(3, 1, 2.0, 2.1, Kind.TWIST, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1.0), 1.9)
    target = CommandRecord(4, 1, 2.0, 2.1, Kind.JOINT_TARGET, (*Q, *DQ))
    for command in (twist, target):
        app.put_command(command)
        assert host.get_command() == command
        assert host.get_command() is host.get_command()
    deadman = DeadmanRecord(True, True, 5, 1.75)
    app.put_deadman(deadman)
    app.put_session(SessionRecord(6, 4, 2))
    assert host.get_deadman() == deadman
    assert host.get_session() == (6, 4, 2)


def test_a_grippers_command_and_state_arrive() -> None:
    memory = memoryview(bytearray(GripperMail.size()))
    app, host = GripperMail(memory), GripperMail(memory)
    assert (host.get_command(), app.get()) == (None, None)
    command = GripperCommand(7, 2, 3, GripperAct.GRASP, 0.03, 0.1, 40.0, 0.004, 0.006)
    app.put_command(command)
    assert host.get_command() == command
    fault = Fault("hot", "it is too hot \u2717", "let it cool down")
    reading = GripperReading(3.0, 4.0, 9, 0.031, 0.03, True, True, 12.5)
    host.put(reading, 7, GripperOutcome.FAILED, fault, True, 20.0)
    found = app.get()
    assert found.lost
    state = found.state
    assert (state.stamp.t, state.stamp.t_device, state.stamp.seq) == (3.0, 4.0, 9)
    assert (state.width, state.width_target, state.force_target) == (0.031, 0.03, 20.0)
    assert (state.moving, state.grasped, state.force) == (True, True, 12.5)
    assert (state.outcome, state.fault, state.target_seq) == (GripperOutcome.FAILED, fault, 7)
    host.put(GripperReading(3.1, 4.1, 10, 0.031, 0.03, False))
    found = app.get()
    assert (found.lost, found.state.grasped, found.state.force, found.state.fault) == (False, None, None, None)


def test_mailboxes_of_a_group_do_not_overlap() -> None:
    robots, grippers = [("left", 6), ("right", 7)], ["left.gripper", "right.gripper"]
    memory = memoryview(bytearray(GroupMemory.size(robots, grippers)))
    app, host = (GroupMemory(memory, robots, grippers) for _ in range(2))
    for k, name in enumerate(grippers):
        app.grippers[name].put_command(GripperCommand(k + 1, 0, 0, GripperAct.HOME))
        host.grippers[name].put(GripperReading(k, k, k, 0.01 * k, 0.0, False))
    app.robots["right"].put_session(SessionRecord(1, 0, 1))
    app.app.write(1.0, 5)
    host.host.write(2.0, 3, 4, True)
    for k, name in enumerate(grippers):
        command, found = host.grippers[name].get_command(), app.grippers[name].get()
        assert (command.seq, found.state.width) == (k + 1, 0.01 * k)
    assert (host.robots["left"].get_session().rearms, host.robots["right"].get_session().rearms) == (0, 1)
    assert (host.get_app(), app.get_host()) == ((1.0, 5), (2.0, 3, 4, True))


def test_a_torn_record_is_not_taken_for_the_newest(mails: tuple[RobotMail, RobotMail]) -> None:
    memory = bytearray(RobotMail.size(N))
    app, host = RobotMail(memoryview(memory), N), RobotMail(memoryview(memory), N)
    app.put_command(CommandRecord(1, 1, 2.0, 2.1, Kind.JOINT_TARGET, (*Q, *DQ)))
    first = host.get_command()
    app.put_command(CommandRecord(2, 1, 2.0, 2.1, Kind.JOINT_TARGET, (*DQ, *Q)))
    good, memory[8 + 16] = memory[8 + 16], memory[8 + 16] ^ 0xFF  # in the slot of the second record
    assert host.get_command() is first
    memory[8 + 16] = good
    second = host.get_command()
    assert second.seq == 2
    assert math.isfinite(second.t)
