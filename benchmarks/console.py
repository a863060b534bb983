"""The console: latency from a key or a hand to a set-point, and times until the arm brakes. Needs Chromium, and npm."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from typing import Any

import pytest

from .kit import ROOT, Table, ms

sys.path.append(str(ROOT / "tests"))
from browser.kit import Bench, Browser, wait_for
from browser.test_headset import WEAR, load_iwer, rest, squeeze, wear

PATHS = ("drivers/web", "hal/views.py")
_TREMBLE = 1e-2
"""Speed of a joint's set-point, rad/s, that no hand reaches which holds still."""


def latencies(presses: int) -> tuple[list[float], list[float], float]:
    """Return the times from a key's event in the page to the first set-point that moves, and to braking, s.

    The last is the time from opening the link to the first motion, for somebody who knows the keys.
    """
    found: tuple[list[float], list[float]] = [], []
    with closing(Bench()) as bench, closing(Browser()) as browser:
        opened, first = time.monotonic(), 0.0
        browser.open(bench.link)
        browser.wait_driving()
        # The event's own time stamp, by the wall clock that all processes of this machine share.
        browser.run(
            """const note = (event) => { if (!event.repeat) window.t0 = performance.timeOrigin + event.timeStamp };
               for (const type of ['keydown', 'keyup']) window.addEventListener(type, note, true)"""
        )
        for turn in range(presses):
            browser.hold()
            wait_for(lambda: bench.status == "following", "the arm to follow")
            _wait_out_of_step(turn)
            key = ("ArrowLeft", "ArrowRight")[turn % 2]
            moved: list[float] = []
            watch = threading.Thread(target=_note_motion, args=(bench, moved))  # the call that presses returns late
            watch.start()
            browser.key(key, key, True)
            watch.join()
            found[0].append(moved[0] - _time_of(browser))
            first = first or moved[0] - opened
            browser.let_go()
            wait_for(lambda: bench.speed() == 0.0, "the arm to rest")
            found[1].append(bench.servo.t_stop - _time_of(browser))
            browser.key(key, key, False)
    return *found, first


def hand_latencies(presses: int) -> tuple[list[float], list[float]]:
    """Return the times from a headset's picture to the first set-point that moves, and from a release to braking, s.

    The picture is the first one that shows the hand elsewhere. Meta's emulator plays the headset, 60 pictures a second.
    """
    found: tuple[list[float], list[float]] = [], []
    with closing(Bench()) as bench, closing(Browser()) as browser:
        browser.cdp("Page.addScriptToEvaluateOnNewDocument", source=load_iwer(ROOT / ".pytest_cache/d/iwer") + WEAR)
        browser.open(bench.link)
        browser.wait_driving()
        browser.run(
            """const next = XRSession.prototype.requestAnimationFrame;
               XRSession.prototype.requestAnimationFrame = function (call) {
                 return next.call(this, (...now) => {
                   if (window.moved) window.t0 = performance.timeOrigin + performance.now();
                   window.moved = false;
                   call(...now);
                 });
               }"""
        )
        wear(browser)
        for turn in range(3 * presses):
            if len(found[1]) == presses:
                break
            rest(bench, browser)
            squeeze(bench, browser)
            with suppress(pytest.fail.Exception):
                wait_for(lambda: bench.status == "following", "the arm to follow", 2.0)
            if bench.status != "following":  # the page hung, and let go
                continue
            _wait_out_of_step(turn)
            moved: list[float] = []
            watch = threading.Thread(target=_note_motion, args=(bench, moved, _TREMBLE))
            watch.start()
            browser.run("window.moved = true; hand.position.x += arguments[0]", (0.05, -0.05)[turn % 2])
            watch.join()
            if not moved:  # the page hung, and let go
                continue
            found[0].append(moved[0] - _time_of(browser))
            browser.run("hand.updateButtonValue('squeeze', 0); t0 = performance.timeOrigin + performance.now()")
            wait_for(lambda: bench.speed() == 0.0, "the arm to rest")
            found[1].append(bench.servo.t_stop - _time_of(browser))
    return found


def _wait_out_of_step(turn: int) -> None:
    """Wait so that events come at every place of the loops' periods."""
    time.sleep(0.15 + 0.0137 * (turn % 7))


def _time_of(browser: Browser) -> float:
    """Return the time of the newest event in the page, s, monotonic."""
    return float(browser.run("return t0")) / 1e3 - time.time() + time.monotonic()


def _note_motion(bench: Bench, moved: list[float], least: float = 0.0) -> None:
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        servo = bench.servo
        if max(map(abs, servo.dq_set)) > least:
            moved.append(servo.t_written)
            return
        time.sleep(0.0005)


def _act(action: Callable[[], Any]) -> float:
    now = time.monotonic()
    action()
    return now


def _kill(browser: Browser) -> None:
    for pid in browser.processes():
        os.kill(pid, signal.SIGKILL)


STOPS: dict[str, Callable[[Browser], float]] = {
    "stop by Esc": lambda browser: _act(lambda: browser.key("Escape", "Escape", True)),
    "page reloaded": lambda browser: _act(lambda: browser.run("location.reload()")),
    "browser killed": lambda browser: _act(lambda: _kill(browser)),
    "browser frozen (SIGSTOP)": lambda browser: browser.freeze(),
}


def braking(way: Callable[[Browser], float]) -> float:
    """Return the time from an event in the browser to the start of braking, at full speed, s."""
    bench, browser = Bench(), Browser()
    try:
        browser.open(bench.link)
        browser.wait_driving()
        wait_for(lambda: bench.session.pad.state().connected, "the pad")
        browser.hold()
        browser.key("ArrowLeft", "ArrowLeft", True)
        wait_for(lambda: bench.tcp_speed[1] > 0.15, "full speed")
        event = way(browser)
        wait_for(lambda: bench.speed() == 0.0, "the arm to rest")
        return bench.servo.t_stop - event
    finally:
        browser.close()
        bench.close()


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    presses, runs = (1, 1) if quick else (60, 6)
    table = Table(f"times, ms, of {presses} presses and {runs} of each event", ("", "p50, p99", "median (max)"))
    moves, releases, first = latencies(presses)
    table.add("link opened, to the first motion by a key", None, ms([first]))
    table.add("key pressed, to a set-point that moves", ms(moves, 0.5, 0.99))
    table.add("key released, to braking", ms(releases, 0.5, 0.99))
    if shutil.which("npm"):
        moves, releases = hand_latencies(presses)
        table.add("picture that shows a hand moved, to a set-point that moves", ms(moves, 0.5, 0.99))
        table.add("squeeze released, to braking", ms(releases, 0.5, 0.99))
    for name, way in list(STOPS.items())[: 1 if quick else None]:
        table.add(f"{name}: braking begins after", None, ms([braking(way) for _ in range(runs)]))
    yield table
