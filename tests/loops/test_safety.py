"""Every row of the tables of docs/safety.md, as a program meets it: through ``hal.open``.

Rows of a mock arm run in lock-step, where times are exact. Rows about a process run in real time, and wait for events.
A row that a test elsewhere shows through ``hal.open`` or an emulator is in :data:`ELSEWHERE`.
"""

from __future__ import annotations

import itertools
import math
import os
import re
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
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

ROOT = Path(__file__).parents[2]
TICK = 1 / 240
"""Period of the mock arm's servo, s."""
HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)

ELSEWHERE = {
    "the console's browser freezes": ("tests/browser/test_trips.py", "tests/browser/test_pages.py"),
    "another arm of the same `hal-teleop`": (
        "tests/unit/core/test_session_arms.py::test_a_trip_of_one_arm_holds_the_other_until_a_new_press_of_its_own",
        "tests/unit/core/test_session_arms.py::test_independent_arms_do_not_stop_each_other",
    ),
    "your loop is too slow or hangs": ("tests/system/test_ends.py::test_user_code_that_goes_wrong",),
    "the app is killed": ("tests/system/test_ends.py::test_an_app_that_ends",),
    "the host's process dies": ("tests/system/test_real_time.py::test_a_host_that_is_killed_is_told_by_the_next_call",),
    "a Franka ends the motion": ("tests/wire/test_franka_faults.py", "tests/wire/test_franka_stops.py"),
    "a Franka's set-points or states": ("tests/wire/test_franka_tour.py::test_packets_that_are_lost_end_no_motion",),
    "the app of a Franka is killed": ("tests/wire/test_franka_ends.py::test_an_app_is_killed_while_the_robot_hangs",),
    "the host of an arm with Damiao motors dies": (
        "tests/wire/test_can_gravity.py::test_an_arm_without_its_program_sinks_slowly",
    ),
    "an arm with Damiao motors is closed": (
        "tests/lock_step/test_can_faults.py::test_close_lowers_a_raised_arm_slowly_and_never_drops_it",
        "tests/lock_step/test_can_faults.py::test_a_gripper_holds_while_its_arm_sinks",
    ),
    "the host of a PiPER dies": (
        "tests/wire/test_piper_rig.py::test_an_arm_whose_program_ends_holds",
        "tests/wire/test_piper_rig.py::test_a_bus_that_is_cut_stops_the_program_and_comes_back",
    ),
    "a motor or joint on a CAN bus": ("tests/lock_step/test_can_faults.py::test_a_fault_in_motion",),
    "the process of a gripper dies": (
        "tests/system/test_gripper_process.py::test_an_arm_does_not_wait_for_a_gripper_that_is_slow_or_dead",
    ),
}
"""Beginning of a row -> the tests that show it."""
SHOWN = set(ELSEWHERE)
"""Beginnings of all rows that have a test."""


def shows(*rows: str) -> Callable[[Any], Any]:
    """Note which rows a test shows, by how they begin."""
    SHOWN.update(rows)
    return lambda test: test


def rows_of_the_page() -> list[str]:
    """Return the first cell of each row of the three tables."""
    text = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    cells = []
    for heading in ("The numbers", "Trips and how to continue", "Events and their effects"):
        section = text.split(f"## {heading}\n")[1].split("\n## ")[0]
        cells += [line.strip("| ").split(" |")[0] for line in re.findall(r"^\|.*\|$", section, re.MULTILINE)[2:]]
    return cells


def test_every_row_has_a_test_and_every_test_a_row() -> None:
    rows = rows_of_the_page()
    assert len(rows) > 50
    found = {row: [begin for begin in SHOWN if row.startswith(begin)] for row in rows}
    assert [row for row, begins in found.items() if len(begins) != 1] == []
    assert SHOWN - {begins[0] for begins in found.values()} == set()
    for place in itertools.chain(*ELSEWHERE.values()):
        file, _, name = place.partition("::")
        assert f"def {name}" in (ROOT / file).read_text(encoding="utf-8"), place


# Trips.


@dataclass(frozen=True)
class Stop:
    """A cause of a trip: what happens, what the program gets, when the arm brakes, and what ends the cause."""

    name: str
    row: str
    trip: Trip
    begin: Callable[[Loop], object]
    end: Callable[[Loop], object] | None = None
    """None where the cause is over by itself."""
    after: float = 0.0
    """From the event to the stop, at most, s; at least 15 ms less."""
    deadman: bool | None = None
    """Whether it needs a session with a dead-man; None for both kinds."""
    command: hal.Command = TURN
    rig: tuple[tuple[str, Any], ...] = ()

    def start(self, deadman: bool) -> Any:
        """Return a program in motion."""
        return driving(deadman=deadman, command=self.command, **dict(self.rig))


def inject(**faults: Any) -> Callable[[Loop], object]:
    return lambda loop: loop.arm.inject(**faults)


def inject_pad(**faults: Any) -> Callable[[Loop], object]:
    return lambda loop: loop.pad.inject(**faults)


def report(**fields: Any) -> Callable[[Loop], object]:
    """Return a function that lets the arm report these instead of its own."""
    return lambda loop: loop.alter(lambda reading: reading._replace(**fields))


def report_noise(size: float) -> Callable[[Loop], object]:
    """Return a function that lets the reported set-points vary by up to ``size``, rad."""
    signs = itertools.cycle([1.0, -1.0, 0.6, -0.8, 0.9])
    return lambda loop: loop.alter(
        lambda reading: reading._replace(q_commanded=[x + size * next(signs) for x in reading.q_commanded or ()])
    )


def recover(loop: Loop) -> None:
    loop.restore()
    loop.arm.recover()
    loop.wait(0.05)


def push(torque: float) -> Callable[[Loop], object]:
    """Return a function that adds a torque to those that drive the first joint."""

    def begin(loop: Loop) -> None:
        driven = type(loop.device)._driven.__get__(loop.device)
        loop.device._driven = lambda tau, dt: driven([tau[0] + torque, *tau[1:]], dt)  # type: ignore[method-assign]

    return begin


def let_go(loop: Loop) -> None:
    loop.device.__dict__.pop("_driven", None)


def turn_back(loop: Loop) -> None:
    loop.command = JointTorque([-5.0] + [0.0] * 6)


NAN, INF = math.nan, math.inf
PUSHING = JointTorque([3.0] + [0.0] * 6)
BAD_VALUES = {
    "not finite: nan": inject(garbage="nan"),
    "not finite: inf": inject(garbage="inf"),
    "too few": inject(garbage="short"),
    "beyond the range": report(q=(2.8973 + 1.01, *HOME[1:])),
    "too fast": report(dq=(1001.0, *[0.0] * 6)),
    # Every field that a reading has, not only those that the servo needs.
    **{
        f"{field}: {value}": report(**{field: (value, *[0.0] * (5 if field == "wrench_ext" else 6))})
        for field in ("dq", "q_commanded", "dq_commanded", "tau", "tau_ext", "wrench_ext")
        for value in (NAN, INF)
    },
}


def end_bad_values(loop: Loop) -> None:
    loop.arm.inject(garbage=None)
    loop.restore()


STOPS = (
    Stop("no command", "`COMMAND_LATE`", Trip.COMMAND_LATE, lambda loop: loop.wait(0.3), after=0.08 + TICK),
    Stop(
        "a frozen pad",
        "`DEADMAN_SILENT`",
        Trip.DEADMAN_SILENT,
        inject_pad(freeze=True),
        inject_pad(freeze=False),
        after=0.12,
        deadman=True,
    ),
    Stop(
        "an unplugged pad",
        "`DEADMAN_LOST`",
        Trip.DEADMAN_LOST,
        inject_pad(disconnect=True),
        inject_pad(disconnect=False),
        after=0.015,
        deadman=True,
    ),
    Stop("rig.stop()", "`STOP`", Trip.STOP, lambda loop: loop.rig.stop(), after=TICK),
    Stop("a fault of the arm", "`FAULT`", Trip.FAULT, inject(fault="collision"), recover, after=TICK),
    Stop("SETPOINT_MISMATCH", "`FAULT`", Trip.FAULT, report_noise(0.01), recover, after=22 * TICK),
    Stop(
        "an arm that does not answer",
        "`DEVICE_LOST`",
        Trip.DEVICE_LOST,
        inject(disconnect=True),
        inject(disconnect=False),
        after=TICK,
    ),
    Stop(
        "an arm that repeats a reading",
        "`DEVICE_LOST`",
        Trip.DEVICE_LOST,
        inject(freeze=True),
        inject(freeze=False),
        after=0.15,
    ),
    *(
        Stop(name, "`BAD_READING`", Trip.BAD_READING, begin, end_bad_values, TICK, None if name == "too few" else False)
        for name, begin in BAD_VALUES.items()
    ),
    Stop("pushed too fast", "`LIMIT`", Trip.LIMIT, push(30.0), let_go, after=2 * TICK, command=PUSHING),
    Stop(
        "at the end of a joint",
        "`LIMIT`",
        Trip.LIMIT,
        lambda loop: None,
        turn_back,
        after=1.0,
        command=PUSHING,
        rig=(("robots__panda__initial", [2.3, *HOME[1:]]),),
    ),
)
SHOWN.update(stop.row for stop in STOPS)
CASES = [
    pytest.param(stop, deadman, id=f"{stop.name}, {'dead-man' if deadman else 'no dead-man'}")
    for stop in STOPS
    for deadman in ((False, True) if stop.deadman is None else (stop.deadman,))
]


FIRST = {case.values[0].row: case.values[0] for case in reversed(CASES)}
ONE_OF_EACH = [case for case in CASES if case.values[0] is FIRST[case.values[0].row]]
"""One cause of each trip."""


def found_code(error: hal.HalError | None) -> str | None:
    return None if error is None else error.code


@pytest.mark.parametrize(("stop", "deadman"), CASES)
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_a_trip_stops_the_arm_until_its_cause_is_gone_and_it_is_acknowledged(stop: Stop, deadman: bool) -> None:
    with stop.start(deadman) as loop:
        began = loop.now
        stop.begin(loop)
        assert found_code(loop.drive(1.5)) == stop.trip.code
        assert loop.control.trip is stop.trip
        if stop.name != "at the end of a joint":
            assert stop.after - 0.015 <= loop.servo.t_stop - began <= stop.after + 1e-6
        loop.rest()
        loop.assert_stays()
        if stop.end is not None:
            if stop.row != "`LIMIT`":  # whose cause is gone at rest
                loop.acknowledge()
                loop.assert_stays()
            stop.end(loop)
            loop.wait(0.2)
            loop.assert_stays()
        loop.acknowledge()
        loop.assert_continues()


@pytest.mark.parametrize(("stop", "deadman"), ONE_OF_EACH)
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_a_stop_replaces_every_trip_but_a_fault(stop: Stop, deadman: bool) -> None:
    # New: a stop is visible behind any trip, and only who saw it clears it.
    with stop.start(deadman) as loop:
        stop.begin(loop)
        assert found_code(loop.drive(1.5)) == stop.trip.code
        loop.rig.stop()
        if not deadman:
            loop.control.rearm()  # for the trip that the program has seen
        loop.wait(0.05)
        expected = Trip.FAULT if stop.trip is Trip.FAULT else Trip.STOP
        assert loop.control.trip is expected
        if stop.end is not None:
            stop.end(loop)
        loop.wait(0.2)
        if stop.trip is not Trip.FAULT:
            assert found_code(loop.drive()) == Trip.STOP.code
        loop.assert_stays()
        loop.acknowledge()
        if stop.trip is Trip.FAULT and loop.control.trip:
            assert found_code(loop.drive()) == Trip.STOP.code
            loop.acknowledge()
        loop.assert_continues()


FINGERS_REST = 0.150
"""Longest time in which fingers come to rest after the session may not move, s."""


def close_released(loop: Loop) -> None:
    loop.pad.release("l2")


@pytest.mark.parametrize("held", [False, True], ids=["nothing", "an object"])
@pytest.mark.parametrize(
    ("begin", "deadman"),
    [
        *(pytest.param(stop.begin, deadman, id=case.id) for case in ONE_OF_EACH for stop, deadman in [case.values]),
        pytest.param(close_released, True, id="released dead-man"),
    ],
)
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_fingers_that_a_session_moves_stop_with_it_and_keep_an_object(
    begin: Callable[[Loop], object], deadman: bool, held: bool
) -> None:
    # New: fingers that a session moves are under the same watch as its arm.
    with driving(deadman=deadman, robots__panda__gripper__speed=0.02) as loop:
        gripper = loop.arm.gripper
        assert gripper is not None
        loop.grip = 1.0
        if held:
            gripper.inject(object_width=0.07)
        assert loop.drive(1.0) is None
        before = gripper.state()
        assert before.grasped if held else before.moving
        began = loop.now
        begin(loop)
        loop.drive(1.0)
        assert not loop.moves
        since = max(began, loop.servo.t_stop)
        loop.grip = None
        loop.wait(1.0)
        after = gripper.state()
        if held:
            assert after.grasped
            assert after.width == before.width
        else:
            assert before.width - after.width <= 0.02 * (since - began + FINGERS_REST + 2 * TICK)


# Trips of the process.


@shows("`HOST_LATE`")
@pytest.mark.parametrize("how", ["stopped", "suspended"])
@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.filterwarnings("ignore:panda was stopped")
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


REARMING = """
        try:
            control.send(hal.JointVelocity(velocity))
        except hal.MotionStopped:
            control.rearm()
"""


@shows("`APP_SILENT`", "the app is stopped")
@pytest.mark.slow
@pytest.mark.alone
def test_an_app_that_is_stopped_continues_when_it_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send = "        control.send(hal.JointVelocity(velocity))\n"
    assert send in observer.APP
    # Its velocities last for three seconds each: not their deadline stops the arm, but its silence.
    chunk = "hal.JointChunk([now + 0.1, now + 2.9], [arm.state().q_set] * 2)"
    drifting = REARMING.lstrip("\n").replace("hal.JointVelocity(velocity)", "command")
    choice = f"        now = rig.clock.now()\n        command = {chunk} if turn > 40 else hal.JointVelocity(velocity)\n"
    monkeypatch.setattr(observer, "APP", observer.APP.replace(send, choice + drifting))
    app = observer.Watched(tmp_path, rate_hz=5)
    try:
        app.wait_for(lambda: app.servo().target_seq > 60)
        app.end("SIGSTOP")
        app.wait_for(lambda: app.servo().trip is Trip.APP_SILENT)
        alive = app.memory.get_app().t
        assert 0.1 < app.servo().t_stop - alive < 0.15 + 0.05, "a busy computer may run the servo late"
        assert not app.nobody_left(), "the host holds"
        os.kill(app.pid, signal.SIGCONT)
        app.wait_for(lambda: app.servo().status is RobotStatus.FOLLOWING)
    finally:
        app.close()


@shows("after the last sign of life of an app that still exists")
@pytest.mark.slow
@pytest.mark.alone
def test_the_host_of_an_app_that_stays_silent_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    with laboratory() as rig:
        host: Any = rig._hosts[0]
        rig.robots["panda"].inject(shorten={"hal.host.main:APP_GONE": 1.0})
        beat, host._beat = host._beat, lambda: None  # the app exists, and its threads stand still
        last = rig._hosts[0].memory.get_app().t
        wait_until(lambda: host.child.process.poll() is not None, "ended")
        assert time.monotonic() - last > 1.0
        host._beat = beat
        with pytest.raises(hal.ConnectionLost):
            rig.robots["panda"].state(max_age=9.0)


@shows("a vendor's library that does not return")
@pytest.mark.slow
@pytest.mark.alone
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
@pytest.mark.filterwarnings("ignore:panda was stopped")
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


def test_what_is_held_when_the_session_opens_moves_nothing() -> None:
    with mock_rig() as rig:
        rig.clock.sleep(0.1)
        rig.driver("pad").press("l2")
        rig.clock.sleep(0.1)
        with rig.robots["panda"].control(deadman=rig.gamepads["pad"].hold("l2")) as control:
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
        session = lambda: rig.robots["panda"].control(deadman=rig.gamepads["pad"].hold("l2"))  # noqa: E731
        if accepted:
            with session():
                pass
        else:
            with raises_code(hal.NotSupported, "deadman_not_trusted"):
                session()
        with raises_code(hal.CommandError, "deadman_required"):
            rig.robots["panda"].control()


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


@shows("the robot does not answer")
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_an_arm_that_is_lost_is_braked_for_when_it_answers_again() -> None:
    with driving() as loop:
        at = np.array(loop.servo.q_set)
        loop.arm.inject(disconnect=True)
        loop.wait(2 * TICK)
        with pytest.raises(hal.ConnectionLost):
            loop.arm.state()
        assert loop.moves, "the set-point brakes"
        assert found_code(loop.drive()) == "device_lost"
        loop.rest()
        assert 0.0 < loop.servo.q_set[0] - at[0] < 0.05
        loop.arm.inject(disconnect=False)
        loop.wait(0.1)
        assert loop.arm.state().q == pytest.approx(at, abs=0.05)
        loop.acknowledge()
        loop.assert_continues()


@shows("a session ends, or trips, with an object")
@pytest.mark.filterwarnings("ignore:panda was stopped")
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
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_silence_is_a_stop_within(who: str, most: float) -> None:
    """The app's silence is that of a process: see the row of the app that is stopped."""
    with driving(deadman=True) as loop:
        (loop.pad if who == "pad" else loop.arm).inject(freeze=True)
        loop.wait(TICK)
        alive = loop.control.deadman.record.t_alive if who == "pad" else loop.arm.state().stamp.t
        loop.drive(0.5)
        assert most - 2 * TICK <= loop.servo.t_stop - alive <= most + 1e-9


@shows("period of the app's sign of life")
@pytest.mark.slow
@pytest.mark.alone
def test_the_app_shows_that_it_is_alive() -> None:
    with laboratory() as rig:
        memory, signs = rig._hosts[0].memory, set()
        wait_until(lambda: signs.add(memory.get_app().t) or len(signs) > 20, "heard 20 times")
        assert 0.019 < min(b - a for a, b in itertools.pairwise(sorted(signs))) < 0.04, "as a busy computer allows"


@shows("the next command must come within 2.5 periods")
@pytest.mark.parametrize(("rate_hz", "deadline"), [(50.0, 0.1), (1000.0, 0.1), (10.0, 0.25), (2.5, 1.0)])
@pytest.mark.filterwarnings("ignore:panda was stopped")
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
@pytest.mark.filterwarnings("ignore:panda was stopped")
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


def first_commands(arm: hal.Robot, now: float, angle: float, distance: float) -> dict[str, hal.Command]:
    pose = arm.state().tcp
    q = arm.home + np.array([0, 0, 0, 0, 0, 0, angle])
    return {
        "target": JointTarget(q),
        "chunk": hal.JointChunk([now, now + 1.0], [q, q]),
        "pose": hal.CartesianTarget(hal.Pose(pose.position + [0.0, 0.0, distance], pose.orientation)),
    }


@shows("distance of a first joint target", "the same for a first pose")
@pytest.mark.parametrize("kind", ["target", "chunk", "pose"])
@pytest.mark.parametrize("near", [True, False])
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_a_first_target_is_near(kind: str, near: bool) -> None:
    with mock_rig() as rig, rig.robots["panda"].control() as control:
        share = 0.99 if near else 1.01
        command = first_commands(control.robot, rig.clock.now(), 0.1 * share, 0.05 * share)[kind]
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
    return [NAN if setpoint.tau is None else setpoint.tau[0] for setpoint in loop.log]


@shows("torques: each changes by at most")
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_torques_change_at_a_rate() -> None:
    with driving(command=JointTorque([30.0] + [0.0] * 6)) as loop:
        steps = np.abs(np.diff(torques(loop))) / TICK
        assert np.nanmax(steps) == pytest.approx(990.0)


@shows("torques are kept without a reading")
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_torques_are_removed_when_readings_stop() -> None:
    with driving(command=PUSHING) as loop:
        written = len(loop.log)
        loop.arm.inject(freeze=True)
        began = loop.now
        assert found_code(loop.drive()) == "device_lost"
        assert 0.020 < loop.servo.t_stop - began <= 0.020 + TICK
        loop.wait(0.5)
        later = torques(loop)[written + 6 :]
        assert np.abs(later).max() <= abs(later[0])
        assert later[-1] == 0.0
        assert len(later) < 0.15 / TICK, "then nothing is written"


@shows("torques brake for at most")
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_positions_take_over_an_arm_that_torques_do_not_brake() -> None:
    with driving(command=PUSHING) as loop:
        driven = type(loop.device)._driven.__get__(loop.device)
        still = 0.3  # rad/s, whatever the torques
        loop.device._follows = loop.device._follows._replace(dq=(still, *[0.0] * 6))
        loop.device._driven = lambda tau, dt: driven(tau, dt)._replace(  # type: ignore[method-assign]
            q=[x + dt * v for x, v in zip(loop.device._follows.q, (still, *[0.0] * 6), strict=True)],
            dq=(still, *[0.0] * 6),
        )
        loop.rig.stop()
        written = len(loop.log)
        loop.wait(1.0)
        braked = np.isfinite(torques(loop)[written:])
        assert braked[0]
        assert 0.5 - 2 * TICK <= TICK * braked.sum() <= 0.5 + 2 * TICK
        assert not braked[-1]


def reported(change: Callable[[list[Any], int], Any]) -> str | None:
    """Return the code that ends 1.5 s of driving; ``change`` makes each report of the set-points so far."""
    with mock_rig() as rig:
        loop = Loop(rig, rig.robots["panda"].control(), TURN)
        given: list[Any] = []

        def changed(reading: Any) -> Any:
            given.append(reading.q_commanded)
            return reading._replace(q_commanded=change(given, len(given)))

        loop.alter(changed)
        with loop.control:
            return found_code(loop.drive(1.5))


def shifted(q: Any, by: float) -> list[float]:
    return [x + by for x in q]


def wrong(count: int) -> Callable[[list[Any], int], Any]:
    return lambda given, n: shifted(given[-1], 0.01 * (1.0 + n % 3)) if 200 <= n < 200 + count else given[-1]


def noisy(size: float) -> Callable[[list[Any], int], Any]:
    random = np.random.default_rng(1)
    return lambda given, n: given[-1] + size * random.choice([-1.0, 1.0], 7)


def late(cycles: int) -> Callable[[list[Any], int], Any]:
    return lambda given, n: given[max(0, n - 1 - cycles)]


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
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_devices_are_closed_although_an_arm_does_not_come_to_rest() -> None:
    with mock_rig(robots__panda__limits={"acceleration": 0.02}) as rig:
        control = rig.robots["panda"].control()
        control.__enter__()
        loop = Loop(rig, control, TURN)
        assert loop.drive(10.0) is None
        with pytest.raises(hal.ConnectionLost):  # the session waits as long
            control.close()
        assert loop.moves
        written, device = len(loop.log), loop.device
        rig.close()
        assert 4.9 < TICK * (len(device.log) - written) <= 5.0
        assert not device.is_open
