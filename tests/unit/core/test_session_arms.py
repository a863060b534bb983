"""``hal.TeleopSession`` with two mock arms in lock-step: two pads at once, one pad handed on, stops that hold both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

import hal
from hal.drivers.mock.gamepad import MockPad
from hal.errors import ConfigError
from hal.teleop import share_pads

ARMS = {name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("left", 0.5), ("right", -0.5))}
TWO_PADS = {"first": {"drives": "right"}, "second": {"drives": "left"}}


def speed_of(arm: hal.Robot) -> float:
    """Return the speed of the fastest joint, rad/s; 0 for an arm that does not answer."""
    try:
        return float(np.abs(arm.state().dq_set).max())
    except (hal.ConnectionLost, hal.StaleStateError):
        return 0.0


class Bench:
    """A rig with two arms and one or two pads, whose steps happen at times of the run, s."""

    def __init__(self, rig: hal.Rig, **options: Any) -> None:
        self.rig = rig
        self.events: list[hal.SessionEvent] = []
        self.speeds: list[dict[str, float]] = []
        self.times: list[float] = []
        arms = list(rig.robots.values())
        self.session = hal.TeleopSession(rig, arms, on_event=self.events.append, on_tick=self.note, **options)

    def note(self) -> None:
        self.times.append(round(self.rig.clock.now(), 3))
        self.speeds.append({name: speed_of(arm) for name, arm in self.rig.robots.items()})

    def pad(self, name: str) -> MockPad:
        driver = self.rig.driver(name)
        assert isinstance(driver, MockPad)
        return driver

    def run(self, seconds: float, *steps: tuple[float, Callable[[], object]]) -> None:
        start, left = self.rig.clock.now(), sorted(steps, key=lambda step: step[0])
        self.times.clear()
        self.speeds.clear()

        def act() -> None:
            while left and left[0][0] <= self.rig.clock.now() - start + 1e-6:
                left.pop(0)[1]()

        self.rig.clock.call_every(0.02, act)  # type: ignore[attr-defined]  # of the lock-step clock
        self.session.run(lambda state: "time" if self.rig.clock.now() >= start + seconds else "")
        self.times = [t - start for t in self.times]

    def speed(self, arm: str, since: float, until: float) -> list[float]:
        return [s[arm] for t, s in zip(self.times, self.speeds, strict=True) if since <= t <= until]

    def kinds(self, arm: str) -> list[str]:
        return [event.kind for event in self.events if event.robot == arm]


@contextmanager
def bench(pads: Mapping[str, Any], **options: Any) -> Iterator[Bench]:
    with hal.open({"robots": ARMS, "gamepads": pads}, driver="mock") as rig:
        yield Bench(rig, **options)


def up(pad: MockPad) -> Callable[[], object]:
    """Hold the dead-man and the button that moves the arm up."""
    return lambda: pad.press("l2", "l1")


def test_each_pad_drives_the_arm_that_the_rig_names_with_its_own_dead_man() -> None:
    with bench(TWO_PADS) as two:
        first, second = two.pad("first"), two.pad("second")
        two.run(1.5, (0.2, up(first)), (0.6, up(second)), (1.0, lambda: first.release("l2")))
        assert max(two.speed("right", 0.3, 0.9)) > 0.05
        assert max(two.speed("left", 0.0, 0.58)) == 0.0
        assert min(two.speed("left", 0.9, 1.4)) > 0.05, "the other arm goes on when one dead-man is released"
        assert max(two.speed("right", 1.2, 1.5)) == 0.0
        assert two.events == []
        assert "first drives right" in two.session.help()


def test_a_trip_of_one_arm_holds_the_other_until_a_new_press_of_its_own() -> None:
    with bench(TWO_PADS) as two:
        first, second = two.pad("first"), two.pad("second")
        steps = [(0.2, up(first)), (0.2, up(second)), (0.6, lambda: first.inject(freeze=True))]
        back = [(1.4, first.clear), (1.6, lambda: first.release("l2")), (1.8, up(first))]
        again = [(2.6, lambda: second.release("l2")), (2.8, up(second))]
        two.run(3.4, *steps, *back, *again)
        assert two.kinds("right") == ["stopped", "resumed"]
        assert two.kinds("left") == ["held"]
        stopped = next(t for t, s in zip(two.times, two.speeds, strict=True) if t > 0.6 and s["right"] == 0.0)
        assert max(two.speed("left", stopped + 0.02, 1.3)) == 0.0
        assert min(two.speed("right", 2.0, 2.4)) > 0.05
        assert max(two.speed("left", stopped + 0.02, 2.7)) == 0.0, "still held: nothing moves without a new press"
        assert min(two.speed("left", 3.0, 3.3)) > 0.05


def test_independent_arms_do_not_stop_each_other() -> None:
    with bench(TWO_PADS, independent=True) as two:
        first, second = two.pad("first"), two.pad("second")
        two.run(1.6, (0.2, up(first)), (0.2, up(second)), (0.6, lambda: first.inject(disconnect=True)))
        assert two.kinds("right") == ["stopped"]
        assert two.kinds("left") == []
        assert max(two.speed("right", 1.0, 1.6)) == 0.0
        assert min(two.speed("left", 0.4, 1.5)) > 0.05


@pytest.mark.parametrize("independent", [False, True])
def test_an_arm_that_does_not_answer_stops_the_other_unless_they_are_independent(independent: bool) -> None:
    with bench(TWO_PADS, independent=independent) as two:
        first, second = two.pad("first"), two.pad("second")
        right = two.rig.robots["right"]
        lost, found = (0.6, lambda: right.inject(disconnect=True)), (1.2, lambda: right.inject(disconnect=False))
        again = [(2.4, lambda: first.release("l2")), (2.6, up(first))]
        two.run(3.4, (0.2, up(first)), (0.2, up(second)), lost, found, *again)
        assert two.kinds("right")[0] == "stopped"
        assert two.kinds("right")[-1] == "resumed"
        assert max(two.speed("right", 0.9, 2.5)) == 0.0
        assert min(two.speed("right", 2.9, 3.3)) > 0.05
        assert (min(two.speed("left", 0.4, 3.3)) > 0.05) is independent


def test_one_pad_is_handed_on_while_its_dead_man_is_released() -> None:
    with bench({"pad": {}}) as one:
        pad = one.pad("pad")
        tap = [(0.6, lambda: pad.press("select")), (0.8, lambda: pad.release("select"))]
        one.run(1.0, (0.2, up(pad)), *tap, (0.9, lambda: pad.release("l2")))
        assert [event.kind for event in one.events] == ["setting_refused"]
        assert max(one.speed("left", 0.4, 0.8)) > 0.05
        assert max(one.speed("right", 0.0, 1.0)) == 0.0
        one.run(2.0, (0.2, lambda: pad.press("select")), (0.4, lambda: pad.release("select")), (0.8, up(pad)))
        assert one.events[-1].kind == "robot_changed"
        assert one.session.robot.name == "right"
        assert max(one.speed("left", 0.0, 2.0)) == 0.0
        assert min(one.speed("right", 1.2, 1.9)) > 0.05
        assert "next arm of left, right" in one.session.help()
        assert one.session.teleop.labels(actions=("other_arm",))["controls"]["select"] == ["next arm"]


def test_home_is_for_the_arm_whose_pad_it_is() -> None:
    with bench(TWO_PADS) as two:
        for arm in two.rig.robots.values():
            arm.move_to(arm.home + 0.1)
        second = two.pad("second")
        two.run(6.0, (0.2, lambda: second.press("l2")), (0.4, lambda: second.press("north")))
        assert two.kinds("left") == ["homing", "home_reached"]
        away = {name: float(np.abs(arm.state().q_set - arm.home).max()) for name, arm in two.rig.robots.items()}
        assert away["left"] < 1e-3
        assert away["right"] == pytest.approx(0.1, abs=1e-3)


def test_a_reset_drives_every_arm_home_with_its_own_dead_man() -> None:
    with bench(TWO_PADS) as two:
        for arm in two.rig.robots.values():
            arm.move_to(arm.home + 0.05)
        times = {"second": 0.3, "first": 4.0}
        start = two.rig.clock.now()

        def act() -> None:
            for name, t in times.items():
                if abs(two.rig.clock.now() - start - t) < 0.011:
                    two.pad(name).press("l2")

        two.rig.clock.call_every(0.02, act)  # type: ignore[attr-defined]  # of the lock-step clock
        assert two.session.reset_scene(0) is True
        assert all(np.abs(arm.state().q_set - arm.home).max() < 1e-3 for arm in two.rig.robots.values())


def test_pads_are_shared_out() -> None:
    with hal.open({"robots": ARMS, "gamepads": {"a": {}, "b": {"drives": "left"}, "c": {}}}, driver="mock") as rig:
        left, right = rig.robots.values()
        a, b, c = rig.gamepads.values()
        assert share_pads([left, right], [a, b, c]) == [(b, [left]), (a, [right])]
        assert share_pads([left, right], [a]) == [(a, [left, right])]
        assert share_pads([right], [a, b, c]) == [(a, [right])]
        assert share_pads([right], [b]) == [(b, [right])]
        assert share_pads([left, right], [a, c]) == [(a, [left]), (c, [right])]


def test_a_pad_drives_an_arm_of_the_rig() -> None:
    with pytest.raises(ConfigError) as caught, hal.open({"robots": ARMS, "gamepads": {"a": {"drives": "lfet"}}}):
        pass
    assert [(p.key, p.code) for p in caught.value.problems] == [("gamepads.a.drives", "unknown_robot")]


def test_a_dead_man_that_is_disarmed_needs_a_new_press() -> None:
    from hal.deadman import Deadman

    switch = Deadman("l2 of pad")
    held: list[bool] = []
    switch.attach(lambda record: held.append(record.held))
    for pressed in (False, True):
        switch.update(pressed, True, 1.0)
    switch.disarm()
    switch.update(True, True, 1.1)
    assert held == [False, False, True, False, False]
    switch.update(False, True, 1.2)
    assert switch.update(True, True, 1.3).held


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_both_arms_brake_at_once_when_the_sessions_end() -> None:
    with bench(TWO_PADS) as two:
        first, second = two.pad("first"), two.pad("second")
        two.run(1.0, (0.2, up(first)), (0.2, up(second)))
        assert all(speed_of(arm) == 0.0 for arm in two.rig.robots.values())
        assert two.session.run(lambda state: "now") == "now"
