"""The teleoperation app and its pad: the mapping that the pad is meant for, and the rumble of a trip."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

import hal
from hal.apps.teleop import TeleopRun, parser
from hal.drivers.mock.gamepad import MockPad


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as opened:
        yield opened


@pytest.fixture
def hand(rig: hal.Rig) -> MockPad:
    driver = rig.driver("pad")
    assert isinstance(driver, MockPad)
    return driver


class App:
    """The app, in a thread; the test is the person."""

    def __init__(self, rig: hal.Rig, *arguments: str) -> None:
        self.robot, self.pad = rig.robots["panda"], rig.gamepads["pad"]
        self.app = TeleopRun(rig, self.robot, self.pad, parser().parse_args([*arguments, "--duration", "60"]))
        self.session = self.app.session
        self._thread = threading.Thread(target=self.app.run, daemon=True)

    def __enter__(self) -> App:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.app.end_time = 0.0
        self._thread.join(30.0)
        assert not self._thread.is_alive()

    def until(self, true: Callable[[], object], limit: float = 20.0) -> None:
        end = time.monotonic() + limit
        while not true():
            assert time.monotonic() < end, "it did not happen"
            assert self._thread.is_alive(), "the app has ended"
            time.sleep(0.01)

    def until_ready(self) -> None:
        """The pad is there, and its hands are off it."""
        self.until(lambda: self.pad.state().connected and not self.pad.waiting_for)


def test_a_pad_with_a_mapping_of_its_own_gets_it_and_drives(
    rig: hal.Rig, hand: MockPad, capsys: pytest.CaptureFixture[str]
) -> None:
    hand.meant_for = "spacemouse"
    with App(rig) as app:
        assert app.session.mapping == "spacemouse"
        app.until_ready()
        where = app.robot.state().tcp.position[2]
        hand.press("l1")
        hand.stick("push_z", 1.0)
        app.until(lambda: app.robot.state().tcp.position[2] > where + 0.01)
        hand.release("l1")
    text = capsys.readouterr().out
    assert "mapping spacemouse: one cap for all six directions" in text
    assert "hold L1 to move" in text


def test_a_pad_without_one_gets_the_default_and_an_option_beats_both(
    rig: hal.Rig, hand: MockPad, capsys: pytest.CaptureFixture[str]
) -> None:
    with App(rig) as app:
        assert app.session.mapping == "default"
    assert "mapping default: sticks and d-pad of a gamepad" in capsys.readouterr().out
    hand.meant_for = "spacemouse"
    with App(rig, "--mapping", "default") as app:
        assert app.session.mapping == "default"


def test_a_pad_that_is_plugged_in_later_brings_its_mapping_with_it(
    rig: hal.Rig, hand: MockPad, capsys: pytest.CaptureFixture[str]
) -> None:
    with App(rig) as app:
        hand.inject(disconnect=True)
        app.until(lambda: not app.pad.state().connected)
        hand.meant_for = "spacemouse"  # somebody plugs another one in
        hand.press("l1")  # and holds its dead-man while doing so
        hand.stick("push_x", 1.0)
        hand.clear()
        app.until(lambda: app.session.mapping == "spacemouse" and app.pad.state().connected)
        where = app.robot.state().q_set
        time.sleep(0.3)
        assert not app.session.deadman.held
        assert (app.robot.state().q_set == where).all(), "what was held when it came moves nothing"
        hand.release("l1")
        hand.stick("push_x", 0.0)
        app.until_ready()
        hand.press("l1")
        hand.stick("push_x", 1.0)
        app.until(lambda: (app.robot.state().q_set != where).any())
        hand.release("l1")
        hand.inject(disconnect=True)
        app.until(lambda: not app.pad.state().connected)
        assert app.session.mapping == "spacemouse", "while there is none, nothing changes"
        hand.meant_for = None
        hand.stick("push_x", 0.0)
        hand.clear()
        app.until(lambda: app.session.mapping == "default")
    text = capsys.readouterr().out
    assert "driving with a mock pad" in text
    assert text.count("hold L2 to move") == 2


def test_a_trip_shakes_the_hand_once(rig: hal.Rig, hand: MockPad) -> None:
    with App(rig) as app:
        app.until_ready()
        hand.press("l2")
        app.until(lambda: app.session.deadman.held)
        assert hand.rumbles == []
        hand.inject(freeze=True)  # held, and silent
        app.until(lambda: app.session.stopped)
        time.sleep(0.2)
        assert len(hand.rumbles) == 1
        strong, _, seconds = hand.rumbles[0]
        assert strong > 0.5
        assert seconds > 0.1
