"""The HTTP side of the console: tokens, hosts and origins, files, headers."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import pytest
from web_kit import TOKEN, WAIT, App, Page

from hal.drivers.web.server import read_page_files
from hal.keys import make_key


@pytest.fixture(scope="module")
def server() -> Iterator[App]:
    """One for all tests that only knock at the door."""
    with App() as found:
        yield found


@pytest.mark.parametrize("path", ["/live", "/pictures"])
@pytest.mark.parametrize("token", ["wrong", TOKEN[:-1], TOKEN + "0"])
async def test_a_wrong_token_is_reported(server: App, path: str, token: str) -> None:
    async with Page(server, path, token) as page:
        message = await page.ws.receive(WAIT)
        assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, 4403)
        assert "token" in message.extra
    async with Page(server) as page:
        assert (await page.next("state"))["pages"] == 1, "the other one never was a page"


@pytest.mark.parametrize("path", ["/live", "/pictures"])
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://attacker.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1"}, 403),
        ({"Host": "attacker.example", "Origin": "http://attacker.example"}, 421),
        ({"Host": "192.168.1.7", "Origin": "http://192.168.1.7"}, 421),
        ({"Host": "testbench", "Origin": "http://testbench"}, 421),
    ],
)
async def test_foreign_origins_and_hosts_are_turned_away(server, path, headers, status):
    with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
        async with Page(server, path, **headers):
            pass
    assert caught.value.status == status


async def test_a_handshake_without_an_origin_is_turned_away(server: App) -> None:
    async with aiohttp.ClientSession() as session:
        with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
            await session.ws_connect(server.url + "/live", protocols=("hal.v1", TOKEN))
        assert caught.value.status == 403


@pytest.mark.parametrize(
    ("path", "method", "host", "status"),
    [
        ("/page/nothing.js", "GET", None, 404),
        ("/page/%2e%2e/process.py", "GET", None, 404),
        ("/page/..%2fprocess.py", "GET", None, 404),
        ("/elsewhere", "GET", None, 404),
        ("/", "POST", None, 405),
        ("/live", "GET", None, 400),
        ("/", "GET", "attacker.example", 421),
        ("/page/nothing.js", "GET", "attacker.example", 421),
    ],
)
async def test_every_answer_has_its_headers(server: App, path: str, method: str, host: str | None, status: int) -> None:
    headers = {} if host is None else {"Host": host}
    async with (
        aiohttp.ClientSession() as session,
        session.request(method, server.url + path, headers=headers) as answer,
    ):
        assert answer.status == status
        assert answer.headers["Cache-Control"] == "no-store"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        policy = answer.headers.get("Content-Security-Policy", "")
        assert TOKEN not in await answer.text()
        if host is None:
            assert policy.startswith("default-src 'none'; script-src 'self'; ")
            assert f"connect-src 'self' ws://127.0.0.1:{server.port};" in policy
        else:
            assert host not in policy


async def test_the_page_is_served(server: App) -> None:
    files = read_page_files()
    assert "index.html" in files
    async with aiohttp.ClientSession() as session:
        for name, (body, kind) in files.items():
            async with session.get(f"{server.url}/page/{name}") as answer:
                assert (answer.status, answer.headers["Content-Type"]) == (200, kind)
                assert await answer.read() == body
        async with session.get(server.url + "/") as answer:
            assert await answer.read() == files["index.html"][0]
        async with session.get(server.url + "/page/keys.js") as answer:
            assert (await answer.text()).startswith('export const KEYS = {"hold": ["Space"], ')


async def test_too_many_pages(app: App) -> None:
    pages = [Page(app) for _ in range(16)]
    for page in pages:
        await page.__aenter__()
        await page.next("hello")
    async with Page(app) as one_more:
        assert await one_more.closed() == 4409
    await pages[3].__aexit__()
    async with Page(app) as another:
        assert (await another.next("hello"))["name"] == "page 17"
    for page in pages:
        await page.__aexit__()


async def test_pages_of_another_computer_are_served_with_tls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many connections never finish their handshake."""
    monkeypatch.setenv("HAL_KEYS", str(tmp_path))
    make_key("host", "bench", ["127.0.0.2"])
    with App(listen=["127.0.0.2", 0], tls=True) as app:
        app.tls = ssl.create_default_context(cafile=str(tmp_path / "authority.crt"))
        silent = [socket.create_connection(("127.0.0.2", app.port)) for _ in range(100)]
        async with Page(app) as page:
            await page.take()
            await page.drive(buttons=1)
            assert (await app.pad())["connected"]
        with pytest.raises(aiohttp.WSServerHandshakeError):
            async with Page(app, Origin=app.url.replace("https", "http")):
                pass
        async with aiohttp.ClientSession() as session, session.get(app.url, ssl=app.tls) as answer:
            assert "wss://127.0.0.2" in answer.headers["Content-Security-Policy"]
        with pytest.raises(aiohttp.ClientConnectorCertificateError):
            async with aiohttp.ClientSession() as session, session.get(app.url):
                pass
        for sock in silent:
            sock.close()
