"""What every GripperDriver owes to the host."""

from __future__ import annotations

import itertools
import math
import statistics
import time

import pytest

from ..driver import GripperReading
from ..errors import CommandError, ConnectionLost, HalError, NotSupported
from .benches import GripperBench
from .contract import Contract, needs
from .grasping import GraspChecks
from .waiting import comes_back, in_thread, is_lost

__all__ = ["GripperContract"]

_SLOW = 0.01
"""s; a call that takes longer, most of the time, blocks."""
_AT = 2e-3
"""m within which fingers are where they were told to be."""
_REST = 0.1
"""s without motion after which fingers rest."""
_LIMIT = 5.0
"""s within which every motion must be over."""


def cycles(bench: GripperBench, seconds: float) -> list[GripperReading]:
    """What the driver reads in so many seconds."""
    return [bench.driver.read(bench.pass_time()) for _ in bench.turns(seconds)]


def until_rest(bench: GripperBench) -> list[GripperReading]:
    """What the driver reads until the fingers rest, at least for a tenth of a second."""
    readings = cycles(bench, _REST)
    still = 0.0
    for _ in bench.turns(_LIMIT):
        readings += cycles(bench, bench.dt)
        still = 0.0 if readings[-1].moving else still + bench.dt
        if still > _REST:
            return readings
    raise AssertionError(f"the fingers still move after {_LIMIT:g} s: {readings[-1]}")


def half(bench: GripperBench) -> float:
    """Half open, m."""
    return bench.driver.spec.width_max / 2


def opened(bench: GripperBench) -> GripperBench:
    """Open, and read once."""
    bench.driver.open()
    bench.driver.read(bench.pass_time())
    return bench


def move(bench: GripperBench, width: float, share: float = 1.0) -> None:
    """Start towards ``width`` (m) at that share of the greatest speed."""
    spec = bench.driver.spec
    bench.driver.move(width, share * spec.speed, spec.force)


class GripperContract(GraspChecks, Contract):
    """Checks of a gripper's driver. The bench is a :class:`~hal.testing.GripperBench`.

    ``left_out`` may name ``lose``, ``restore``, ``freeze`` and ``put_object``.
    """

    abilities = ("lose", "restore", "freeze", "put_object")

    # Reading.

    def test_open_moves_nothing(self, bench: GripperBench) -> None:
        first, *_, last = cycles(opened(bench), 0.3)
        assert last.width == pytest.approx(first.width, abs=1e-3), "open must not move the fingers"
        assert not last.moving

    def test_readings_are_in_range_and_stamped(self, bench: GripperBench) -> None:
        spec = opened(bench).driver.spec
        move(bench, half(bench))
        readings = cycles(bench, 0.5)
        for reading in readings:
            assert -1e-3 <= reading.width <= spec.width_max + 1e-3, "width is in metres between the fingers"
            assert reading.width_target == half(bench), "width_target is the newest command's, m"
            assert reading.force is None or math.isfinite(reading.force), "what you cannot know is None"
        for before, after in itertools.pairwise(readings):
            if bench.real_time:
                assert before.t - bench.dt < after.t < bench.now + bench.dt, (
                    "t is on the clock of `now`, and not ahead of it"
                )
                assert after.t_device >= before.t_device
                assert after.seq >= before.seq
            else:
                assert after.t - before.t == pytest.approx(bench.dt), "t is the `now` of the read that measured it"
                assert after.t_device > before.t_device, "t_device is the device's own clock, which goes on"
                assert after.seq > before.seq, "seq counts the device's samples: each new one is greater"
        assert readings[-1].seq > readings[0].seq, "new readings have new numbers"

    def test_no_call_blocks(self, bench: GripperBench) -> None:
        opened(bench)
        took = []
        for k in range(30):
            now = bench.pass_time()
            began = time.perf_counter()
            bench.driver.read(now)
            if k % 3 == 0:
                move(bench, half(bench))
            took.append(time.perf_counter() - began)
        median = statistics.median(took)
        assert median < _SLOW, (
            f"read and move took {1e3 * median:.1f} ms: start the motion and return, never wait for it"
        )

    @needs("freeze")
    def test_a_device_that_freezes_shows_by_its_old_stamps(self, bench: GripperBench) -> None:
        cycles(opened(bench), 0.1)
        bench.freeze()
        cycles(bench, 0.1)  # what was on its way
        first, *_, last = cycles(bench, 0.2)
        repeat = "when nothing new came, repeat the last reading's stamps: their age is how a program notices"
        assert last.t == pytest.approx(first.t, abs=1e-3), repeat
        assert (last.t_device, last.seq) == (first.t_device, first.seq), repeat

    # Moving.

    @pytest.mark.parametrize("share", [0.25, 0.75])
    def test_it_moves_to_a_width_at_the_speed_asked_for(self, bench: GripperBench, share: float) -> None:
        spec = opened(bench).driver.spec
        move(bench, half(bench))
        assert until_rest(bench)[-1].width == pytest.approx(half(bench), abs=_AT), "move goes to a width in m"
        target = share * spec.width_max
        move(bench, target, 0.5)
        readings = until_rest(bench)
        assert any(reading.moving for reading in readings[:10]), "moving says that the fingers are on their way"
        assert readings[-1].width == pytest.approx(target, abs=_AT)
        assert not readings[-1].moving
        assert not readings[-1].grasped, "there was nothing to grasp"
        speed = _steepest(readings, bench)
        assert 0.25 * spec.speed < speed < 0.6 * spec.speed, f"asked for {spec.speed / 2:g} m/s, it was {speed:.3f}"

    def test_the_newest_command_wins(self, bench: GripperBench) -> None:
        spec = opened(bench).driver.spec
        move(bench, half(bench))
        assert until_rest(bench)[-1].width < 0.6 * spec.width_max
        move(bench, 0.0)
        cycles(bench, 0.1)
        move(bench, spec.width_max)
        last = until_rest(bench)[-1].width
        assert last == pytest.approx(spec.width_max, abs=_AT), "a newer command ends the one before it"

    def test_stop_stays_where_it_is(self, bench: GripperBench) -> None:
        start = opened(bench).driver.read(bench.pass_time()).width
        move(bench, half(bench))
        assert until_rest(bench)[-1].width != pytest.approx(start, abs=0.01)
        move(bench, 0.0, 0.5)
        at = cycles(bench, 0.2)[-1].width
        bench.driver.stop()
        stopped = cycles(bench, 0.3)[-1]
        assert stopped.width == pytest.approx(at, abs=3e-3) or bench.real_time, "stop stays where it is, at once"
        assert stopped.width > 0.01, "it stopped on the way"
        assert not stopped.moving
        assert cycles(bench, 0.2)[-1].width == pytest.approx(stopped.width, abs=1e-3), "stop stays where it is"

    # Closing.

    def test_close_does_not_move_the_fingers_and_may_be_repeated(self, bench: GripperBench) -> None:
        bench.driver.close()
        opened(bench)
        move(bench, half(bench))
        there = until_rest(bench)[-1].width
        assert there == pytest.approx(half(bench), abs=_AT)
        bench.driver.close()
        bench.driver.close()
        for _ in bench.turns(0.4):
            bench.pass_time()
        bench.driver.open()
        assert cycles(bench, 0.1)[-1].width == pytest.approx(there, abs=_AT), "close leaves the fingers where they are"

    def test_another_thread_may_close_it(self, bench: GripperBench) -> None:
        opened(bench)
        in_thread(bench.driver.close)

    def test_what_is_not_open_is_an_error(self, bench: GripperBench) -> None:
        for _ in range(2):
            with pytest.raises(HalError):
                bench.driver.read(bench.now)
            with pytest.raises(HalError):
                move(bench, half(bench))
            bench.driver.open()
            bench.driver.close()

    # Losing it.

    @needs("lose")
    def test_a_lost_link_is_an_error_at_every_use_and_never_at_close(self, bench: GripperBench) -> None:
        opened(bench)
        bench.lose()
        is_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        with pytest.raises(ConnectionLost):
            bench.driver.read(bench.pass_time())
        with pytest.raises(ConnectionLost):
            move(bench, half(bench))
        bench.driver.close()
        bench.driver.close()

    @needs("lose", "restore")
    def test_a_link_that_is_mended_can_be_opened_again(self, bench: GripperBench) -> None:
        opened(bench)
        bench.lose()
        is_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        bench.driver.close()
        bench.restore()
        comes_back(bench, bench.driver.open)
        move(bench, half(bench))
        assert until_rest(bench)[-1].width == pytest.approx(half(bench), abs=_AT)

    def test_an_unknown_knob_is_refused(self, bench: GripperBench) -> None:
        with pytest.raises((CommandError, NotSupported)):
            bench.driver.inject(no_such_knob=True)


def _steepest(readings: list[GripperReading], bench: GripperBench) -> float:
    """The greatest speed of the width, m/s; in real time, where single readings are ragged, over the middle half."""
    if not bench.real_time:
        return max(abs(b.width - a.width) for a, b in itertools.pairwise(readings)) / bench.dt
    way = readings[-1].width - readings[0].width
    middle = [r for r in readings if 0.25 < (r.width - readings[0].width) / way < 0.75]
    return abs(middle[-1].width - middle[0].width) / (middle[-1].t_device - middle[0].t_device)
