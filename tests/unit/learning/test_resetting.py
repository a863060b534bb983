"""Before an episode: an arm that has to drive home does so for a press that was made for that, and for nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.apps._collecting import CollectRun
from hal.apps.collect import parser
from hal.drivers.mock.gamepad import MockPad
from hal.learning.episode import reset_scene
from hal.recording import Dataset, Recorder

AWAY = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2])


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    """A mock, in lock-step, whose arm is not at home and whose hand is closed."""
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        arm = rig.robots["panda"]
        arm.move_to(arm.home + AWAY, unattended=True, speed=0.5)
        assert arm.gripper is not None
        arm.gripper.move(0.0)
        yield rig


class Person:
    """Performs the scripted actions at their times; notes when the arm moves, and by which press."""

    def __init__(self, rig: hal.Rig, *does: tuple[float, Callable[[MockPad], object]]) -> None:
        hand = rig.driver("pad")
        assert isinstance(hand, MockPad)
        self.hand, self.deadman, self.arm = hand, rig.gamepads["pad"].hold("l2"), rig.robots["panda"]
        self.moved_by: set[int] = set()
        self._does, self._clock = list(does), rig.clock
        self._start = rig.clock.now()
        self.tripped = False
        assert isinstance(rig.clock, hal.clock.LockStepClock)
        rig.clock.call_every(0.02, self._look)

    def _look(self) -> None:
        while self._does and self._does[0][0] <= self._clock.now() - self._start:
            self._does.pop(0)[1](self.hand)
        if np.abs(self.arm.state().dq_set).max() > 0.02:
            self.moved_by.add(self.deadman.record.presses)


def press(name: str = "l2") -> Callable[[MockPad], object]:
    return lambda hand: hand.press(name)


def release(name: str = "l2") -> Callable[[MockPad], object]:
    return lambda hand: hand.release(name)


def test_a_press_that_began_before_the_prompt_does_not_start_the_move_home(rig: hal.Rig) -> None:
    person = Person(rig, (0.1, press()), (1.5, release()), (2.0, press()))
    rig.clock.sleep(0.5)
    assert person.deadman.held
    reset_scene(rig, person.arm, deadman=person.deadman)
    assert person.moved_by == {2}
    assert np.abs(person.arm.state().q - person.arm.home).max() < 1e-3
    assert person.arm.gripper is not None
    assert person.arm.gripper.state().width > 0.07, "at home the gripper opens"


def test_without_a_press_the_reset_times_out(rig: hal.Rig) -> None:
    person = Person(rig, (0.1, press()))
    rig.clock.sleep(0.5)
    with raises_code(hal.MotionStopped, "deadman_not_pressed"):
        reset_scene(rig, person.arm, deadman=person.deadman, patience=2.0)
    assert person.moved_by == set()


def test_without_a_hand_to_open(rig: hal.Rig) -> None:
    reset_scene(rig, rig.robots["panda"], unattended=True, open_gripper=False)
    gripper = rig.robots["panda"].gripper
    assert gripper is not None
    assert gripper.state().width < 0.01


def collect(rig: hal.Rig, folder: Path, *options: str) -> int:
    with Recorder(rig, folder) as recorder:
        run = CollectRun(rig, [rig.robots["panda"]], recorder, parser().parse_args([*options]))
        return run.run()


def end(hand: MockPad) -> None:
    raise KeyboardInterrupt


def test_the_press_of_an_episode_does_not_start_the_move_home(rig: hal.Rig, tmp_path: Path) -> None:
    """PS is pressed in mid-motion, with L2 held for three more seconds."""
    episode = [(12.0, press("south")), (12.2, release("south")), (12.5, press()), (14.0, press("home"))]
    person = Person(rig, (0.5, press()), (11.0, release()), *episode, (17.0, end))
    person.hand.stick("dpad_y", 0.0)
    rig.clock.call_every(0.02, lambda: person.hand.stick("dpad_y", 1.0 if person.deadman.record.presses == 2 else 0.0))
    assert collect(rig, tmp_path, "--episodes", "2") == 1
    assert person.moved_by == {1, 2}
    (episode_,) = Dataset(tmp_path).episodes
    assert episode_.success is True
    q = person.arm.state().q
    assert np.abs(q - person.arm.home).max() > 0.05, "it stands where the episode ended"


def test_after_a_trip_on_the_way_home_it_takes_a_new_press(
    rig: hal.Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = rig.robots["panda"]
    reflex = (1.2, lambda hand: arm.inject(fault="reflex"))
    person = Person(rig, (0.5, press()), reflex, (2.0, lambda hand: arm.recover()), (4.0, release()), (4.5, press()))
    standing: list[float] = []
    rig.clock.call_every(
        0.1, lambda: standing.append(np.abs(arm.state().dq_set).max() if 2.5 < rig.clock.now() - t0 < 4.4 else 0)
    )
    t0 = rig.clock.now()
    rig.clock.call_every(20.0, lambda: end(person.hand))
    assert collect(rig, tmp_path, "--episodes", "1") == 1
    assert max(standing) < 1e-6, "nothing continues by itself"
    assert person.moved_by == {1, 2}
    assert np.abs(arm.state().q - arm.home).max() < 1e-3, "with a new press it went on"
    assert "FAULT: reflex" in capsys.readouterr().out


def test_presses_during_the_move_home_are_ignored_later(rig: hal.Rig, tmp_path: Path) -> None:
    """Before the second episode Cross is pressed too early, and stays down."""
    episode = [(12.0, press("south")), (12.2, release("south")), (13.0, press("home")), (13.2, release("home"))]
    way_home = [(13.4, press("south")), (13.6, press()), (16.0, release())]
    Person(rig, (0.5, press()), (11.0, release()), *episode, *way_home, (18.0, end))
    assert collect(rig, tmp_path, "--episodes", "2") == 1
    assert [one.success for one in Dataset(tmp_path).episodes] == [True]
