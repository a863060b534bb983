"""Pictures of cameras on the pages: the newest one, at the page's own pace, and only of watched cameras."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator

import aiohttp
import numpy as np
import pytest
from PIL import Image
from web_kit import HEADER, WAIT, App, Page, camera

from hal.drivers.web.pictures import DEPTH_COLORS

SCENE, WRIST = camera("scene"), camera("wrist", 40, 30)
LARGE, DEPTH = camera("large", 640, 480), camera("large/depth", 640, 480, "depth")


@pytest.fixture
def app() -> Iterator[App]:
    with App(SCENE, WRIST, LARGE, DEPTH) as found:
        yield found


async def picture(page: Page) -> tuple[str, int, float, float, np.ndarray]:
    """The next picture: camera, number, time, age, pixels."""
    message = await page.ws.receive(WAIT)
    assert message.type is aiohttp.WSMsgType.BINARY, f"{message.type}: {message.data}"
    index, zero, also_zero, seq, t, age = HEADER.unpack_from(message.data)
    assert (HEADER.size, zero, also_zero) == (20, 0, 0)
    pixels = np.asarray(Image.open(io.BytesIO(message.data[20:])))
    return ["scene", "wrist", "large", "large/depth"][index], seq, t, age, pixels


async def watch(app: App, page: Page, *cameras: str) -> None:
    """Watch these, and wait until the app knows."""
    await page.say(type="watch", cameras=dict.fromkeys(cameras, 640))
    assert await app.next(lambda message: "watched" in message) == {"watched": list(cameras)}


async def test_a_picture_arrives_as_it_was_taken(app: App) -> None:
    async with Page(app, "/pictures") as page:
        await watch(app, page, "scene", "wrist", "large")
        for name, spec in tuple(app.cameras.items())[:3]:
            t = time.monotonic() - 0.25
            app.show(name, 200, t)
            got, seq, taken, age, pixels = await picture(page)
            assert (got, seq, taken) == (name, 1, t)
            assert 0.25 <= age < 5.0
            assert pixels.shape == (spec.height, spec.width, 3)
            assert np.abs(pixels.astype(int) - 200).max() <= 2


async def test_one_picture_is_under_way_and_the_next_is_the_newest(app: App) -> None:
    async with Page(app, "/pictures") as page, Page(app) as other:
        await watch(app, page, "scene", "wrist")
        for value in (10, 20, 30, 40):
            app.show("scene", value)
        name, seq, *_ = await picture(page)
        assert (name, 1 <= seq <= 4) == ("scene", True)
        app.show("scene", 50)
        app.show("wrist", 60)
        assert (await picture(page))[0] == "wrist", "credit is each camera's own"
        await other.next("state")
        await page.say(type="drawn", camera="scene")
        name, seq, *_, pixels = await picture(page)
        assert (name, seq) == ("scene", 5)
        assert abs(int(pixels[0, 0, 0]) - 50) <= 2
        await page.say(type="drawn", camera="scene")
        await other.next("state")
        app.show("scene", 70)
        assert (await picture(page))[:2] == ("scene", 6), "there was none newer to be sent before"


async def test_only_watched_cameras_are_requested_and_old_pictures_are_not_shown(app: App) -> None:
    app.show("scene", 10)
    async with Page(app, "/pictures") as first:
        await watch(app, first, "scene")
        async with Page(app, "/pictures") as second:
            await second.say(type="watch", cameras={"wrist": 640, "scene": 640})
            assert await app.next() == {"watched": ["scene", "wrist"]}
            app.show("scene", 20)
            for page in (first, second):
                name, seq, *_ = await picture(page)
                assert (name, seq) == ("scene", 2), "the old one is not shown as if it were new"
            await second.say(type="watch", cameras={"wrist": 640})
            await first.say(type="watch", cameras={})
            assert await app.next() == {"watched": ["wrist"]}
            app.show("wrist", 30)
            assert (await picture(second))[0] == "wrist"
        assert await app.next() == {"watched": []}


async def test_a_page_that_joins_sees_the_newest_at_once_and_each_gets_its_own_size(app: App) -> None:
    async with Page(app, "/pictures") as first, Page(app, "/pictures") as second:
        await watch(app, first, "large")
        app.show("large", 20)
        assert (await picture(first))[1] == 1
        await second.say(type="watch", cameras={"large": 200})
        _, seq, *_, pixels = await picture(second)
        assert (seq, pixels.shape) == (1, (160, 213, 3)), "divided by a whole number, and not narrower than it is shown"
        await first.say(type="watch", cameras={"large": 100})
        await first.say(type="drawn", camera="large")
        app.show("large", 30)
        assert (await picture(first))[-1].shape == (80, 107, 3)


async def test_another_stream_is_taken_and_sent_only_while_a_page_shows_it(app: App) -> None:
    async with Page(app, "/pictures") as page:
        await watch(app, page, "large")
        app.show("large/depth", 0.5)
        app.show("large", 20)
        assert (await picture(page))[0] == "large"
        await watch(app, page, "large/depth")
        app.show("large", 20)
        app.show("large/depth", 0.2)
        name, *_, pixels = await picture(page)
        assert (name, pixels.shape) == ("large/depth", (480, 640, 3))
        assert np.abs(pixels.astype(int) - DEPTH_COLORS[0]).max() <= 3


async def test_malformed_messages_on_the_picture_socket(app: App) -> None:
    async with Page(app, "/pictures") as page:
        for text in (
            '{"type":"stop"}',
            '{"type":"watch","cameras":{"attic":640}}',
            '{"type":"drawn","camera":"attic"}',
        ):
            await page.ws.send_str(text)
        await page.say(type="drawn", camera="scene")
        await watch(app, page, "scene")
        for _ in range(98):
            await page.ws.send_str("nonsense")
        assert await page.closed() == 4400
        assert await app.next() == {"watched": []}


async def test_a_page_that_draws_nothing_leaves_the_others_their_pictures(app: App) -> None:
    async with Page(app, "/pictures") as slow, Page(app, "/pictures") as page:
        await watch(app, slow, "large")
        await page.say(type="watch", cameras={"large": 640})
        for k in range(1, 30):
            app.show("large", k)
            assert (await picture(page))[1] == k
            await page.say(type="drawn", camera="large")
        assert (await picture(slow))[1] == 1
        await slow.say(type="drawn", camera="large")
        assert (await picture(slow))[1] == 29
