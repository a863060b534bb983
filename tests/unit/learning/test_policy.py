"""Policies: where they come from, and what ends an episode of one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.learning.policy import PolicyRunner, load_policy

Rig = hal.Rig
UP = hal.Twist([0.0, 0.0, 0.05])


def height(rig: Rig) -> float:
    return float(rig.robots["panda"].state().tcp.position[2])


def is_at_rest(rig: Rig) -> bool:
    rig.clock.sleep(0.01)
    return float(np.abs(rig.robots["panda"].state().dq_set).max()) < 1e-9


class Chunks:
    """Looks ``ahead`` s into the future and thinks for ``thinks`` s."""

    def __init__(self, rig: Rig, ahead: float, thinks: float) -> None:
        self.rig, self.ahead, self.thinks = rig, ahead, thinks
        self.start = rig.robots["panda"].state().q_set
        self.t0 = rig.clock.now()

    def __call__(self, observation: hal.Observation) -> hal.JointChunk:
        self.rig.clock.sleep(self.thinks)
        t = observation.t + np.arange(0.0, self.ahead, 0.05)
        return hal.JointChunk(t, self.start + 0.1 * np.sin(t - self.t0)[:, None])


# What a policy is.

MODULE = """
import hal

made = []

def act(observation):
    return None

class WithRig:
    def __init__(self, rig, extra=1):
        made.append(rig)

    def __call__(self, observation):
        return None

class Without:
    def __call__(self, observation):
        return None

class Dumb:
    pass

number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    (tmp_path / "some_policies.py").write_text(MODULE)
    (tmp_path / "lacking_policies.py").write_text("import a_missing_library")
    monkeypatch.syspath_prepend(str(tmp_path))
    import importlib

    yield importlib.import_module("some_policies")
    for name in ("some_policies", "lacking_policies"):
        sys.modules.pop(name, None)


def test_a_class_is_made_once_with_the_rig_where_it_takes_one(rig: Rig, module: Any) -> None:
    assert load_policy("some_policies:act", rig) is module.act
    assert isinstance(load_policy("some_policies:Without", rig), module.Without)
    assert isinstance(load_policy("some_policies:WithRig", rig), module.WithRig)
    assert module.made == [rig]


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ("some_policies", "not_importable"),
        ("some_policies:", "not_importable"),
        ("nowhere_at_all:act", "not_importable"),
        ("some_policies:acct", "not_importable"),
        ("some_policies:number", "not_callable"),
        ("some_policies:Dumb", "not_callable"),
        ("lacking_policies:act", "not_importable"),
    ],
)
def test_an_object_that_is_no_policy_is_refused(rig: Rig, module: Any, place: str, code: str) -> None:
    with raises_code(hal.CommandError, code):
        load_policy(place, rig)


# An episode.


def test_the_policy_is_called_at_its_rate_until_the_time_is_over(rig: Rig) -> None:
    asked: list[float] = []

    def policy(observation: hal.Observation) -> tuple[hal.Twist, float]:
        asked.append(observation.t)
        return UP, 1.7  # a network's output beyond 1 means closed

    before = height(rig)
    outcome = PolicyRunner(rig, policy, rate_hz=20, seconds=2.0).run()
    assert (outcome.ended, outcome.success, outcome.reason) == ("time", None, "")
    assert outcome.turns == len(asked) == 40
    assert np.diff(asked) == pytest.approx(0.05, abs=0.005)
    assert (outcome.missed, outcome.repeated, outcome.pauses) == (0, 0, 0)
    assert height(rig) - before == pytest.approx(0.1, abs=0.02)
    gripper = rig.robots["panda"].gripper
    assert gripper is not None
    assert gripper.state().width < 0.005
    assert outcome.inference["p50"] is not None
    assert is_at_rest(rig)


def test_turns_without_a_newer_observation_are_counted(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = rig.observe(cameras=())
    monkeypatch.setattr(rig, "observe", lambda **_: seen)
    outcome = PolicyRunner(rig, lambda _: UP, rate_hz=20, seconds=0.5).run()
    assert (outcome.turns, outcome.repeated) == (10, 9)


def test_reset_gets_the_seed_and_a_rehearsal_moves_nothing(rig: Rig) -> None:
    calls: list[Any] = []

    class Policy:
        def reset(self, seed: int | None) -> None:
            calls.append(seed)

        def __call__(self, observation: hal.Observation) -> hal.Twist:
            calls.append("asked")
            return UP

    before = height(rig)
    runner = PolicyRunner(rig, Policy(), seconds=0.1)
    runner.rehearse()
    rig.clock.sleep(0.5)
    assert height(rig) == before
    runner.run(seed=7)
    assert calls == [None, "asked", 7, "asked", "asked"]


@pytest.mark.parametrize(
    ("policy", "error"),
    [
        (lambda o: np.zeros(7), hal.CommandError),
        (lambda o: (UP, 0.0, 1.0), hal.CommandError),
        (lambda o: 1 / 0, ZeroDivisionError),
    ],
)
def test_a_rehearsal_shows_what_is_wrong(rig: Rig, policy: Callable[[Any], Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        PolicyRunner(rig, policy).rehearse()


def test_chunks_are_followed_and_none_continues_the_last_one(rig: Rig) -> None:
    chunks, turn = Chunks(rig, ahead=1.0, thinks=0.0), 0
    heard: list[np.ndarray] = []

    def policy(observation: hal.Observation) -> hal.JointChunk | None:
        nonlocal turn
        turn += 1
        heard.append(observation.robots["panda"].q)
        return chunks(observation) if turn % 10 == 1 else None

    outcome = PolicyRunner(rig, policy, rate_hz=20, seconds=3.0).run()
    assert outcome.ended == "time"
    assert np.ptp([q[0] for q in heard]) > 0.09


def test_a_late_policy_trips_like_any_program(rig: Rig) -> None:
    def policy(observation: hal.Observation) -> hal.Twist:
        if rig.clock.now() > 1.0:
            rig.clock.sleep(0.4)
        return UP

    rig.clock.sleep(0.2)
    outcome = PolicyRunner(rig, policy, rate_hz=20).run()
    assert (outcome.ended, outcome.success, outcome.code) == ("stopped", False, "command_deadline")
    assert "commands stopped coming" in outcome.reason
    assert is_at_rest(rig)


def test_a_chunk_lasts_while_the_policy_thinks_and_the_turns_it_misses_are_counted(rig: Rig) -> None:
    outcome = PolicyRunner(rig, Chunks(rig, ahead=1.0, thinks=0.4), rate_hz=20, seconds=3.0).run()
    assert outcome.ended == "time"
    assert outcome.turns == pytest.approx(3.0 / 0.4, abs=2)
    assert outcome.missed == pytest.approx(3.0 / 0.05 - outcome.turns, abs=9)
    short = PolicyRunner(rig, Chunks(rig, ahead=0.3, thinks=0.4), rate_hz=20, seconds=3.0).run()
    assert short.ended in ("stopped", "error"), "its chunk ran out, or was over before it was sent"
    assert is_at_rest(rig)


@pytest.mark.parametrize("good", [1, 10])
@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda o: 1 / 0, "ZeroDivisionError"),
        (lambda o: hal.JointTarget(o.robots["panda"].q[:3]), "CommandError"),
        (lambda o: hal.Twist([np.nan, 0, 0]), "CommandError"),
        (lambda o: (UP, float("nan")), "CommandError"),
        (lambda o: "up", "CommandError"),
    ],
)
def test_what_a_policy_raises_ends_the_episode_and_the_arm_is_at_rest(
    rig: Rig, wrong: Callable[[hal.Observation], Any], text: str, good: int
) -> None:
    turn = 0

    def policy(observation: hal.Observation) -> Any:
        nonlocal turn
        turn += 1
        return UP if turn < good else wrong(observation)

    outcome = PolicyRunner(rig, policy).run()
    assert (outcome.ended, outcome.success) == ("error", False)
    assert text in outcome.reason
    assert type(outcome.error).__name__ == text
    assert outcome.turns >= good - 1
    assert is_at_rest(rig)


def test_a_first_answer_may_take_longer_but_not_for_ever(rig: Rig) -> None:
    def thinks(seconds: float) -> Callable[[hal.Observation], hal.Twist]:
        turn = 0

        def policy(observation: hal.Observation) -> hal.Twist:
            nonlocal turn
            turn += 1
            rig.clock.sleep(seconds if turn == 1 else 0.0)
            return UP

        return policy

    assert PolicyRunner(rig, thinks(2.0), seconds=4.0).run().ended == "time"
    assert PolicyRunner(rig, thinks(3.0), seconds=4.0).run().ended == "stopped"


def test_ctrl_c_is_not_an_outcome(rig: Rig) -> None:
    def policy(observation: hal.Observation) -> hal.Twist:
        if rig.clock.now() > 0.5:
            raise KeyboardInterrupt
        return UP

    with pytest.raises(KeyboardInterrupt):
        PolicyRunner(rig, policy).run()
    assert is_at_rest(rig)


def test_success_is_judged_or_marked(rig: Rig) -> None:
    start = height(rig)
    runner = PolicyRunner(rig, lambda o: UP, seconds=3.0, success=lambda rig, o: height(rig) > start + 0.05)
    outcome = runner.run()
    assert (outcome.ended, outcome.success) == ("success", True)
    assert outcome.seconds == pytest.approx(1.1, abs=0.3)
    outcome = PolicyRunner(rig, lambda o: UP, seconds=0.5, success=lambda rig, o: False).run()
    assert (outcome.ended, outcome.success) == ("time", False)
    end = rig.clock.now() + 0.5
    outcome = PolicyRunner(rig, lambda o: UP, mark=lambda: False if rig.clock.now() > end else None).run()
    assert (outcome.ended, outcome.success) == ("failure", False)


def test_without_the_dead_man_the_policy_is_not_called_and_time_pauses(rig: Rig) -> None:
    hand, asked = rig.driver("pad"), []
    start = rig.clock.now()

    def policy(observation: hal.Observation) -> hal.Twist:
        asked.append(observation.t - start)
        return UP

    def on_turn(seconds: float) -> None:
        elapsed = rig.clock.now() - start
        for t, held in ((0.5, True), (1.0, False), (2.0, True)):
            if elapsed >= t:
                (hand.press if held else hand.release)("l2")
        assert elapsed < 10.0

    runner = PolicyRunner(rig, policy, seconds=1.5, deadman=rig.gamepads["pad"].hold("l2"))
    outcome = runner.run(on_turn=on_turn)
    assert outcome.ended == "time"
    assert outcome.pauses == 1
    assert outcome.turns == pytest.approx(30, abs=2)
    assert min(asked) >= 0.5
    assert not [t for t in asked if 1.05 < t < 2.0]
    assert max(asked) > 2.5
