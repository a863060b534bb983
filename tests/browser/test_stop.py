"""The confirmation of STOP, and the alarm without it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest

import hal

from .cable import Cable
from .kit import Bench, Browser, wait_for
from .moves import BRIEF, drive_left, let_go_of_all, lines, undisturbed

ALARM = "#alarm"


@pytest.fixture(autouse=True)
def nothing_is_left(bench: Bench) -> Iterator[None]:
    """Far from where a test left the arm, so that no limit is near in the next one."""
    yield
    bench.rig.world.reset("panda")


def alarm(page: Browser) -> str:
    return page.text(ALARM)


def quiet(page: Browser, seconds: float = 0.8) -> bool:
    """No alarm for longer than a stop may take to be confirmed."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if alarm(page):
            return False
        time.sleep(0.02)
    return True


def test_a_confirmed_stop_raises_no_alarm(bench: Bench, page: Browser) -> None:
    def stop() -> None:
        drive_left(bench, page)
        before = lines(page, "STOP was sent")
        page.click("#stop")
        wait_for(lambda: bench.trip == "stop", "the stop", BRIEF)
        assert quiet(page)
        page.click("#stop")  # an arm that is stopped for this or another reason shows just that
        assert quiet(page)
        assert lines(page, "STOP was sent") == before + 2

    undisturbed(bench, page, stop)
    let_go_of_all(page)


def test_the_banner_names_who_stopped_however_late_the_arm_shows_it(bench, page, monkeypatch):
    stop = bench.rig.stop

    def stop_late() -> None:
        drive_left(bench, page)
        with monkeypatch.context() as late:
            late.setattr(bench.rig, "stop", lambda: threading.Timer(0.3, stop).start())
            page.click("#stop")
            wait_for(lambda: page.text("#trip-text"), "the stop", BRIEF)
        assert page.text("#trip-text").startswith("Stopped by STOP (you, ")

    undisturbed(bench, page, stop_late)
    let_go_of_all(page)


def test_a_stop_with_nothing_to_stop(page: Browser) -> None:
    """No program drives the arm: nothing is latched, and nothing moves."""
    with hal.open("panda_table", sim=True, pad="web", listen=":0", overrides=["cameras={}"]) as rig:
        page.open(rig.console.link)
        wait_for(lambda: page.facts.get("lastState"), "a state")
        assert page.facts["lastState"]["robots"]["panda"]["status"] == "idle"
        page.click("#stop")
        assert quiet(page)
        assert lines(page, "STOP was sent") == 1


def test_a_stop_without_effect_raises_the_alarm(bench: Bench, page: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is heard, and the arm goes on."""

    def stop_in_vain() -> None:
        drive_left(bench, page)
        with monkeypatch.context() as broken:
            broken.setattr(bench.rig, "stop", lambda: None)
            page.click("#stop")
            wait_for(lambda: "STOP was not confirmed: use the robot's own stop" in alarm(page), "the alarm", BRIEF)
            assert "panda is " in alarm(page)
            page.click("#alarm-close")
            wait_for(lambda: not alarm(page), "the alarm to be closed", BRIEF)
            page.click("#stop")
            wait_for(lambda: alarm(page), "the alarm", BRIEF)
            time.sleep(0.3)
            assert alarm(page), "it stays"
        page.click("#stop")
        wait_for(lambda: bench.trip == "stop", "the stop", BRIEF)
        wait_for(lambda: not alarm(page), "the alarm to end with what it tells", BRIEF)

    undisturbed(bench, page, stop_in_vain)
    let_go_of_all(page)


def on_top(page: Browser, selector: str) -> Any:
    script = """const r = document.querySelector(arguments[0]).getBoundingClientRect();
        return document.elementFromPoint(r.x + r.width / 2, r.y + r.height / 2).closest(arguments[0]) !== null"""
    return page.run(script, selector)


def test_a_stop_that_never_arrives_raises_the_alarm(bench: Bench, page: Browser) -> None:
    """The cable is pulled, and the page cannot know yet."""
    parts = urlsplit(bench.link)
    assert parts.port is not None
    cable = Cable(parts.port)
    try:
        page.open(f"http://127.0.0.1:{cable.port}/#{parts.fragment}")
        page.wait_driving()
        cable.cut()
        page.tap("Escape", "Escape")
        wait_for(lambda: "STOP was not confirmed" in alarm(page), "the alarm")
        assert "does not answer" in alarm(page)
        assert on_top(page, "#stop")
        wait_for(lambda: page.text("#overlay"), "the page to give the connection up")
        assert on_top(page, ALARM)
        before = lines(page, "STOP was sent")
        page.tap("Escape", "Escape")
        wait_for(lambda: "STOP does not reach the arm" in alarm(page), "the page to say so at once")
        assert lines(page, "STOP was sent") == before, "nothing was sent"
        cable.mend()
        wait_for(lambda: page.facts.get("connected"), "the connection")
        page.tap("Escape", "Escape")
        wait_for(lambda: bench.trip != "none", "the stop")
        wait_for(lambda: not alarm(page), "the alarm to end with what it tells")
        page.complaints()  # the browser may log the socket that it could not open
        page.chrome.get("about:blank")
    finally:
        cable.close()
