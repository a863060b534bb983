"""What several tests do with a page."""

from __future__ import annotations

from .kit import Bench, Browser, wait_for


def drive_left(bench: Bench, page: Browser) -> None:
    page.hold()
    page.key("ArrowLeft", "ArrowLeft", True)
    wait_for(lambda: bench.tcp_speed[1] > 0.1, "motion")


def let_go_of_all(page: Browser) -> None:
    page.key("ArrowLeft", "ArrowLeft", False)
    page.let_go()


def lines(page: Browser, words: str) -> int:
    return page.text("#log").count(words)
