"""One browser for all tests, and one rig for a module: both take seconds to start."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from _pytest.runner import runtestprotocol

from .kit import TRIES, Bench, Browser, disturbed, need_browser, wait_for
from .moves import clear_trip


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Run a test again that failed while the machine was too busy for the page or the app to be heard in time."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for turn in range(TRIES):
        began = time.monotonic()
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if not any(report.failed for report in reports) or turn == TRIES - 1 or not disturbed(began):
            break
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


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
