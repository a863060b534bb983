"""Keys of a terminal as a gamepad, at pseudo-terminals with and without the Kitty keyboard protocol."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from terminal_kit import FarEnd, wait_for

from hal.commands import DeadmanRecord
from hal.drivers.terminal.pad import TerminalPad
from hal.errors import ConfigError, NotSupported
from hal.gamepad import Gamepad
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import PadSpec

DT = 0.005
UP, DOWN, PAGE_UP = "\x1b[A", "\x1b[B", "\x1b[5~"
SPACE, SPACE_UP, W, W_UP = "\x1b[32u", "\x1b[32;1:3u", "\x1b[119u", "\x1b[119;1:3u"
FOCUS_OUT, FOCUS_IN = "\x1b[O", "\x1b[I"


class Bench:
    """A pad that is polled by hand, on a clock that only goes on when it is told to."""

    def __init__(self, far: FarEnd, **options: Any) -> None:
        self.far = far
        self.stops = 0
        self.now = 1000.0
        spec = PadSpec(name="pad", driver="terminal", model=None, options={"tty": far.path, **options})
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
        """For how long the dead-man was held so far, s."""
        return sum(DT for _, record in self.records if record.held)

    def presses(self) -> int:
        return self.deadman.record.presses

    def press(self, key: str) -> None:
        self.far.put(key)
        self.run(DT)


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    with ExitStack() as stack:

        def make(kitty: bool = False, options: dict[str, Any] | None = None, **far: Any) -> Bench:
            made = Bench(stack.enter_context(FarEnd(kitty=kitty, **far)), **(options or {}))
            stack.callback(made.pad.close)
            return made

        yield make


@pytest.fixture(autouse=True)
def _terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")


# Steps.


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
def test_a_key_press_is_one_bounded_press_of_the_dead_man(
    bench, key: str, axis: str | None, share: float, buttons: set[str], longest: float
) -> None:
    it = bench()
    it.press(key)
    state = it.pad.state()
    assert it.deadman.held
    assert state.buttons == buttons
    away = {name: value for name, value in state.axes.items() if value and name != "l2"}
    assert away == ({} if axis is None else {axis: pytest.approx(share)}), "behind the dead zone"
    it.run(1.0)
    assert it.held() == pytest.approx(longest, abs=2 * DT)
    assert it.presses() == 1
    state = it.pad.state()
    assert not state.buttons
    assert not any(state.axes.values())


def test_a_burst_makes_one_step_and_auto_repeat_step_after_step(bench) -> None:
    it = bench()
    it.press(300 * UP + "a" + 300 * DOWN)
    it.run(1.0)
    assert it.presses() == 1
    assert it.held() < 0.12
    for _ in range(60):  # two seconds of auto-repeat
        it.press(DOWN)
        it.run(0.028)
    assert 8 <= it.presses() <= 14
    released = [record for _, record in it.records if not record.held]
    assert len(released) * DT > 0.06 * it.presses(), "released in between, long enough for the arm to come to rest"


def test_two_steps_never_become_one_although_the_poller_was_late(bench) -> None:
    it = bench()
    it.press(UP)
    it.now += 0.4  # nobody polled
    it.press(UP)
    assert not it.deadman.held, "the release is told before anything else"


def test_a_step_proves_life_by_its_key_press_alone(bench) -> None:
    it = bench()
    it.press(UP)
    pressed = it.now
    it.run(0.05)
    assert it.deadman.held
    assert it.deadman.record.t_alive == pytest.approx(pressed, abs=DT)
    assert PAD_SILENCE - DT > 0.08 + 0.02, "a step is over before the watchdog ends it, with time for a late poll"
    it.run(0.5)
    assert it.deadman.record.t_alive == it.now


@pytest.mark.parametrize("key", ["\x7f", "\x1b"])
def test_backspace_and_esc_end_the_step_stop_the_rig_and_the_next_key_goes_on(bench, key: str) -> None:
    it = bench()
    it.press(UP)
    it.press(key)
    if key == "\x1b":  # what may still become a sequence takes a moment
        deadline = time.monotonic() + 5.0
        while not it.stops and time.monotonic() < deadline:
            it.pad.poll_once(it.now)
    assert it.stops == 1
    assert not it.deadman.held
    it.press(UP)
    assert not it.deadman.held, "what was typed before the stop may still come in"
    it.run(0.6)
    it.press(UP)
    assert it.deadman.held
    assert it.presses() == 2


def test_space_holds_where_keys_can_be_held_and_else_does_nothing(bench) -> None:
    """It means the same wherever a person drives: it never stops here what it moves there."""
    it = bench()
    it.press(" ")
    it.run(0.2)
    assert (it.stops, it.presses()) == (0, 0)


def test_a_stop_in_the_middle_of_a_burst_counts(bench) -> None:
    it = bench()
    it.press(20 * UP + "\x7f" + 20 * UP)
    it.run(0.4)
    assert it.stops == 1
    assert it.held() == 0.0


def test_the_gripper_is_taken_over_where_it_is_before_it_moves(bench) -> None:
    it = bench()
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
    assert seen == pytest.approx([0.1, 0.2, 0.1, 0.0, 0.0]), "it stays where it was put"


@pytest.mark.parametrize(("key", "button"), [("1", "south"), ("4", "north"), ("\r", "start"), ("\x1b[H", "home")])
def test_other_buttons_are_pressed_without_the_dead_man(bench, key: str, button: str) -> None:
    it = bench()
    it.press(key)
    assert it.pad.state().buttons == {button}
    assert not it.deadman.held
    it.run(0.3)
    assert not it.pad.state().buttons


@pytest.mark.parametrize("key", ["\x1b[1;5A", "\x1b[1;3A", "x", "\x7f", "\x01", "\u00e4"])
def test_other_keys_move_nothing(bench, key: str) -> None:
    it = bench()
    it.press(key)
    it.run(0.2)
    assert it.held() == 0.0


def test_what_was_typed_before_it_was_opened_does_not_count() -> None:
    with FarEnd() as far:
        far.type(20 * "w")
        it = Bench(far)
        it.run(0.3)
        assert it.held() == 0.0
        it.pad.close()


@pytest.mark.parametrize(
    ("far", "why"),
    [
        ({}, "let go of"),
        ({"answers": False}, "does not answer"),
        ({"kitty": True, "reports_focus": False}, "focus"),
        ({"kitty": True, "delay": 0.05}, "too slow"),
        ({"kitty": True, "options": {"mode": "step"}}, "the rig asks"),
    ],
)
def test_where_keys_cannot_be_held_safely_they_make_steps_and_it_says_why(bench, far: dict[str, Any], why: str) -> None:
    it = bench(**far)
    assert "step" in it.pad.describe()
    (note,) = it.pad.notes
    assert why in note
    wait_for(lambda: it.far.flags == [0], "taking back what was asked of the terminal")
    it.press(UP)
    assert it.deadman.held
    it.run(0.3)
    assert not it.deadman.held


# Keys that are held.


class Held(Bench):
    """In real time, for the terminal answers in real time."""

    def run(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            self.now = now
            self.pad.poll_once(now)
            time.sleep(0.002)

    def until(self, condition: Callable[[], bool], what: str) -> float:
        """How long it took, s."""
        begun = time.monotonic()
        while not condition():
            assert time.monotonic() - begun < 10.0, what
            self.run(0.002)
        return time.monotonic() - begun

    def press(self, key: str) -> None:
        self.far.type(key)
        self.run(0.05)


@pytest.fixture
def held() -> Iterator[Held]:
    with FarEnd(kitty=True) as far:
        made = Held(far)
        yield made
        made.pad.close()


def fresh(it: Held) -> bool:
    return time.monotonic() - it.deadman.record.t_alive < PAD_SILENCE


def test_keys_are_held_from_press_to_release(held: Held) -> None:
    assert "held" in held.pad.describe()
    assert held.pad.notes == ()
    held.press(SPACE + W + UP + PAGE_UP)
    assert held.deadman.held
    held.run(0.5)
    state = held.pad.state()
    assert (state.axis("left_y"), state.axis("dpad_y"), state.buttons) == (1.0, 1.0, {"l2", "l1"})
    held.press("\x1b[57441;2u")
    assert held.pad.state().axis("left_y") == pytest.approx(0.3), "Shift: slower"
    held.press(W_UP + "\x1b[5;1:3~")
    state = held.pad.state()
    assert (state.axis("left_y"), state.buttons) == (0.0, {"l2"})
    held.press(SPACE_UP)
    assert not held.deadman.held


def test_a_repeat_is_no_press(held: Held) -> None:
    held.press("\x1b[32;1:2u\x1b[119;1:2u")
    assert not held.deadman.held
    assert held.pad.state().axis("left_y") == 0.0


def test_it_is_alive_while_the_terminal_answers_and_not_a_moment_longer(held: Held) -> None:
    held.press(SPACE + W)
    held.until(lambda: fresh(held), "an answer")
    held.far.silent = True
    cut = time.monotonic()
    held.until(lambda: not fresh(held), "growing old")
    assert held.deadman.record.t_alive <= cut, "what was asked after the cut was never answered"
    assert held.deadman.held, "the release got lost with the link: only the age tells"
    held.far.silent = False
    held.until(lambda: fresh(held), "answers, when the link is back")


def test_late_answers_to_old_questions_prove_nothing(held: Held) -> None:
    held.until(lambda: fresh(held), "an answer")
    held.far.silent = True
    held.run(0.3)
    newest = held.deadman.record.t_alive
    numbers = [text.partition(b"$p")[0] for text in held.far.screen.split(b"\x1b[?60")[1:]]
    held.far.type(b"\x1b[?60%s;0$y" % numbers[-1])
    held.run(0.05)
    assert newest < held.deadman.record.t_alive < held.now - 0.02, "the time of the question, not of the answer"
    before = held.deadman.record.t_alive
    held.far.type(b"\x1b[?60%s;0$y\x1b[?63999;0$y" % numbers[0])
    held.run(0.05)
    assert held.deadman.record.t_alive == before


def test_a_window_without_the_focus_is_a_pad_that_is_unplugged(held: Held) -> None:
    held.press(SPACE + W + "\x1b[103u")
    held.press(FOCUS_OUT)
    assert not held.pad.state().connected
    assert not held.deadman.held
    held.press(FOCUS_IN + "\x1b[32;1:2u")
    assert held.pad.state().connected
    assert not held.deadman.held, "still down, but nobody knows since when"
    held.press(SPACE_UP)
    held.press(SPACE)
    assert held.deadman.held


@pytest.mark.parametrize("stop", ["\x1b[27u", "\x1b[127u"])
def test_a_stop_key_stops_and_space_must_be_pressed_anew(held: Held, stop: str) -> None:
    held.press(SPACE + W)
    held.press(stop)
    assert held.stops == 1
    assert not held.deadman.held
    held.press("\x1b[32;1:2u")
    assert not held.deadman.held
    held.press(SPACE_UP + SPACE)
    assert held.deadman.held


def test_a_terminal_that_was_reset_is_noticed(held: Held) -> None:
    held.press(SPACE + W)
    assert held.deadman.held
    held.far.flags[:] = [0]  # somebody types `reset` elsewhere; from here on releases are not reported
    assert held.until(lambda: not held.deadman.held, "letting go") < 5.0
    held.until(lambda: held.far.flags[-1] == 15, "being asked again")
    held.press(SPACE)
    assert held.deadman.held


# Opening and closing.


def test_without_a_terminal_it_says_what_to_do(tmp_path) -> None:
    file = tmp_path / "file"
    file.touch()
    for path in (str(file), str(tmp_path / "nowhere")):
        driver = TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"tty": path}))
        with pytest.raises(NotSupported, match="ssh -t"):
            driver.open()
        driver.close()


def test_options_of_another_driver_are_ignored_and_its_own_are_checked() -> None:
    TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"device": "/dev/input/event3"}))
    with pytest.raises(ConfigError, match="step_s"):
        TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"step_s": 0.2}))


def test_a_terminal_that_is_closed_is_a_pad_that_is_gone(bench) -> None:
    it = bench()
    it.press(UP)
    it.far.hang_up()
    it.run(0.05)
    assert not it.pad.state().connected
    assert not it.deadman.held
    assert it.pad.notes == ("the terminal was closed",)


@pytest.mark.parametrize("kitty", [False, True])
def test_the_terminal_is_as_before_when_it_is_closed(kitty: bool) -> None:
    with FarEnd(kitty=kitty) as far:
        before = far.settings
        driver = TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"tty": far.path}))
        for _ in range(2):
            driver.open()
            assert far.raw
            assert far.flags[-1] == (15 if kitty else 0)
            driver.close()
            assert far.settings == before
            wait_for(lambda: far.flags == [0] and not far.focus, "taking everything back")
            assert far.unread() == 0, "no answer is left for the shell"
        driver.close()
