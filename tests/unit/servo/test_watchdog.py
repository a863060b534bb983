"""When the arm may move, when it must stop, and how a stop is left. The servo around it moves, or does not."""

from __future__ import annotations

import math

import pytest
from servo_kit import Bench
from specs import panda

from hal.commands import Kind
from hal.servo.watchdog import SILENCE
from hal.types import RobotStatus, Trip


def held() -> Bench:
    """A session with a dead-man that is held, moving joint 0."""
    bench = Bench(deadman=True)
    bench.tick()
    bench.press()
    bench.drive()
    assert bench.status is RobotStatus.FOLLOWING
    assert bench.moving
    return bench


def assert_a_new_press_continues(bench: Bench) -> None:
    bench.press_again()
    bench.drive(0.3)
    assert bench.trip is Trip.NONE
    assert bench.moving
    bench.assert_within_limits()


def assert_only_a_new_press_continues(bench: Bench, trip: Trip) -> None:
    """Check that neither new commands, a rearm nor the release of the dead-man clear the stop."""
    bench.until_rest(0.5)
    bench.drive(0.3)
    bench.rearm()
    bench.drive(0.3)
    bench.release()
    bench.run(0.1)
    assert (bench.trip, bench.moving) == (trip, False)
    assert_a_new_press_continues(bench)


def test_nothing_moves_before_a_command() -> None:
    bench = Bench()
    start = list(bench.q)
    bench.run(0.5)
    assert bench.status is RobotStatus.HOLDING
    assert bench.q == start
    bench.drive(0.2)
    assert bench.q[0] > start[0] + 0.01


def test_a_release_between_two_ticks_is_a_release() -> None:
    bench = held()
    bench.release()
    bench.press()
    bench.tick()
    assert bench.status is RobotStatus.STOPPING
    bench.until_rest(0.5)


def test_a_press_while_the_arm_brakes_counts_only_once_it_is_at_rest() -> None:
    bench = held()
    bench.press_again()
    bench.drive(bench.dt)
    while bench.moving:
        assert bench.status is RobotStatus.STOPPING
        bench.drive(bench.dt)
    bench.drive(0.3)
    assert bench.status is RobotStatus.FOLLOWING
    assert bench.moving
    bench.assert_within_limits()


def test_a_command_that_was_sent_before_the_press_is_not_followed_after_it() -> None:
    bench = held()
    bench.release()
    bench.until_rest(0.5)
    bench.send(Kind.JOINT_VELOCITY, [0.5] + [0.0] * 6, deadline=9.0)
    bench.press()  # the servo sees both in the same tick
    bench.run(0.3)
    assert not bench.moving
    bench.drive(0.1)
    assert bench.moving


def test_a_command_that_came_meanwhile_is_in_time() -> None:
    bench = held()
    bench.now += 0.2  # the host was held up; the app was not
    bench.send(Kind.JOINT_VELOCITY, [0.5] + [0.0] * 6)
    bench.tick()
    assert bench.status is RobotStatus.FOLLOWING


def test_a_press_while_the_device_is_lost_does_not_count() -> None:
    bench = held()
    bench.lose()
    bench.release()
    bench.press()
    bench.lose()
    bench.drive(0.5)
    assert bench.trip is Trip.DEVICE_LOST


def test_a_rearm_while_the_device_is_lost_does_not_count() -> None:
    bench = Bench()
    bench.drive()
    bench.lose()
    bench.rearm()
    bench.lose()
    bench.drive(0.5)
    assert (bench.trip, bench.moving) == (Trip.DEVICE_LOST, False)
    bench.rearm()
    bench.drive()
    assert bench.moving


def test_a_command_of_another_session_does_not_extend_the_deadline() -> None:
    bench = held()
    for _ in range(round(0.2 / bench.dt)):
        bench.send(Kind.JOINT_VELOCITY, [0.5] + [0.0] * 6)
        bench.command = bench.command._replace(session=2)
        bench.tick()
    assert bench.trip is Trip.COMMAND_LATE


@pytest.mark.parametrize("known_stops", [0, None], ids=["unknown to the app", "known to the app"])
def test_a_stop_counts_unless_the_app_knew_of_it_before_the_session(known_stops: int | None) -> None:
    bench = Bench(begin=False)
    bench.tick()
    bench.stops += 1
    bench.tick()
    bench.begin(known_stops)
    bench.drive(0.3)
    assert bench.moving is (known_stops is None)
    if known_stops is None:
        bench.stops += 1
        bench.tick()
    assert bench.trip is Trip.STOP


@pytest.mark.parametrize("garbage", [math.nan, math.inf, -math.inf])
def test_a_heartbeat_that_is_no_number_counts_as_silence(garbage: float) -> None:
    bench = held()
    bench.app_alive = False
    bench.t_app = garbage
    bench.tick()
    assert bench.trip is Trip.APP_SILENT
    bench = held()
    bench.pad_alive = False
    bench.deadman = bench.deadman._replace(t_alive=garbage)
    bench.tick()
    assert bench.trip is Trip.DEADMAN_SILENT


@pytest.mark.parametrize("fault", ["pad silent", "pad gone", "app silent"])
def test_what_happens_while_the_deadman_is_released_is_no_trip_and_moves_nothing(fault: str) -> None:
    bench = held()
    bench.release()
    bench.until_rest(0.5)
    if fault == "pad silent":
        bench.pad_alive = False
    elif fault == "pad gone":
        bench.deadman = bench.deadman._replace(connected=False)
    else:
        bench.app_alive = False
    bench.drive(0.5)
    assert (bench.status, bench.trip) == (RobotStatus.HOLDING, Trip.NONE)
    bench.press()  # whatever this was, it does not count
    bench.drive(0.3)
    assert not bench.moving
    bench.pad_alive = bench.app_alive = True
    bench.deadman = bench.deadman._replace(connected=True)
    bench.drive(0.3)
    assert not bench.moving
    bench.release()
    bench.drive(0.1)
    bench.press()
    bench.drive(0.3)
    assert bench.moving


def attended(**changes: object) -> Bench:
    """An arm that really moves, driven as in `held`."""
    bench = Bench(panda(attended=True, **changes), deadman=True)
    bench.tick()
    bench.press()
    bench.drive()
    assert bench.moving
    return bench


def test_a_servo_that_could_not_run_trips_an_arm_that_really_moves() -> None:
    """The app, the pad and the device went on meanwhile: nothing but the pause itself tells."""
    bench = attended()
    bench.now += SILENCE
    bench.drive(bench.dt)
    assert (bench.status, bench.trip) == (RobotStatus.TRIPPED, Trip.HOST_LATE)
    assert_only_a_new_press_continues(bench, Trip.HOST_LATE)


def test_a_shorter_pause_and_one_in_which_nothing_may_move_are_no_trip() -> None:
    bench = attended()
    bench.now += SILENCE - 2.5 * bench.dt
    bench.drive(bench.dt)
    assert bench.status is RobotStatus.FOLLOWING
    bench.release()
    bench.until_rest(0.5)
    bench.now += 9.0
    bench.tick()
    assert (bench.status, bench.trip) == (RobotStatus.HOLDING, Trip.NONE)
    bench.servo.close_session()
    bench.run(0.1)
    bench.now += 9.0
    bench.begin()
    bench.tick()
    assert bench.trip is Trip.NONE


def test_a_simulated_arm_waits_with_its_world() -> None:
    bench = held()
    bench.now += 9.0
    bench.drive(bench.dt)
    assert (bench.status, bench.trip) == (RobotStatus.FOLLOWING, Trip.NONE)


@pytest.mark.parametrize("attended_arm", [True, False])
def test_a_pause_that_the_clock_does_not_show_is_told_by_the_host(attended_arm: bool) -> None:
    bench = attended() if attended_arm else held()
    bench.late = True
    bench.drive(bench.dt)
    bench.late = False
    assert bench.trip is Trip.HOST_LATE
    bench.until_rest(0.5)


def test_a_clock_that_runs_backwards_does_no_harm() -> None:
    bench = held()
    for step in (-0.5, 0.0, 0.3, -0.01, -5.0):
        bench.now += step
        bench.tick()
    bench.until_rest(1.0)
    bench.assert_within_limits()


def test_every_trip_has_a_code_of_its_own() -> None:
    assert len({trip.code for trip in Trip}) == len(Trip)
