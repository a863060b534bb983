"""Every row of the tables of docs/safety.md, as a program meets it: through ``hal.open``.

Rows of a mock arm run in lock-step, where times are exact. Rows about a process run in real time, and wait for events.
Other rows are shown elsewhere: ``safety_kit.py`` names the tests.
"""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable
from math import cos, nan, sin
from pathlib import Path
from typing import Any

import numpy as np
import observer
import pytest
from errors_kit import raises_code
from loop_kit import TURN, Loop, driving, laboratory, mock_rig
from waiting import wait_until

import hal
from hal import JointTarget, JointTorque, RobotStatus, Trip

from .safety_kit import PUSHING, STOPS, TICK, Stop, check_rows, code_of, late, noisy, reported, shows, wrong

pytestmark = pytest.mark.filterwarnings("ignore:panda was stopped")
ROOT = Path(__file__).parents[2]


def in_real_time(test: Any) -> Any:
    """Mark a test of what a busy computer would stop."""
    return pytest.mark.slow(pytest.mark.pair(test))


def test_every_row_has_a_test_and_every_test_a_row() -> None:
    check_rows()


# Trips.


def cases(stops: Any) -> list[Any]:
    """Return each cause with and without a dead-man, where it has both."""
    return [
        pytest.param(stop, deadman, id=f"{stop.name}, {'dead-man' if deadman else 'no dead-man'}")
        for stop in stops
        for deadman in ((False, True) if stop.deadman is None else (stop.deadman,))
    ]


ONE_EACH = cases({stop.trip: stop for stop in reversed(STOPS) if stop.name != "SETPOINT_MISMATCH"}.values())
"""One cause of each trip."""


@pytest.mark.parametrize(("stop", "deadman"), cases(STOPS))
def test_a_trip_stops_the_arm_until_its_cause_is_gone_and_it_is_acknowledged(stop: Stop, deadman: bool) -> None:
    with stop.start(deadman) as loop:
        began = loop.now
        stop.begin(loop)
        assert code_of(loop.drive(1.5)) == stop.trip.code
        assert loop.control.trip is stop.trip
        if stop.name != "at the end of a joint":
            assert stop.after - 0.015 <= loop.servo.t_stop - began <= stop.after + 1e-6
        loop.rest()
        loop.assert_stays()
        if stop.end is not None:
            if stop.trip is not Trip.LIMIT:  # whose cause is gone at rest
                loop.acknowledge()
                loop.assert_stays()
            stop.end(loop)
            loop.wait(0.2)
            loop.assert_stays()
        loop.acknowledge()
        loop.assert_continues()


@pytest.mark.parametrize(("stop", "deadman"), ONE_EACH)
def test_a_stop_replaces_every_trip_but_a_fault(stop: Stop, deadman: bool) -> None:
    with stop.start(deadman) as loop:
        stop.begin(loop)
        assert code_of(loop.drive(1.5)) == stop.trip.code
        loop.rig.stop()
        for _ in range(0 if deadman else 2):
            loop.control.rearm()  # for the trip that the program has seen
            loop.wait(0.1)
        loop.wait(0.05)
        expected = Trip.FAULT if stop.trip is Trip.FAULT else Trip.STOP
        assert loop.control.trip is expected
        if stop.end is not None:
            stop.end(loop)
        loop.wait(0.2)
        assert code_of(loop.drive()) == Trip.STOP.code, "also after a fault that hid it"
        loop.assert_stays()
        loop.acknowledge()
        loop.assert_continues()


RELEASE = Stop("a released dead-man", Trip.NONE, lambda loop: loop.pad.release("l2"), deadman=True)
FINGERS_REST = 0.150
"""Longest time in which fingers come to rest after the session may not move, s."""


@pytest.mark.parametrize("held", [False, True], ids=["nothing", "an object"])
@pytest.mark.parametrize(("stop", "deadman"), [*ONE_EACH, *cases([RELEASE])])
def test_fingers_that_a_session_closes_stop_with_the_arm_and_keep_an_object(
    stop: Stop, deadman: bool, held: bool
) -> None:
    with stop.start(deadman, robots__panda__gripper__speed=0.02) as loop:
        gripper = loop.arm.gripper
        assert gripper is not None
        gripper.inject(object_width=0.07 if held else None)
        loop.grip = 1.0
        assert loop.drive(1.0) is None
        before, began = gripper.state(), loop.now
        assert before.grasped if held else before.moving
        stop.begin(loop)
        loop.drive(1.0)
        loop.rest()
        loop.wait(1.0)
        after = gripper.state()
        if held:
            assert after.grasped
            assert after.width == before.width
        else:
            stopped = max(began, loop.servo.t_stop) - began
            assert before.width - after.width <= 0.02 * (stopped + FINGERS_REST + 2 * TICK)


# Trips of the process.


@shows("`HOST_LATE`")
@pytest.mark.parametrize("how", ["stopped", "suspended"])
@in_real_time
def test_a_servo_that_could_not_run_trips(how: str) -> None:
    with laboratory() as rig, rig.robots["panda"].control(unattended=True, rate_hz=9) as control:
        loop = Loop(rig, control, TURN)
        assert loop.drive() is None
        assert loop.moves
        if how == "stopped":
            process = rig._hosts[0].child.process.pid
            os.kill(process, signal.SIGSTOP)
            loop.drive(0.5)
            os.kill(process, signal.SIGCONT)
        else:
            loop.arm.inject(suspend=0.5)
        wait_until(lambda: loop.servo.trip is Trip.HOST_LATE, "tripped")
        with raises_code(hal.MotionStopped, "host_late"):
            for _ in range(20):
                control.send(TURN)
                loop.wait(0.02)
        loop.rest()
        control.rearm()
        wait_until(lambda: loop.servo.trip is Trip.NONE, "rearmed")


CHUNKS = """
        now, at = rig.clock.now(), arm.state().q_set
        try:
            control.send(hal.JointChunk([now, now + 2.9], [at, [x + v for x, v in zip(at, velocity)]]))
        except hal.MotionStopped:
            control.rearm()
"""
"""Each lasts for three seconds: not a deadline stops the arm, but the app's silence."""


@shows("`APP_SILENT`", "the app is stopped")
@in_real_time
def test_an_app_that_is_stopped_continues_when_it_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (send,) = (line for line in observer.APP.splitlines() if "control.send(" in line)
    monkeypatch.setattr(observer, "APP", observer.APP.replace(send, CHUNKS.strip("\n")))
    app = observer.Watched(tmp_path, rate_hz=5)
    try:
        app.wait_for(lambda: app.speed() > 0.05)
        app.end("SIGSTOP")
        app.wait_for(lambda: app.servo().trip is Trip.APP_SILENT)
        alive = app.memory.get_app().t
        assert 0.1 < app.servo().t_stop - alive < 0.15 + 0.05, "a busy computer may run the servo late"
        app.wait_for(app.at_rest)
        assert not app.nobody_left(), "the host holds"
        os.kill(app.pid, signal.SIGCONT)
        app.wait_for(lambda: app.speed() > 0.05)
    finally:
        app.close()


@shows("after the last sign of life of an app that still exists")
@in_real_time
def test_the_host_of_an_app_that_stays_silent_ends() -> None:
    with laboratory() as rig:
        host: Any = rig._hosts[0]
        rig.robots["panda"].inject(shorten={"hal.host.main:APP_GONE": 1.0})
        beat, host.beat = host.beat, lambda: None  # the app exists, and its threads stand still
        last = rig._hosts[0].memory.get_app().t
        wait_until(lambda: host.child.process.poll() is not None, "ended")
        assert time.monotonic() - last > 1.0
        host.beat = beat
        with pytest.raises(hal.ConnectionLost):
            rig.robots["panda"].state(max_age=9.0)


@shows("a vendor's library that does not return")
@in_real_time
def test_a_library_that_does_not_return_is_ended_with_its_process() -> None:
    with laboratory("PACING_ARM") as rig:
        rig.robots["panda"].inject(shorten={"hal.host.main:HANG": 1}, hang=True)
        host: Any = rig._hosts[0]
        wait_until(lambda: host.child.process.poll() is not None, "ended")
        assert host.child.process.poll() == -signal.SIGALRM


# The dead-man.


@shows("the dead-man is released")
def test_a_released_dead_man_stops_the_arm_and_a_press_continues_with_new_commands() -> None:
    with driving(deadman=True) as loop:
        began = loop.now
        loop.pad.release("l2")
        assert loop.drive(0.5) is None, "that is no trip"
        assert 0.0 <= loop.servo.t_stop - began <= 0.015
        assert loop.control.status is RobotStatus.HOLDING
        loop.assert_stays()
        loop.press()
        assert not loop.moves, "commands from before the press do not count"
        loop.assert_continues()


@shows("the pad is unplugged, or freezes")
@pytest.mark.parametrize("fault", ["freeze", "disconnect"])
def test_a_pad_that_comes_back_counts_once_its_sticks_are_at_rest(fault: str) -> None:
    with driving(deadman=True) as loop:
        loop.pad.inject(**{fault: True})
        assert loop.drive() is not None
        loop.rest()
        loop.pad.stick("left_x", 0.8)
        loop.pad.inject(**{fault: False})
        if fault == "disconnect":  # plugged in with a stick held aside
            loop.acknowledge()
            loop.assert_stays()
        loop.pad.stick("left_x", 0.0)
        loop.wait(0.05)
        loop.assert_stays()
        loop.acknowledge()
        loop.assert_continues()


@pytest.mark.parametrize("taped", [False, True])
def test_what_is_held_when_the_session_opens_moves_nothing(taped: bool) -> None:
    with mock_rig() as rig:
        if taped:  # before the pad was seen with it released
            rig.driver("pad").inject(disconnect=True)
        switch = rig.gamepads["pad"].hold("l2")
        rig.clock.sleep(0.1)
        rig.driver("pad").press("l2")
        rig.driver("pad").clear()
        rig.clock.sleep(0.1)
        assert switch.held is not taped
        with rig.robots["panda"].control(deadman=switch) as control:
            loop = Loop(rig, control, TURN)
            loop.assert_stays()
            loop.acknowledge()
            loop.assert_continues()


RECORDING = str(ROOT / "tests" / "data" / "pads" / "tour.jsonl")
ACCEPTED = {"options": {"accept_silent_pad": True}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pad", "accepted"),
    [
        ({"driver": "loop_kit:PAD"}, False),
        ({"driver": "loop_kit:PAD", **ACCEPTED}, True),
        ({"driver": "playback", "file": RECORDING}, False),
        ({"driver": "loop_kit:PLAYER", **ACCEPTED}, False),
    ],
    ids=["silent", "silent, accepted", "recording", "recording, accepted"],
)
def test_a_real_arm_takes_only_a_dead_man_whose_silence_is_detectable(pad: dict[str, Any], accepted: bool) -> None:
    with laboratory(gamepads={"pad": pad}) as rig:
        arm, switch = rig.robots["panda"], rig.gamepads["pad"].hold("l2")
        if accepted:
            with arm.control(deadman=switch):
                pass
        else:
            with raises_code(hal.NotSupported, "deadman_not_trusted"):
                arm.control(deadman=switch)
        with raises_code(hal.CommandError, "deadman_required"):
            arm.control()


def test_a_recording_is_not_opened_for_a_real_arm() -> None:
    with raises_code(hal.NotSupported, "recording_on_real_arm"):
        laboratory(pad=RECORDING, gamepads={"pad": ACCEPTED})


# The rig and the program.


@shows("`rig.stop()`")
@pytest.mark.parametrize("deadman", [False, True])
def test_a_stop_between_sessions_is_acknowledged_before_the_next_one(deadman: bool) -> None:
    with mock_rig() as rig:
        arm, pad = rig.robots["panda"], rig.driver("pad")
        switch = rig.gamepads["pad"].hold("l2") if deadman else None
        rig.clock.sleep(0.1)
        pad.press("l2")
        rig.clock.sleep(0.1)
        rig.stop()
        for attempt in (lambda: arm.control(deadman=switch).__enter__(), lambda: arm.move_to(arm.home, deadman=switch)):
            with raises_code(hal.MotionStopped, "rig_stop"):
                attempt()
        if deadman:
            pad.release("l2")
            rig.clock.sleep(0.1)
        else:
            rig.rearm()
        with arm.control(deadman=switch) as control:
            loop = Loop(rig, control, TURN)
            if deadman:
                loop.assert_stays()
                loop.press()
            loop.assert_continues()


@shows("an exception leaves")
@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_an_exception_continues_once_the_arm_rests(error: type[BaseException]) -> None:
    with mock_rig() as rig:
        arm = rig.robots["panda"]
        with pytest.raises(error), arm.control() as control:
            loop = Loop(rig, control, TURN)
            assert loop.drive() is None
            assert loop.moves
            raise error
        assert not loop.moves
        assert arm.state().status is RobotStatus.IDLE
        with raises_code(hal.CommandError, "session_closed"):
            control.send(TURN)


@shows("the robot does not answer")
def test_an_arm_that_is_lost_is_braked_for_when_it_answers_again() -> None:
    with driving() as loop:
        at = np.array(loop.servo.q_set)
        loop.arm.inject(disconnect=True)
        loop.wait(2 * TICK)
        with pytest.raises(hal.ConnectionLost):
            loop.arm.state()
        assert loop.moves, "the set-point brakes"
        assert code_of(loop.drive()) == "device_lost"
        loop.rest()
        assert 0.0 < loop.servo.q_set[0] - at[0] < 0.05
        loop.arm.inject(disconnect=False)
        loop.wait(0.1)
        assert loop.arm.state().q == pytest.approx(at, abs=0.05)
        loop.acknowledge()
        loop.assert_continues()


@shows("a session ends, or trips, with an object")
def test_fingers_keep_an_object_after_the_session() -> None:
    with driving() as loop:
        gripper = loop.arm.gripper
        assert gripper is not None
        gripper.inject(object_width=0.03)
        loop.grip = 1.0
        assert loop.drive(2.0) is None
        assert gripper.state().grasped
        loop.wait(0.5)
        assert loop.control.trip is Trip.COMMAND_LATE
        assert gripper.state().grasped
        loop.control.close()
        loop.wait(0.5)
        assert gripper.state().grasped
        assert gripper.state().force == gripper.spec.force


# The numbers. ``tests/unit/test_documents.py`` compares them with the code; here is what they do.


@shows("from the last sign of life of the dead-man's pad", "a sign of life of a pad is too old")
@pytest.mark.parametrize(("who", "most"), [("pad", 0.120), ("arm", 0.150)])
def test_silence_is_a_stop_within(who: str, most: float) -> None:
    """The app's silence is that of a process: see the row of the app that is stopped."""
    with driving(deadman=True) as loop:
        (loop.pad if who == "pad" else loop.arm).inject(freeze=True)
        loop.wait(TICK)
        alive = loop.control.deadman.record.t_alive if who == "pad" else loop.arm.state().stamp.t
        loop.drive(0.5)
        assert most - 2 * TICK <= loop.servo.t_stop - alive <= most + 1e-9


@shows("period of the app's sign of life")
@in_real_time
def test_the_app_shows_that_it_is_alive() -> None:
    with laboratory() as rig:
        memory, signs = rig._hosts[0].memory, set()
        wait_until(lambda: signs.add(memory.get_app().t) or len(signs) > 20, "heard 20 times")
        assert 0.019 < min(b - a for a, b in itertools.pairwise(sorted(signs))) < 0.04, "as a busy computer allows"


@shows("the next command must come within 2.5 periods")
@pytest.mark.parametrize(("rate_hz", "deadline"), [(50.0, 0.1), (1000.0, 0.1), (10.0, 0.25), (2.5, 1.0)])
def test_commands_have_a_deadline(rate_hz: float, deadline: float) -> None:
    with driving(rate_hz=rate_hz) as loop:
        loop.control.send(TURN)
        sent = loop.now
        loop.wait(1.5)
        assert loop.control.trip is Trip.COMMAND_LATE
        assert deadline < loop.servo.t_stop - sent <= deadline + 2 * TICK


@shows("and within, for a real arm,")
@pytest.mark.slow
def test_a_real_arm_has_a_longest_deadline() -> None:
    with laboratory() as rig:
        with raises_code(hal.CommandError, "rate_too_low"):
            rig.robots["panda"].control(unattended=True, rate_hz=2.5 / 0.301)
        with rig.robots["panda"].control(unattended=True, rate_hz=2.5 / 0.299):
            pass


@shows("and for a simulated one")
def test_a_simulated_arm_has_a_longest_deadline() -> None:
    with mock_rig() as rig:
        with raises_code(hal.CommandError, "rate_too_low"):
            rig.robots["panda"].control(rate_hz=2.49)
        with rig.robots["panda"].control(rate_hz=2.51):
            pass


def fastest(loop: Loop) -> float:
    """Return the greatest speed of a joint's set-point, as a share of its limit."""
    limits = np.array(loop.arm.limits.velocity)
    return float(max((np.abs(setpoint.dq) / limits).max() for setpoint in loop.log))


@shows("share of the joint speed limits in a control session")
def test_a_session_is_slower_than_the_joints() -> None:
    with driving(command=hal.JointVelocity([9.0, 0, 0, 0, 0, 0, 9.0]), robots__panda__tcp_speed=1.5) as loop:
        assert fastest(loop) == pytest.approx(0.3, rel=1e-4)
        with raises_code(hal.CommandError, "bad_command"):
            loop.arm.control(speed=0.31)


@shows("the same in `move_to`")
def test_move_to_is_slower_still() -> None:
    with mock_rig() as rig:
        arm = rig.robots["panda"]
        loop = Loop(rig, arm.control(), TURN)
        arm.move_to([0.3, *arm.home[1:]])
        assert fastest(loop) == pytest.approx(0.1, rel=1e-4)
        arm.move_to(arm.home, speed=0.2)
        assert fastest(loop) == pytest.approx(0.2, rel=1e-4)


@shows("speed of the tcp, at most")
def test_the_tcp_is_slow() -> None:
    with driving(command=hal.Twist([0.0, 0.9, 0.0])) as loop:
        kinematics, period = loop.arm.kinematics, 1 / loop.arm.spec.rate_hz
        places = [kinematics.pose(setpoint.q).position for setpoint in loop.log]
        speeds = [float(np.linalg.norm(b - a)) / period for a, b in itertools.pairwise(places)]
        assert 0.24 < max(speeds) <= 0.25
        with raises_code(hal.CommandError, "bad_command"):
            loop.arm.control(tcp_speed=0.26)


@shows("greatest `tcp_speed`")
@pytest.mark.slow
def test_a_rig_cannot_give_a_real_arm_any_speed() -> None:
    with pytest.raises(hal.ConfigError) as caught:
        laboratory(arm={"tcp_speed": 1.51})
    assert [(problem.key, problem.code) for problem in caught.value.problems] == [
        ("robots.panda.tcp_speed", "out_of_range")
    ]
    with laboratory(arm={"tcp_speed": 1.49}):
        pass


def first_commands(arm: hal.Robot, now: float, share: float) -> dict[str, hal.Command]:
    """Return first commands this share of the greatest distance away."""
    pose = arm.state().tcp
    q = arm.home + np.array([0, 0, 0, 0, 0, 0, 0.1 * share])
    return {
        "target": JointTarget(q),
        "chunk": hal.JointChunk([now, now + 1.0], [q, q]),
        "pose": hal.CartesianTarget(hal.Pose(pose.position + [0.0, 0.0, 0.05 * share], pose.orientation)),
        "turned pose": hal.CartesianTarget(pose @ hal.Pose([0.0] * 3, [0.0, 0.0, sin(0.1 * share), cos(0.1 * share)])),
    }


@shows("distance of a first joint target", "the same for a first pose", "its turn")
@pytest.mark.parametrize("kind", ["target", "chunk", "pose", "turned pose"])
@pytest.mark.parametrize("near", [True, False])
def test_a_first_target_is_near(kind: str, near: bool) -> None:
    with mock_rig() as rig, rig.robots["panda"].control() as control:
        share = 0.99 if near else 1.01
        command = first_commands(control.robot, rig.clock.now(), share)[kind]
        loop = Loop(rig, control, command)
        if near:
            assert loop.drive() is None
            assert not np.array_equal(control.robot.state().q, control.robot.home)
        else:
            with raises_code(hal.CommandError, "first_step_too_far"):
                loop.drive()
            rig.clock.sleep(0.2)
            assert np.array_equal(control.robot.state().q, control.robot.home)


def torques(loop: Loop) -> list[float]:
    """Return the torques of the first joint that were written, Nm; NaN where positions were."""
    return [nan if setpoint.tau is None else setpoint.tau[0] for setpoint in loop.log]


@shows("torques: each changes by at most")
def test_torques_change_at_a_rate() -> None:
    with driving(command=JointTorque([30.0] + [0.0] * 6)) as loop:
        steps = np.abs(np.diff(torques(loop))) / TICK
        assert np.nanmax(steps) == pytest.approx(990.0)


@shows("torques are kept without a reading")
def test_torques_are_removed_when_readings_stop() -> None:
    with driving(command=PUSHING) as loop:
        written = len(loop.log)
        loop.arm.inject(freeze=True)
        began = loop.now
        assert code_of(loop.drive()) == "device_lost"
        assert 0.020 < loop.servo.t_stop - began <= 0.020 + TICK
        loop.wait(0.5)
        later = torques(loop)[written + 6 :]
        assert np.abs(later).max() <= abs(later[0])
        assert later[-1] == 0.0
        assert len(later) < 0.15 / TICK, "then nothing is written"


@shows("torques brake for at most")
def test_positions_take_over_an_arm_that_torques_do_not_brake() -> None:
    with driving(command=PUSHING) as loop:
        speed = (0.3, *[0.0] * 6)  # rad/s, whatever the torques
        driven = loop.device._driven
        loop.device._driven = lambda tau, dt: driven(tau, dt)._replace(  # type: ignore[method-assign]
            q=[x + dt * v for x, v in zip(loop.device._follows.q, speed, strict=True)], dq=speed
        )
        loop.rig.stop()
        written = len(loop.log)
        loop.wait(1.0)
        braked = np.isfinite(torques(loop)[written:])
        assert braked[0]
        assert 0.5 - 2 * TICK <= TICK * braked.sum() <= 0.5 + 2 * TICK
        assert not braked[-1]


@shows("reports of set-points may be late", "and differ from the set-points", "of 100 reports, this many")
@pytest.mark.parametrize(
    ("change", "code"),
    [
        pytest.param(late(5), None, id="5 cycles late"),
        pytest.param(late(6), "robot_fault", id="6 cycles late"),
        pytest.param(noisy(0.9e-4), None, id="0.09 mrad"),
        pytest.param(noisy(1.2e-4), "robot_fault", id="0.12 mrad"),
        pytest.param(wrong(20), None, id="20 wrong"),
        pytest.param(wrong(21), "robot_fault", id="21 wrong"),
    ],
)
def test_reports_that_fit_no_set_point_are_a_fault(change: Callable[[list[Any], int], Any], code: str | None) -> None:
    assert reported(change) == code


@shows("bringing the arms to rest")
def test_devices_are_closed_although_an_arm_does_not_come_to_rest() -> None:
    with mock_rig(robots__panda__limits={"acceleration": 0.01}) as rig:
        control = rig.robots["panda"].control()
        control.__enter__()
        loop = Loop(rig, control, TURN)
        assert loop.drive(12.0) is None
        with pytest.raises(hal.ConnectionLost):  # the session waits as long
            control.close()
        assert loop.moves
        written, device = len(loop.log), loop.device
        rig.close()
        assert 4.9 < TICK * (len(device.log) - written) <= 5.0
        assert not device.is_open
