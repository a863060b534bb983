"""The console of a real rig when things go wrong around it: its process, its threads, a tour that is stopped."""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
from web_kit import REST, Page

import hal
from hal.views import RecordingView

L2, PRESSED = 1 << 6, [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
WAIT = 20.0


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    opened = hal.open("panda_table", sim=True, pad="web", listen=":0", overrides=["cameras={}"])
    yield opened
    opened.close()


def console(rig: hal.Rig) -> Any:
    return rig.console


def page_of(rig: hal.Rig) -> Page:
    parts = urlsplit(console(rig).link)
    return Page(SimpleNamespace(url=f"http://{parts.netloc}", tls=True), token=parts.fragment)


async def until(condition: Callable[[], Any], page: Page | None = None, **pad: Any) -> None:
    """Wait, while the page says how its pad stands."""
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline, "it never came"
        if page is not None:
            await page.drive(**pad)
        await asyncio.sleep(0.01)


def process_of(rig: hal.Rig) -> int:
    return int(console(rig)._child.process.pid)


def view(frames: int, *actions: str) -> RecordingView:
    """How a recording goes, after so many rows."""
    counts = {"episode": 0, "saved": 0, "wanted": 3, "succeeded": 0, "failed": 0, "discarded": 0, "dropped": 0}
    words = {"phase": "recording", "prompt": "drive", "task": "the task", "trouble": ""}
    return RecordingView(**words, **counts, seconds=0.1, frames=frames, free_bytes=10**10, actions=actions)


def speed(rig: hal.Rig) -> float:
    return float(abs(rig.robots["panda"].state(max_age=5.0).dq_set).max())


async def test_a_stop_is_heard_after_a_mistake_in_what_came_before(rig, monkeypatch, capfd):
    def fails(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(console(rig), "_start_recovery", fails)
    async with page_of(rig) as page:
        await page.take()
        await page.say(type="recover", robot="panda")
        await page.say(type="stop")
        await until(lambda: rig._latch.stopped)
    assert "can't start new thread" in capfd.readouterr().err


async def test_only_one_recovery_at_a_time(rig: hal.Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[float] = []
    refused = threading.Event()

    def slow() -> None:
        calls.append(time.monotonic())
        refused.wait(WAIT)

    monkeypatch.setattr(rig.robots["panda"], "recover", slow)
    async with page_of(rig) as page:
        await page.take()
        for _ in range(20):
            await page.say(type="recover", robot="panda")
        assert "already" in (await page.next("refused"))["why"]
        assert len(calls) == 1
        refused.set()


async def test_a_console_that_is_killed_leaves_no_stick_pushed_and_says_so(rig, capfd):
    pad = rig.gamepads["pad"]
    async with page_of(rig) as page:
        await page.take()
        await until(lambda: pad.state().connected, page)
        await until(lambda: pad.state().axis("left_x") > 0.9, page, axes=[1.0, *REST[1:]])
        os.kill(process_of(rig), signal.SIGKILL)
        await until(lambda: not pad.state().connected)
    assert pad.state().axis("left_x") == 0.0
    assert "no page can drive or stop" in capfd.readouterr().err


@pytest.mark.slow
def test_a_console_that_is_stopped_does_not_hold_up_the_end(rig: hal.Rig) -> None:
    os.kill(process_of(rig), signal.SIGSTOP)
    for k in range(3000):  # more than fits into the channel
        rig.say(f"line {k} of what nobody hears" + 200 * ".")
    begin = time.monotonic()
    rig.close()
    assert time.monotonic() - begin < 20.0, "it would be 35 s if the end waited for an answer"


@pytest.mark.slow
@pytest.mark.pair
async def test_a_stop_ends_the_tour_for_good(rig: hal.Rig) -> None:
    arm, pad = rig.robots["panda"], rig.gamepads["pad"]
    teleop = hal.Teleop(arm)
    async with page_of(rig) as page:
        await page.take()
        await until(lambda: pad.state().connected, page)
        await page.say(type="demo", play=True)
        with arm.control(deadman=pad.hold("l2"), rate_hz=20) as control:

            def turn() -> None:
                with contextlib.suppress(hal.MotionStopped):
                    control.send(teleop.step(pad.state(), 0.05)[0])

            async def drive(condition: Callable[[], Any], seconds: float = WAIT) -> bool:
                deadline = time.monotonic() + seconds
                while not condition() and time.monotonic() < deadline:
                    turn()
                    await page.drive()
                    await asyncio.sleep(0.02)
                return bool(condition())

            assert await drive(lambda: speed(rig) > 0.05), "the tour moves the arm"
            await page.say(type="stop")
            assert await drive(lambda: control.trip is hal.Trip.STOP and speed(rig) == 0.0), "the arm stops"
            assert not await drive(lambda: speed(rig) > 1e-6, seconds=9.0), "the recording's next press is no press"


async def test_a_recording_is_steered_from_the_page_and_a_mistake_in_the_app_costs_nothing_else(rig, capfd):
    asked: queue.SimpleQueue[str] = queue.SimpleQueue()

    def take(action: str) -> None:
        asked.put(action)
        if action == "fail":
            raise RuntimeError("the disk is gone")

    async with page_of(rig) as page:
        await page.take()
        console(rig).show_recording(view(0, "record", "fail"))
        await page.next("recording")
        console(rig).on_action(take)
        await page.say(type="action", action="fail")
        await page.say(type="action", action="record")
        await until(lambda: asked.qsize() == 2)
        await page.say(type="stop")
        await until(lambda: rig._latch.stopped)
    assert [asked.get(), asked.get()] == ["fail", "record"]
    assert "the disk is gone" in capfd.readouterr().err


async def test_a_console_that_is_stopped_holds_up_no_recording_and_shows_the_newest_later(rig: hal.Rig) -> None:
    """Nor does what is said so often push out what was said once."""
    os.kill(process_of(rig), signal.SIGSTOP)
    try:
        rig.say("said before")
        begin = time.monotonic()
        for frames in range(20_000):
            console(rig).show_recording(view(frames))
        assert time.monotonic() - begin < 15.0, "it waits for nobody"
    finally:
        os.kill(process_of(rig), signal.SIGCONT)
    async with page_of(rig) as page:
        while (await page.next("recording"))["frames"] != 19_999:
            pass
    async with page_of(rig) as page:
        while (await page.next("say"))["text"] != "said before":
            pass
