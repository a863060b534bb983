"""One browser for all tests, and one rig for a module: both take seconds to start."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from .kit import Bench, Browser, need_browser, wait_for
from .moves import clear_trip


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """A rig without cameras that its console drives."""
    need_browser()
    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A browser; a test that uses it directly leaves an empty page."""
    need_browser()
    browser = Browser()
    yield browser
    browser.close()


@pytest.fixture
def page(bench: Bench, browser: Browser) -> Iterator[Browser]:
    """The console, opened anew; it drives, nothing is held, and no stop is latched."""
    browser.size(1280, 800)
    browser.open(bench.link)
    browser.wait_driving()
    wait_for(lambda: bench.session.pad.state().connected and not bench.session.pad.waiting_for, "the pad to be at rest")
    clear_trip(bench, browser)
    yield browser
    complaints = browser.complaints()
    browser.chrome.get("about:blank")
    wait_for(bench.rests, "the arm to rest")
    assert complaints == []
