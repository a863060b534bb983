"""What every GamepadDriver owes to the public Gamepad, and to the dead-man behind it."""

from __future__ import annotations

import itertools
import math
import statistics
import time

import pytest

from ..driver import PadReading
from ..errors import HalError
from ..gamepad import Gamepad
from ..types import AXES, BUTTONS
from .benches import PadBench
from .contract import Contract, needs
from .waiting import in_thread

__all__ = ["GamepadContract"]

_TURNS = 3000
"""Most polls that anything may take."""
_SLOW = 0.005
"""s; a poll that was told not to wait, and takes longer most of the time, blocks."""
_WAIT = 0.05
"""s; a time-out that is tried."""
_SLACK = 2.0
"""s that a poll may take longer than it was told to, on a busy machine."""


def poll(bench: PadBench) -> PadReading:
    """The next reading; it waits for nothing."""
    return bench.driver.poll(bench.pass_time(), 0.0)


def poll_until_pressed(bench: PadBench) -> list[PadReading]:
    """Press south, and poll until the reading says so."""
    bench.press()
    readings = []
    for _ in range(_TURNS):
        readings.append(poll(bench))
        if "south" in readings[-1].buttons:
            return readings
    raise AssertionError("south was never pressed")


def poll_until(bench: PadBench, connected: bool, alive_after: float | None = None) -> PadReading:
    """Poll until the pad is there, if wanted with a proof of life later than ``alive_after`` (s), or gone."""
    deadline = time.monotonic() + bench.patience
    for turn in itertools.count():
        reading = poll(bench)
        if reading.connected is connected and (alive_after is None or reading.t_alive > alive_after):
            return reading
        what = "it comes back by itself, and shows life again" if connected else "it is unplugged"
        assert turn < 20 or time.monotonic() < deadline, what
    raise AssertionError


def is_released(reading: PadReading) -> None:
    """Fails when anything of the pad is still pressed or pushed."""
    assert not reading.buttons, "nothing is pressed on a pad that is not there"
    assert not any(reading.axes.values()), "a pad that is not there has its sticks in the middle"


class GamepadContract(Contract):
    """Checks of a gamepad's driver. The bench is a :class:`~hal.testing.PadBench`.

    ``left_out`` may name ``press``, ``release`` (nothing can be held there), ``lose`` (unplug it), ``restore`` (plug it
    in again) and ``freeze`` (it stays connected, and says nothing more).
    """

    abilities = ("press", "release", "lose", "restore", "freeze")

    # Readings.

    @needs("press")
    def test_names_and_ranges(self, bench: PadBench) -> None:
        bench.driver.open()
        for reading in poll_until_pressed(bench):
            assert set(reading.axes) <= set(AXES), f"axes are named as in hal.types.AXES: {', '.join(AXES)}"
            assert reading.buttons <= set(BUTTONS), f"buttons are named as in hal.types.BUTTONS: {', '.join(BUTTONS)}"
            for name, value in reading.axes.items():
                lowest = 0.0 if name in ("l2", "r2") else -1.0
                assert lowest <= value <= 1.0, f"{name} goes from {lowest:g} to 1"
            assert set(reading.unknown) <= set(AXES)

    @needs("press")
    def test_stamps(self, bench: PadBench) -> None:
        bench.driver.open()
        readings = poll_until_pressed(bench)
        for reading in readings:
            assert reading.connected
            assert reading.t <= bench.now + _SLACK * bench.real_time, "t is that of the newest event, on `now`'s clock"
            assert reading.t_alive <= bench.now + _SLACK * bench.real_time, "t_alive is never ahead of the clock"
        for before, after in itertools.pairwise(readings):
            assert after.t >= before.t
            assert after.t_alive >= before.t_alive, "t_alive is when there was proof last: it never goes back"
            assert after.seq >= before.seq, "seq counts events"
        assert readings[-1].seq > readings[0].seq or len(readings) == 1

    # Proof of life.

    @needs("press")
    def test_a_pad_that_is_there_shows_life_without_events(self, bench: PadBench) -> None:
        bench.driver.open()
        poll_until_pressed(bench)
        readings = [poll(bench) for _ in range(20)]
        if bench.driver.proves_liveness:
            passed = 19 * bench.dt if not bench.real_time else bench.now - readings[0].t_alive
            life = readings[-1].t_alive - readings[0].t_alive
            assert life == pytest.approx(passed, abs=0.05), "t_alive goes on while the pad is there, pressed or not"

    @needs("freeze")
    def test_the_silence_of_a_pad_ages_its_proof_of_life(self, bench: PadBench) -> None:
        bench.driver.open()
        last = [poll(bench) for _ in range(5)][-1]
        bench.freeze()
        for _ in range(3):
            poll(bench)  # what was on its way
        silent = [poll(bench) for _ in range(30)]
        assert silent[-1].t_alive <= last.t_alive + 5 * bench.dt, "without a sign from the pad t_alive stands still"
        assert silent[-1].t_alive == silent[5].t_alive or not silent[-1].connected

    # Waiting.

    def test_a_poll_that_was_told_not_to_wait_does_not(self, bench: PadBench) -> None:
        bench.driver.open()
        took = []
        for _ in range(30):
            now = bench.pass_time()
            began = time.perf_counter()
            bench.driver.poll(now, 0.0)
            took.append(time.perf_counter() - began)
        assert statistics.median(took) < _SLOW, (
            f"poll(now, 0) took {1e3 * statistics.median(took):.1f} ms: it must not wait"
        )

    def test_a_poll_ends_in_time(self, bench: PadBench) -> None:
        bench.driver.open()
        for _ in range(5):
            began = time.monotonic()
            bench.driver.poll(bench.pass_time(), _WAIT)
            assert time.monotonic() - began < _WAIT + _SLACK, "poll waits for news for its time-out at most"

    # Unplugging.

    @needs("press", "lose", "restore")
    def test_nothing_is_pressed_on_a_pad_that_is_unplugged(self, bench: PadBench) -> None:
        bench.driver.open()
        pressed = poll_until_pressed(bench)[-1]
        bench.lose()
        poll_until(bench, connected=False)
        gone = poll(bench)
        assert not gone.connected
        is_released(gone)
        assert gone.t_alive <= pressed.t_alive + 3 * bench.dt, "a pad that is gone shows no life"
        bench.restore()
        proof = gone.t_alive if bench.driver.proves_liveness else None
        back = poll_until(bench, connected=True, alive_after=proof)
        assert back.seq >= gone.seq

    @needs("press", "release", "lose", "restore")
    def test_the_dead_man_of_an_unplugged_pad_wants_a_new_press(self, bench: PadBench) -> None:
        pad = Gamepad(bench.driver)
        pad.open(bench.now)
        deadman = pad.hold("south")

        def until(held: bool, what: str) -> None:
            for _ in range(_TURNS):
                pad.poll_once(bench.pass_time())
                if deadman.held is held:
                    return
            raise AssertionError(what)

        for _ in range(20):
            pad.poll_once(bench.pass_time())  # nothing counts before it was seen at rest
        bench.press()
        until(True, "south is pressed, and the dead-man is not held")
        bench.lose()
        until(False, "the pad is unplugged, and its dead-man still held")
        deadline = time.monotonic() + bench.patience
        bench.restore()
        while not pad.state().connected:
            pad.poll_once(bench.pass_time())
            assert not deadman.held
            assert time.monotonic() < deadline + _SLACK, "it comes back by itself"
        for _ in range(10):
            pad.poll_once(bench.pass_time())
            assert not deadman.held, "held through a reconnect: it must be let go of, and pressed again"
        bench.release()
        for _ in range(20):
            pad.poll_once(bench.pass_time())
            assert not deadman.held
        bench.press()
        until(True, "pressed again, and the dead-man is not held")
        pad.close()
        assert not deadman.held

    # Closing.

    def test_close_may_be_repeated_or_come_first(self, bench: PadBench) -> None:
        bench.driver.close()
        bench.driver.open()
        assert poll(bench).connected
        bench.driver.close()
        bench.driver.close()

    def test_another_thread_may_close_it(self, bench: PadBench) -> None:
        bench.driver.open()
        poll(bench)
        in_thread(bench.driver.close)

    def test_a_pad_that_is_not_open_is_not_connected(self, bench: PadBench) -> None:
        for _ in range(2):
            try:
                reading = poll(bench)
            except HalError:
                pass
            else:
                assert not reading.connected, "a closed pad is not connected, or polling it is an error of hal.errors"
                is_released(reading)
            bench.driver.open()
            bench.driver.close()

    def test_it_says_what_it_is(self, bench: PadBench) -> None:
        assert bench.driver.describe(), "describe says what drives, in words, for the banner"
        assert all(math.isfinite(share) for share in bench.driver.flat.values())
