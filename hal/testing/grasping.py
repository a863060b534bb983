"""How a gripper's commands end, as a program sees it: part of :class:`~hal.testing.GripperContract`."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ..errors import ConnectionLost, StaleStateError
from ..types import GripperOutcome, GripperState
from .benches import GripperBench
from .contract import needs
from .hosting import HostedHand
from .waiting import is_lost

__all__ = ["GraspChecks"]

_AT = 2e-3
"""m within which fingers are where they were told to be."""
THING = 0.03
"""Width of what is grasped, m."""


def _target_seq(hand: HostedHand) -> int:
    newest = hand.gripper.newest()
    assert newest is not None
    return newest.target_seq


class GraspChecks:
    """The driver in the host's unit, behind the public gripper, which says how each command ended."""

    @pytest.fixture
    def hand(self, bench: GripperBench) -> Iterator[HostedHand]:
        """Open."""
        with HostedHand(bench) as hand:
            yield hand

    def test_a_motion_runs_and_is_done(self, bench: GripperBench, hand: HostedHand) -> None:
        width = bench.driver.spec.width_max / 2
        state = hand.turn(0.1)
        assert (state.outcome, state.target_seq) == (GripperOutcome.NONE, 0), "nothing was asked for yet"
        motion = hand.gripper.start(width)
        state = hand.turn(3 * bench.dt)
        assert (state.outcome, state.target_seq) == (GripperOutcome.RUNNING, 1), "it has only just begun"
        result = motion.wait(5.0)
        assert result.outcome is GripperOutcome.DONE, "a width that is reached is DONE"
        assert result.state.width == pytest.approx(width, abs=_AT)
        assert hand.turn(0.2).outcome is GripperOutcome.DONE
        assert hand.gripper.start(width).wait(5.0).outcome is GripperOutcome.DONE, "it is there already"

    def test_a_newer_command_is_the_one_that_is_judged(self, bench: GripperBench, hand: HostedHand) -> None:
        first = hand.gripper.start(0.0)
        hand.turn(0.1)
        width = bench.driver.spec.width_max
        result = hand.gripper.start(width).wait(5.0)
        assert result.outcome is GripperOutcome.DONE
        assert result.state.width == pytest.approx(width, abs=_AT)
        assert first.wait(1.0).outcome is GripperOutcome.STOPPED
        assert _target_seq(hand) == 2

    @needs("put_object")
    def test_a_grasp_holds_what_is_there_and_misses_what_is_not(self, bench: GripperBench, hand: HostedHand) -> None:
        result = hand.gripper.start_grasp(bench.driver.spec.width_max / 2).wait(5.0)
        assert result.outcome is GripperOutcome.MISSED, "there was nothing to hold"
        assert not result.state.grasped
        hand.gripper.open()
        bench.put_object(THING)
        result = hand.gripper.start_grasp(THING).wait(5.0)
        assert result.outcome is GripperOutcome.DONE, "what is there, and of the right width, is held"
        assert result.state.grasped is not False
        assert result.state.width == pytest.approx(THING, abs=3e-3)
        assert hand.turn(0.3).width == pytest.approx(THING, abs=3e-3), "and goes on being held"

    @needs("put_object")
    @pytest.mark.parametrize("expected", [0.01, 0.05])
    def test_a_grasp_of_something_else_is_missed(self, bench: GripperBench, hand: HostedHand, expected: float) -> None:
        bench.put_object(THING)
        result = hand.gripper.start_grasp(expected, inner=0.008, outer=0.008).wait(5.0)
        assert result.outcome is GripperOutcome.MISSED, "it is not of the width that was asked for"

    @needs("put_object")
    def test_closing_on_something_is_not_where_it_should_be(self, bench: GripperBench, hand: HostedHand) -> None:
        bench.put_object(THING)
        result = hand.gripper.start(0.0).wait(5.0)
        assert result.outcome is GripperOutcome.MISSED, "the width was not reached"
        assert result.state.width == pytest.approx(THING, abs=3e-3)

    def test_homing_ends(self, hand: HostedHand) -> None:
        result = hand.gripper.start_home().wait(20.0)
        assert result.outcome is GripperOutcome.DONE, "a gripper that needs no homing has nothing to do, and is DONE"

    @needs("put_object")
    @pytest.mark.parametrize("how", ["command", "rig"])
    def test_a_stop_ends_a_motion_and_keeps_a_grip(self, bench: GripperBench, hand: HostedHand, how: str) -> None:
        def stop() -> None:
            if how == "rig":
                hand.host.stop()
            else:
                hand.gripper.stop()

        hand.gripper.start(0.0)
        at = hand.turn(0.2).width
        stop()
        state = hand.turn(0.3)
        assert state.outcome is GripperOutcome.STOPPED
        assert state.width > 0.01, "it stopped on the way"
        assert state.width == pytest.approx(at, abs=5e-3) or bench.real_time, "it stopped at once"
        assert hand.turn(0.2).width == pytest.approx(state.width, abs=1e-3), "and stays there"
        hand.gripper.open()
        bench.put_object(THING)
        assert hand.gripper.grasp(THING)
        stop()
        held = hand.turn(0.3)
        assert held.width == pytest.approx(THING, abs=3e-3), "a stop never lets go"
        assert held.grasped is not False
        assert held.outcome is (GripperOutcome.DONE if how == "rig" else GripperOutcome.STOPPED)

    def test_a_command_from_before_a_stop_moves_nothing_later(self, bench: GripperBench, hand: HostedHand) -> None:
        hand.gripper.start(0.0)
        hand.host.stop()
        state: GripperState = hand.turn(0.3)
        assert (state.target_seq, state.outcome) == (1, GripperOutcome.STOPPED)
        assert state.width == pytest.approx(bench.driver.spec.width_max, abs=_AT)

    @needs("freeze")
    def test_a_program_learns_that_it_froze(self, bench: GripperBench, hand: HostedHand) -> None:
        hand.turn(0.1)
        bench.freeze()
        with pytest.raises((StaleStateError, ConnectionLost)):
            hand.turn(0.6)

    @needs("lose")
    def test_a_program_learns_that_it_is_lost(self, bench: GripperBench, hand: HostedHand) -> None:
        hand.turn(0.1)
        bench.lose()
        is_lost(bench, lambda: hand.turn(0.6))
