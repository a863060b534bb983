"""The teleoperation app driven by the keys of its terminal: steps, held keys, a cut link."""

from __future__ import annotations

import re
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "kits"))
from terminal_kit import FarEnd, InTerminal, wait_for

APP = Path(__file__).resolve().parents[2] / "apps" / "teleop.py"
SPACE, W, W_UP = "\x1b[32u", "\x1b[119u", "\x1b[119;1:3u"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]


class App(InTerminal):
    """The teleoperation app in simulation."""

    def __init__(self, far: FarEnd) -> None:
        command = [sys.executable, str(APP), "--sim", "--pad", "terminal", "--set", "cameras={}"]
        super().__init__(far, command)
        try:
            self.shows("tcp ", 60.0)
        except AssertionError:
            self.close()
            raise

    def tcp(self) -> np.ndarray:
        """Return the position of the tcp that the app shows, mm."""
        found = re.findall(rb"tcp +(-?[0-9.]+) +(-?[0-9.]+) +(-?[0-9.]+) m", self.far.screen)
        return 1e3 * np.array([float(number) for number in found[-1]])

    def at_rest(self) -> np.ndarray:
        """Return the tcp's position, mm, once the app has shown the same place five times."""
        seen: list[np.ndarray] = []
        shown = -1
        deadline = time.monotonic() + 30.0
        while len(seen) < 5 or np.ptp(seen[-5:], axis=0).max() > 0.0:
            assert time.monotonic() < deadline, "it does not come to rest"
            count = self.far.screen.count(b"tcp ")
            if count > shown:
                shown = count
                seen.append(self.tcp())
            time.sleep(0.02)
        return seen[-1]

    def moved(self, start: np.ndarray) -> bool:
        return bool(np.abs(self.tcp() - start).max() > 1.0)


@contextmanager
def app(*, kitty: bool) -> Iterator[tuple[FarEnd, App]]:
    with FarEnd(kitty=kitty) as far, App(far) as it:
        yield far, it


def test_each_key_press_is_one_step_and_backspace_stops() -> None:
    with app(kitty=False) as (far, it):
        it.shows("one small step for each press")
        place = it.at_rest()
        for key, axis, way in [("\x1b[A", 0, 1), ("\x1b[D", 1, 1), ("\x1b[6~", 2, -1), ("\x1b[B", 0, -1)]:
            before, place = place, None
            far.type(key)
            wait_for(lambda before=before: it.moved(before), f"a step along axis {axis}")
            place = it.at_rest()
            step = place - before
            # 3 to 10 mm, and somewhat less or more on a loaded machine, which polls late.
            assert 2.0 <= way * step[axis] <= 15.0, step
            assert np.abs(np.delete(step, axis)).max() <= 3.0, step
        far.type(300 * "\x1b[A")
        wait_for(lambda: it.moved(place), "a step")
        burst = it.at_rest() - place
        assert burst[0] <= 24.0, "a burst is a step, or two where it came in pieces"
        far.type("\x7f")
        it.shows("STOPPED")
        far.type("\x1b[B")
        stopped = it.at_rest()
        time.sleep(0.6)  # keys that come right after a stop do not count
        far.type("\x1b[B")
        it.shows("resumed")
        wait_for(lambda: it.moved(stopped), "a step")
        far.type("\x03")
        assert it.process.wait(30) == 0
        it.shows("the arm is at rest")
        it.is_put_back()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_terminal_is_restored_when_the_app_is_killed(number: signal.Signals) -> None:
    with app(kitty=True) as (_, it):
        it.process.send_signal(number)
        assert it.process.wait(30) == (-number if number is signal.SIGKILL else 0)
        it.is_put_back()


def test_cut_link_trips_the_arm_while_a_key_is_held() -> None:
    with app(kitty=True) as (far, it):
        it.shows("held down")
        start = it.at_rest()
        far.type(SPACE + "\x1b[A")
        wait_for(lambda: it.moved(start), "driving")
        far.silent = True  # no release and no reply arrives any more
        it.shows("STOPPED")
        it.shows("the pad of the dead-man sent nothing")
        stopped = it.at_rest()
        far.silent = False
        time.sleep(0.5)
        assert np.abs(it.at_rest() - stopped).max() <= 1.0, "still held, but it was a trip: release first"
        far.type("\x1b[32;1:3u")
        time.sleep(0.5)  # so that the app sees the release before the press
        far.type(SPACE)
        it.shows("resumed")
        far.type("\x1b[99;5u")  # Ctrl-C, which this terminal reports as a key
        assert it.process.wait(30) == 0
        it.is_put_back()
