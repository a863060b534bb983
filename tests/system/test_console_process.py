"""The console's process with real sockets: whose pad arrives, what pages get, how it ends."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from child_targets import HURRY
from web_kit import TOKEN, WAIT, App, Page

from hal.drivers.web.messages import PAGE_SILENT
from hal.errors import Fault, NotSupported
from hal.servo.watchdog import PAD_SILENCE
from hal.types import RobotStatus


def gone(message: dict[str, Any]) -> bool:
    return "pad" in message and not message["pad"]["connected"]


# What they say.


async def test_malformed_messages_are_tolerated_up_to_a_limit(app: App) -> None:
    async with Page(app) as page:
        for k in range(98):
            await page.ws.send_str('{"type":"pad","seen":NaN}' if k % 2 else "[" * 4000)
        await page.ws.send_bytes(b'{"type":"stop"}')
        await page.ws.send_str("{" + " " * 4094 + "}")
        await page.take()
        await page.drive()
        assert (await app.pad())["connected"]
        await page.ws.send_str("nonsense")
        assert await page.closed() == 4400
        assert (await app.pad())["why"] == "the page in control is no longer connected"
    async with Page(app) as page:
        await page.next("hello")


async def test_a_message_that_is_too_long_ends_the_page(app: App) -> None:
    async with Page(app) as page:
        await page.ws.send_str(" " * 4097)
        assert await page.closed() == 1009
    async with Page(app) as page:
        await page.next("hello")


async def test_too_many_messages_close_the_page_and_a_stop_among_them_counts(app: App) -> None:
    async with Page(app) as page:
        await page.take()
        for _ in range(900):
            await page.ws.send_json(page.pad([1.0] * 16))
        await page.say(type="stop")
        missing = [{"stop": "page 1"}, {"driver": None}]  # in either order
        told = await app.all_until(lambda message: message in missing and (missing.remove(message) or not missing))
        assert sum("pad" in message and message["pad"]["connected"] for message in told) <= 400
        assert any(gone(message) for message in told), "it drives no more"
        assert await page.closed() == 4408


@pytest.mark.parametrize("how", ["hidden", "closed", "cut"])
async def test_a_page_that_leaves_loses_the_pad_at_once(app: App, how: str) -> None:
    async with Page(app) as page:
        await page.take()
        await page.drive([0.0] * 4 + [1.0] + [0.0] * 11, 64)
        assert (await app.pad())["connected"]
        if how == "hidden":
            await page.say(type="away", why="hidden")
        elif how == "closed":
            await page.ws.close()
        else:
            page.ws._response.connection.transport.abort()
        pad = await app.pad()
        assert not pad["connected"]
        assert pad["why"] == (
            "the page was hidden" if how == "hidden" else "the page in control is no longer connected"
        )


async def test_a_silent_page_loses_the_pad(app: App) -> None:
    async with Page(app) as page:
        await page.take()
        await page.drive()
        pad = await app.pad()
        lost = await app.pad()
        assert (lost["connected"], lost["why"]) == (False, PAGE_SILENT)
        assert lost["t"] - pad["t_alive"] > PAD_SILENCE


async def test_messages_during_a_stall_of_the_server_move_nothing(app: App) -> None:
    """The page goes on, held at full deflection; the console's process is stopped, as by a machine that swaps."""
    async with Page(app) as page:
        await page.take()
        await page.drive()
        assert (await app.pad())["connected"]
        os.kill(app.child.process.pid, signal.SIGSTOP)
        try:
            until = time.monotonic() + 0.8
            while time.monotonic() < until:
                await page.ws.send_json(page.pad([1.0] * 16, 64))
                await asyncio.sleep(0.02)
        finally:
            os.kill(app.child.process.pid, signal.SIGCONT)
        assert not (await app.pad())["connected"]
        await page.drive([0.125] * 16)
        while True:
            pad = await app.pad()
            if pad["connected"]:
                assert pad["t"] - pad["t_alive"] <= PAD_SILENCE
                if pad["axes"][0] == 0.125:
                    return


async def test_an_app_that_does_not_read_delays_no_page(app: App) -> None:
    """It is stopped for a while. Pages are answered, and what it then finds is a handful of messages, stop included."""
    async with Page(app) as page, Page(app) as watcher:
        await page.take()
        for k in range(200):
            await page.drive([k / 200.0] * 16)
            if k == 150:
                await watcher.say(type="stop")
            await asyncio.sleep(0.005)
        await page.next("state")
        told = await app.all_until(lambda message: "pad" in message and message["pad"]["axes"][0] == 199 / 200.0)
        assert {"stop": "page 2"} in told
        assert len(told) < 60


# What they are told.


async def test_states(app: App) -> None:
    async with Page(app) as page:
        arm = (await page.next("state"))["robots"]["arm"]
        assert arm == {"lost": "no state received yet"}
        fault = Fault("e1", "the button is pressed", "release it")
        state = {"robots": {"arm": arm}}
        while "lost" in state["robots"]["arm"]:  # a busy computer looks when it is too old already
            app.put_state(time.monotonic(), q=0.123456789, fault=fault)
            state = await page.next("state")
        arm = state["robots"]["arm"]
        assert (arm["q"], arm["q_set"], arm["dq"]) == ([0.12346] * 3, [0.25] * 3, [0.0] * 3)
        assert arm["tcp"] == [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]
        assert (arm["status"], arm["trip"], arm["trip_text"], arm["limited"]) == ("following", "none", "", "speed")
        assert arm["fault"] == {"code": "e1", "cause": "the button is pressed", "remedy": "release it"}
        assert arm["gripper"] == {"width": 0.04, "width_target": 0.08, "moving": True, "grasped": None}
        assert arm["deadman"]["held"]
        assert 0.0 <= arm["age"] < 0.1
        host = state["hosts"]["group"]
        assert (host["rate_hz"], host["ticks"], host["missed"]) == (240.0, 1000, 3)
        assert (state["pages"], state["playing"]) == (1, False)
        while "lost" not in state["robots"]["arm"]:
            state = await page.next("state")
        assert "old" in state["robots"]["arm"]["lost"]
        app.put_state(time.monotonic(), status=RobotStatus.LOST, fault=Fault("lost", "no packets", ""))
        while "no packets" not in state["robots"]["arm"]["lost"]:
            state = await page.next("state")


async def test_nan_reaches_no_page_as_a_number(app: App) -> None:
    async with Page(app) as page:
        await page.next("hello")
        app.put_state(time.monotonic(), q=float("nan"))
        state = await page.next("state")
        while "q" not in state["robots"]["arm"]:
            app.put_state(time.monotonic(), q=float("nan"))
            state = await page.next("state")
        assert state["robots"]["arm"]["q"] == [None] * 3


# A page that reads nothing.


def handshake(app: App, path: str) -> socket.socket:
    """A page's socket by hand, with a small window, of which nothing more is ever read."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.settimeout(WAIT)
    sock.connect(("127.0.0.1", app.port))
    lines = [
        f"GET {path} HTTP/1.1",
        f"Host: 127.0.0.1:{app.port}",
        f"Origin: {app.url}",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        f"Sec-WebSocket-Protocol: hal.v1, {TOKEN}",
    ]
    sock.sendall("\r\n".join([*lines, "", ""]).encode())
    assert sock.recv(12) == b"HTTP/1.1 101"
    return sock


def resident(pid: int) -> int:
    """Memory of a process, bytes."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
async def test_a_page_that_reads_nothing_delays_no_other_and_is_disconnected(hasty: App) -> None:
    app = hasty
    frozen = handshake(app, "/live")
    async with Page(app) as page:
        await page.take()
        start, memory = time.monotonic(), resident(app.child.process.pid)
        pages, longest = 2, 0.0
        while pages == 2 and time.monotonic() < start + 30.0:
            app.put_state(time.monotonic())
            sent = time.monotonic()
            await page.drive()
            longest = max(longest, time.monotonic() - sent)
            pages = (await page.next("state"))["pages"]
        assert pages == 1
        assert time.monotonic() - start > 9.0 / HURRY, "it is given some time"
        assert longest < 1.0
        assert resident(app.child.process.pid) - memory < 8 << 20
    frozen.close()


# How it ends.


async def test_the_app_closes(app: App) -> None:
    async with Page(app) as live, Page(app, "/pictures") as pictures:
        await live.take()
        app.child.channel.send({"id": 0, "method": "close", "params": {}})
        assert await live.closed() == 4410
        assert await pictures.closed() == 4410
        assert app.child.process.wait(WAIT) == 0


def test_a_page_that_sends_while_the_app_closes_learns_of_it(app: App) -> None:
    """A browser takes a failed write for a cut network: it would try to connect for ever."""
    page = handshake(app, "/live")
    app.child.channel.send({"id": 0, "method": "close", "params": {}})
    for _ in range(20):
        page.sendall(b"\x81\x82\0\0\0\0{}")  # a text, which a client masks
        time.sleep(0.01)
    found = b""
    while b"the app has ended" not in found:
        received = page.recv(65536)
        assert received, "the connection ended without a close"
        found += received
    page.close()
    assert app.child.process.wait(WAIT) == 0


def test_it_closes_at_once_though_a_page_does_not_answer(app: App) -> None:
    frozen = handshake(app, "/live")
    start = time.monotonic()
    app.child.close()
    assert app.child.process.returncode == 0
    assert time.monotonic() - start < 4.0
    frozen.close()


def test_the_app_is_gone(app: App) -> None:
    app.child.channel.sock.shutdown(socket.SHUT_RDWR)
    assert app.child.process.wait(WAIT) == 0


def test_a_port_that_is_taken() -> None:
    with App() as first, App(listen=["127.0.0.1", first.port]) as second:
        assert first.port < second.port <= first.port + 20
        with pytest.raises(NotSupported) as taken:
            App(listen=["127.0.0.1", first.port], port_fixed=True)
        assert taken.value.code == "port_taken"


def test_an_address_of_another_machine() -> None:
    with pytest.raises(NotSupported) as refused:
        App(listen=["192.0.2.1", 0])
    assert refused.value.code == "bad_address"


async def test_ipv6() -> None:
    if not Path("/proc/net/if_inet6").exists() or "lo" not in Path("/proc/net/if_inet6").read_text():
        pytest.skip("this machine has no IPv6")
    with App(listen=["::1", 0]) as app:
        app.url = f"http://[::1]:{app.port}"
        async with Page(app) as page:
            await page.next("hello")


async def test_text_of_a_page_is_never_passed_on(app: App) -> None:
    """What a page writes is never passed on, neither to the app nor to other pages."""
    async with Page(app) as page, Page(app) as other:
        await page.take()
        for message in ({"type": "away", "why": "<b>x</b>"}, {"type": "recover", "robot": "<b>x</b>"}):
            await page.ws.send_str(json.dumps(message))
        await page.say(type="stop")
        assert "<b>" not in json.dumps(await app.all_until(lambda message: "stop" in message))
        assert "<b>" not in json.dumps(await other.next("state"))
