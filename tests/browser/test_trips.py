"""Whatever happens to the browser while the arm moves: the arm trips, and only a new press continues."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from urllib.parse import urlsplit

import pytest

from .cable import Cable
from .kit import Bench, Browser, wait_for
from .moves import HANG, TROUBLE, drive_left, end_trouble, lines, row_of_docs, shows_trouble, undisturbed


@pytest.fixture
def moving(bench: Bench, page: Browser) -> Iterator[Browser]:
    """The arm goes to the left, by real keys that stay down."""
    move(bench, page)
    yield page
    page.key("ArrowLeft", "ArrowLeft", False)
    page.let_go()
    bring_home(bench)


def move(bench: Bench, page: Browser) -> None:
    drive_left(bench, page, 0.15)


def bring_home(bench: Bench) -> None:
    """Far from where the test left it, so that no limit is near in the next one."""
    bench.rig.world.reset("panda")


def stopped(bench: Bench) -> bool:
    return bench.trip != "none" and bench.rests()


def goes_on_after_release_and_press(bench: Bench, page: Browser) -> None:
    """Still latched, also while the key is down; then it goes on."""
    assert bench.trip != "none"
    page.key("ArrowLeft", "ArrowLeft", False)
    page.let_go()
    wait_for(lambda: bench.session.pad.state().connected, "the pad to be back")
    wait_for(lambda: not bench.deadman.held and not bench.session.pad.waiting_for, "everything to be released")
    move(bench, page)
    assert bench.trip == "none"


def stops_for(bench: Bench, page: Browser, trip: str, cause: Callable[[], None]) -> None:
    """``cause`` stops the arm for that reason, and for no other."""

    def attempt() -> None:
        if bench.trip != "none":
            move(bench, page)
        cause()
        braking_after(bench, time.monotonic())
        assert bench.trip == trip

    undisturbed(bench, page, attempt)


def braking_after(bench: Bench, event: float) -> float:
    """Seconds from the event until the servo began to brake."""
    wait_for(lambda: stopped(bench), "the arm to be stopped")
    return bench.servo.t_stop - event


def test_a_frozen_browser(bench: Bench, moving: Browser) -> None:
    event = moving.freeze()
    late = braking_after(bench, event)
    assert bench.trip in ("deadman_silent", "deadman_lost"), "the servo and the console notice at about the same time"
    assert 0.05 < late < 1.0  # how late exactly is for python -m benchmarks console
    before = bench.tcp.copy()
    moving.thaw()
    wait_for(lambda: moving.facts.get("connected"), "the page to answer")
    time.sleep(0.5)
    assert stopped(bench), "what the browser still had to say moves nothing"
    wait_for(lambda: "he page" in moving.text("#trip-text"), "the page to say why")
    assert "pad" not in moving.text("#trip-text"), "the page is the pad here"
    assert abs(bench.tcp - before).max() < 1e-3
    goes_on_after_release_and_press(bench, moving)


@pytest.mark.parametrize("what", TROUBLE)
def test_each_trouble_is_one_state_and_one_sentence(bench: Bench, moving: Browser, what: str) -> None:
    """The table of the docs, row by row."""
    try:
        TROUBLE[what](bench, moving)
        wait_for(lambda: shows_trouble(moving, what), f"{what}: {row_of_docs(what)}")
        if what == "the robot does not answer":
            wait_for(lambda: moving.text("#waiting") == "Arm state unknown.", "the same beside the button")
    finally:
        end_trouble(bench, moving)


def test_a_page_that_hangs_names_the_busy_computer(bench: Bench, moving: Browser) -> None:
    for count in (1, 2):
        moving.run(HANG)
        wait_for(lambda: stopped(bench), "the arm to be stopped")
        wait_for(lambda: "too busy (the page hung for 0.6 s)" in moving.text("#trip-text"), "the page to say why")
        if count == 1:
            assert lines(moving, "the page hung") == 1
            goes_on_after_release_and_press(bench, moving)


def test_a_reloaded_page(bench: Bench, moving: Browser) -> None:
    moving.chrome.refresh()
    braking_after(bench, time.monotonic())
    assert bench.trip == "deadman_lost"
    moving.wait_driving()
    goes_on_after_release_and_press(bench, moving)


def test_a_hidden_tab(bench: Bench, moving: Browser) -> None:
    console = moving.chrome.current_window_handle
    moving.chrome.switch_to.new_window("tab")
    try:
        braking_after(bench, time.monotonic())
        assert bench.trip in ("deadman_lost", "deadman_silent")
    finally:
        moving.chrome.close()
        moving.chrome.switch_to.window(console)
    goes_on_after_release_and_press(bench, moving)


def test_a_window_that_lost_the_focus(bench: Bench, moving: Browser) -> None:
    stops_for(bench, moving, "deadman_lost", lambda: moving.run("window.dispatchEvent(new Event('blur'))"))
    wait_for(lambda: "focus" in moving.text("#trip"), "the page to say why")
    moving.run("window.dispatchEvent(new Event('focus'))")
    goes_on_after_release_and_press(bench, moving)


def test_stop_by_the_person_who_drives(bench: Bench, moving: Browser) -> None:
    def escape() -> None:
        moving.tap("Escape", "Escape")

    stops_for(bench, moving, "stop", escape)
    wait_for(lambda: "STOP" in moving.text("#trip"), "the page to say why")
    goes_on_after_release_and_press(bench, moving)


AGAIN, CONTINUE = "Release everything, then hold Space again.", "Hold Space to continue."


@pytest.mark.parametrize("trip", ["stop", "deadman_lost"])
def test_the_page_says_one_thing_to_do_and_it_works(bench: Bench, moving: Browser, trip: str) -> None:
    """Space and an arrow stay held during the trip."""
    if trip == "stop":
        moving.tap("Escape", "Escape")
    else:
        moving.run("window.dispatchEvent(new Event('blur')); window.dispatchEvent(new Event('focus'))")
    wait_for(lambda: bench.trip == trip and bench.rests(), "the trip")

    def says(text: str, button: str) -> bool:
        shown = [moving.text(part) for part in ("#waiting", "#trip-remedy", "#hold b")]
        return shown == [text, text, button]

    if trip == "stop":  # after the other one the page has released everything by itself
        wait_for(lambda: says(AGAIN, "RELEASE"), "one instruction")
        assert not moving.text("#hold-keys")
    moving.key("ArrowLeft", "ArrowLeft", False)
    moving.let_go()
    wait_for(lambda: says(CONTINUE, "HOLD TO MOVE"), "the next one")
    move(bench, moving)
    wait_for(lambda: moving.text("#hold b") == "HELD" and not moving.text("#trip-text"), "nothing more to do")


def test_a_closed_tab(bench: Bench, moving: Browser) -> None:
    console = moving.chrome.current_window_handle
    moving.chrome.switch_to.new_window("window")
    other = moving.chrome.current_window_handle
    moving.chrome.switch_to.window(console)
    if bench.trip != "none":  # the new window took the focus away: that was the other test
        goes_on_after_release_and_press(bench, moving)
    moving.chrome.close()
    moving.chrome.switch_to.window(other)
    moving.size(1280, 800)
    braking_after(bench, time.monotonic())
    assert bench.trip == "deadman_lost"
    assert bench.session.pad.state().connected is False
    moving.open(bench.link)
    moving.wait_driving()
    goes_on_after_release_and_press(bench, moving)


@pytest.mark.slow
def test_a_network_that_is_cut_and_comes_back(bench: Bench, browser: Browser) -> None:
    """All that the page sent meanwhile arrives at once then, and moves nothing."""
    parts = urlsplit(bench.link)
    assert parts.port is not None
    cable = Cable(parts.port)
    try:
        browser.open(f"http://127.0.0.1:{cable.port}/#{parts.fragment}")
        browser.wait_driving()
        wait_for(lambda: bench.session.pad.state().connected and not bench.session.pad.waiting_for, "the pad at rest")
        move(bench, browser)
        event = cable.cut()
        late = braking_after(bench, event)
        how = bench.trip
        assert how in ("deadman_silent", "deadman_lost"), "the servo and the console notice at about the same time"
        assert late < 1.0
        before = bench.tcp.copy()
        browser.key("ArrowLeft", "ArrowLeft", False)
        browser.let_go()
        browser.hold()  # pressed anew while nobody heard it
        browser.key("ArrowLeft", "ArrowLeft", True)
        time.sleep(0.5)
        cable.mend()
        time.sleep(0.5)
        assert bench.trip == how, "a press of which nothing was heard does not count"
        assert abs(bench.tcp - before).max() < 1e-3
        browser.wait_driving()
        goes_on_after_release_and_press(bench, browser)
        cable.cut()
        time.sleep(0.4)
        cable.mend()
        wait_for(lambda: shows_trouble(browser, "the network was slow"), "the slow network")
        browser.key("ArrowLeft", "ArrowLeft", False)
        browser.let_go()
        cable.cut()
        wait_for(lambda: shows_trouble(browser, "the connection is lost"), "the lost connection")
        cable.mend()
        bring_home(bench)
        browser.chrome.get("about:blank")
    finally:
        cable.close()


BUTTONS = """return [...document.querySelectorAll('button')]
    .filter((one) => one.innerText === arguments[0] && one.checkVisibility())
    .map((one) => one.getBoundingClientRect()).map((r) => [r.left + r.width / 2, r.top + r.height / 2])"""


def test_a_fault_is_shown_and_its_remedy_is_what_recovers(bench: Bench, moving: Browser) -> None:
    bench.arm.inject(fault="joint 3 is too warm")
    wait_for(lambda: "joint 3 is too warm" in moving.text("#fault"), "the page to tell the fault")
    button = re.search('Press "(.+)", then release everything and hold again', moving.text("#fault-remedy"))
    assert button is not None, "the remedy is in the words of the page"
    assert "recover()" not in moving.text("#fault") + moving.text("#log"), "what a program calls is no use here"
    (named,) = moving.run(BUTTONS, button[1])
    moving.key("ArrowLeft", "ArrowLeft", False)
    moving.let_go()
    moving.mouse("mousePressed", *named)
    moving.mouse("mouseReleased", *named)
    wait_for(lambda: bench.arm.state().fault is None, "the fault to be cleared")
    move(bench, moving)
    assert not moving.text("#fault")


def test_the_end_of_the_app_is_shown(page: Browser) -> None:
    """Of another rig than the other tests'."""
    other = Bench()
    try:
        page.open(other.link)
        page.wait_driving()
    finally:
        other.close()
    wait_for(lambda: not page.facts.get("connected"), "the page to notice")
    wait_for(lambda: "ended" in page.text("#overlay-title"), "the page to say so")
    assert page.text("#overlay-next") == "", "nothing is tried again: another run has another link"
    assert page.text("#notice") == "", "what was wrong before does not matter any more"


def test_the_link_of_the_next_run_in_the_same_tab(page: Browser) -> None:
    """Only what stands behind the # differs, so the browser loads nothing."""
    other = Bench()
    port = urlsplit(other.link).port
    try:
        page.open(other.link)
        page.wait_driving()
        page.hold()
        wait_for(lambda: other.deadman.held, "the dead-man")
    finally:
        other.close()
    wait_for(lambda: "ended" in page.text("#overlay-title"), "the page to say so")
    other = Bench(listen=f":{port}")
    try:
        page.run("window.sameDocument = true")
        page.chrome.get(other.link)
        page.wait_driving()
        assert page.run("return window.sameDocument"), "the browser loaded the page anew"
        space = {"code": "Space", "key": " ", "windowsVirtualKeyCode": 32}
        page.cdp("Input.dispatchKeyEvent", type="rawKeyDown", autoRepeat=True, **space)
        time.sleep(0.5)
        assert not other.deadman.held, "the press of the run before counts"
        page.let_go()
        drive_left(other, page)
        page.key("ArrowLeft", "ArrowLeft", False)
        page.let_go()
        page.chrome.get("about:blank")
    finally:
        other.close()
