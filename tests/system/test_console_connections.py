"""Connections to the console's port without the token: they delay no page and fill no disk."""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import socket
import time
from pathlib import Path

import aiohttp
import pytest
from child_targets import HURRY
from web_kit import WAIT, App, Page

from hal.errors import HalError
from hal.host.process import Child

KEY = b"AAAAAAAAAAAAAAAAAAAAAA=="


async def visit(app: App, sent: bytes = b"") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect by hand, and send this."""
    reader, writer = await asyncio.wait_for(asyncio.open_connection("127.0.0.1", app.port), WAIT)
    writer.write(sent)
    return reader, writer


async def answer(reader: asyncio.StreamReader) -> bytes:
    """All that comes until the other side closes, or breaks off."""
    found = b""
    with contextlib.suppress(ConnectionError):
        while more := await asyncio.wait_for(reader.read(4096), WAIT):
            found += more
    return found


def handshake(app: App, key: bytes = KEY, token: bytes = b"wrong") -> bytes:
    host = f"127.0.0.1:{app.port}".encode()
    lines = [
        b"GET /live HTTP/1.1",
        b"Host: " + host,
        b"Origin: http://" + host,
        b"Connection: Upgrade",
        b"Upgrade: websocket",
        b"Sec-WebSocket-Version: 13",
        b"Sec-WebSocket-Key: " + key,
        b"Sec-WebSocket-Protocol: hal.v1, " + token,
    ]
    return b"\r\n".join([*lines, b"", b""])


def descriptors(app: App) -> int:
    return len(os.listdir(f"/proc/{app.child.process.pid}/fd"))


async def stop_of_a_new_page(app: App) -> float:
    """How long it takes, s."""
    start = time.monotonic()
    async with Page(app) as page:
        await page.say(type="stop")
        await app.next(lambda message: "stop" in message)
    return time.monotonic() - start


# What makes no sense.


@pytest.mark.parametrize(
    "request_",
    [
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nbad header\x00\x01: x\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03 not plain\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"GET /" + b"a" * 20000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"x: y\r\n" * 4000 + b"\r\n",
        b"GET http://[::1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET /%ff%fe HTTP/1.1\r\nHost: \xff\xfe\r\nConnection: close\r\n\r\n",
    ],
)
async def test_malformed_requests_are_not_logged(app: App, request_: bytes) -> None:
    for _ in range(30):
        reader, writer = await visit(app, request_)
        assert (await answer(reader))[:12] in {b"HTTP/1.1 400", b"HTTP/1.0 400", b"HTTP/1.1 421", b"HTTP/1.1 405"}
        writer.close()


@pytest.mark.parametrize("key", [b"short", b"\xc3\xa4" * 12, b"=" * 24])
async def test_malformed_handshakes_are_not_logged(app: App, key: bytes) -> None:
    for _ in range(30):
        reader, writer = await visit(app, handshake(app, key))
        assert await asyncio.wait_for(reader.readexactly(12), WAIT) == b"HTTP/1.1 400"
        writer.close()


def test_the_error_that_ends_the_process_is_logged() -> None:
    child = Child("console", "hal.drivers.web.process:main", {"listen": ["127.0.0.1", "no port"]})
    try:
        with pytest.raises(HalError, match="no port"):
            child.wait_ready(WAIT)
        assert child.process.wait(WAIT) == 1
        child._log.seek(0)
        assert b"Traceback" in child._log.read()
    finally:
        child.close()


# Those who stay.


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"])
async def test_idle_connections_are_closed_and_pages_are_not(hasty: App, sent: bytes) -> None:
    """The second one goes on sending a byte at a time."""
    async with Page(hasty) as page:
        await page.take()
        reader, writer = await visit(hasty, sent)
        start = time.monotonic()
        ended = asyncio.ensure_future(answer(reader))
        while not ended.done():
            if sent:
                writer.write(b"a")
            await page.drive()
            await asyncio.sleep(0.05)
        assert await ended == b""
        assert time.monotonic() - start > 4.0 / HURRY, "whoever is slow has some time"
        await page.drive()
        await page.next("state")


async def test_a_connection_with_regular_requests_stays(hasty: App) -> None:
    reader, writer = await visit(hasty)
    for _ in range(3):
        await asyncio.sleep(2.0 / HURRY)
        writer.write(b"GET /page/nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert (await asyncio.wait_for(reader.readuntil(b"no such file\n"), WAIT)).startswith(b"HTTP/1.1 404")
    writer.close()


async def test_idle_connections_keep_no_page_out(app: App) -> None:
    async with Page(app) as driver:
        await driver.take()
        visitors = [await visit(app) for _ in range(300)]
        assert await stop_of_a_new_page(app) < WAIT / 2
        assert descriptors(app) < 200, "of 300 who came before it"
        await driver.drive()
        for reader, _ in visitors[:100]:
            assert await answer(reader) == b"", "the first ones make room"
        for _, writer in visitors:
            writer.close()


async def test_a_connection_that_reads_no_answer_is_closed(app: App) -> None:
    before = descriptors(app)
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.connect(("127.0.0.1", app.port))
    sock.setblocking(False)
    request = b"GET /page/index.html HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    with contextlib.suppress(BlockingIOError):
        for _ in range(90):  # more would be cut off for their number
            sock.send(request)
    async with Page(app) as page:
        for _ in range(400):
            await page.next("state")
            if descriptors(app) <= before + 1:
                break
        assert descriptors(app) <= before + 1, "the page's alone"
    sock.close()


async def test_requests_in_one_go_are_cut_off(app: App) -> None:
    """Answering 3,000 would keep the console from its pages."""
    reader, _ = await visit(app, b"GET /page/nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 3000)
    assert 0 < (await answer(reader)).count(b"HTTP/1.1 404") <= 100


async def test_many_wrong_tokens_at_the_same_time(app: App) -> None:
    """Some are told why they do not come in, the others are just turned away; whoever has the right one comes in."""
    async with Page(app) as driver:
        await driver.take()
        crowd = [await visit(app, handshake(app)) for _ in range(100)]
        heads = [await asyncio.wait_for(reader.readexactly(12), WAIT) for reader, _ in crowd]
        assert set(heads) == {b"HTTP/1.1 101", b"HTTP/1.1 403"}
        assert heads[:16] == [b"HTTP/1.1 101"] * 16
        assert await stop_of_a_new_page(app) < WAIT / 2
        await driver.drive()
        for _, writer in crowd:
            writer.close()
        for _ in range(100):  # until they are gone
            async with aiohttp.ClientSession() as session:
                try:
                    ws = await session.ws_connect(
                        app.url + "/live", protocols=("hal.v1", "wrong"), headers={"Origin": app.url}
                    )
                except aiohttp.WSServerHandshakeError:
                    await asyncio.sleep(0.05)
                    continue
                assert (await ws.receive(WAIT)).data == 4403
                return
        raise AssertionError("nobody is told any more")


def test_few_descriptors_are_made_more() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard <= 256:
        pytest.skip("this machine allows no more than 256 descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        found = App()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    with found as app:
        limits = Path(f"/proc/{app.child.process.pid}/limits").read_text()
        assert int(limits.split("Max open files")[1].split()[0]) == (8192 if hard < 0 else min(hard, 8192))
