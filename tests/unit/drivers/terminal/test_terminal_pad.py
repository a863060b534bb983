"""Keys of a terminal as a gamepad, on pseudo-terminals with and without the Kitty keyboard protocol."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from errors_kit import raises_code
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
    """A pad that the test polls, on a clock that the test advances."""

    def __init__(self, far: FarEnd, **options: Any) -> None:
        self.far = far
        self.stops = 0
        self.now = 1.0  # before the present of a computer that was just started
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
        """Return for how long the dead-man was held so far, s."""
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


@pytest.fixture
def it(bench: Callable[..., Bench]) -> Bench:
    """A plain terminal."""
    return bench()


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


def test_space_does_nothing_in_step_mode(it: Bench) -> None:
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


@pytest.mark.parametrize(
    "far",
    [
        {},
        {"answers": False},
        {"kitty": True, "reports_focus": False},
        {"kitty": True, "delay": 0.05},
        {"kitty": True, "options": {"mode": "step"}},
    ],
    ids=["plain", "silent", "no focus", "slow", "option"],
)
def test_keys_make_steps_where_they_cannot_be_held_safely(bench, far: dict[str, Any]) -> None:
    it = bench(**far)
    assert not it.pad.can_hold
    assert len(it.pad.notes) == 1, "with the reason"
    wait_for(lambda: it.far.flags == [0], "resetting the terminal")
    it.press(UP)
    assert it.deadman.held
    it.run(0.3)
    assert not it.deadman.held


# Keys that are held.


class Held(Bench):
    """The same in real time, because the terminal answers in real time."""

    def run(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            self.now = now
            self.pad.poll_once(now)
            time.sleep(0.002)

    def until(self, condition: Callable[[], bool], what: str) -> float:
        """Poll until ``condition`` holds; return how long it took, s."""
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
    assert held.pad.can_hold
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


def test_repeat_does_not_count_as_press(held: Held) -> None:
    held.press("\x1b[32;1:2u\x1b[119;1:2u")
    assert not held.deadman.held
    assert held.pad.state().axis("left_y") == 0.0


def test_pad_is_alive_only_while_the_terminal_answers(held: Held) -> None:
    held.press(SPACE + W)
    held.until(lambda: fresh(held), "an answer")
    held.far.silent = True
    cut = time.monotonic()
    held.until(lambda: not fresh(held), "growing old")
    assert held.deadman.record.t_alive <= cut, "questions after the cut are unanswered"
    assert held.deadman.held, "the release got lost with the link"
    held.far.silent = False
    held.until(lambda: fresh(held), "answers")


def test_late_answers_to_old_questions_do_not_prove_life(held: Held) -> None:
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


def test_pad_is_disconnected_while_the_window_lacks_the_focus(held: Held) -> None:
    held.press(SPACE + W + "\x1b[103u")
    held.press(FOCUS_OUT)
    assert not held.pad.state().connected
    assert not held.deadman.held
    held.press(FOCUS_IN + "\x1b[32;1:2u")
    assert held.pad.state().connected
    assert not held.deadman.held, "still down, but it must be pressed again"
    held.press(SPACE_UP)
    held.press(SPACE)
    assert held.deadman.held


@pytest.mark.parametrize("stop", ["\x1b[27u", "\x1b[127u"])
def test_stop_key_stops_until_space_is_pressed_again(held: Held, stop: str) -> None:
    held.press(SPACE + W)
    held.press(stop)
    assert held.stops == 1
    assert not held.deadman.held
    held.press("\x1b[32;1:2u")
    assert not held.deadman.held
    held.press(SPACE_UP + SPACE)
    assert held.deadman.held


def test_reset_of_the_terminal_releases_the_keys(held: Held) -> None:
    held.press(SPACE + W)
    assert held.deadman.held
    held.far.flags[:] = [0]  # as by `reset` in another program: releases are not reported any more
    assert held.until(lambda: not held.deadman.held, "release") < 5.0
    held.until(lambda: held.far.flags[-1] == 15, "enabling reports again")
    held.press(SPACE)
    assert held.deadman.held


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


@pytest.mark.parametrize("kitty", [False, True])
def test_close_restores_the_terminal(kitty: bool) -> None:
    with FarEnd(kitty=kitty) as far:
        before = far.settings
        driver = TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options={"tty": far.path}))
        for _ in range(2):
            driver.open()
            assert far.raw
            assert far.flags[-1] == (15 if kitty else 0)
            driver.close()
            assert far.settings == before
            wait_for(lambda: far.flags == [0] and not far.focus, "resetting the terminal")
            assert far.unread() == 0, "no reply is left for the shell"
        driver.close()
