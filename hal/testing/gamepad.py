"""The contract of a GamepadDriver: what the public Gamepad and its dead-man rely on."""

from __future__ import annotations

import itertools
import math
import statistics
import time

from ..driver import PadReading
from ..errors import HalError
from ..gamepad import Gamepad
from ..types import AXES, BUTTONS, ONE_SIDED
from .benches import Contract, PadBench, needs, run_in_thread

_TURNS = 3000
"""Polls within which a change must show."""
_SLOW = 0.005
"""s; a poll without a time-out whose median is longer blocks."""
_BEHIND = 0.05
"""s by which ``t_alive`` may differ from the present while the pad is connected."""
_WAIT = 0.05
"""s; a time-out that the checks try."""
_SLACK = 2.0
"""s that a poll may exceed its time-out, on a busy machine."""


def _poll(bench: PadBench) -> PadReading:
    return bench.driver.poll(bench.pass_time(), 0.0)


def _poll_until_pressed(bench: PadBench) -> list[PadReading]:
    """Press south, and poll until it is pressed; return the readings."""
    bench.press()
    readings = []
    for _ in range(_TURNS):
        readings.append(_poll(bench))
        if "south" in readings[-1].buttons:
            return readings
    raise AssertionError("south was pressed, and no reading shows it")


def _poll_until(bench: PadBench, connected: bool, alive_after: float | None = None) -> PadReading:
    """Poll until the pad is connected, or not; optionally with ``t_alive`` later than ``alive_after`` (s)."""
    deadline = time.monotonic() + bench.patience
    for turn in itertools.count():
        reading = _poll(bench)
        if reading.connected is connected and (alive_after is None or reading.t_alive > alive_after):
            return reading
        what = (
            "a pad must reconnect by itself, with a new t_alive"
            if connected
            else "the pad is unplugged, and connected is True"
        )
        assert turn < 20 or time.monotonic() < deadline, what
    raise AssertionError


def _check_released(reading: PadReading) -> None:
    """Fail if a button is pressed or a stick deflected."""
    assert not reading.buttons, "a disconnected pad has no pressed button"
    assert not any(reading.axes.values()), "a disconnected pad has its sticks in the middle"


class GamepadContract(Contract):
    """Checks of a gamepad's driver. The bench is a :class:`~hal.testing.PadBench`.

    ``left_out`` may name ``press``, ``release`` (nothing can be held there), ``lose`` (unplug it), ``restore`` (plug it
    in again) and ``freeze`` (it stays connected, and sends nothing more).
    """

    abilities = ("press", "release", "lose", "restore", "freeze")

    # Readings.

    @needs("press")
    def test_names_and_ranges(self, bench: PadBench) -> None:
        bench.driver.open()
        for reading in _poll_until_pressed(bench):
            assert set(reading.axes) <= set(AXES), f"axes are named as in hal.types.AXES: {', '.join(AXES)}"
            assert reading.buttons <= set(BUTTONS), f"buttons are named as in hal.types.BUTTONS: {', '.join(BUTTONS)}"
            for name, value in reading.axes.items():
                lowest = 0.0 if name in ONE_SIDED else -1.0
                assert lowest <= value <= 1.0, f"{name} must be from {lowest:g} to 1"
            assert set(reading.unknown) <= set(AXES)

    @needs("press")
    def test_stamps(self, bench: PadBench) -> None:
        bench.driver.open()
        readings = _poll_until_pressed(bench)
        for reading in readings:
            assert reading.connected
            assert reading.t <= bench.now + _SLACK * bench.real_time, "t is that of the newest event, on `now`'s clock"
            assert reading.t_alive <= bench.now + _SLACK * bench.real_time, "t_alive is never ahead of `now`"
        for before, after in itertools.pairwise(readings):
            assert after.t >= before.t
            assert after.t_alive >= before.t_alive, "t_alive is the time of the last sign of life: it never goes back"
            assert after.seq >= before.seq, "seq counts events"
        assert readings[-1].seq > readings[0].seq or len(readings) == 1

    # Liveness.

    @needs("press")
    def test_a_connected_pad_stays_alive_without_events(self, bench: PadBench) -> None:
        bench.driver.open()
        _poll_until_pressed(bench)
        readings = [_poll(bench) for _ in range(20)]
        if not bench.driver.proves_liveness:
            return

        def behind() -> float:
            passed = bench.now - readings[0].t_alive if bench.real_time else 19 * bench.dt
            return passed - (readings[-1].t_alive - readings[0].t_alive)

        deadline = time.monotonic() + _SLACK
        while bench.real_time and abs(behind()) > _BEHIND and time.monotonic() < deadline:
            readings.append(_poll(bench))  # on a busy machine a sign of life may be late
        assert abs(behind()) <= _BEHIND, "t_alive advances while the pad is connected"

    @needs("freeze")
    def test_t_alive_stops_when_the_pad_is_silent(self, bench: PadBench) -> None:
        bench.driver.open()
        last = [_poll(bench) for _ in range(5)][-1].t_alive
        if bench.real_time:
            last = max(last, bench.now)  # a sign of life from before may arrive late
        bench.freeze()
        for _ in range(3):
            _poll(bench)  # events that were under way
        silent = [_poll(bench) for _ in range(30)]
        assert silent[-1].t_alive <= last + 5 * bench.dt, "without a sign of life t_alive must not advance"
        assert silent[-1].t_alive == silent[5].t_alive or not silent[-1].connected

    # Waiting.

    def test_a_poll_without_time_out_does_not_wait(self, bench: PadBench) -> None:
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

    def test_a_poll_respects_its_time_out(self, bench: PadBench) -> None:
        bench.driver.open()
        for _ in range(5):
            began = time.monotonic()
            bench.driver.poll(bench.pass_time(), _WAIT)
            assert time.monotonic() - began < _WAIT + _SLACK, "poll waits for events for its time-out at most"

    # Unplugging.

    @needs("press", "lose", "restore")
    def test_an_unplugged_pad_is_released(self, bench: PadBench) -> None:
        bench.driver.open()
        pressed = _poll_until_pressed(bench)[-1]
        bench.lose()
        _poll_until(bench, connected=False)
        gone = _poll(bench)
        assert not gone.connected
        _check_released(gone)
        assert gone.t_alive <= pressed.t_alive + 3 * bench.dt, "an unplugged pad is not alive"
        bench.restore()
        proof = gone.t_alive if bench.driver.proves_liveness else None
        back = _poll_until(bench, connected=True, alive_after=proof)
        assert back.seq >= gone.seq

    @needs("press", "release", "lose", "restore")
    def test_the_dead_man_of_a_replugged_pad_needs_a_new_press(self, bench: PadBench) -> None:
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
            pad.poll_once(bench.pass_time())  # a press only counts after the pad was seen at rest
        bench.press()
        until(True, "south is pressed, and the dead-man is not held")
        bench.lose()
        until(False, "the pad is unplugged, and its dead-man is still held")
        deadline = time.monotonic() + bench.patience
        bench.restore()
        while not pad.state().connected:
            pad.poll_once(bench.pass_time())
            assert not deadman.held
            assert time.monotonic() < deadline + _SLACK, "a pad must reconnect by itself"
        for _ in range(10):
            pad.poll_once(bench.pass_time())
            assert not deadman.held, "a button held through a reconnect must be released and pressed again"
        bench.release()
        for _ in range(20):
            pad.poll_once(bench.pass_time())
            assert not deadman.held
        bench.press()
        until(True, "pressed again, and the dead-man is not held")
        pad.close()
        assert not deadman.held

    # Closing.

    def test_close_may_be_repeated_or_come_before_open(self, bench: PadBench) -> None:
        bench.driver.close()
        bench.driver.open()
        assert _poll(bench).connected
        bench.driver.close()
        bench.driver.close()

    def test_another_thread_may_close(self, bench: PadBench) -> None:
        bench.driver.open()
        _poll(bench)
        run_in_thread(bench.driver.close)

    def test_a_driver_that_is_not_open_is_not_connected(self, bench: PadBench) -> None:
        for _ in range(2):
            try:
                reading = _poll(bench)
            except HalError:
                pass
            else:
                assert not reading.connected, "a closed pad is not connected, or polling it raises a HalError"
                _check_released(reading)
            bench.driver.open()
            bench.driver.close()

    def test_describe_names_the_device(self, bench: PadBench) -> None:
        assert bench.driver.describe(), "describe names the device for the banner"
        assert all(math.isfinite(share) for share in bench.driver.flat.values())
