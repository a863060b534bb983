"""Takeover: a person drives in between, and the arm's set-point never steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import hal
from hal.learning.policy import PolicyOutcome, PolicyRunner
from hal.learning.takeover import Takeover

Rig = hal.Rig
SIDES = {"left": 0.6, "right": -0.6}


class Wave:
    """Chunks along a sine, asked again after every restart, which takes eight turns."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.restarts, self.calls, self.next, self.waits = rig, 0, 0, 0.0, 0

    def restart(self) -> None:
        self.restarts += 1
        self.next, self.waits = 0.0, 8

    def __call__(self, observation: hal.Observation) -> hal.JointChunk | None:
        self.calls += 1
        self.waits -= 1
        if self.waits > 0 or observation.t < self.next:
            return None
        if not self.next:
            self.start, self.t0 = self.rig.robots["panda"].state().q_set, observation.t
        t = observation.t + np.arange(16) / 20
        self.next = t[8]
        return hal.JointChunk(t, self.start + 0.1 * np.sin(2.0 * (t - self.t0))[:, None] * np.eye(7)[0])


def drive(
    rig: Rig, touches: list[tuple[float, float]], axis: str, seconds: float = 4.0
) -> tuple[PolicyOutcome, np.ndarray[Any, Any], Wave]:
    """Run the policy while a person moves an axis of the pad in some intervals, by the run's own time.

    Returns:
        The outcome; per turn the time, q_set (7,), dq_set (7,) and the height of the tcp; the policy.
    """
    arm, pad = rig.robots["panda"], rig.driver("pad")
    policy, seen = Wave(rig), []
    pad.press("l2")
    start = rig.clock.now()

    def turn(_: float) -> None:
        elapsed = rig.clock.now() - start
        pad.stick(axis, 1.0 if any(begin <= elapsed < end for begin, end in touches) else 0.0)
        state = arm.state()
        seen.append((elapsed, *state.q_set, *state.dq_set, state.tcp_set.position[2]))

    runner = PolicyRunner(
        rig,
        policy,
        rate_hz=50,
        seconds=seconds,
        cameras=(),
        deadman=rig.gamepads["pad"].hold("l2"),
        takeover=Takeover(hal.Teleop(arm), rig.gamepads["pad"]),
    )
    return runner.run(on_turn=turn), np.array(seen), policy


def test_a_person_drives_while_a_stick_is_held_and_the_policy_is_asked_again(rig: Rig) -> None:
    outcome, seen, policy = drive(rig, [(1.0, 2.0)], "dpad_y")
    arm = rig.robots["panda"]
    assert (outcome.ended, policy.restarts) == ("time", 1)
    ((begin, end),) = outcome.interventions
    assert 0.9 < end - begin - 0.3 < 1.1
    t, q, dq = seen[:, 0], seen[:, 1:8], seen[:, 8:15]
    by_hand = (t > 1.4) & (t < 1.95)
    assert np.ptp(q[by_hand, 3]) > 0.02, "the person moves the elbow, which the policy never does"
    assert np.ptp(q[t < 0.95, 3]) < 1e-3
    assert np.ptp(q[t > 2.5, 0]) > 0.05, "the policy drives again"
    # No step anywhere: between two turns a joint moves as its speed says, and the speed as the acceleration allows.
    assert np.abs(np.diff(q, axis=0)).max() <= 0.021 * np.abs(dq).max() + 1e-6
    assert (np.abs(np.diff(dq, axis=0)).max(axis=0) <= 0.021 * np.asarray(arm.limits.acceleration)).all()


def test_the_first_turn_of_a_takeover_moves_as_the_person_says(rig: Rig) -> None:
    _, seen, _ = drive(rig, [(1.0, 1.5)], "dpad_y", seconds=2.0)
    t, elbow = seen[:, 0], seen[:, 11]
    moving = np.flatnonzero((t >= 1.0) & (np.abs(elbow) > 1e-3))
    assert t[moving[0]] - 1.0 <= 0.05 + 1e-9


def test_short_rests_of_the_stick_do_not_hand_the_arm_back(rig: Rig) -> None:
    outcome, _, policy = drive(rig, [(1.0, 1.3), (1.4, 1.7), (2.5, 2.7)], "dpad_x")
    assert len(outcome.interventions) == 2
    assert policy.restarts == 2


def test_a_gripper_that_the_policy_closed_stays_closed_in_a_takeover(rig: Rig) -> None:
    arm, pad = rig.robots["panda"], rig.driver("pad")
    assert arm.gripper is not None
    pad.press("l2")
    widths = []

    def close(observation: hal.Observation) -> tuple[hal.Twist, float]:
        return hal.Twist([0.0, 0.0, 0.0]), 1.0

    def turn(seconds: float) -> None:
        pad.stick("dpad_x", 1.0 if 1.5 < seconds < 2.0 else 0.0)
        widths.append(arm.gripper.state().width)

    takeover = Takeover(hal.Teleop(arm), rig.gamepads["pad"])
    hold = rig.gamepads["pad"].hold("l2")
    PolicyRunner(rig, close, rate_hz=50, seconds=2.5, cameras=(), deadman=hold, takeover=takeover).run(on_turn=turn)
    assert len(takeover.intervals) == 1
    assert max(widths[-40:]) < 0.002


TWO = {"robots": {side: {"model": "panda", "base": {"position": [0.0, y, 0.0]}} for side, y in SIDES.items()}}
SWING = hal.JointVelocity([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2])


def test_an_arm_that_follows_rests_until_the_other_one_follows_too(monkeypatch: pytest.MonkeyPatch) -> None:
    follows, turns = hal.Control.hold_until_following, []

    def follow(control: hal.Control) -> bool:
        turns.append(control.robot.name)
        if control.robot.name == "left" and turns.count("left") < 20:
            control.send(hal.JointTarget(control.robot.state().q_set))
            return False
        return follows(control)

    monkeypatch.setattr(hal.Control, "hold_until_following", follow)
    with hal.open(TWO, driver="mock") as rig:
        swing = dict.fromkeys(rig.robots, SWING)
        outcome = PolicyRunner(rig, lambda _: swing, robots=rig.robots.values(), rate_hz=50, seconds=0.2).run()
    assert (outcome.ended, outcome.reason) == ("time", "")


def test_the_other_arm_rests_in_a_takeover_and_both_pause_with_the_dead_man() -> None:
    with hal.open({**TWO, "gamepads": {"pad": {"model": "auto"}}}, driver="mock") as rig:
        pad, seen = rig.driver("pad"), []
        pad.press("l2")

        def turn(seconds: float) -> None:
            t = rig.clock.now() - start
            pad.stick("dpad_x", 1.0 if 0.5 < t < 0.9 else 0.0)
            if 1.7 < t < 1.8:
                pad.release("l2")
            elif t > 1.9:
                pad.press("l2")
            seen.append((t, *(np.abs(arm.state().dq_set).max() for arm in rig.robots.values())))

        runner = PolicyRunner(
            rig,
            lambda observation: dict.fromkeys(rig.robots, SWING),
            robots=rig.robots.values(),
            rate_hz=50,
            seconds=2.0,
            deadman=rig.gamepads["pad"].hold("l2"),
            takeover=Takeover(hal.Teleop(rig.robots["left"]), rig.gamepads["pad"]),
        )
        start = rig.clock.now()
        outcome = runner.run(on_turn=turn)
        assert (outcome.ended, outcome.pauses, len(outcome.interventions)) == ("time", 1, 1)
        t, left, right = np.array(seen).T
        by_hand, resumed = (t > 0.8) & (t < 0.9), (t > 1.5) & (t < 1.7)
        assert left[by_hand].min() > 0.01
        assert right[by_hand].max() < 1e-6
        assert min(left[resumed].min(), right[resumed].min()) > 0.1
        released = (t > 1.84) & (t < 1.9)
        assert max(left[released].max(), right[released].max()) < 0.1
        assert min(left[-1], right[-1]) > 0.1
        with pytest.raises(hal.CommandError):
            PolicyRunner(
                rig,
                lambda observation: SWING,
                robots=[rig.robots["right"]],
                takeover=Takeover(hal.Teleop(rig.robots["left"]), rig.gamepads["pad"]),
            )
