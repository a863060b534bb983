"""What the cameras see, on the pages: the newest picture, at the page's own pace, and only what is watched."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator

import aiohttp
import numpy as np
import pytest
from PIL import Image
from web_kit import HEADER, WAIT, App, Page, camera, frame, run

from hal.drivers.web.pictures import PictureCredit, compress, smoothed

SCENE, WRIST = camera("scene"), camera("wrist", 40, 30)
LARGE = camera("large", 640, 480)


@pytest.fixture
def app() -> Iterator[App]:
    with App(SCENE, WRIST, LARGE) as found:
        yield found


async def picture(page: Page) -> tuple[str, int, float, float, np.ndarray]:
    """The next picture: camera, number, time, age, pixels."""
    message = await page.ws.receive(WAIT)
    assert message.type is aiohttp.WSMsgType.BINARY, f"{message.type}: {message.data}"
    index, zero, also_zero, seq, t, age = HEADER.unpack_from(message.data)
    assert (HEADER.size, zero, also_zero) == (20, 0, 0)
    pixels = np.asarray(Image.open(io.BytesIO(message.data[20:])))
    return ["scene", "wrist", "large"][index], seq, t, age, pixels


async def watch(app: App, page: Page, *cameras: str) -> None:
    """Watch these, and wait until the app knows."""
    await page.say(type="watch", cameras=list(cameras))
    assert await app.next(lambda message: "watched" in message) == {"watched": list(cameras)}


def test_a_picture_arrives_as_it_was_taken(app: App) -> None:
    async def test() -> None:
        async with Page(app, "/pictures") as page:
            await watch(app, page, "scene", "wrist", "large")
            for name, spec in app.cameras.items():
                t = time.monotonic() - 0.25
                app.show(name, 200, t)
                got, seq, taken, age, pixels = await picture(page)
                assert (got, seq, taken) == (name, 1, t)
                assert 0.25 <= age < 5.0
                assert pixels.shape == (spec.height, spec.width, 3)
                assert np.abs(pixels.astype(int) - 200).max() <= 2

    run(test)


def test_one_picture_is_under_way_and_the_next_is_the_newest(app: App) -> None:
    async def test() -> None:
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

    run(test)


def test_only_what_somebody_watches_is_asked_for_and_nothing_from_before(app: App) -> None:
    async def test() -> None:
        app.show("scene", 10)
        async with Page(app, "/pictures") as first:
            await watch(app, first, "scene")
            async with Page(app, "/pictures") as second:
                await second.say(type="watch", cameras=["wrist", "scene"])
                assert await app.next() == {"watched": ["scene", "wrist"]}
                app.show("scene", 20)
                for page in (first, second):
                    name, seq, *_ = await picture(page)
                    assert (name, seq) == ("scene", 2), "the old one is not shown as if it were new"
                await second.say(type="watch", cameras=["wrist"])
                await first.say(type="watch", cameras=[])
                assert await app.next() == {"watched": ["wrist"]}
                app.show("wrist", 30)
                assert (await picture(second))[0] == "wrist"
            assert await app.next() == {"watched": []}

    run(test)


def test_a_page_that_joins_sees_the_newest_at_once(app: App) -> None:
    async def test() -> None:
        async with Page(app, "/pictures") as first, Page(app, "/pictures") as second:
            await watch(app, first, "large")
            app.show("large", 20)
            assert (await picture(first))[1] == 1
            await second.say(type="watch", cameras=["large"])
            assert (await picture(second))[1] == 1

    run(test)


def test_rates_and_ages_are_told(app: App) -> None:
    async def test() -> None:
        async with Page(app) as live, Page(app, "/pictures") as page:
            cameras = (await live.next("state"))["cameras"]
            assert cameras["scene"] == {"fps": None, "age": None}
            await watch(app, page, "scene")
            start = time.monotonic()
            while cameras["scene"]["fps"] is None or time.monotonic() < start + 1.0:
                app.show("scene", 20)
                cameras = (await live.next("state"))["cameras"]  # 20 times a second
            assert 5.0 < cameras["scene"]["fps"] < 40.0
            assert 0.0 <= cameras["scene"]["age"] < 1.0
            assert cameras["wrist"] == {"fps": None, "age": None}
            while cameras["scene"]["fps"] is not None:
                cameras = (await live.next("state"))["cameras"]
            assert cameras["scene"]["age"] > 1.0

    run(test)


def test_nonsense_here(app: App) -> None:
    async def test() -> None:
        async with Page(app, "/pictures") as page:
            for text in (
                '{"type":"stop"}',
                '{"type":"watch","cameras":["attic"]}',
                '{"type":"drawn","camera":"attic"}',
            ):
                await page.ws.send_str(text)
            await page.say(type="drawn", camera="scene")
            await watch(app, page, "scene")
            for _ in range(98):
                await page.ws.send_str("nonsense")
            assert await page.closed() == 4400
            assert await app.next() == {"watched": []}

    run(test)


def test_a_page_that_draws_nothing_leaves_the_others_their_pictures(app: App) -> None:
    async def test() -> None:
        async with Page(app, "/pictures") as slow, Page(app, "/pictures") as page:
            await watch(app, slow, "large")
            await page.say(type="watch", cameras=["large"])
            for k in range(1, 30):
                app.show("large", k)
                assert (await picture(page))[1] == k
                await page.say(type="drawn", camera="large")
            assert (await picture(slow))[1] == 1
            await slow.say(type="drawn", camera="large")
            assert (await picture(slow))[1] == 29

    run(test)


# How they look.


def pixels(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg))).astype(int)


def test_depth_is_bright_where_it_is_near_and_black_where_nothing_was_measured() -> None:
    spec = camera("depth", 64, 16, "depth")  # 0.2 to 2.2 m
    depth = frame(spec, 0.0)
    assert depth.depth is not None
    for k, value in enumerate((0.0, 0.2, 1.2, 2.2, 9.0, float("nan"), float("inf"), -1.0)):
        depth.depth[:, 8 * k : 8 * k + 8] = value
    row = pixels(compress(depth, spec))[8, 4::8]
    assert np.abs(row - [0, 255, 147, 40, 40, 0, 40, 0]).max() <= 2


def test_infrared_is_grey() -> None:
    spec = camera("ir", 32, 16, "infrared")
    image = pixels(compress(frame(spec, 90), spec))
    assert image.shape == (16, 32)
    assert np.abs(image - 90).max() <= 2


def test_colours_are_not_swapped() -> None:
    spec = camera("color", 32, 16)
    red = frame(spec, 0)
    assert red.color is not None
    red.color[:, :, 0] = 250
    assert np.abs(pixels(compress(red, spec)) - [250, 0, 0]).max() <= 4


# Credit, by itself.


def test_credit() -> None:
    newest = {"a": 0, "b": 3}
    credit = PictureCredit()
    assert list(credit.due(newest.__getitem__)) == []
    credit.watch(("a", "b"))
    assert list(credit.due(newest.__getitem__)) == ["b"]
    credit.spend("b", 3)
    newest["b"] = 5
    assert list(credit.due(newest.__getitem__)) == []
    credit.watch(("b",))
    assert list(credit.due(newest.__getitem__)) == [], "asking again for the same gives no credit"
    credit.give_back("b")
    credit.give_back("b")
    credit.give_back("a")
    assert list(credit.due(newest.__getitem__)) == ["b"]
    credit.spend("b", 5)
    credit.give_back("b")
    assert list(credit.due(newest.__getitem__)) == [], "it has the newest one"


def test_a_small_picture_has_no_staircases_and_no_lone_pixels_and_is_not_changed_itself() -> None:
    """A steep edge as it is drawn with one sample a pixel, and a glint."""
    row, column = np.mgrid[:60, :80]
    picture = np.where((row > 0.3 * column + 10)[:, :, None], 200, 60).astype(np.uint8).repeat(3, axis=2)
    picture[5, 60] = 255
    before = picture.copy()
    found = smoothed(picture)
    assert (picture == before).all(), "what others get of this frame stays as it is"
    steps = np.unique(found[:, 20:60, 0])
    assert len(steps) > 6, "an edge passes through values in between"
    assert steps.min() >= 60
    assert steps.max() <= 200
    assert found[5, 60].max() < 100, "a lone pixel becomes like those around it"
    far = abs(row - 0.3 * column - 10) > 8
    far[3:8, 58:63] = False
    assert (found[far] == picture[far]).all(), "surfaces stay as they are"


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3), (48, 64)])
def test_any_size_and_any_noise_can_be_smoothed(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    found = smoothed(noise)
    assert (found.shape, found.dtype) == (noise.shape, noise.dtype)
