"""Fingers that a session moves come to rest with it, on each engine and on emulated arms; what they hold stays held.

``tests/loops/test_safety.py`` has every trip, with the mock's fingers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from engines_kit import need_engine
from stepped_can import SteppedArm, SteppedEmulator, take_for_off

import hal
from hal import Deadman, GripperOutcome, registry

IN_TIME = 0.15
"""Longest time from the event to fingers at rest, s."""


class Closing:
    """A session whose gripper closes while its dead-man is held."""

    def __init__(self, arm: hal.Robot, host: Any, clock: Any, stop: Callable[[], object]) -> None:
        self.arm, self.host, self.clock, self.stop = arm, host, clock, stop
        assert self.arm.gripper is not None
        self.gripper = self.arm.gripper
        self.deadman = Deadman("the test's dead-man")
        self.held, self.connected = False, True
        host.pollers.append(lambda t: self.deadman.update(self.held, self.connected, t))

    @classmethod
    def of(cls, rig: hal.Rig) -> Closing:
        """Return one for a rig with one arm."""
        (arm,) = rig.robots.values()
        return cls(arm, rig._hosts[0], rig.clock, rig.stop)

    def run(self) -> hal.Control:
        """Open the session, press the dead-man, and close the gripper for a while."""
        self.clock.sleep(0.1)
        control = self.arm.control(deadman=self.deadman, rate_hz=50)
        control.__enter__()
        self.press(control)
        return control

    def press(self, control: hal.Control) -> None:
        self.held = True
        self.clock.sleep(0.05)
        self.send(control)

    def send(self, control: hal.Control, seconds: float = 0.2) -> None:
        end = self.clock.now() + seconds
        for tick in self.clock.rate(50):
            control.send(hal.JointVelocity([0.05, *[0.0] * (self.arm.n - 1)]), grip=1.0)
            if tick.t >= end:
                break

    def assert_at_rest(self) -> float:
        """Check that the fingers rest in time, not closed; return their width, m."""
        self.clock.sleep(IN_TIME)
        width = self.gripper.state().width
        self.clock.sleep(0.5)
        state = self.gripper.state()
        assert state.width == pytest.approx(width, abs=1e-3)
        assert 0.2 * self.gripper.width_max < state.width < 0.95 * self.gripper.width_max
        assert state.outcome is GripperOutcome.STOPPED
        return state.width


@pytest.fixture(params=[*registry.ENGINES, "yam", "piper"])
def closing(request: pytest.FixtureRequest) -> Iterator[Closing]:
    """The gripper of a simulated arm, or of an emulated CAN arm, which is stepped with the rig."""
    kind, options = request.param, {"clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with contextlib.ExitStack() as stack:
        if kind in ("yam", "piper"):
            far = stack.enter_context(SteppedEmulator(kind))
            arm = SteppedArm(far, grips=True)
            stack.callback(arm.host.close)
            if kind == "yam":
                stack.callback(take_for_off, arm.driver)
            arm.robot.gripper.open()
            yield Closing(arm.robot, arm.host, arm.clock, arm.host.latch.stop)
            return
        engine = need_engine(kind).name
        yield Closing.of(stack.enter_context(hal.open("panda_table", sim=True, engine=engine, **options)))


def release(closing: Closing, control: hal.Control) -> None:
    closing.held = False


def unplug(closing: Closing, control: hal.Control) -> None:
    closing.connected = False


def freeze(closing: Closing, control: hal.Control) -> None:
    """The pad is silent: the arm notices after 120 ms."""
    closing.host.pollers.clear()
    closing.send(control, 0.08)


def stop(closing: Closing, control: hal.Control) -> None:
    closing.stop()


def trip(closing: Closing, control: hal.Control) -> None:
    """No command comes any more: the arm notices after 100 ms."""
    closing.clock.sleep(0.1)


def leave(closing: Closing, control: hal.Control) -> None:
    error = ValueError("in the program")
    control.__exit__(ValueError, error, None)


@pytest.mark.parametrize("event", [release, unplug, freeze, stop, trip, leave])
@pytest.mark.filterwarnings("ignore:.* was stopped in this session")
def test_fingers_stop_with_their_session(closing: Closing, event: Callable[[Closing, hal.Control], None]) -> None:
    control = closing.run()
    try:
        event(closing, control)
        stopped = closing.assert_at_rest()
        if event is release:
            closing.press(control)
            assert closing.gripper.state().width < stopped - 0.005, "the same grip, sent again, continues"
    finally:
        control.close()


def test_an_exception_in_a_session_keeps_a_held_object() -> None:
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"]) as rig:
        closing = Closing.of(rig)
        closing.gripper.inject(object_width=0.05)
        control = closing.run()
        closing.send(control, 0.5)
        before = closing.gripper.state()
        assert before.grasped
        leave(closing, control)
        rig.clock.sleep(0.5)
        after = closing.gripper.state()
        assert (after.grasped, after.width, after.force) == (True, before.width, before.force)
        control.close()
