"""The settings of the page in control: arm, speed, axes, and the reset of the scene."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import pytest

import hal

from .kit import Bench, Browser, need_browser, wait_for
from .moves import BRIEF, clear_trip, let_go_of_all, undisturbed, wait_until_released

TWO_ARMS = {
    "robots": {
        "left": {"model": "panda", "base": {"position": [0.0, 0.5, 0.0]}},
        "right": {"model": "panda", "base": {"position": [0.0, -0.5, 0.0]}},
    },
    "gamepads": {"pad": {"model": "auto"}},
}


TWO_PADS = TWO_ARMS | {
    "gamepads": {
        "left_pad": {"model": "auto", "drives": "left"},
        "right_pad": {"model": "auto", "drives": "right"},
    },
}


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Two arms; which one is driven shows in the page."""
    need_browser()
    bench = Bench(rig=TWO_ARMS)
    yield bench
    bench.close()


@pytest.fixture
def page(bench: Bench, page: Browser) -> Browser:
    """The console; it drives the left arm at full speed along the base's axes, whatever a test before has left."""
    bench.session._changes.update(speed=1.0, frame="base", robot="left")
    wait_for(lambda: not bench.session._changes, "the program to take the settings")
    wait_for(lambda: names_the_driven(page, "left"), "the page to name the driven arm")
    return page


@pytest.fixture
def two_pads() -> Iterator[Bench]:
    """Two arms and two pads, both of which are the page."""
    need_browser()
    bench = Bench(rig=TWO_PADS, robots=("left", "right"))
    yield bench
    bench.close()


def choose(page: Browser, name: str) -> None:
    page.run(
        "[...document.querySelectorAll('#robots button')].find((b) => b.textContent === arguments[0]).click()", name
    )


def tcp(bench: Bench, name: str) -> float:
    """Height of an arm's tool, m."""
    return float(bench.rig.robots[name].state(max_age=2.0).tcp.position[2])


def names_the_driven(page: Browser, name: str) -> bool:
    return name in page.text("#driven") and name in page.text("#who") and name in page.text("#model")


def drive_up(bench: Bench, page: Browser, name: str) -> None:
    """Hold the dead-man and go up, until that arm has moved; the other one must not."""
    other = "left" if name == "right" else "right"
    before = tcp(bench, name), tcp(bench, other)

    def press() -> None:
        page.hold()
        with held_key(page, "KeyQ", "q"):
            wait_for(lambda: tcp(bench, name) > before[0] + 0.02, f"{name} to move", BRIEF)

    undisturbed(bench, page, press)
    let_go_of_all(page)
    wait_for(lambda: not bench.deadman.held, "the release")
    assert abs(tcp(bench, other) - before[1]) < 1e-3, f"{other} stays where it is"


@contextlib.contextmanager
def held_key(page: Browser, code: str, key: str) -> Iterator[None]:
    """A key that is held for as long as the block lasts."""
    page.key(code, key, True)
    try:
        yield
    finally:
        page.key(code, key, False)


def test_with_two_pads_the_page_drives_the_chosen_arm_alone(two_pads: Bench, browser: Browser) -> None:
    assert sum("one pad" in note for note in two_pads.rig.notes) == 1
    browser.open(two_pads.link)
    browser.wait_driving()
    wait_for(lambda: not two_pads.session.pad.waiting_for, "the pad to be at rest")
    wait_for(lambda: names_the_driven(browser, "left"), "the page to name the driven arm")
    drive_up(two_pads, browser, "left")
    choose(browser, "right")
    wait_for(lambda: names_the_driven(browser, "right"), "the page to name the other arm")
    wait_until_released(two_pads)
    drive_up(two_pads, browser, "right")


def test_the_arm_that_is_chosen_is_the_arm_that_moves(bench: Bench, page: Browser) -> None:
    drive_up(bench, page, "left")
    choose(page, "right")
    wait_for(lambda: names_the_driven(page, "right"), "the page to name the other arm")
    wait_until_released(bench)
    drive_up(bench, page, "right")
    choose(page, "left")
    wait_for(lambda: names_the_driven(page, "left"), "the page to name the first arm again")


def test_a_held_dead_man_keeps_its_arm(bench: Bench, page: Browser) -> None:
    """Neither the page nor the program changes what is driven under a hand."""
    page.hold()
    wait_for(lambda: bench.deadman.held, "the dead-man")
    choose(page, "right")
    wait_for(lambda: "elease" in page.text("#notice"), "the page to refuse")
    bench.session._changes["robot"] = "right"  # a page that asks all the same
    wait_for(lambda: "was not changed: release" in page.text("#log"), "the program to refuse", BRIEF)
    assert bench.session.robot.name == "left"
    assert names_the_driven(page, "left")
    let_go_of_all(page)


def test_a_page_without_control_names_the_driver_and_the_arm(bench: Bench, page: Browser) -> None:
    page.click("#lease")
    wait_for(lambda: not page.facts["driving"], "the page to stop driving")
    assert "control" in page.text("#who")
    choose(page, "right")
    assert bench.session.robot.name == "left", "what a page without control shows moves nothing"
    page.click("#lease")
    wait_for(lambda: page.facts["driving"] and names_the_driven(page, "left"), "control again, of what was driven")


def test_the_speed_slider_slows_the_arm_down(bench: Bench, page: Browser) -> None:
    page.run("const s = document.querySelector('#speed'); s.value = 25; s.dispatchEvent(new Event('input'))")
    wait_for(lambda: bench.session.teleop.speed == 0.25, "the program to hear it")
    wait_for(lambda: page.text("#speed-share") == "25 %", "the page to show what the program does")
    page.run("const s = document.querySelector('#speed'); s.value = 100; s.dispatchEvent(new Event('input'))")
    wait_for(lambda: page.text("#speed-share") == "100 %", "the page to show it")


def test_the_frame_can_be_switched(bench: Bench, page: Browser) -> None:
    """Up along the tool's own axes of a hand that points down is down in the base's."""
    press = "[...document.querySelectorAll('#frame button')].find((b) => b.textContent === arguments[0]).click()"
    page.run(press, "tool")
    wait_for(lambda: bench.session.teleop.frame == "tcp", "the program to hear it")
    wait_for(lambda: "tool" in page.text('[data-button="l1"]'), "the labels to follow")
    arm = bench.session.robot
    before = arm.state(max_age=2.0).tcp.position[2]

    def move() -> None:
        page.hold()
        with held_key(page, "KeyQ", "q"):
            wait_for(lambda: arm.state(max_age=2.0).tcp.position[2] < before - 0.02, "motion along the tool", BRIEF)

    undisturbed(bench, page, move)
    let_go_of_all(page)
    wait_until_released(bench)
    page.run(press, "base")
    wait_for(lambda: bench.session.teleop.frame == "base", "the program to hear it")


def test_a_reset_stops_first_and_needs_a_new_press(bench: Bench, page: Browser) -> None:
    """What was held through the reset moves nothing."""
    arm = bench.session.robot
    start = arm.home

    def move() -> None:
        page.hold()
        page.key("ArrowUp", "ArrowUp", True)
        wait_for(lambda: abs(arm.state(max_age=2.0).q - start).max() > 0.1, "motion", BRIEF)

    undisturbed(bench, page, move)
    page.click("#reset")
    wait_for(lambda: "Scene reset" in page.text("#log"), "the program to reset the scene")
    wait_for(lambda: abs(arm.state(max_age=2.0).q - start).max() < 0.02, "the arm to be where it started")
    time.sleep(0.3)
    assert abs(arm.state(max_age=2.0).q - start).max() < 0.02, "still held, but from before"
    page.key("ArrowUp", "ArrowUp", False)
    let_go_of_all(page)
    wait_until_released(bench)
    drive_up(bench, page, bench.session.robot.name)


def test_a_page_without_control_resets_nothing(bench: Bench, page: Browser) -> None:
    page.click("#lease")
    wait_for(lambda: not page.facts["driving"], "the page to stop driving")
    assert page.text("#reset") == ""
    page.click("#lease")
    page.wait_driving()
    clear_trip(bench, page)
    assert page.text("#reset")


def test_a_program_that_offers_nothing_has_no_selector(bench: Bench, page: Browser) -> None:
    """An arm that cannot be chosen is not offered: then the page in control shows the one that it drives."""
    from hal.views import DrivingView

    try:
        bench.console.show_driving(DrivingView("right", note="policy: 3 chunk(s)"))
        wait_for(lambda: names_the_driven(page, "right"), "the page to name the driven arm")
        assert page.text("#driving-note") == "policy: 3 chunk(s)"
        assert page.text("#robots") == ""
        assert page.text("#reset") == ""
        assert page.text("#settings") == ""
    finally:
        bench.session._show_driving()
    wait_for(lambda: names_the_driven(page, "left"), "the page to name the driven arm again")
    assert page.text("#driving-note") == ""


def test_invalid_driving_views() -> None:
    from hal.views import DrivingView

    for wrong in ({"speed": 0.0}, {"speed": float("nan")}, {"speed": 0.5, "speed_max": 0.4}, {"frame": "world"}):
        with pytest.raises(hal.CommandError):
            DrivingView("arm", **wrong)
    with pytest.raises(hal.CommandError):
        DrivingView("arm", settings=("torque",))
