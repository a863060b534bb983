"""The teleoperation app driven by the keys of its terminal."""

from __future__ import annotations

import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "kits"))
from terminal_kit import FarEnd, InTerminal, wait_for

APP = Path(__file__).resolve().parents[2] / "apps" / "teleop.py"

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


def test_each_key_press_is_one_step_and_backspace_stops() -> None:
    with FarEnd() as far, App(far) as it:
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_terminal_is_restored_when_a_signal_ends_the_app(number: signal.Signals) -> None:
    with FarEnd() as far, App(far) as it:
        it.process.send_signal(number)
        assert it.process.wait(30) == 0
        it.is_put_back()
