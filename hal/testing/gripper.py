"""The contract of a GripperDriver: what the host and the public Gripper rely on."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Iterator

import pytest

from ..driver import GripperReading
from ..errors import CommandError, ConnectionLost, HalError, NotSupported, StaleStateError
from ..types import GripperOutcome, GripperState
from .benches import Contract, GripperBench, needs, run_in_thread, wait_lost, wait_restored
from .hosting import HostedGripper

_SLOW = 0.01
"""s; a call whose median is longer blocks."""
_AT = 2e-3
"""m; tolerance of a width that was reached."""
_REST = 0.1
"""s without motion after which fingers are at rest."""
_LIMIT = 5.0
"""s within which every motion must end."""
_OBJECT = 0.03
"""Width of the object that is grasped, m."""


def _run(bench: GripperBench, seconds: float) -> list[GripperReading]:
    """Run cycles for ``seconds``, and return their readings."""
    return [bench.driver.read(bench.pass_time()) for _ in bench.turns(seconds)]


def _run_until_rest(bench: GripperBench) -> list[GripperReading]:
    """Run cycles until the fingers have been at rest for a tenth of a second, and return the readings."""
    readings = _run(bench, _REST)
    still = 0.0
    for _ in bench.turns(_LIMIT):
        readings += _run(bench, bench.dt)
        still = 0.0 if readings[-1].moving else still + bench.dt
        if still > _REST:
            return readings
    raise AssertionError(f"the fingers still move after {_LIMIT:g} s: {readings[-1]}")


def _half(bench: GripperBench) -> float:
    return bench.driver.spec.width_max / 2


def _open_driver(bench: GripperBench) -> GripperBench:
    bench.driver.open()
    bench.driver.read(bench.pass_time())
    return bench


def _move(bench: GripperBench, width: float, share: float = 1.0) -> None:
    """Start a motion to ``width`` (m) at a share of the greatest speed."""
    spec = bench.driver.spec
    bench.driver.move(width, share * spec.speed, spec.force)


def _peak_speed(readings: list[GripperReading], bench: GripperBench) -> float:
    """Return the greatest speed of the width, m/s; in real time, where readings jitter, that over the middle half."""
    if not bench.real_time:
        return max(abs(b.width - a.width) for a, b in itertools.pairwise(readings)) / bench.dt
    way = readings[-1].width - readings[0].width
    middle = [r for r in readings if 0.25 < (r.width - readings[0].width) / way < 0.75]
    return abs(middle[-1].width - middle[0].width) / (middle[-1].t_device - middle[0].t_device)


class GripperContract(Contract):
    """Checks of a gripper's driver. The bench is a :class:`~hal.testing.GripperBench`.

    ``left_out`` may name ``lose``, ``restore``, ``freeze`` and ``put_object``.
    """

    abilities = ("lose", "restore", "freeze", "put_object")

    # Reading.

    def test_open_does_not_move_the_fingers(self, bench: GripperBench) -> None:
        first, *_, last = _run(_open_driver(bench), 0.3)
        assert last.width == pytest.approx(first.width, abs=1e-3), "open must not move the fingers"
        assert not last.moving

    def test_readings_are_in_range_and_stamped(self, bench: GripperBench) -> None:
        spec = _open_driver(bench).driver.spec
        _move(bench, _half(bench))
        readings = _run(bench, 0.5)
        for reading in readings:
            assert -1e-3 <= reading.width <= spec.width_max + 1e-3, "width is in metres between the fingers"
            assert reading.width_target == _half(bench), "width_target is the newest command's, m"
            assert reading.force is None or math.isfinite(reading.force), "an unknown value is None"
        for before, after in itertools.pairwise(readings):
            if bench.real_time:
                assert before.t - bench.dt < after.t < bench.now + bench.dt, (
                    "t is on the clock of `now`, and not ahead of it"
                )
                assert after.t_device >= before.t_device
                assert after.seq >= before.seq
            else:
                assert after.t - before.t == pytest.approx(bench.dt), "t is the `now` of the read that measured it"
                assert after.t_device > before.t_device, "t_device is the device's own clock, and must advance"
                assert after.seq > before.seq, "seq counts the device's samples: each new one is greater"
        assert readings[-1].seq > readings[0].seq, "new readings have new numbers"

    def test_no_call_blocks(self, bench: GripperBench) -> None:
        _open_driver(bench)
        took = []
        for k in range(30):
            now = bench.pass_time()
            began = time.perf_counter()
            bench.driver.read(now)
            if k % 3 == 0:
                _move(bench, _half(bench))
            took.append(time.perf_counter() - began)
        median = statistics.median(took)
        assert median < _SLOW, (
            f"read and move took {1e3 * median:.1f} ms: start the motion and return, never wait for it"
        )

    @needs("freeze")
    def test_a_frozen_device_repeats_its_stamps(self, bench: GripperBench) -> None:
        _run(_open_driver(bench), 0.1)
        bench.freeze()
        _run(bench, 0.1)  # samples that were under way
        first, *_, last = _run(bench, 0.2)
        repeat = "without a new sample repeat the last reading's stamps: their age is how an app notices"
        assert last.t == pytest.approx(first.t, abs=1e-3), repeat
        assert (last.t_device, last.seq) == (first.t_device, first.seq), repeat

    # Moving.

    @pytest.mark.parametrize("share", [0.25, 0.75])
    def test_moves_reach_their_width_at_their_speed(self, bench: GripperBench, share: float) -> None:
        spec = _open_driver(bench).driver.spec
        _move(bench, _half(bench))
        assert _run_until_rest(bench)[-1].width == pytest.approx(_half(bench), abs=_AT), "move takes a width in m"
        target = share * spec.width_max
        _move(bench, target, 0.5)
        readings = _run_until_rest(bench)
        assert any(reading.moving for reading in readings[:10]), "moving is True while the fingers move"
        assert readings[-1].width == pytest.approx(target, abs=_AT)
        assert not readings[-1].moving
        assert not readings[-1].grasped, "there was no object to grasp"
        speed = _peak_speed(readings, bench)
        assert 0.25 * spec.speed < speed < 0.6 * spec.speed, (
            f"move takes a speed: it should be {spec.speed / 2:g} m/s, and is {speed:.3f}"
        )

    def test_the_newest_command_wins(self, bench: GripperBench) -> None:
        spec = _open_driver(bench).driver.spec
        _move(bench, _half(bench))
        assert _run_until_rest(bench)[-1].width < 0.6 * spec.width_max
        _move(bench, 0.0)
        _run(bench, 0.1)
        _move(bench, spec.width_max)
        last = _run_until_rest(bench)[-1].width
        assert last == pytest.approx(spec.width_max, abs=_AT), "a newer command replaces the one before it"

    def test_stop_holds_the_width(self, bench: GripperBench) -> None:
        start = _open_driver(bench).driver.read(bench.pass_time()).width
        _move(bench, _half(bench))
        assert _run_until_rest(bench)[-1].width != pytest.approx(start, abs=0.01)
        _move(bench, 0.0, 0.25)
        at = _run(bench, 0.2)[-1].width
        bench.driver.stop()
        stopped = _run_until_rest(bench)[-1]
        assert stopped.width == pytest.approx(at, abs=3e-3) or bench.real_time, "stop holds the present width, at once"
        assert stopped.width > 0.01, "the motion was stopped before its end"
        assert _run(bench, 0.2)[-1].width == pytest.approx(stopped.width, abs=1e-3), "stop holds the width"

    # Closing.

    def test_close_does_not_move_the_fingers_and_may_be_repeated(self, bench: GripperBench) -> None:
        bench.driver.close()
        _open_driver(bench)
        _move(bench, _half(bench))
        width = _run_until_rest(bench)[-1].width
        assert width == pytest.approx(_half(bench), abs=_AT)
        bench.driver.close()
        bench.driver.close()
        for _ in bench.turns(0.4):
            bench.pass_time()
        bench.driver.open()
        assert _run(bench, 0.1)[-1].width == pytest.approx(width, abs=_AT), "close must not move the fingers"

    def test_another_thread_may_close(self, bench: GripperBench) -> None:
        _open_driver(bench)
        run_in_thread(bench.driver.close)

    def test_a_driver_that_is_not_open_raises(self, bench: GripperBench) -> None:
        for _ in range(2):
            with pytest.raises(HalError):
                bench.driver.read(bench.now)
            with pytest.raises(HalError):
                _move(bench, _half(bench))
            bench.driver.open()
            bench.driver.close()

    # Lost links.

    @needs("lose")
    def test_a_lost_link_raises_at_every_call_except_close(self, bench: GripperBench) -> None:
        _open_driver(bench)
        bench.lose()
        wait_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        with pytest.raises(ConnectionLost):
            bench.driver.read(bench.pass_time())
        with pytest.raises(ConnectionLost):
            _move(bench, _half(bench))
        bench.driver.close()
        bench.driver.close()

    @needs("lose", "restore")
    def test_a_restored_link_can_be_opened_again(self, bench: GripperBench) -> None:
        _open_driver(bench)
        bench.lose()
        wait_lost(bench, lambda: bench.driver.read(bench.pass_time()))
        bench.driver.close()
        bench.restore()
        wait_restored(bench, bench.driver.open)
        _move(bench, _half(bench))
        assert _run_until_rest(bench)[-1].width == pytest.approx(_half(bench), abs=_AT)

    def test_an_unknown_fault_to_inject_is_refused(self, bench: GripperBench) -> None:
        with pytest.raises((CommandError, NotSupported)):
            bench.driver.inject(no_such_fault=True)

    # Behind the public Gripper, which reports how each command ended.

    @pytest.fixture
    def hosted(self, bench: GripperBench) -> Iterator[HostedGripper]:
        """The gripper behind its public class, open."""
        with HostedGripper(bench) as hosted:
            yield hosted

    def test_a_motion_is_running_and_then_done(self, bench: GripperBench, hosted: HostedGripper) -> None:
        width = bench.driver.spec.width_max / 2
        state = hosted.run_for(0.1)
        assert (state.outcome, state.target_seq) == (GripperOutcome.NONE, 0), "there was no command yet"
        motion = hosted.gripper.start(width)
        state = hosted.run_for(3 * bench.dt)
        assert (state.outcome, state.target_seq) == (GripperOutcome.RUNNING, 1), "the motion has just started"
        result = motion.wait(5.0)
        assert result.outcome is GripperOutcome.DONE, "a command whose width is reached is DONE"
        assert result.state.width == pytest.approx(width, abs=_AT)
        assert hosted.run_for(0.2).outcome is GripperOutcome.DONE
        assert hosted.gripper.start(width).wait(5.0).outcome is GripperOutcome.DONE, (
            "a width that is already reached is DONE"
        )

    def test_the_outcome_is_that_of_the_newest_command(self, bench: GripperBench, hosted: HostedGripper) -> None:
        first = hosted.gripper.start(0.0)
        hosted.run_for(0.1)
        width = bench.driver.spec.width_max
        result = hosted.gripper.start(width).wait(5.0)
        assert result.outcome is GripperOutcome.DONE
        assert result.state.width == pytest.approx(width, abs=_AT)
        assert first.wait(1.0).outcome is GripperOutcome.STOPPED
        assert _target_seq(hosted) == 2

    @needs("put_object")
    def test_a_grasp_holds_an_object_and_misses_without_one(self, bench: GripperBench, hosted: HostedGripper) -> None:
        result = hosted.gripper.start_grasp(bench.driver.spec.width_max / 2).wait(5.0)
        assert result.outcome is GripperOutcome.MISSED, "a grasp without an object is MISSED"
        assert not result.state.grasped
        hosted.gripper.open()
        bench.put_object(_OBJECT)
        result = hosted.gripper.start_grasp(_OBJECT).wait(5.0)
        assert result.outcome is GripperOutcome.DONE, "an object of the expected width is held"
        assert result.state.grasped is not False
        assert result.state.width == pytest.approx(_OBJECT, abs=3e-3)
        assert hosted.run_for(0.3).width == pytest.approx(_OBJECT, abs=3e-3), "the object must stay held"

    @needs("put_object")
    @pytest.mark.parametrize("expected", [0.01, 0.05])
    def test_a_grasp_of_another_width_is_missed(
        self, bench: GripperBench, hosted: HostedGripper, expected: float
    ) -> None:
        bench.put_object(_OBJECT)
        result = hosted.gripper.start_grasp(expected, inner=0.008, outer=0.008).wait(5.0)
        assert result.outcome is GripperOutcome.MISSED, "the object is not of the expected width"

    @needs("put_object")
    def test_closing_on_an_object_is_missed(self, bench: GripperBench, hosted: HostedGripper) -> None:
        bench.put_object(_OBJECT)
        result = hosted.gripper.start(0.0).wait(5.0)
        assert result.outcome is GripperOutcome.MISSED, "the width was not reached"
        assert result.state.width == pytest.approx(_OBJECT, abs=3e-3)

    def test_homing_is_done(self, hosted: HostedGripper) -> None:
        result = hosted.gripper.start_home().wait(20.0)
        assert result.outcome is GripperOutcome.DONE, "a gripper that needs no homing is DONE at once"

    @needs("put_object")
    @pytest.mark.parametrize("how", ["command", "rig"])
    def test_a_stop_ends_a_motion_and_keeps_a_grasp(self, bench: GripperBench, hosted: HostedGripper, how: str) -> None:
        def stop() -> None:
            if how == "rig":
                hosted.host.latch.stop()
            else:
                hosted.gripper.stop()

        hosted.gripper.start(0.0)
        at = hosted.run_for(0.2).width
        stop()
        state = hosted.run_for(0.3 if bench.real_time else 0.15)
        assert state.outcome is GripperOutcome.STOPPED
        assert state.width > 0.01, "the motion was stopped before its end"
        assert state.width == pytest.approx(at, abs=5e-3) or bench.real_time, "the fingers stopped at once"
        assert hosted.run_for(0.2).width == pytest.approx(state.width, abs=1e-3), "the fingers stay where they stopped"
        hosted.host.latch.acknowledge(hosted.host.latch.stops)
        hosted.gripper.open()
        bench.put_object(_OBJECT)
        assert hosted.gripper.grasp(_OBJECT)
        stop()
        held = hosted.run_for(0.3)
        assert held.width == pytest.approx(_OBJECT, abs=3e-3), "a stop must not release an object"
        assert held.grasped is not False
        assert held.outcome is (GripperOutcome.DONE if how == "rig" else GripperOutcome.STOPPED)

    def test_a_command_from_before_a_stop_moves_nothing(self, bench: GripperBench, hosted: HostedGripper) -> None:
        hosted.gripper.start(0.0)
        hosted.host.latch.stop()
        state: GripperState = hosted.run_for(0.3)
        assert (state.target_seq, state.outcome) == (1, GripperOutcome.STOPPED)
        assert state.width == pytest.approx(bench.driver.spec.width_max, abs=_AT)

    @needs("freeze")
    def test_an_app_notices_a_frozen_device(self, bench: GripperBench, hosted: HostedGripper) -> None:
        hosted.run_for(0.1)
        bench.freeze()
        with pytest.raises((StaleStateError, ConnectionLost)):
            hosted.run_for(0.6)

    @needs("lose")
    def test_an_app_notices_a_lost_link(self, bench: GripperBench, hosted: HostedGripper) -> None:
        hosted.run_for(0.1)
        bench.lose()
        wait_lost(bench, lambda: hosted.run_for(0.6))


def _target_seq(hosted: HostedGripper) -> int:
    newest = hosted.gripper.peek()
    assert newest is not None
    return newest.target_seq
