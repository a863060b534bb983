"""Keys of a terminal as a gamepad, on pseudo-terminals."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from errors_kit import raises_code
from terminal_kit import FarEnd

from hal.commands import DeadmanRecord
from hal.drivers.terminal.pad import TerminalPad
from hal.errors import ConfigError, NotSupported
from hal.gamepad import Gamepad
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import PadSpec

DT = 0.005
UP, DOWN, PAGE_UP = "\x1b[A", "\x1b[B", "\x1b[5~"


class Bench:
    """A pad that the test polls, on a clock that the test advances."""

    def __init__(self, far: FarEnd) -> None:
        self.far = far
        self.stops = 0
        self.now = 1.0  # before the present of a computer that was just started
        spec = PadSpec(name="pad", driver="terminal", model=None, options={"tty": far.path})
        self.driver = TerminalPad(spec, self.stop)
        self.pad = Gamepad(self.driver)
        self.deadman = self.pad.hold("l2")
        self.records: list[tuple[float, DeadmanRecord]] = []
        self.deadman.attach(lambda record: self.records.append((self.now, record)))
        self.pad.open(self.now)
        self.run(0.05)

    def stop(self) -> None:
        self.stops += 1

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self.now += DT
            self.pad.poll_once(self.now)

    def held(self) -> float:
        """Return for how long the dead-man was held so far, s."""
        return sum(DT for _, record in self.records if record.held)

    def presses(self) -> int:
        return self.deadman.record.presses

    def press(self, key: str) -> None:
        self.far.put(key)
        self.run(DT)


@pytest.fixture
def it() -> Iterator[Bench]:
    with FarEnd() as far:
        made = Bench(far)
        yield made
        made.pad.close()


@pytest.mark.parametrize(
    ("key", "axis", "share", "buttons", "longest"),
    [
        (UP, "dpad_y", 0.5, {"l2"}, 0.08),
        (DOWN, "dpad_y", -0.5, {"l2"}, 0.08),
        ("\x1b[C", "dpad_x", 0.5, {"l2"}, 0.08),
        ("a", "left_x", -0.6, {"l2"}, 0.08),
        ("I", "right_y", 0.6, {"l2"}, 0.08),  # with Caps Lock
        (PAGE_UP, None, 0.0, {"l2", "l1"}, 0.05),
        ("\x1b[6~", None, 0.0, {"l2", "r1"}, 0.05),
    ],
)
def test_key_press_holds_the_deadman_for_one_bounded_step(it, key, axis, share, buttons, longest):
    it.press(key)
    state = it.pad.state()
    assert it.deadman.held
    assert state.buttons == buttons
    away = {name: value for name, value in state.axes.items() if value and name != "l2"}
    assert away == ({} if axis is None else {axis: pytest.approx(share)}), "behind the dead zone"
    it.run(1.0)
    assert (it.held(), it.presses()) == (pytest.approx(longest, abs=2 * DT), 1)
    state = it.pad.state()
    assert not state.buttons
    assert not any(state.axes.values())


def test_burst_makes_one_step_and_auto_repeat_many(it: Bench) -> None:
    it.press(300 * UP + "a" + 300 * DOWN)
    it.run(1.0)
    assert it.presses() == 1
    assert it.held() < 0.12
    for _ in range(60):  # two seconds of auto-repeat
        it.press(DOWN)
        it.run(0.028)
    assert 8 <= it.presses() <= 14
    released = [record for _, record in it.records if not record.held]
    assert len(released) * DT > 0.06 * it.presses(), "released in between, for the arm to come to rest"


def test_late_poll_does_not_join_two_steps(it: Bench) -> None:
    it.press(UP)
    it.now += 0.4  # no poll
    it.press(UP)
    assert not it.deadman.held, "the release is reported first"


def test_proof_of_life_of_a_step_is_its_key_press(it: Bench) -> None:
    it.press(UP)
    pressed = it.now
    it.run(0.05)
    assert it.deadman.held
    assert it.deadman.record.t_alive == pytest.approx(pressed, abs=DT)
    assert PAD_SILENCE - DT > 0.08 + 0.02, "a step ends before the watchdog ends it, with a margin for a late poll"
    it.run(0.5)
    assert it.deadman.record.t_alive == it.now


@pytest.mark.parametrize("key", ["\x7f", "\x1b"])
def test_backspace_and_esc_stop_the_rig_and_a_later_key_continues(it: Bench, key: str) -> None:
    it.press(UP)
    it.press(key)
    if key == "\x1b":  # what may still become a sequence takes a moment
        deadline = time.monotonic() + 5.0
        while not it.stops and time.monotonic() < deadline:
            it.pad.poll_once(it.now)
    assert it.stops == 1
    assert not it.deadman.held
    it.press(UP)
    assert not it.deadman.held, "keys typed before the stop may arrive after it"
    it.run(0.6)
    it.press(UP)
    assert it.deadman.held
    assert it.presses() == 2


def test_space_does_nothing(it: Bench) -> None:
    it.press(" ")
    it.run(0.2)
    assert (it.stops, it.presses()) == (0, 0)


def test_stop_in_a_burst_counts(it: Bench) -> None:
    it.press(20 * UP + "\x7f" + 20 * UP)
    it.run(0.4)
    assert (it.stops, it.held()) == (1, 0.0)


def test_gripper_is_taken_over_at_its_width_before_it_moves(it: Bench) -> None:
    seen = []
    for key, wanted in [("g", 0.1), ("g", 0.2), ("h", 0.1), ("h", 0.0), ("h", 0.0)]:
        before = it.pad.state().axis("r2")
        it.press(key)
        assert it.pad.state().pressed("l2")
        assert it.pad.state().axis("r2") == pytest.approx(before)
        it.run(0.07)
        assert it.pad.state().pressed("l2")
        assert it.pad.state().axis("r2") == pytest.approx(wanted)
        it.run(0.2)
        seen.append(it.pad.state().axis("r2"))
    assert seen == pytest.approx([0.1, 0.2, 0.1, 0.0, 0.0])


@pytest.mark.parametrize(("key", "button"), [("1", "south"), ("4", "north"), ("\r", "start"), ("\x1b[H", "home")])
def test_other_buttons_are_pressed_without_the_deadman(it: Bench, key: str, button: str) -> None:
    it.press(key)
    assert it.pad.state().buttons == {button}
    assert not it.deadman.held
    it.run(0.3)
    assert not it.pad.state().buttons


@pytest.mark.parametrize("key", ["\x1b[1;5A", "\x1b[1;3A", "x", "\x7f", "\x01", "\u00e4"])
def test_other_keys_move_nothing(it: Bench, key: str) -> None:
    it.press(key)
    it.run(0.2)
    assert it.held() == 0.0


def test_keys_typed_before_opening_are_dropped() -> None:
    with FarEnd() as far:
        far.type(20 * "w")
        it = Bench(far)
        it.run(0.3)
        assert it.held() == 0.0
        it.pad.close()


# Opening and closing.


def test_opening_without_a_terminal_is_refused(tmp_path) -> None:
    file = tmp_path / "file"
    file.touch()
    for path in (str(file), str(tmp_path / "nowhere")):
        driver = TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"tty": path}))
        with raises_code(NotSupported, "no_terminal"):
            driver.open()
        driver.close()


def test_own_options_are_checked_and_others_ignored() -> None:
    TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"device": "/dev/input/event3"}))
    with pytest.raises(ConfigError) as caught:
        TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"step_s": 0.2}))
    assert [problem.key for problem in caught.value.problems] == ["step_s"]


def test_close_restores_the_terminal() -> None:
    with FarEnd() as far:
        before = far.settings
        driver = TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"tty": far.path}))
        for turn in range(2):
            driver.open()
            assert driver.poll(float(turn), 0.0).connected
            assert far.raw
            far.put("www")
            driver.close()
            assert far.settings == before
            assert far.unread() == 0, "no key is left for the shell"
        driver.close()


def test_settings_that_another_program_changed_are_left_alone(it: Bench) -> None:
    attributes = it.far.settings
    attributes[0] |= 1  # IGNBRK: any change will do
    it.far.settings = attributes
    it.pad.close()
    assert it.far.settings == attributes
