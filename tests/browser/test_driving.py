"""Driving with a browser: the right direction and speed, and only while the dead-man is held."""

from __future__ import annotations

import json
import time

import pytest

from hal import Pose

from .kit import Bench, Browser, wait_for
from .moves import BRIEF, undisturbed

SPEED = 0.2
"""m/s at the end of the d-pad's way, by the default mapping."""


def held(bench: Bench) -> bool:
    return bench.deadman.held


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "up", "expected"),
    [(0.0, 1.0, (1.0, 0.0)), (0.54, 0.0, (0.0, -0.5))],
    ids=["forward", "right at half speed"],
)
def test_a_disc_moves_the_arm_its_way_at_its_speed(bench, page, right, up, expected):
    """0.08 of the way is the dead zone, so 0.54 of it is half the speed."""
    before = bench.tcp.copy()
    page.hold()
    wait_for(lambda: held(bench), "the dead-man")
    with page.drag("dpad", right, up):
        wait_for(lambda: abs(bench.tcp_speed[:2] - [SPEED * share for share in expected]).max() < 0.012, "its speed")
        time.sleep(0.3)
    page.let_go()
    wait_for(lambda: not held(bench), "the release")
    wait_for(bench.rests, "the arm to rest")
    way = bench.tcp - before
    along = way[0] * expected[0] + way[1] * expected[1]
    assert along > 0.3 * SPEED * 0.4 * max(map(abs, expected))
    assert abs(way[1] * expected[0] - way[0] * expected[1]) < 0.1 * along + 0.002, "not sideways"
    assert abs(way[2]) < 0.01, "nor up or down"


def test_nothing_moves_without_the_dead_man(bench: Bench, page: Browser) -> None:
    before = bench.tcp.copy()

    def push() -> None:
        with page.drag("dpad", 0.0, 1.0):
            wait_for(lambda: bench.session.pad.state().axis("dpad_y") > 0.9, "the disc to be heard", BRIEF)
            time.sleep(0.3)
            assert bench.status == "holding"

    undisturbed(bench, page, push)
    assert abs(bench.tcp - before).max() < 1e-3


def test_release_of_the_dead_man_stops_the_arm_while_the_disc_is_held(bench: Bench, page: Browser) -> None:
    def drive() -> None:
        page.hold()
        with page.drag("dpad", -0.8, 0.0):
            wait_for(lambda: bench.speed() > 0.05, "motion", BRIEF)
            page.let_go()
            wait_for(bench.rests, "the arm to rest")
            time.sleep(0.2)
            assert bench.rests()
            assert bench.trip == "none", "a release is no trip"

    undisturbed(bench, page, drive)


def test_keys_and_the_button_do_the_same(bench: Bench, page: Browser) -> None:
    button = page.place("#hold")
    page.mouse("mousePressed", button["x"], button["y"])
    wait_for(lambda: held(bench), "the button to hold")
    page.key("ArrowUp", "ArrowUp", True)
    wait_for(lambda: bench.tcp_speed[0] > 0.1, "motion")
    page.key("ArrowUp", "ArrowUp", False)
    page.mouse("mouseReleased", button["x"], button["y"])
    wait_for(lambda: not held(bench), "the release")


def test_a_joint_is_jogged_alone_by_the_mouse_and_by_enter(bench: Bench, page: Browser) -> None:
    def jog() -> None:
        at = page.place('[data-jog="joint_4"][data-way="-1"]')
        page.hold()
        page.mouse("mousePressed", at["x"], at["y"])
        wait_for(lambda: bench.servo.dq_set[3] < -0.1, "the joint", BRIEF)
        assert max(abs(speed) for k, speed in enumerate(bench.servo.dq_set) if k != 3) < 1e-3
        page.mouse("mouseReleased", at["x"], at["y"])
        wait_for(bench.rests, "the arm to rest", BRIEF)
        page.run("document.querySelector('[data-jog=joint_4][data-way=\"1\"]').focus()")
        page.key("Enter", "Enter", True)
        wait_for(lambda: bench.servo.dq_set[3] > 0.1, "the way back", BRIEF)
        page.key("Enter", "Enter", False)
        wait_for(bench.rests, "the arm to rest", BRIEF)
        page.let_go()

    undisturbed(bench, page, jog)


def test_joints_and_tcp_are_copied(bench: Bench, page: Browser) -> None:
    page.run("addEventListener('copy', () => (window.copied = document.activeElement.value))")
    page.click("#copy")
    wait_for(lambda: page.text("#copy") == "copied", "the page to say so")
    copied, state = json.loads(page.run("return window.copied")), bench.arm.state(max_age=2.0)
    assert copied["q"] == pytest.approx(state.q.tolist(), abs=1e-3)
    assert Pose(**copied["tcp"]).distance(state.tcp)[0] < 1e-3


def test_the_sliders_place_is_the_grip(bench: Bench, page: Browser) -> None:
    """It takes the fingers over when it crosses the place where they are: open, at first."""
    bench.arm.gripper.open()
    slider = page.place("#gripper")
    page.hold()
    wait_for(lambda: held(bench), "the dead-man")
    vertical = slider["height"] > slider["width"]
    start = (slider["x"], slider["bottom"] - 8) if vertical else (slider["left"] + 8, slider["y"])
    end = (slider["x"], slider["y"])
    time.sleep(0.1)  # as a person would, who does not press two things within one turn of the app's loop
    page.mouse("mousePressed", *start)
    for step in range(1, 11):
        page.mouse("mouseMoved", *(a + 0.1 * step * (b - a) for a, b in zip(start, end, strict=True)))
    page.mouse("mouseReleased", *end)
    grip = bench.session.pad.state().axis("r2")
    wait_for(lambda: 0.3 < bench.session.pad.state().axis("r2") < 0.7, f"the slider at about half, not {grip}")
    width = bench.arm.gripper.width_max * (1.0 - bench.session.pad.state().axis("r2"))
    wait_for(lambda: abs(bench.arm.gripper.state(max_age=2.0).width - width) < 0.004, "the fingers")
    page.let_go()


def test_home_goes_while_the_dead_man_is_held(bench: Bench, page: Browser) -> None:
    page.hold()
    with page.drag("dpad", 0.0, -0.8):
        wait_for(lambda: abs(bench.arm.state(max_age=2.0).q - bench.arm.home).max() > 0.05, "the arm to leave home")
    wait_for(bench.rests, "the arm to rest")
    page.click("#home")
    wait_for(lambda: abs(bench.arm.state(max_age=2.0).q - bench.arm.home).max() < 0.01, "the arm to be home", 40.0)
    wait_for(lambda: bench.status == "holding", "the app to drive again")
    page.let_go()


def test_release_on_the_way_home_cancels_it(bench: Bench, page: Browser) -> None:
    page.hold()
    with page.drag("dpad", 0.0, -0.8):
        wait_for(lambda: abs(bench.arm.state(max_age=2.0).q - bench.arm.home).max() > 0.2, "the arm to leave home")
    wait_for(bench.rests, "the arm to rest")
    page.click("#home")
    wait_for(lambda: "Homing: hold" in page.text("#log") and bench.speed() > 0.01, "the way home")
    page.let_go()
    wait_for(lambda: "cancelled" in page.text("#log"), "the app to give it up")
    wait_for(lambda: bench.status == "holding", "the app to drive again")  # a press from before does not count

    def drive() -> None:
        page.hold()
        with page.drag("dpad", -0.8, 0.0):
            wait_for(lambda: bench.tcp_speed[1] > 0.1, "the sticks to drive again", BRIEF)

    undisturbed(bench, page, drive)
    page.let_go()


def test_a_pad_of_the_browser_has_the_same_names(bench: Bench, page: Browser) -> None:
    """A pad as the Gamepad API shows it, standard layout: its L2 holds, its d-pad drives."""
    page.run(
        """window.testPad = {id: 'Test pad', index: 0, connected: true, mapping: 'standard', timestamp: 1,
             axes: [0, 0, 0, 0], buttons: Array.from({length: 18}, () => ({pressed: false, touched: false, value: 0}))};
           navigator.getGamepads = () => [window.testPad, null, null, null];
           const event = new Event('gamepadconnected'); event.gamepad = window.testPad; window.dispatchEvent(event);"""
    )

    def press(button: int, down: bool) -> None:
        page.run(
            """const [k, down] = arguments; window.testPad.timestamp += 1;
               window.testPad.buttons[k] = {pressed: down, touched: down, value: down ? 1 : 0};""",
            button,
            down,
        )

    wait_for(lambda: "dead-man" in page.text("#gamepad"), "the page to know the pad")
    press(6, True)  # l2
    wait_for(lambda: held(bench), "L2 to hold")
    press(15, True)  # d-pad, right
    wait_for(lambda: bench.tcp_speed[1] < -0.1, "motion to the right")
    press(15, False)
    page.run("window.testPad.axes = [0, -1, 0, 0]; window.testPad.timestamp += 1")  # left stick away from the person
    wait_for(lambda: bench.session.pad.state().axis("left_y") > 0.9, "up to be positive")
    page.run("window.testPad.axes = [0, 0, 0, 0]; window.testPad.timestamp += 1")
    press(6, False)
    wait_for(lambda: not held(bench), "the release")


def test_the_tour_moves_the_arm(bench: Bench, page: Browser) -> None:
    page.click("#demo")
    wait_for(lambda: bench.speed() > 0.05, "the tour to move the arm")
    page.click("#demo")
    wait_for(bench.rests, "the arm to rest")
    wait_for(lambda: not held(bench), "the tour's dead-man to be gone")
