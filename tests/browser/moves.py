"""Actions on a page that several tests share."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import pytest

from .kit import TRIES, Bench, Browser, disturbed, wait_for

BRIEF = 8.0
"""s until a try is given up; a page that is heard moves the arm within 0.2 s."""


def undisturbed(bench: Bench, page: Browser, attempt: Callable[[], None], losses: Sequence[str] = ()) -> None:
    """Do it, and anew where it failed while the machine was too busy for the page or the app to be heard in time.

    Then the arm has to stop, and a press does not count: that is no failure of what is tested here. Between two tries
    everything is let go of. ``losses`` are what the page's log has where it lets go for that reason itself.
    """
    for turn in range(TRIES):
        began, before = time.monotonic(), sum(lines(page, words) for words in losses)
        try:
            attempt()
            return
        except (AssertionError, pytest.fail.Exception):
            lost = sum(lines(page, words) for words in losses) > before
            if turn == TRIES - 1 or not (lost or disturbed(began)):
                raise
        let_go_of_all(page)
        wait_until_released(bench)


def wait_until_released(bench: Bench) -> None:
    pad, deadman = bench.session.pad, bench.deadman
    wait_for(lambda: pad.state().connected and not deadman.held and not pad.waiting_for, "everything to be released")


def clear_trip(bench: Bench, page: Browser) -> None:
    """What latched a stop is over: a press and a release, as a person does it."""

    def press() -> None:
        if bench.trip != "none":
            page.hold()
            wait_for(lambda: bench.trip == "none", "the press to count", BRIEF)
            page.let_go()
            wait_until_released(bench)
            wait_for(lambda: bench.status == "holding", "the arm to rest", BRIEF)

    undisturbed(bench, page, press)


def drive_left(bench: Bench, page: Browser, speed: float = 0.1) -> None:
    """Hold the dead-man and go to the left, until it goes so fast, m/s."""

    def press() -> None:
        page.hold()
        page.key("ArrowLeft", "ArrowLeft", True)
        wait_for(lambda: bench.tcp_speed[1] > speed, "motion", BRIEF)

    undisturbed(bench, page, press)


def let_go_of_all(page: Browser) -> None:
    page.key("ArrowLeft", "ArrowLeft", False)
    page.let_go()
    page.run("window.rest?.()")  # the hands of a headset


def lines(page: Browser, words: str) -> int:
    script = """return [...log.children].filter((one) => one.dataset.text.includes(arguments[0]))
        .reduce((sum, one) => sum + Number(one.dataset.count), 0)"""
    return int(page.run(script, words))
