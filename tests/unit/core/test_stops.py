"""A stop by ``rig.stop()`` before every other trip: neither hides the other, and only its own rearm clears it.

A stop after another trip is in ``tests/loops/test_safety.py``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal import JointVelocity, MotionStopped, Trip
from hal.commands import StopLatch
from hal.host.records import AppRecord

TURN = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
FAULTS = {
    "robot_fault": ("fault", (None, "collision")),
    "device_lost": ("disconnect", (False, True)),
    "bad_reading": ("garbage", (None, "nan")),
}
"""Fault of the mock arm, and its values without and with it, by the code of its trip."""
ANY_SESSION = ["app_silent", "host_late", *FAULTS]


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock") as opened:
        yield opened


@pytest.fixture
def arm(rig: hal.Rig) -> hal.Robot:
    return rig.robots["panda"]


def drive(rig: hal.Rig, control: hal.Control) -> None:
    for _ in itertools.islice(rig.clock.rate(50.0), 10):
        control.send(TURN)


class Causes:
    """What can trip the session of the mock arm, switched on and off."""

    def __init__(self, rig: hal.Rig) -> None:
        self.rig = rig
        self.arm, self.pad = rig.robots["panda"], rig.driver("pad")
        self.app: Callable[[float], float] = lambda now: now
        self.late = False
        cycle = rig._hosts[0].cycle  # type: ignore[attr-defined]
        step = cycle.step
        cycle.step = lambda now, app, late=False: step(now, AppRecord(self.app(now), app.stops), self.late)

    def begin(self, cause: str) -> None:
        """Let it happen while the arm moves, for long enough that it trips the session and the arm comes to rest."""
        self._set(cause, True)
        self.rig.clock.sleep(0.5)

    def end(self, cause: str) -> None:
        self._set(cause, False)
        self.rig.clock.sleep(0.1)

    def _set(self, cause: str, on: bool) -> None:
        if cause == "app_silent":
            self.app = (lambda now: now - 1.0) if on else (lambda now: now)
        elif cause == "host_late":
            self.late = on
        elif cause in ("pad_silent", "pad_lost"):
            self.pad.inject(**{"freeze" if cause == "pad_silent" else "disconnect": on})
        elif cause == "robot_fault" and not on:
            self.arm.recover()
        elif cause in FAULTS:
            name, values = FAULTS[cause]
            self.arm.inject(**{name: values[on]})


def assert_stopped(rig: hal.Rig, control: hal.Control, moves: Callable[[], object]) -> None:
    """Check that the session shows the stop everywhere, and that only ``moves`` makes it continue."""
    arm = rig.robots["panda"]
    rig.clock.sleep(0.1)
    at = arm.state().q
    for acknowledge in (lambda: None, rig.rearm):
        acknowledge()
        for _ in itertools.islice(rig.clock.rate(50.0), 10):
            with raises_code(MotionStopped, "rig_stop"):
                control.send(TURN)
        assert control.trip is arm.state().trip is Trip.STOP
        assert np.array_equal(arm.state().q, at)
    moves()
    drive(rig, control)
    assert arm.state().q[0] > at[0] + 0.01


@pytest.mark.parametrize("cause", ["command_deadline", *ANY_SESSION])
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_a_rearm_for_another_trip_never_clears_a_stop(rig: hal.Rig, arm: hal.Robot, cause: str) -> None:
    causes = Causes(rig)
    with arm.control(rate_hz=50) as control:
        drive(rig, control)
        rig.stop()
        causes.begin(cause)
        causes.end(cause)
        control.rearm()  # for what the program has seen, which is not the stop
        at = arm.state().q
        with raises_code(MotionStopped, "rig_stop"):
            drive(rig, control)
        rig.stop()  # of this one the program has not seen anything either
        control.rearm()
        assert np.array_equal(arm.state().q, at)
        assert_stopped(rig, control, control.rearm)


@pytest.mark.parametrize("cause", ["command_deadline", "pad_silent", "pad_lost", *ANY_SESSION])
def test_a_press_for_another_trip_never_clears_a_stop(rig: hal.Rig, arm: hal.Robot, cause: str) -> None:
    causes = Causes(rig)

    def press_again() -> None:
        for change in (causes.pad.release, causes.pad.press):
            change("l2")
            rig.clock.sleep(0.1)

    rig.clock.sleep(0.1)
    with arm.control(deadman=rig.gamepads["pad"].hold("l2")) as control:
        press_again()
        drive(rig, control)
        rig.stop()
        causes.begin(cause)
        rig.clock.sleep(0.1)
        assert control.trip is (Trip.FAULT if cause == "robot_fault" else Trip.STOP)
        causes.end(cause)
        assert_stopped(rig, control, press_again)


def test_a_late_acknowledgement_of_an_earlier_stop_takes_no_newer_one_back() -> None:
    latch = StopLatch()
    for _ in range(2):
        latch.stop()
    for seen in (2, 1):
        latch.acknowledge(seen)
    assert not latch.stopped


def test_the_rearm_of_one_arm_acknowledges_no_stop_for_another() -> None:
    robots = {name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("a", 0.0), ("b", 2.0))}
    with (
        hal.open({"robots": robots}, driver="mock", clock="lock_step", pad="none") as rig,
        rig.robots["a"].control(rate_hz=50) as seeing,
        rig.robots["b"].control(rate_hz=50) as other,
    ):
        rig.stop()
        with raises_code(MotionStopped, "rig_stop"):
            drive(rig, seeing)
        seeing.rearm()
        drive(rig, seeing)
        other.rearm()  # its caller has not seen the stop
        with raises_code(MotionStopped, "rig_stop"):
            drive(rig, other)
        other.rearm()
        drive(rig, other)
