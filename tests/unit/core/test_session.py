"""``hal.TeleopSession`` with a mock arm and pad, in lock-step: stops, homing, other pads, settings, resets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import hal
from hal.drivers.mock.gamepad import MockPad
from hal.gamepad import RUMBLE_STRONG


class Bench:
    """A rig, its operated pad and a session; steps of a script happen at times of the run, in s."""

    def __init__(self, rig: hal.Rig) -> None:
        driver = rig.driver("pad")
        assert isinstance(driver, MockPad)
        self.rig, self.hand, self.arm = rig, driver, rig.robots["panda"]
        self.events: list[hal.SessionEvent] = []
        self.ticks = 0
        self.session = self.open_session()

    def open_session(self, **options: Any) -> hal.TeleopSession:
        self.session = hal.TeleopSession(
            self.rig, on_event=self.events.append, on_tick=lambda: setattr(self, "ticks", self.ticks + 1), **options
        )
        return self.session

    def script(self, *steps: tuple[float, Callable[[], object]]) -> None:
        start, left = self.rig.clock.now(), list(steps)

        def act() -> None:
            while left and left[0][0] <= self.rig.clock.now() - start + 1e-6:
                left.pop(0)[1]()

        self.rig.clock.call_every(0.02, act)  # type: ignore[attr-defined]  # of the lock-step clock

    def run(self, seconds: float, *steps: tuple[float, Callable[[], object]]) -> str:
        end = self.rig.clock.now() + seconds
        self.script(*steps)
        return self.session.run(lambda state: "time" if self.rig.clock.now() >= end else "")

    def press(self, *names: str) -> Callable[[], object]:
        return lambda: self.hand.press(*names)

    def release(self, *names: str) -> Callable[[], object]:
        return lambda: self.hand.release(*names)

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]

    @property
    def q(self) -> np.ndarray:
        return self.arm.state().q_set

    def away(self) -> float:
        """Greatest distance of a joint from home, rad."""
        return float(np.abs(self.q - self.arm.home).max())


@pytest.fixture
def bench() -> Iterator[Bench]:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        yield Bench(rig)


def test_the_first_arm_is_driven_while_the_dead_man_is_held(bench: Bench) -> None:
    height = bench.arm.state().tcp.position[2]
    assert (
        bench.run(2.0, (0.2, bench.press("l1")), (0.8, bench.press("l2")), (1.5, bench.release("l1", "l2"))) == "time"
    )
    moved = bench.arm.state().tcp.position[2] - height
    assert 0.05 < moved < 0.2, "l1 alone moves nothing; with the dead-man 0.2 m/s up"
    assert bench.events == []
    assert bench.ticks == pytest.approx(100 + 4, abs=3), "50 in a second, and one for each change of the pad"
    assert bench.session.state is not None
    assert np.abs(bench.arm.state().dq_set).max() == 0.0


def test_a_rig_without_devices_is_refused() -> None:
    with hal.open({"robots": {"arm": {"model": "panda"}}}, driver="mock") as rig:
        with pytest.raises(hal.CommandError) as caught:
            hal.TeleopSession(rig)
        assert caught.value.code == "no_gamepad"
    with hal.open({"robots": {}, "gamepads": {"pad": {}}}, driver="mock") as rig:
        with pytest.raises(hal.CommandError) as caught:
            hal.TeleopSession(rig)
        assert caught.value.code == "no_robot"


def test_after_a_stop_the_arm_waits_for_a_new_press(bench: Bench) -> None:
    steps = [
        (0.2, bench.press("l2", "l1")),
        (0.6, bench.rig.stop),
        (1.2, bench.release("l2")),
        (1.4, bench.press("l2")),
    ]
    standing: list[float] = []

    def note() -> None:
        if 1.0 < bench.rig.clock.now() - start < 1.4:
            standing.append(float(np.abs(bench.arm.state().dq_set).max()))

    start = bench.rig.clock.now()
    bench.rig.clock.call_every(0.02, note)  # type: ignore[attr-defined]  # of the lock-step clock
    bench.run(2.0, *steps)
    assert bench.kinds == ["stopped", "resumed"]
    assert bench.events[0].reason
    assert max(standing) == 0.0, "still held after the stop"
    assert bench.session.stopped == ""


def test_a_fault_is_one_event_and_the_session_continues_after_recovery(bench: Bench) -> None:
    steps = [
        (0.2, bench.press("l2")),
        (0.4, lambda: bench.arm.inject(fault="reflex")),
        (1.0, bench.arm.recover),
        (1.2, bench.release("l2")),
        (1.4, bench.press("l2")),
    ]
    bench.run(2.0, *steps)
    assert bench.kinds[0] == "fault"
    assert bench.kinds[-1] == "resumed"
    assert bench.kinds.count("fault") == 1
    assert bench.events[0].reason == "reflex"


def test_an_arm_that_is_lost_and_answers_again_is_one_event(bench: Bench) -> None:
    steps = [
        (0.2, bench.press("l2", "l1")),
        (0.6, lambda: bench.arm.inject(disconnect=True)),
        (1.0, lambda: bench.arm.inject(disconnect=False)),
        (1.4, bench.release("l2")),
        (1.6, bench.press("l2")),
    ]
    bench.run(2.0, *steps)
    assert bench.kinds == ["stopped", "resumed"]


def test_a_silent_pad_stops_the_arm_and_rumbles_once(bench: Bench) -> None:
    bench.run(2.0, (0.2, bench.press("l2")), (0.6, lambda: bench.hand.inject(freeze=True)))
    assert bench.kinds == ["stopped"]
    assert [strong for strong, _, _ in bench.hand.rumbles] == [RUMBLE_STRONG]


def test_the_home_button_drives_home_while_the_dead_man_is_held(bench: Bench) -> None:
    bench.arm.move_to(bench.arm.home + 0.1)
    bench.run(6.0, (0.2, bench.press("l2")), (0.4, bench.press("north")), (0.6, bench.release("north")))
    assert bench.kinds == ["homing", "home_reached"]
    assert bench.away() < 1e-3


def test_releasing_the_dead_man_cancels_homing(bench: Bench) -> None:
    bench.arm.move_to(bench.arm.home + 0.3)
    bench.run(3.0, (0.2, bench.press("l2")), (0.4, bench.press("north")), (0.8, bench.release("l2", "north")))
    assert bench.kinds == ["homing", "homing_cancelled"]
    assert bench.away() > 0.1


def test_the_mapping_is_that_of_the_pad_unless_one_is_given(bench: Bench) -> None:
    assert bench.session.mapping == "default"
    bench.hand.meant_for = "spacemouse"
    assert bench.open_session().mapping == "spacemouse"
    assert "mapping spacemouse: " in bench.session.help()
    assert "hold L1 to move" in bench.session.help()
    height = bench.arm.state().tcp.position[2]
    bench.run(1.5, (0.2, bench.press("l1")), (0.2, lambda: bench.hand.stick("push_z", 1.0)), (1.0, bench.release("l1")))
    assert bench.arm.state().tcp.position[2] > height + 0.05
    assert bench.open_session(mapping="default").mapping == "default"


def test_a_pad_that_is_plugged_in_later_brings_its_mapping(bench: Bench) -> None:
    hand, seen = bench.hand, {}

    def plug() -> None:
        """Plug another pad in, with its dead-man held."""
        hand.meant_for = "spacemouse"
        hand.press("l1")
        hand.stick("push_x", 1.0)
        hand.clear()

    def note(name: str) -> Callable[[], object]:
        return lambda: seen.update({name: (bench.session.mapping, bench.q)})

    def rest() -> None:
        hand.release("l1")
        hand.stick("push_x", 0.0)

    def back() -> None:
        hand.meant_for = None
        hand.clear()

    drive = [(1.6, bench.press("l1")), (1.8, lambda: hand.stick("push_x", 1.0)), (2.4, rest)]
    steps = [(0.2, lambda: hand.inject(disconnect=True)), (0.5, plug), (0.6, note("plugged")), (1.1, note("held"))]
    steps += [(1.2, rest), *drive, (2.8, note("driven")), (3.0, lambda: hand.inject(disconnect=True))]
    bench.run(4.0, *steps, (3.4, note("unplugged")), (3.5, back))
    assert seen["held"][0] == "spacemouse"
    assert (seen["held"][1] == seen["plugged"][1]).all(), "controls that were held when it came move nothing"
    assert np.abs(seen["driven"][1] - seen["held"][1]).max() > 0.01
    assert seen["unplugged"][0] == "spacemouse", "without a pad nothing changes"
    assert bench.session.mapping == "default"
    assert bench.kinds.count("pad_changed") == 2


def test_a_pad_that_is_plugged_in_before_a_reset_needs_one_press(bench: Bench) -> None:
    """The dead-man of the other pad counts its own presses."""
    bench.arm.move_to(bench.arm.home + 0.1)
    for _ in range(3):
        bench.hand.press("l2")
        bench.rig.clock.sleep(0.1)
        bench.hand.release("l2")
        bench.rig.clock.sleep(0.1)

    def plug() -> None:
        bench.hand.meant_for = "spacemouse"
        bench.hand.clear()

    bench.script((0.2, lambda: bench.hand.inject(disconnect=True)), (0.5, plug), (1.0, bench.press("l1")))
    end = bench.rig.clock.now() + 5.0
    assert bench.session.reset_scene(0, lambda: bench.rig.clock.now() < end) is True
    assert bench.kinds.count("pad_changed") == 1
    assert bench.away() < 1e-3


def test_settings_of_a_page_wait_for_the_release_of_the_dead_man() -> None:
    arms = {name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("panda", 0.5), ("other", -0.5))}
    with hal.open({"robots": arms, "gamepads": {"pad": {}}}, driver="mock") as rig:
        bench = Bench(rig)
        session = bench.open_session(speed=0.5, adjustable=True)
        change = session._changes.__setitem__  # what the console calls
        held = [(0.4, lambda: change("robot", "other")), (0.5, lambda: change("speed", 0.9))]
        bench.run(1.0, (0.2, bench.press("l2")), *held, (0.8, bench.release("l2")))
        assert (bench.kinds, session.robot.name) == (["setting_refused"], "panda")
        assert session.teleop.speed == 0.5, "never faster than the program permits"
        bench.run(0.5, (0.1, lambda: change("frame", "tcp")), (0.2, lambda: change("speed", 0.2)))
        assert (session.teleop.frame, session.teleop.speed) == ("tcp", 0.2)
        bench.run(0.5, (0.1, lambda: change("robot", "other")))
        assert (bench.kinds[-1], session.robot.name) == ("robot_changed", "other")
        z = {name: robot.state().tcp.position[2] for name, robot in rig.robots.items()}
        bench.run(1.5, (0.2, bench.press("l2", "l1")), (1.2, bench.release("l2", "l1")))
        assert rig.robots["other"].state().tcp.position[2] > z["other"] + 0.02
        assert rig.robots["panda"].state().tcp.position[2] == z["panda"]


@pytest.mark.parametrize("gripper", [{"axis": "r2"}, {"toggle": "r1"}, {"open": "east", "close": "south"}])
def test_each_trouble_of_a_gripper_is_announced_and_a_press_after_it_moves_the_fingers(
    bench: Bench, gripper: dict[str, str]
) -> None:
    fingers, pull = bench.arm.gripper, gripper.get("close") or gripper.get("toggle")
    assert fingers is not None

    def close() -> None:
        bench.hand.press(pull) if pull else bench.hand.stick("r2", 1.0)

    def let_go() -> None:
        bench.hand.release("l2", *filter(None, [pull]))
        bench.hand.stick("r2", 0.0)

    def fault(**faults: object) -> Callable[[], object]:
        return lambda: fingers.inject(**faults)

    bench.open_session(mapping={"deadman": "l2", "gripper": gripper})
    bench.run(
        9.0,
        (0.2, fault(fail="too hot")),
        (0.5, bench.press("l2")),
        (0.8, close),
        (1.2, let_go),
        (1.5, fault(fail=None, disconnect=True)),
        (3.0, fault(disconnect=False)),
        (4.0, fault(disconnect=True)),
        (5.5, fault(disconnect=False)),
        (6.0, bench.press("l2")),
        (6.5, close),
        (8.5, let_go),
    )
    told = [event.text for event in bench.events if event.kind == "gripper_fault"]
    assert [("too hot" in text, "disconnect" in text) for text in told] == [(True, False), (False, True)] * 2 + [
        (True, False)
    ]
    recovered = [event.text for event in bench.events if event.kind == "gripper_recovered"]
    assert recovered == ["the gripper takes commands again"], "it answered all the time"
    assert fingers.state().width < 0.01


def test_a_reset_drives_home_only_for_a_press_made_for_it(bench: Bench) -> None:
    assert bench.session.drives_home
    bench.arm.move_to(bench.arm.home + 0.1)
    assert bench.arm.gripper is not None
    bench.arm.gripper.move(0.0)
    bench.script((0.1, bench.press("l2")))
    bench.rig.clock.sleep(0.5)
    end = bench.rig.clock.now() + 1.0
    assert bench.session.deadman.held
    assert bench.session.reset_scene(0, lambda: bench.rig.clock.now() < end) is False
    assert bench.away() == pytest.approx(0.1, abs=1e-3), "the press began before"
    bench.script(
        (0.2, bench.release("l2")), (0.5, bench.press("l2")), (0.8, bench.release("l2")), (2.0, bench.press("l2"))
    )
    assert bench.session.reset_scene(0) is True
    assert bench.away() < 1e-3
    assert bench.arm.gripper.state().width > 0.07


def test_a_reset_that_is_stopped_takes_a_new_press(bench: Bench) -> None:
    bench.arm.move_to(bench.arm.home + 0.3)
    steps = [(0.2, bench.press("l2")), (0.6, lambda: bench.arm.inject(fault="reflex")), (1.0, bench.arm.recover)]
    distances: list[float] = []
    bench.script(*steps, (1.4, lambda: distances.append(bench.away())), (2.0, lambda: distances.append(bench.away())))
    bench.script((2.2, bench.release("l2")), (2.5, bench.press("l2")))
    assert bench.session.reset_scene(0) is True
    assert distances[0] == distances[1] > 0.01, "a held dead-man does not continue the move"
    assert bench.kinds[0] == "fault"
    assert bench.away() < 1e-3


def test_an_error_in_the_program_is_not_swallowed(bench: Bench) -> None:
    def fail(state: hal.PadState) -> str:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        bench.session.run(fail)
    bench.rig.clock.sleep(0.5)
    assert np.abs(bench.arm.state().dq_set).max() == 0.0
