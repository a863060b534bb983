"""Releases that the page may miss: menus, drags, a lost keyboard, a browser that hangs."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from .kit import Bench, Browser, wait_for
from .moves import BRIEF, clear_trip, drive_left, let_go_of_all, lines, undisturbed

ALARM = "#alarm"


@pytest.fixture(autouse=True)
def nothing_is_left(bench: Bench) -> Iterator[None]:
    """Far from where a test left the arm, so that no limit is near in the next one."""
    yield
    bench.rig.world.reset("panda")


def held(bench: Bench) -> bool:
    return bench.deadman.held


def repeat(page: Browser, code: str, key: str) -> None:
    """The keyboard repeats a key that is down."""
    virtual = {"Space": 32, "ArrowLeft": 37}[code]
    page.cdp(
        "Input.dispatchKeyEvent", type="rawKeyDown", code=code, key=key, windowsVirtualKeyCode=virtual, autoRepeat=True
    )


def repeat_for(page: Browser, seconds: float, code: str = "ArrowLeft", key: str = "ArrowLeft") -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        repeat(page, code, key)
        time.sleep(0.03)


def button(page: Browser, kind: str, at: dict[str, float], name: str, buttons: int, modifiers: int = 0) -> None:
    """A mouse button; ``buttons``: all that are down then (1 left, 2 right)."""
    page.cdp(
        "Input.dispatchMouseEvent",
        type=kind,
        x=at["x"],
        y=at["y"],
        button=name,
        buttons=buttons,
        clickCount=1,
        modifiers=modifiers,
    )


def enter(page: Browser, down: bool, again: bool = False) -> None:
    """The Enter key as a keyboard sends it: with its character, which is what clicks a button."""
    page.cdp(
        "Input.dispatchKeyEvent",
        type="keyDown" if down else "keyUp",
        code="Enter",
        key="Enter",
        windowsVirtualKeyCode=13,
        autoRepeat=again,
        **({"text": "\r"} if down else {}),
    )


# What takes the hands from the page is not let in.


def test_no_menu_opens_anywhere(page: Browser) -> None:
    page.run("window.menus = []; addEventListener('contextmenu', (e) => window.menus.push(e.defaultPrevented))")
    for count, place in enumerate(("#view", "#rig", "#joints", "#log", "#hold", "#stop"), 1):
        at = page.place(place)
        button(page, "mousePressed", at, "right", 2)
        button(page, "mouseReleased", at, "right", 0)
        wait_for(lambda count=count: page.run("return window.menus.length") >= count, f"the menu of {place}")
        assert page.run("return window.menus") == [True] * count, place


def test_a_menu_that_cannot_be_prevented_releases_everything(bench: Bench, page: Browser) -> None:
    """Firefox opens one with Shift, and asks no page."""
    drive_left(bench, page)
    shift = 8
    button(page, "mousePressed", page.place("#view"), "right", 2, shift)
    wait_for(lambda: not held(bench), "the release")
    button(page, "mouseReleased", page.place("#view"), "right", 0, shift)
    let_go_of_all(page)


def test_no_text_can_be_dragged(page: Browser) -> None:
    """Words of the log may be selected; a drag of them would keep the keys."""
    page.run(
        """window.drags = []; addEventListener('dragstart', (e) => window.drags.push(e.defaultPrevented));
           document.querySelector('#log').innerHTML = '<li><span>some words that one may copy</span></li>';
           getSelection().selectAllChildren(document.querySelector('#log span'))"""
    )
    at = page.place("#log span")
    at["x"] = at["left"] + 12
    button(page, "mousePressed", at, "left", 1)
    for step in range(1, 15):
        button(page, "mouseMoved", at | {"x": at["x"] + 5 * step, "y": at["y"] + 3 * step}, "left", 1)
    wait_for(lambda: page.run("return window.drags.length"), "the drag to be tried")
    button(page, "mouseReleased", at, "left", 0)
    assert page.run("return window.drags") == [True]


def test_text_can_be_selected_and_controls_cannot(page: Browser) -> None:
    script = "return getComputedStyle(document.querySelector(arguments[0])).userSelect"
    assert {page.run(script, place) for place in ("#hold", "#stop", "#gripper", '[data-disc="left"]')} == {"none"}
    assert {page.run(script, place) for place in ("#rig", "#tcp", "#width", "#waiting", "#log")} <= {"auto", "text"}


# Hands that let go while nobody tells.


def test_a_second_mouse_button_ends_the_press(bench: Bench, page: Browser) -> None:
    """With two of them down, only the last one to be let go of is told of."""
    at, elsewhere = page.place("#hold"), page.place("#joints")
    button(page, "mousePressed", at, "left", 1)
    wait_for(lambda: held(bench), "the button to hold")
    button(page, "mouseMoved", elsewhere, "left", 1)
    time.sleep(0.1)
    assert held(bench), "sliding off the button does not let go"
    button(page, "mousePressed", elsewhere, "right", 3)
    wait_for(lambda: not held(bench), "the release")
    button(page, "mouseReleased", elsewhere, "right", 1)
    button(page, "mouseMoved", at, "left", 1)
    time.sleep(0.1)
    assert not held(bench), "only a new press holds again"
    button(page, "mouseReleased", at, "left", 0)


def test_keys_that_cease_to_repeat_count_as_released(bench: Bench, page: Browser) -> None:
    """As when a locked screen takes the keyboard: no more repetitions, no release, and the focus stays."""

    def cease() -> None:
        drive_left(bench, page)
        repeat_for(page, 0.3)
        event = time.monotonic()
        wait_for(lambda: bench.trip == "deadman_lost" and bench.rests(), "the arm to be stopped", BRIEF)
        assert 0.2 < bench.servo.t_stop - event < 1.0

    undisturbed(bench, page, cease)
    repeat_for(page, 0.3)
    assert not held(bench), "keys that come back without a new press hold nothing"
    assert "lost the keyboard" in page.text("#log")
    let_go_of_all(page)
    drive_left(bench, page)
    let_go_of_all(page)


def stays_held(page: Browser, seconds: float = 1.0) -> None:
    """By what the page says: a servo on a machine that is busy may have reasons of its own to stop."""
    pressed = "return document.querySelector('#hold').dataset.pressed === ''"
    wait_for(lambda: page.run(pressed), "the button to show it")
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert page.run(pressed), page.text("#log")
        time.sleep(0.02)


def test_keys_that_never_repeat_stay_held(bench: Bench, page: Browser) -> None:
    drive_left(bench, page)
    stays_held(page)
    let_go_of_all(page)


def test_the_older_key_does_not_go_on_repeating(bench: Bench, page: Browser) -> None:
    """Space, then an arrow: Space repeats, then the arrow does, and then none."""
    page.hold()
    wait_for(lambda: held(bench), "the dead-man")
    repeat_for(page, 0.2, "Space", " ")
    page.key("ArrowLeft", "ArrowLeft", True)
    stays_held(page, 0.6)  # a keyboard waits for about as long before it repeats
    repeat_for(page, 0.2)
    page.key("ArrowLeft", "ArrowLeft", False)
    stays_held(page)
    page.let_go()


@pytest.mark.parametrize("what", ["a click", "another key", "a key of no meaning"])
def test_other_input_may_end_a_repetition(bench: Bench, page: Browser, what: str) -> None:
    def hold() -> None:
        page.hold()
        wait_for(lambda: held(bench), "the dead-man", BRIEF)
        repeat_for(page, 0.2, "Space", " ")
        if what == "a click":
            page.click('[data-disc="dpad"]')
        else:
            code, key = ("Digit2", "2") if what == "another key" else ("KeyZ", "z")
            page.tap(code, key)
        stays_held(page)

    undisturbed(bench, page, hold)
    page.let_go()


def test_a_keyboard_that_repeats_slowly(bench: Bench, page: Browser) -> None:
    """Some people set it to seconds."""
    page.hold()
    wait_for(lambda: held(bench), "the dead-man")
    for _ in range(5):
        repeat(page, "Space", " ")
        stays_held(page, 0.5)
    page.let_go()


def main_process(browser: Browser) -> int:
    """The one that hears the keyboard and the mouse, and has all others as children."""
    for pid in browser.processes():
        with contextlib.suppress(OSError):
            command = Path(f"/proc/{pid}/cmdline").read_bytes()
            if b"--user-data-dir" in command and b"--type=" not in command and b"chrom" in command.split(b"\0")[0]:
                return pid
    pytest.fail("the browser has no main process")


@pytest.mark.parametrize("by", ["keys", "mouse"])
def test_a_browser_that_hangs_though_its_page_does_not(bench: Bench, page: Browser, by: str) -> None:
    def hang() -> None:
        button(page, "mouseReleased", page.place("#hold"), "left", 0)
        if by == "keys":
            page.hold()
        else:
            button(page, "mousePressed", page.place("#hold"), "left", 1)
        page.key("ArrowLeft", "ArrowLeft", True)
        wait_for(lambda: bench.tcp_speed[1] > 0.1, "motion", BRIEF)
        pid = main_process(page)
        os.kill(pid, signal.SIGSTOP)
        event = time.monotonic()
        try:
            wait_for(lambda: bench.trip == "deadman_lost" and bench.rests(), "the arm to be stopped", BRIEF)
            assert bench.servo.t_stop - event < 1.0  # 0.2 s where the machine is idle
            print(f"braked after {bench.servo.t_stop - event:.3f} s")
            wait_for(lambda: bench.session.pad.state().connected, "the page itself to go on", BRIEF)
        finally:
            os.kill(pid, signal.SIGCONT)

    undisturbed(bench, page, hang)
    time.sleep(0.3)
    assert not held(bench), "what is held since before holds nothing"
    button(page, "mouseReleased", page.place("#hold"), "left", 0)
    let_go_of_all(page)
    assert "The browser hung" in page.text("#log")
    drive_left(bench, page)
    let_go_of_all(page)


# Keys on buttons that were reached with Tab.


def test_space_on_the_stop_button_stops(bench: Bench, page: Browser) -> None:
    def press() -> None:
        clear_trip(bench, page)
        before = lines(page, "STOP was sent")
        page.run("document.querySelector('#stop').focus()")
        page.hold()
        wait_for(lambda: bench.trip == "stop", "the stop", BRIEF)
        repeat_for(page, 0.2, "Space", " ")
        page.let_go()
        time.sleep(0.2)
        assert not held(bench)
        assert lines(page, "STOP was sent") == before + 1, "one press is one stop"
        page.run("document.activeElement.blur()")

    undisturbed(bench, page, press)


def test_enter_on_the_stop_button_stops(bench: Bench, page: Browser) -> None:
    def press() -> None:
        clear_trip(bench, page)
        before = lines(page, "STOP was sent")
        page.run("document.querySelector('#stop').focus()")
        enter(page, True)
        wait_for(lambda: bench.trip == "stop", "the stop", BRIEF)
        for _ in range(5):
            enter(page, True, again=True)
        enter(page, False)
        assert lines(page, "STOP was sent") == before + 1, "one press is one stop"
        page.run("document.activeElement.blur()")

    undisturbed(bench, page, press)


def test_a_held_enter_clicks_once(page: Browser) -> None:
    page.run(
        """window.clicks = 0; const lease = document.querySelector('#lease');
           lease.addEventListener('click', () => window.clicks += 1); lease.focus()"""
    )
    enter(page, True)
    for _ in range(9):
        enter(page, True, again=True)
    enter(page, False)
    wait_for(lambda: page.facts["driving"] is False, "the lease to be let go of")
    assert page.run("return window.clicks") == 1
