"""Fingers that a session moves come to rest with it, on the mock and on each engine; what they hold stays held."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from engines_kit import need_engine

import hal
from hal import Deadman, GripperOutcome, registry

IN_TIME = 0.15
"""Longest time from the event to fingers at rest, s."""


class Closing:
    """A session whose gripper closes while its dead-man is held."""

    def __init__(self, rig: hal.Rig) -> None:
        self.rig = rig
        (self.arm,) = rig.robots.values()
        assert self.arm.gripper is not None
        self.gripper = self.arm.gripper
        self.deadman = Deadman("the test's dead-man")
        self.held, self.connected = False, True
        rig._hosts[0].pollers.append(lambda t: self.deadman.update(self.held, self.connected, t))  # type: ignore[attr-defined]

    def run(self) -> hal.Control:
        """Open the session, press the dead-man, and close the gripper for a while."""
        self.rig.clock.sleep(0.1)
        control = self.arm.control(deadman=self.deadman, rate_hz=50)
        control.__enter__()
        self.press(control)
        return control

    def press(self, control: hal.Control) -> None:
        self.held = True
        self.rig.clock.sleep(0.05)
        self.send(control)

    def send(self, control: hal.Control, seconds: float = 0.2) -> None:
        end = self.rig.clock.now() + seconds
        for tick in self.rig.clock.rate(50):
            control.send(hal.JointVelocity([0.05, *[0.0] * (self.arm.n - 1)]), grip=1.0)
            if tick.t >= end:
                break

    def assert_at_rest(self) -> float:
        """Check that the fingers rest in time, not closed; return their width, m."""
        self.rig.clock.sleep(IN_TIME)
        width = self.gripper.state().width
        self.rig.clock.sleep(0.5)
        state = self.gripper.state()
        assert state.width == pytest.approx(width, abs=1e-3)
        assert 0.2 * self.gripper.width_max < state.width < 0.95 * self.gripper.width_max
        assert state.outcome is GripperOutcome.STOPPED
        return state.width


@pytest.fixture(params=["mock", *registry.ENGINES])
def closing(request: pytest.FixtureRequest) -> Iterator[Closing]:
    options = {"clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    options |= (
        {"driver": "mock"} if request.param == "mock" else {"sim": True, "engine": need_engine(request.param).name}
    )
    with hal.open("panda_table", **options) as rig:
        yield Closing(rig)


def release(closing: Closing, control: hal.Control) -> None:
    closing.held = False


def unplug(closing: Closing, control: hal.Control) -> None:
    closing.connected = False


def freeze(closing: Closing, control: hal.Control) -> None:
    """The pad is silent: the arm notices after 120 ms."""
    closing.rig._hosts[0].pollers.clear()  # type: ignore[attr-defined]
    closing.send(control, 0.1)


def stop(closing: Closing, control: hal.Control) -> None:
    closing.rig.stop()


def trip(closing: Closing, control: hal.Control) -> None:
    """No command comes any more: the arm notices after 100 ms."""
    closing.rig.clock.sleep(0.1)


def leave(closing: Closing, control: hal.Control) -> None:
    error = ValueError("in the program")
    control.__exit__(ValueError, error, None)


@pytest.mark.parametrize("event", [release, unplug, freeze, stop, trip, leave])
@pytest.mark.filterwarnings("ignore:panda was stopped")
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


@pytest.mark.parametrize("event", [release, unplug, stop, trip, leave])
@pytest.mark.filterwarnings("ignore:panda was stopped")
def test_a_held_object_stays_held(event: Callable[[Closing, hal.Control], None]) -> None:
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"]) as rig:
        closing = Closing(rig)
        closing.gripper.inject(object_width=0.05)
        control = closing.run()
        closing.send(control, 0.5)
        before = closing.gripper.state()
        assert before.grasped
        event(closing, control)
        rig.clock.sleep(0.5)
        after = closing.gripper.state()
        assert (after.grasped, after.width, after.force) == (True, before.width, before.force)
        control.close()
