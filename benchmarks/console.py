"""The console: latency from a key to a set-point, and times until the arm brakes. Needs Chromium."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from .kit import ROOT, Table, ms

sys.path.append(str(ROOT / "tests"))
from browser.kit import Bench, Browser, wait_for

PATHS = ("drivers/web", "hal/views.py")


def latencies(presses: int) -> list[float]:
    """Return the times from a key's event in the page to the first set-point that moves, s."""
    bench, browser, found = Bench(), Browser(), []
    try:
        browser.open(bench.link)
        browser.wait_driving()
        # The event's own time stamp, by the wall clock that all processes of this machine share.
        browser.run(
            """const note = (event) => { if (!event.repeat) window.t0 = performance.timeOrigin + event.timeStamp };
               window.addEventListener('keydown', note, true)"""
        )
        for turn in range(presses):
            browser.hold()
            wait_for(lambda: bench.status == "following", "the arm to follow")
            time.sleep(0.1 + 0.0137 * (turn % 7))  # not in step with the app's loop
            key = ("ArrowLeft", "ArrowRight")[turn % 2]
            shift = time.time() - time.monotonic()
            moved: list[float] = []
            watch = threading.Thread(target=_note_motion, args=(bench, moved))  # the call that presses returns late
            watch.start()
            browser.key(key, key, True)
            watch.join()
            found.append(moved[0] - (browser.run("return window.t0") / 1e3 - shift))
            browser.key(key, key, False)
            browser.let_go()
            wait_for(lambda: bench.speed() == 0.0, "the arm to rest")
    finally:
        browser.close()
        bench.close()
    return found


def _note_motion(bench: Bench, moved: list[float]) -> None:
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        servo = bench.servo
        if any(servo.dq_set):
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
    "key released (reference)": lambda browser: _act(browser.let_go),
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
    table.add("from a key in the page to a set-point that moves", ms(latencies(presses), 0.5, 0.99))
    for name, way in list(STOPS.items())[: 1 if quick else None]:
        table.add(f"{name}: braking begins after", None, ms([braking(way) for _ in range(runs)]))
    yield table
