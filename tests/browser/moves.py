"""Actions on a page that several tests share."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

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


HANG = "const t = performance.now(); while (performance.now() - t < 600);"
BLUR = "window.dispatchEvent(new Event('blur')); window.dispatchEvent(new Event('focus'))"
TAKE = """window.other = new WebSocket(`ws://${location.host}/live`, ['hal.v1', location.hash.slice(1)]);
    other.onopen = () => other.send('{"type": "lease", "take": true}')"""
TROUBLE: dict[str, Callable[[Bench, Browser], object]] = {
    "the robot reports a fault": lambda bench, page: bench.arm.inject(fault="joint 3 is too warm"),
    "the robot does not answer": lambda bench, page: bench.arm.inject(disconnect=True),
    "somebody pressed STOP": lambda bench, page: page.tap("Escape", "Escape"),
    "the page's computer was busy": lambda bench, page: page.run(HANG),
    "the robot's computer was busy": lambda bench, page: stall_console(bench),
    "the page in control was closed": lambda bench, page: page.chrome.refresh(),
    "another page is in control": lambda bench, page: page.run(TAKE),
    "the window lost the keyboard": lambda bench, page: page.run(BLUR),
}
"""Rows of the table in docs/console.md -> what happens to a page in control whose arm moves."""
SHOWN = """return (overlay.hidden ? [...banners.children] : [overlay]).filter((one) => one.checkVisibility())
    .map((one) => [...one.querySelectorAll('b, span, h2, p')].map((part) => part.innerText))"""


@contextlib.contextmanager
def frozen_console(bench: Bench) -> Iterator[None]:
    """Stop the process of the console, as a busy computer does."""
    process = bench.console._child.process.pid
    os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process, signal.SIGCONT)


def stall_console(bench: Bench) -> None:
    with frozen_console(bench):
        time.sleep(0.3)


def end_trouble(bench: Bench, page: Browser) -> None:
    """Take back what lasts."""
    page.run("window.other?.close()")
    bench.arm.inject(disconnect=False, fault=None)


def row_of_docs(what: str) -> list[str]:
    """Return what the page shows, and what to do next, as patterns."""
    text = (Path(__file__).parents[2] / "docs/console.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith(f"| {what} |"))
    return [re.sub(r"\\\*[^*]*\\\*", ".*", re.escape(cell)) for cell in row.strip("| ").split(" | ")[1:]]


def shows_trouble(page: Browser, what: str) -> bool:
    """Return whether the page shows this row of the docs' table, and nothing else."""
    says, asks = row_of_docs(what)
    asks = asks.replace(r"Hold\ .*\ to\ continue", ".*")  # what is still down must be released first
    shown = page.run(SHOWN)
    if len(shown) != 1 or not re.fullmatch(says, shown[0][0], re.IGNORECASE):
        return False
    return any(re.fullmatch(asks, part) for part in shown[0][1:])
