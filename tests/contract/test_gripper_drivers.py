"""What every GripperDriver owes to the host."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import pytest

from hal.gripper import GripperReading

from .benches import GRIPPERS, GripperBench


@pytest.fixture(params=GRIPPERS)
def bench(request: pytest.FixtureRequest) -> Iterator[GripperBench]:
    with GRIPPERS[request.param]() as bench:
        yield bench


def cycles(bench: GripperBench, seconds: float) -> list[GripperReading]:
    return [bench.driver.read(bench.pass_time()) for _ in range(round(seconds / bench.dt))]


def half(bench: GripperBench) -> float:
    return bench.driver.spec.width_max / 2


def test_open_moves_nothing(bench: GripperBench) -> None:
    bench.driver.open()
    first, *_, last = cycles(bench, 0.3)
    assert last.width == pytest.approx(first.width, abs=1e-3)
    assert not last.moving


def test_readings_are_in_range_and_stamped(bench: GripperBench) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    readings = cycles(bench, 0.5)
    for reading in readings:
        assert -1e-3 <= reading.width <= spec.width_max + 1e-3
        assert reading.width_target == half(bench)
        assert reading.force is None or math.isfinite(reading.force)
    for before, after in itertools.pairwise(readings):
        assert after.t - before.t == pytest.approx(bench.dt)
        assert after.t_device > before.t_device
        assert after.seq > before.seq


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_it_moves_to_a_width_at_the_speed_asked_for(bench: GripperBench, share: float) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width == pytest.approx(half(bench), abs=2e-3)
    target = share * spec.width_max
    speed = spec.speed / 2
    bench.driver.move(target, speed, spec.force)
    readings = cycles(bench, 2.0)
    assert readings[5].moving
    assert (readings[-1].width, readings[-1].moving) == (pytest.approx(target, abs=2e-3), False)
    widths = [reading.width for reading in readings]
    steepest = max(abs(b - a) for a, b in itertools.pairwise(widths)) / bench.dt
    assert 0.5 * speed < steepest < 1.2 * speed
    assert not readings[-1].grasped, "there was nothing to grasp"


def test_the_newest_command_wins(bench: GripperBench) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width < 0.6 * spec.width_max
    bench.driver.move(0.0, spec.speed, spec.force)
    cycles(bench, 0.1)
    bench.driver.move(spec.width_max, spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width == pytest.approx(spec.width_max, abs=2e-3)


def test_stop_stays_where_it_is(bench: GripperBench) -> None:
    bench.driver.open()
    spec = bench.driver.spec
    start = bench.driver.read(bench.pass_time()).width
    bench.driver.move(half(bench), spec.speed, spec.force)
    assert cycles(bench, 2.0)[-1].width != pytest.approx(start, abs=0.01)
    bench.driver.move(0.0, spec.speed / 2, spec.force)
    at = cycles(bench, 0.2)[-1].width
    bench.driver.stop()
    stopped = cycles(bench, 1.0)[-1]
    assert stopped.width == pytest.approx(at, abs=3e-3)
    assert stopped.width > 0.01, "it stopped on the way"
    assert not stopped.moving


def test_close_does_not_move_the_fingers_and_may_be_repeated(bench: GripperBench) -> None:
    bench.driver.close()
    bench.driver.open()
    spec = bench.driver.spec
    bench.driver.read(bench.pass_time())
    bench.driver.move(half(bench), spec.speed, spec.force)
    there = cycles(bench, 2.0)[-1].width
    assert there == pytest.approx(half(bench), abs=2e-3)
    bench.driver.close()
    bench.driver.close()
    for _ in range(100):
        bench.pass_time()
    bench.driver.open()
    assert cycles(bench, 0.1)[-1].width == pytest.approx(there, abs=2e-3)
