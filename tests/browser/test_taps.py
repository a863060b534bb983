"""A press that is over at once: of a button that moves nothing it lasts until the app has looked, and nothing else."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from hal.types import BUTTONS, PAGE_AXES, PadState
from hal.views import ACTIONS

from .kit import Bench, Browser, wait_for

LOOK = 20.0
"""ms between two looks of an app at its pad."""
TAP = """
    const [target, kind] = arguments;
    if (kind === "key") {
      for (const type of ["keydown", "keyup"]) dispatchEvent(new KeyboardEvent(type, {code: target, cancelable: true}));
    } else {
      const element = document.querySelector(target);
      element.setPointerCapture = () => {};  // there is no such pointer
      for (const type of ["pointerdown", "pointerup"]) {
        element.dispatchEvent(new PointerEvent(type, {pointerId: 1, pointerType: "mouse", button: 0, buttons: 1}));
      }
    }
"""
"""A press and its release, 0 ms apart."""
LISTEN = """
    window.sent = [];
    const send = WebSocket.prototype.send;
    WebSocket.prototype.send = function (text) {
      window.sent.push({t: performance.now(), ...JSON.parse(text)});
      return send.call(this, text);
    };
"""


@pytest.fixture
def page(bench: Bench, page: Browser) -> Browser:
    """The console, of which is noted what it sends; it knows what every button does."""
    bench.console.explain(bench.session.teleop.labels(actions=("home", *ACTIONS)))
    wait_for(lambda: "record" in page.text('[data-button="south"]'), "the page to know its buttons")
    page.run(LISTEN)
    return page


@pytest.fixture
def seen(bench: Bench) -> Iterator[list[PadState]]:
    """Every state of the pad that the app could see."""
    found: list[PadState] = []
    ended, changed = threading.Event(), threading.Event()
    bench.session.pad.wake(changed)

    def collect() -> None:
        while not ended.is_set():
            if changed.wait(0.05):
                changed.clear()
                found.append(bench.session.pad.state())

    thread = threading.Thread(target=collect)
    thread.start()
    yield found
    ended.set()
    thread.join()


def tap(page: Browser, target: str) -> list[dict[str, Any]]:
    """What the page had sent of it when the hand was off again; ``target`` is a key's code or an element."""
    kind = "element" if target[0] in "#[" else "key"
    return list(page.run(f"const before = window.sent.length; {TAP} return window.sent.slice(before)", target, kind))


def presses(page: Browser, button: str) -> list[dict[str, Any]]:
    """The pad's messages from the first one in which the button is down."""
    bit = 1 << BUTTONS.index(button)
    sent = [one for one in page.run("return window.sent") if one["type"] == "pad"]
    first = next((place for place, one in enumerate(sent) if one["buttons"] & bit), len(sent))
    return [one | {"down": bool(one["buttons"] & bit)} for one in sent[first:]]


@pytest.mark.parametrize(
    ("target", "button"),
    [("Digit1", "south"), ("Digit0", "home"), ('[data-button="west"]', "west")],
)
def test_a_tap_lasts_until_the_app_has_looked(bench, page, seen, target, button):
    tap(page, target)
    wait_for(lambda: any(not one["down"] for one in presses(page, button)), "the release")
    sent = presses(page, button)
    end = next(one["t"] for one in sent if not one["down"])
    assert end - sent[0]["t"] >= 3 * LOOK, "an app that looks 50 times a second cannot miss it"
    wait_for(lambda: seen and not seen[-1].pressed(button), "the app to see the release")
    edges = [state.pressed(button) for state in seen]
    assert edges == [True, False], "one press is one press"
    assert not any(state.pressed("l2") for state in seen)


@pytest.mark.parametrize(("target", "button"), [("Space", "l2"), ("#hold", "l2"), ('[data-button="l1"]', "l1")])
def test_the_dead_man_and_what_moves_the_arm_are_over_at_once(page: Browser, target: str, button: str) -> None:
    bit = 1 << BUTTONS.index(button)
    down = [bool(one["buttons"] & bit) for one in tap(page, target)]
    assert down == [True, False]
    wait_for(lambda: len(presses(page, button)) >= 5, "further messages")
    assert [one["down"] for one in presses(page, button)[1:]].count(True) == 0


def test_a_gripper_on_its_way_delays_no_release(page: Browser) -> None:
    """Its keys send at every beat; what was sent just before a beat is no clogged connection."""
    page.key("KeyG", "g", True)
    for _ in range(8):
        assert [one["buttons"] & 1 << BUTTONS.index("l2") != 0 for one in tap(page, "Space")] == [True, False]
    moved = {one["axes"][PAGE_AXES.index("r2")] for one in page.run("return window.sent") if one["type"] == "pad"}
    assert len(moved) > 4, "the gripper was on its way"
    page.key("KeyG", "g", False)


def test_nor_is_a_key_that_pushes_an_axis(page: Browser) -> None:
    pushed = [one["axes"][PAGE_AXES.index("dpad_y")] for one in tap(page, "ArrowUp")]
    assert pushed == [1, 0]


def test_a_tap_on_the_way_home_counts_while_the_dead_man_is_held_and_never_longer(bench: Bench, page: Browser) -> None:
    tap(page, "Home")
    tap(page, "Digit4")
    page.hold()
    wait_for(lambda: bench.deadman.held, "the dead-man")
    assert [one["down"] for one in presses(page, "north")].count(True) == 1, "that was before it was held"
    page.run("window.sent.length = 0")
    page.run(f"{TAP} dispatchEvent(new KeyboardEvent('keyup', {{code: 'Space'}}));", "Home", "key")
    wait_for(lambda: len(presses(page, "north")) >= 8, "further messages")
    masks = [one["buttons"] for one in presses(page, "north")]
    assert masks[0] & 1 << BUTTONS.index("l2")
    assert not any(masks[1:]), "let go of with the dead-man"
    page.let_go()


def test_who_leaves_the_page_lets_go_of_a_tap_as_well(page: Browser) -> None:
    page.run(f"{TAP} dispatchEvent(new Event('blur'));", "Digit1", "key")
    after = "return window.sent.slice(window.sent.findIndex((one) => one.type === 'away'))"
    wait_for(lambda: sum(one["type"] == "pad" for one in page.run(after)) >= 8, "the page to go on")
    sent = page.run("return window.sent")
    away = next(place for place, one in enumerate(sent) if one["type"] == "away")
    assert any(one.get("buttons") for one in sent[:away])
    assert not any(one.get("buttons") for one in sent[away:])
