"""The panel of a program that records: what it shows, and how the page in control steers it."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from dataclasses import replace

import pytest

from hal.views import ACTIONS, RecordingView

from .kit import Bench, Browser, wait_for

READY = RecordingView(
    phase="ready",
    prompt="Press Record, then put the cube on the plate",
    task="the cube on the plate",
    episode=22,
    saved=2,
    wanted=10,
    succeeded=2,
    failed=0,
    discarded=1,
    seconds=0.0,
    frames=0,
    dropped=0,
    free_bytes=41_200_000_000,
    trouble="",
    actions=("record",),
)
RUNNING = replace(READY, phase="recording", seconds=12.34, frames=370, actions=("finish", "fail", "discard"))


@pytest.fixture
def asked(bench: Bench) -> Iterator[queue.SimpleQueue[str]]:
    """What pages ask for."""
    found: queue.SimpleQueue[str] = queue.SimpleQueue()
    bench.console.on_action(found.put)
    yield found
    assert found.empty(), "one press is one wish"


def show(bench: Bench, page: Browser, view: RecordingView) -> None:
    """Until the page shows it."""
    bench.console.show_recording(view)
    wait_for(lambda: page.text("#recording-prompt") == view.prompt and page.text("#recording"), "the panel")
    wait_for(lambda: (page.facts["recording"] or {}).get("frames") == view.frames, "the newest view")


def enabled(page: Browser) -> list[str]:
    """The actions whose buttons may be pressed."""
    script = """return [...document.querySelectorAll('[data-action]')]
        .filter((one) => one.checkVisibility() && one.ariaDisabled !== 'true').map((one) => one.dataset.action)"""
    return list(page.run(script))


def button(action: str) -> str:
    return f'[data-action="{action}"]'


def test_the_panel_is_there_once_a_recording_was_shown(bench: Bench, page: Browser) -> None:
    assert page.text("#recording") == "", "this program records nothing"
    assert page.run("return document.documentElement.dataset.recording ?? null") is None
    before = page.place("#hold")
    show(bench, page, READY)
    assert page.place("#hold") == before, "nothing moves under a hand"
    assert page.text("#recording-phase") == "ready"
    assert (page.text("#recording-episode"), page.text("#recording-saved")) == ("3 of 10", "2 of 10 saved")
    assert page.text("#recording-free") == "41.2 GB"
    assert (page.text("#rec"), page.text("#recording-trouble")) == ("", "")
    assert enabled(page) == ["record"]
    show(bench, page, RUNNING)
    assert (page.text("#rec"), page.text("#recording-rows")) == ("REC 12.3 s", "370")
    assert page.run("return document.title").startswith("REC 12 s")
    assert enabled(page) == ["finish", "fail", "discard"]


def test_trouble_and_dropped_rows_stand_out(bench: Bench, page: Browser) -> None:
    show(bench, page, replace(RUNNING, frames=371))
    colour = "return getComputedStyle(document.querySelector(arguments[0])).color"
    calm = page.run(colour, "#recording-dropped")
    show(bench, page, replace(RUNNING, frames=372, dropped=2, trouble="less than 1 GB is free"))
    assert page.text("#recording-trouble") == "less than 1 GB is free"
    assert page.run(colour, "#recording-dropped") == page.run(colour, "#recording-trouble") != calm
    assert page.run("return document.querySelector('#rec-lamp').dataset.tone") == "alarm", "also where it is far away"


def test_a_program_that_is_silent_while_it_records_is_shown(bench: Bench, page: Browser) -> None:
    show(bench, page, RUNNING)
    lamp = "return document.querySelector('#recording-lamp').dataset.tone"
    wait_for(lambda: page.run(lamp) == "alarm", "the page to doubt it")
    show(bench, page, replace(RUNNING, frames=400))
    assert page.text("#recording-phase") == "recording"


def test_a_press_reaches_the_program_and_leaves_a_held_dead_man_alone(bench, page, asked):
    show(bench, page, replace(READY, actions=ACTIONS))
    page.hold()
    wait_for(lambda: bench.deadman.held, "the dead-man")
    for action in ACTIONS:
        page.click(button(action))
        assert asked.get(timeout=20.0) == action
    assert bench.deadman.held
    assert bench.trip == "none"
    assert page.run("return document.activeElement === document.body"), "or Space would press the button"
    page.let_go()
    at = page.place(button("discard"))
    page.mouse("mousePressed", at["x"], at["y"])
    page.mouse("mouseMoved", at["x"], at["bottom"] + 40)
    page.mouse("mouseReleased", at["x"], at["bottom"] + 40)
    page.click(button("record"))
    assert asked.get(timeout=20.0) == "record", "who slides off a button has thought better of it"


def test_a_second_thumb_presses_while_the_first_one_holds(bench, page, asked):
    page.size(390, 844, touch=True)
    show(bench, page, READY)
    hold, record = page.place("#hold"), page.place(button("record"))
    assert record["bottom"] <= 844, "in view without scrolling"
    thumbs = [{"x": hold["x"], "y": hold["y"], "id": 1}, {"x": record["x"], "y": record["y"], "id": 2}]
    page.cdp("Input.dispatchTouchEvent", type="touchStart", touchPoints=thumbs[:1])
    wait_for(lambda: bench.deadman.held, "the thumb to hold")
    page.cdp("Input.dispatchTouchEvent", type="touchStart", touchPoints=thumbs)
    page.cdp("Input.dispatchTouchEvent", type="touchEnd", touchPoints=thumbs[1:])
    assert asked.get(timeout=20.0) == "record"
    assert bench.deadman.held
    page.cdp("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    wait_for(lambda: not bench.deadman.held, "the release")


def test_a_page_without_control_steers_no_recording(bench: Bench, page: Browser, asked: queue.SimpleQueue[str]) -> None:
    show(bench, page, READY)
    page.run(
        """const socket = new WebSocket(`ws://${location.host}/live`, ['hal.v1', location.hash.slice(1)]);
           window.refusals = [];
           socket.onopen = () => socket.send(JSON.stringify({type: 'action', action: 'record'}));
           socket.onmessage = (event) => {
             const message = JSON.parse(event.data);
             if (message.type === 'refused') { window.refusals.push(message.why); socket.close(); }
           };"""
    )
    wait_for(lambda: page.run("return window.refusals.length"), "a further page to be refused")
    assert "only the page in control" in page.run("return window.refusals[0]")
    page.click("#lease")
    wait_for(lambda: not page.facts["driving"], "the page to let go")
    wait_for(lambda: enabled(page) == [], "the buttons to say so")
    page.click(button("record"))
    page.click("#lease")
    page.wait_driving()
    wait_for(lambda: enabled(page) == ["record"], "the buttons of the page that drives")


def test_keys_press_the_buttons_of_the_pad_that_do_the_same(bench: Bench, page: Browser) -> None:
    bench.console.explain(bench.session.teleop.labels(actions=("home", *ACTIONS)))
    show(bench, page, READY)
    script = "return [...document.querySelectorAll('#legend tr')].map((row) => row.textContent)"
    wait_for(lambda: "1record" in page.run(script), "the legend")
    assert {"0finish", "3fail", "2discard"} <= set(page.run(script))
    assert page.text(button("record")).split() == ["Record", "1"]
    assert page.text(button("finish")).split() == ["Save", "0"]
    for key, name in (("1", "south"), ("0", "home")):
        page.key(f"Digit{key}", key, True)
        wait_for(lambda name=name: bench.session.pad.state().pressed(name), f"{name} to be pressed")
        page.key(f"Digit{key}", key, False)
        wait_for(lambda name=name: not bench.session.pad.state().pressed(name), f"{name} to be let go of")


@pytest.mark.parametrize(
    ("phase", "title"), [("done", "The program has finished: 2 episodes saved"), ("saving", "The program has ended")]
)
def test_a_run_that_ends_by_itself_is_no_alarm(browser: Browser, phase: str, title: str) -> None:
    program = Bench()
    try:
        browser.open(program.link)
        browser.wait_driving()
        show(program, browser, replace(READY, actions=()))
        program.console.show_recording(replace(READY, phase=phase, prompt="", actions=()))
    finally:
        program.close()
    wait_for(lambda: browser.text("#overlay-title").lower() == title.lower(), title)
    assert "stopped" not in browser.text("#overlay")
    browser.chrome.get("about:blank")
    browser.complaints()  # that nobody answers any more


@pytest.mark.parametrize(
    ("view", "words"),
    [(RUNNING, "the arm has been stopped"), (replace(READY, phase="done", saved=1), "has finished: 1 episode saved")],
    ids=["recording", "done"],
)
def test_a_link_that_breaks_is_an_alarm_unless_the_run_was_done(bench, page, view, words):
    show(bench, page, view)
    page.run(
        """const {send} = WebSocket.prototype, title = document.querySelector('#overlay-title');
           const look = new MutationObserver(() => (window.told ??= title.textContent));
           look.observe(title, {childList: true, subtree: true});
           WebSocket.prototype.send = function () { WebSocket.prototype.send = send; this.close(); };"""
    )
    wait_for(lambda: page.run("return window.told"), "the page to say that it has no connection")
    assert words in page.run("return window.told")
