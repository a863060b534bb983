"""Several pages, wrong links, cameras, and the layout of the page on a desk and on a phone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from .kit import Bench, Browser, need_browser, wait_for
from .moves import BRIEF, drive_left, let_go_of_all, undisturbed


@pytest.fixture
def second(bench: Bench, page: Browser) -> Iterator[Browser]:
    """Another person's browser, which came later."""
    other = Browser()
    other.open(bench.link)
    wait_for(lambda: other.facts.get("connected") and other.facts.get("lastState"), "the second page")
    yield other
    other.close()


@pytest.mark.slow
def test_one_page_drives_and_another_watches_stops_and_takes_over(bench: Bench, page: Browser, second: Browser) -> None:
    assert second.facts["driving"] is False, "who comes later watches"
    second.hold()
    with second.drag("dpad", 0.0, 1.0):
        page.hold()
        wait_for(lambda: bench.deadman.held, "the driver's dead-man")
        with page.drag("dpad", -1.0, 0.0):
            wait_for(lambda: bench.tcp_speed[1] > 0.1, "the driver's motion")
            assert abs(bench.tcp_speed[0]) < 0.02, "a watcher moves nothing"
            second.click("#stop")
            wait_for(lambda: bench.trip == "stop" and bench.rests(), "a watcher's stop")
        page.let_go()
    second.let_go()
    wait_for(lambda: not bench.deadman.held, "the release")
    page.hold()
    with page.drag("dpad", 1.0, 0.0):
        wait_for(lambda: bench.tcp_speed[1] < -0.1, "motion again")
        second.click("#lease")
        wait_for(lambda: second.facts["driving"] and not page.facts["driving"], "the lease to change hands")
        wait_for(lambda: bench.trip == "deadman_lost" and bench.rests(), "the arm to stop")
    page.let_go()
    wait_for(lambda: bench.session.pad.state().connected and not bench.session.pad.waiting_for, "the new driver's pad")
    second.hold()
    with second.drag("dpad", -1.0, 0.0):
        wait_for(lambda: bench.tcp_speed[1] > 0.1, "the new driver to drive")
    second.let_go()


def test_a_link_with_another_token_shows_nothing(bench: Bench, page: Browser) -> None:
    address = bench.link.partition("#")[0]
    page.open(f"{address}#not-the-token")
    wait_for(lambda: "link" in page.text("body").lower() and not page.facts.get("connected"), "the page to refuse")
    assert not page.facts.get("lastState")
    page.complaints()  # the browser may log the closed socket


@pytest.mark.slow
def test_the_cameras_show_what_happens() -> None:
    need_browser()
    picture = """const c = document.querySelector('[data-camera="scene"]');
        const data = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        let sum = 0; for (let k = 0; k < data.length; k += 1) sum = (sum * 31 + data[k]) >>> 0;
        const values = new Set(); for (let k = 0; k < data.length; k += 4) values.add(data[k]);
        return [sum, values.size]"""
    with closing(Bench(cameras=True)) as bench, closing(Browser()) as browser:
        browser.open(bench.link)
        browser.wait_driving()
        wait_for(lambda: browser.run(picture)[1] > 50, "a picture with something in it")
        still = browser.run(picture)[0]
        drive_left(bench, browser)
        wait_for(lambda: browser.run(picture)[0] != still, "another picture")
        let_go_of_all(browser)
        wait_for(lambda: int(browser.text(".camera .numbers").split("/s")[0] or 0) > 5, "a rate")
        browser.click(".camera.large .segments button:nth-child(2)")
        wait_for(lambda: "scene (depth)" in browser.text(".camera.large figcaption"), "the other stream")
        wait_for(lambda: browser.run("return document.querySelector('.camera.large').dataset.state") == "live", "depth")
        assert "unknown" in browser.text(".camera.large .scale"), "its colours are explained"
        wait_for(lambda: browser.run(picture)[1] > 20, "colours of depth")
        assert browser.complaints() == []


SIZES = [
    (1280, 800, False),
    (1920, 1080, False),
    (844, 390, True),
    (667, 375, True),
    (1024, 768, True),
    (390, 844, True),
]
NEEDED = ["#stop", "#hold", '[data-disc="dpad"]', '[data-disc="right"]', "#deadman", "#speed", "#frame"]


def test_the_main_controls_are_in_view_and_apart(page: Browser) -> None:
    for width, height, touch in SIZES:
        page.size(width, height, touch)
        check_the_main_controls(page, width, height)
    page.tap("Escape", "Escape")
    wait_for(lambda: page.text("#trip"), "the alarm")
    for size in SIZES:
        page.size(*size)
        alarm, picture = page.place("#trip"), page.place("#cameras")
        assert alarm["bottom"] <= picture["top"] or alarm["top"] >= picture["bottom"], "the alarm covers the picture"


def check_the_main_controls(page: Browser, width: int, height: int) -> None:
    """Check that each is in the window, large enough, and covered by none."""
    places = {name: page.place(name) for name in NEEDED}
    for name, at in places.items():
        assert at["width"] >= 24, name
        assert at["height"] >= 16, name
        assert at["left"] >= -0.5, name
        assert at["top"] >= -0.5, name
        assert at["right"] <= width + 0.5, f"{name} is cut off on the right"
        assert at["bottom"] <= height + 0.5, f"{name} is below the fold"
    for one in ("#stop", "#hold"):
        for other, at in places.items():
            apart = (
                places[one]["right"] <= at["left"] + 0.5
                or at["right"] <= places[one]["left"] + 0.5
                or places[one]["bottom"] <= at["top"] + 0.5
                or at["bottom"] <= places[one]["top"] + 0.5
            )
            assert one == other or apart, f"{one} and {other} overlap"
    assert page.run("return document.documentElement.scrollWidth") <= width
    assert places["#stop"]["width"] * places["#stop"]["height"] > 44 * 36, "large enough for a thumb"
    top = page.run(
        "const r = arguments[0]; return document.elementFromPoint(r.x, r.y).closest('#stop') !== null",
        places["#stop"],
    )
    assert top, "something covers the stop button"


TEXTS = """const found = [];
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walk.nextNode(); node; node = walk.nextNode()) {
      const parent = node.parentElement;
      if (node.data.trim() && parent.checkVisibility() && !parent.closest('noscript')) found.push([parent, node.data]);
    }"""


def test_no_text_is_smaller_than_twelve_pixels(page: Browser) -> None:
    script = "return found.filter(([at]) => parseFloat(getComputedStyle(at).fontSize) < 12).map(([, text]) => text)"
    for width, height, touch in (*SIZES, (960, 600, False)):
        page.size(width, height, touch)
        assert page.run(TEXTS + script) == [], (width, height)
        assert page.run("return document.documentElement.scrollWidth") <= width


CONTRAST = """
    const parts = (text) => text.match(/[\\d.]+/g).map(Number);
    const light = (colour) => parts(colour).slice(0, 3).map((c) => c / 255)
      .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
      .reduce((sum, c, k) => sum + c * [0.2126, 0.7152, 0.0722][k], 0);
    const clear = (e) => e && (Number(getComputedStyle(e).opacity) < 1 || clear(e.parentElement));
    const ground = (e) => {
      const colour = getComputedStyle(e).backgroundColor;
      return (parts(colour)[3] ?? 1) === 1 || !e.parentElement ? colour : ground(e.parentElement);
    };
    return found.filter(([at]) => !clear(at) && !at.closest('.camera, #overlay')).map(([at, text]) => {
      const [low, high] = [light(getComputedStyle(at).color), light(ground(at))].sort((a, b) => a - b);
      return [text, (high + 0.05) / (low + 0.05)];
    }).filter(([, contrast]) => contrast < 4.5)"""


def test_every_text_can_be_read_and_every_control_has_a_name(page: Browser) -> None:
    """WCAG AA, light and dark, with an alarm; what a screen reader is told."""
    page.tap("Escape", "Escape")
    wait_for(lambda: page.text("#trip"), "the alarm")
    for _ in range(2):
        assert page.run(TEXTS + CONTRAST) == []
        page.click("#theme")
        wait_for(lambda: page.run("return !document.getAnimations().length"), "the other colours")
    nodes = page.cdp("Accessibility.getFullAXTree")["nodes"]
    controls = [node for node in nodes if node.get("role", {}).get("value") in ("button", "slider", "image")]
    assert len(controls) > 15
    assert [node for node in controls if not node["ignored"] and not node["name"]["value"]] == []


def test_every_key_that_drives_is_named_on_a_screen_with_a_keyboard(page: Browser) -> None:
    """960x600 is a laptop's window at 150 % zoom."""
    for size in ((1440, 900), (1024, 768), (960, 600)):
        page.size(*size)
        shown = page.run(
            """return [...document.querySelectorAll('.discs kbd, #home kbd')]
                   .filter((one) => one.checkVisibility())
                   .filter((one) => one.getBoundingClientRect().bottom <= innerHeight)
                   .map((one) => one.textContent)"""
        )
        assert set(shown) == {"Q", "E", "arrows", "G", "H", "W A S D", "I J K L", "Home"}, size
        assert page.run("return [...document.querySelectorAll('.pad')].every((one) => !one.checkVisibility())")


def test_the_keys_of_the_gripper_stand_beside_what_they_do(page: Browser) -> None:
    top = {name: page.place(f"#gripper {name}")["y"] for name in (".top", ".bottom", ".closing", ".opening")}
    assert sorted(top, key=top.__getitem__) == [".closing", ".top", ".bottom", ".opening"]
    assert (page.text("#gripper .closing"), page.text("#gripper .top")) == ("G", "closed")
    assert (page.text("#gripper .opening"), page.text("#gripper .bottom")) == ("H", "open")
    for key, code, place in (("g", "KeyG", "100"), ("h", "KeyH", "0")):
        page.key(code, key, True)
        wait_for(lambda place=place: page.run("return gripper.ariaValueNow") == place, "the slider to get there")
        page.key(code, key, False)


def test_the_knob_covers_no_label(page: Browser) -> None:
    """Wherever it is pushed, its label lies above it."""
    with page.drag("dpad", 0.0, 1.0):
        above = """const r = document.querySelector('[data-disc="dpad"] .up').getBoundingClientRect();
            const e = document.querySelector('[data-disc="dpad"]');
            for (const one of e.children) one.style.pointerEvents = 'auto';
            const top = document.elementFromPoint(r.left + r.width / 2, r.top + r.height / 2);
            for (const one of e.children) one.style.pointerEvents = '';
            return top.className"""
        assert page.run(above) == "up"


def test_only_buttons_that_do_something_are_shown(page: Browser) -> None:
    labels = page.run("return [...document.querySelectorAll('.buttons button')].filter((one) => one.checkVisibility())")
    assert labels == [], "the default mapping gives no button but the way home a meaning"


def test_a_newcomer_moves_the_arm_by_what_the_page_says(bench: Bench, page: Browser) -> None:
    """An arrow alone shows which one key is missing; with that one, the arm moves."""

    def try_keys() -> None:
        wait_for(lambda: page.text("#waiting") == "Stopped. Hold Space to move.", "the advice", BRIEF)
        page.key("ArrowUp", "ArrowUp", True)
        wait_for(lambda: "Space too" in page.text("#waiting"), "the hint", BRIEF)
        assert page.run("return document.querySelector('#waiting').dataset.tone") == "strong"
        page.hold()
        wait_for(lambda: bench.tcp_speed[0] > 0.05, "motion", BRIEF)
        page.let_go()
        page.key("ArrowUp", "ArrowUp", False)
        wait_for(lambda: "Space too" not in page.text("#waiting"), "the hint to go", BRIEF)

    undisturbed(bench, page, try_keys)


@pytest.mark.parametrize("what", ["a reload", "the end of the tour"])
def test_an_intended_stop_is_no_alarm(bench: Bench, page: Browser, what: str) -> None:
    if what == "a reload":
        page.hold()
        wait_for(lambda: bench.deadman.held, "the dead-man")
        page.open(bench.link)
        page.wait_driving()
        words = "closed", "no longer connected"  # its last message may be lost
    else:
        page.click("#demo")
        wait_for(lambda: bench.speed() > 0.05, "the tour to move the arm")
        page.click("#demo")
        words = ("tour has ended",)

    def told() -> bool:
        text = page.text("#trip")
        return any(word in text for word in words) and "Hold Space to continue" in text

    wait_for(told, "what happened")
    assert not page.run("return document.querySelector('#trip').classList.contains('alarm')")
    assert page.run("return document.querySelector('#status-lamp').dataset.tone") == "calm"
    page.let_go()


def test_backspace_stops_as_in_a_terminal(bench: Bench, page: Browser) -> None:
    page.tap("Backspace", "Backspace")
    wait_for(lambda: bench.trip == "stop", "the stop")
    wait_for(lambda: "Stopped by STOP (you," in page.text("#trip"), "the page to say who stopped it")
    assert page.run("return document.querySelector('#trip').classList.contains('alarm')")


def test_two_thumbs(bench: Bench, page: Browser) -> None:
    """One on the dead-man, the other one on a disc; lifting the first stops the arm."""
    page.size(844, 390, touch=True)
    hold, disc = page.place("#hold"), page.place('[data-disc="dpad"]')
    left = {"x": hold["x"], "y": hold["y"], "id": 1}
    right = {"x": disc["x"], "y": disc["y"], "id": 2}
    page.cdp("Input.dispatchTouchEvent", type="touchStart", touchPoints=[left])
    wait_for(lambda: bench.deadman.held, "the thumb to hold")
    page.cdp("Input.dispatchTouchEvent", type="touchStart", touchPoints=[left, right])
    right["x"] -= 0.5 * disc["width"]
    page.cdp("Input.dispatchTouchEvent", type="touchMove", touchPoints=[left, right])
    wait_for(lambda: bench.tcp_speed[1] > 0.1, "motion")
    page.cdp("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[left])
    wait_for(lambda: not bench.deadman.held and bench.rests(), "the arm to rest")
    page.cdp("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
