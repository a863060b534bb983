"""The 3D view on the page: where it is, who has the keys, and whose drags of the gizmo move the arm."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("viser")

from viser_kit import PlainPage
from websockets.sync.client import connect

from .kit import Bench, Browser, need_browser, wait_for
from .moves import BRIEF, undisturbed

FRAME = "document.querySelector('.stage iframe')"
HANDLE = "/arms/panda/handle"


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    need_browser()
    bench = Bench(cameras=True, viewer="3d")
    yield bench
    bench.close()


@pytest.fixture
def staged(bench: Bench, page: Browser) -> Iterator[Browser]:
    """The page with its 3D view open, which finds no WebGL here: without a GPU it would starve the page."""
    without = "if (self !== top) HTMLCanvasElement.prototype.getContext = () => null"
    script = page.cdp("Page.addScriptToEvaluateOnNewDocument", source=without)["identifier"]
    page.click(".stage")
    wait_for(lambda: page.run(f"return {FRAME}.contentDocument.title === 'Viser'"), "the 3D view")
    wait_for(lambda: page.run(f"return {FRAME}.contentDocument.readyState") == "complete", "all of it")
    yield page
    page.cdp("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    page.complaints()  # viser misses WebGL


def test_the_3d_view_is_on_the_page_and_the_keys_stay_with_the_page(bench: Bench, page: Browser) -> None:
    """Without a GPU the camera is large at first, and a click opens the 3D view."""
    assert page.run("return document.querySelector('.camera.large canvas') !== null"), "there is no GPU here"
    assert not page.run(f"return {FRAME}.src")


def test_the_keys_stay_with_the_page(staged: Browser) -> None:
    staged.click(".stage iframe")
    assert staged.run("return document.activeElement === document.body && document.hasFocus()")
    shown = staged.run(f"return getComputedStyle({FRAME}.contentDocument.body).visibility")
    assert shown == "hidden", "viser's panel and warnings would cover the view of a phone"
    staged.run(f"{FRAME}.focus()")
    wait_for(lambda: staged.run("return document.activeElement === document.body"), "the focus to come back")


def test_without_a_gpu_it_stands_still_while_the_dead_man_is_held(bench: Bench, staged: Browser) -> None:
    """A picture takes longer than the dead-man may be silent for."""
    staged.run(
        f"""const view = {FRAME}.contentWindow, loop = () => {{ drawn += 1; view.requestAnimationFrame(loop) }};
            window.drawn = 0;
            loop()"""
    )
    wait_for(lambda: staged.run("return drawn") > 2, "pictures")

    def hold() -> None:
        staged.hold()
        wait_for(lambda: bench.deadman.held, "the dead-man", BRIEF)
        drawn = staged.run("return drawn")
        assert staged.run("return new Promise((done) => setTimeout(() => done(drawn), 2500))") == drawn
        assert bench.deadman.held
        staged.let_go()
        wait_for(lambda: staged.run("return drawn") > drawn, "pictures again", BRIEF)

    undisturbed(bench, staged, hold)


def test_without_a_gpu_it_closes_with_the_connection(staged: Browser) -> None:
    """Opened again, it would cost the page its connection again where a picture takes seconds."""
    staged.run(
        """const send = WebSocket.prototype.send;
            WebSocket.prototype.send = function (data) {
              if (!this.url.endsWith('/live')) return send.call(this, data);
              WebSocket.prototype.send = send;
              this.close();
            }"""
    )
    wait_for(lambda: staged.run(f"return {FRAME}.getAttribute('src')") is None, "the 3D view to close")
    wait_for(lambda: staged.run("return document.querySelector('.camera.large canvas') !== null"), "the camera")


def drag(bench: Bench, view: PlainPage, way: float) -> None:
    """Drag the gizmo to the left of the tool, m, and release it."""
    tcp = bench.arm.state(max_age=2.0).tcp
    (x, y, z), (i, j, k, w) = tcp.position.tolist(), tcp.orientation.tolist()
    view.drag(HANDLE, ((x, y + way, z), (w, i, j, k)))


def stays(bench: Bench, before: NDArray[np.float64]) -> bool:
    """Return whether the arm stays for 0.4 s, in which a goal that counts moves it by centimetres."""
    time.sleep(0.4)
    return bool(abs(bench.tcp - before).max() < 1e-3) and bench.rig.viewer3d.goal("panda") is None


def test_the_gizmo_moves_the_arm_while_the_page_in_control_is_held_and_for_that_page_only(
    bench: Bench, staged: Browser
) -> None:
    """The mouse's part is said to the page's own 3D view; the thumb's is the page's key."""
    link = urlsplit(bench.link)
    live = {"subprotocols": ["hal.v1", link.fragment], "origin": f"http://{link.netloc}", "close_timeout": 0.5}
    mine = urlsplit(staged.run(f"return {FRAME}.src")).path
    with connect(f"ws://{link.netloc}/live", **live) as other:
        number = json.loads(other.recv(timeout=5.0))["page"]
        views = [PlainPage(path, bench.link) for path in (mine, re.sub(r"/\d+/$", f"/{number}", mine))]
        own, foreign = views

        def drive() -> None:
            before = bench.tcp.copy()
            drag(bench, own, 0.1)
            assert stays(bench, before), "nothing is held"
            staged.hold()
            wait_for(lambda: bench.deadman.held, "the dead-man", BRIEF)
            assert stays(bench, before), "that was dragged before the press"
            drag(bench, foreign, 0.1)
            assert stays(bench, before), "that page is view only"
            drag(bench, own, 0.1)
            wait_for(lambda: bench.tcp_speed[1] > 0.1, "motion to the gizmo", BRIEF)
            staged.let_go()
            wait_for(bench.rests, "the arm to rest", BRIEF)
            before = bench.tcp.copy()
            staged.hold()
            wait_for(lambda: bench.deadman.held, "the dead-man again", BRIEF)
            assert stays(bench, before), "the rest of the way was given up"
            staged.let_go()

        try:
            undisturbed(bench, staged, drive)
        finally:
            for view in views:
                view.close()
