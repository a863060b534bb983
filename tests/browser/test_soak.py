"""Nothing stops the arm that should not: a minute of holding, with both cameras on the page.

``HAL_SOAK_S=600`` makes it ten.
"""

from __future__ import annotations

import os
import time

import pytest

from .kit import Bench, Browser, need_browser, wait_for

SECONDS = float(os.environ.get("HAL_SOAK_S", "60"))


@pytest.mark.slow
@pytest.mark.timeout(int(SECONDS) + 120)
def test_a_held_dead_man_stays_held() -> None:
    need_browser()
    bench, browser = Bench(cameras=True), Browser()
    try:
        browser.open(bench.link)
        browser.wait_driving()
        wait_for(lambda: bench.session.pad.state().connected and not bench.session.pad.waiting_for, "the pad at rest")
        browser.hold()
        wait_for(lambda: bench.status == "following", "the arm to follow")
        end, moved, last = time.monotonic() + SECONDS, 0.0, bench.tcp
        keys = ("ArrowLeft", "ArrowRight")
        turn = 0
        while time.monotonic() < end:
            key = keys[turn % 2]
            browser.key(key, key, True)
            time.sleep(0.5)
            browser.key(key, key, False)
            time.sleep(0.5)
            turn += 1
            moved += abs(bench.tcp - last).max()
            last = bench.tcp
            assert bench.trip == "none", f"stopped in turn {turn}: {bench.trip}"
            assert bench.session.deadman.held
        assert bench.session.report.trips == []
        assert moved > 0.03 * SECONDS, "the arm went to and fro"
    finally:
        browser.close()
        bench.close()
