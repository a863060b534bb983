"""A policy on a server: its messages, and chunks that overlap in time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code
from remote_policy_kit import CONFIG, STEPS, assert_within_limits, run, sine, stay

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer, pack, unpack

pytest.importorskip("msgpack")

Rig = hal.Rig


# Messages.


def test_a_message_returns_as_it_was_sent() -> None:
    sent = {
        "picture": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
        "state": np.linspace(0.0, 1.0, 7, dtype=np.float32),
        "one": np.float64(0.5),
        "prompt": "wave",
        "nested": {"flag": True, "list": [1, 2.5, None]},
    }
    got = unpack(pack(sent))
    assert got["picture"].dtype == np.uint8
    np.testing.assert_array_equal(got["picture"], sent["picture"])
    np.testing.assert_array_equal(got["state"], sent["state"])
    assert (got["one"], got["prompt"], got["nested"]) == (0.5, "wave", sent["nested"])


@pytest.mark.parametrize(
    "data",
    [
        b"\xc1",
        b"",
        pack({"a": 1})[:-1],
        pack({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "|O", b"shape": [1]}),
        pack({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f8", b"shape": [2]}),
        pack({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "nonsense", b"shape": [1]}),
        pack({b"__ndarray__": True}),
        pack({"actions": np.zeros((1, 8), complex)}),
    ],
    ids=["no message", "empty", "cut", "objects", "too short", "no type", "no array", "complex"],
)
def test_a_message_that_is_no_data_is_refused(data: bytes) -> None:
    with raises_code(hal.PolicyError, "policy_protocol"):
        unpack(data)


# Driving.


@pytest.mark.parametrize("latency", [0.0, 0.2, 0.4])
def test_chunks_of_a_late_policy_join_without_a_step(rig: Rig, latency: float) -> None:
    arm = rig.robots["panda"]
    wave = sine(rig)

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        t = rig.clock.now() + np.arange(STEPS) / 15
        return {"actions": np.array([[*wave(x), 0.0] for x in t])}

    seen: list[tuple[float, float]] = []

    def watch(_: float) -> None:
        state = arm.state()
        seen.append((state.stamp.t, state.q_set[0]))

    outcome = run(rig, infer, latency=latency, seconds=6.0, on_turn=watch)
    assert (outcome.ended, outcome.reason, outcome.missed) == ("time", "", 0)
    t, q = np.array(seen).T
    settled = t > t[0] + 2.5
    due = np.array([wave(x)[0] for x in t])
    away = 0.6 * (q - due)[settled]  # of the hand, 0.6 m from the axis
    assert np.sqrt((away**2).mean()) < 0.005
    assert np.ptp(q[settled]) > 0.15
    assert_within_limits(rig)
    figures = outcome.statistics
    # The first chunk begins when it arrives, later by the latency than the policy meant.
    assert figures["splice"] < 0.1 * 2 * np.pi * 0.3 * (latency + 0.02) + 2e-4
    assert figures["chunks"] > 6.0 / (max(8 / 15, latency) + 0.1) - 1
    assert abs(figures["latency"]["p50"] - latency) < 0.03


@pytest.mark.parametrize("latency", [0.1, 0.3])
def test_the_noise_of_a_policy_makes_no_more_jerk_where_chunks_meet(latency: float) -> None:
    """Each chunk is off by another way; with ``blend: 0`` the arm changes at once."""

    def jerk(blend: int) -> float:
        chance = np.random.default_rng(1)
        with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
            wave = sine(rig)

            def infer(request: dict[str, Any]) -> dict[str, Any]:
                t, away = rig.clock.now() + np.arange(STEPS) / 15, chance.normal(0.0, 0.01, 7)
                return {"actions": np.array([[*(wave(x) + away), 0.0] for x in t])}

            assert run(rig, infer, config={**CONFIG, "blend": blend}, latency=latency, seconds=6.0).ended == "time"
            points = np.array([point.q for point in rig.driver("panda").log])
        return float(np.sqrt((np.diff(points, 3, axis=0) ** 2).mean()))

    assert jerk(6) < 0.6 * jerk(0)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("latency", [0.0, 0.03, 0.3])
def test_a_policy_that_answers_one_action_is_asked_once_per_step(rig: Rig, flat: bool, latency: float) -> None:
    asked: list[float] = []
    wave = sine(rig)

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(rig.clock.now())
        row = np.array([*wave(asked[-1]), 0.0])
        return {"actions": row if flat else row[None]}

    outcome = run(rig, infer, latency=latency, seconds=4.0)
    assert (outcome.ended, outcome.reason) == ("time", "")
    assert np.diff(asked).mean() == pytest.approx(max(1 / 15, latency), abs=0.01)
    away = np.abs(rig.robots["panda"].state().q_set - wave(rig.clock.now()))
    assert away.max() < 0.19 * (2.0 * latency + 2 / 15), "at 0.19 rad/s: an answer, and the step that it is for"
    assert_within_limits(rig)


def test_the_gripper_closes_by_the_policys_own_convention(rig: Rig) -> None:
    gripper = rig.robots["panda"].gripper
    assert gripper is not None
    asked: list[float] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(float(request["state"][7]))
        return {"actions": np.tile([*request["state"][:7], -0.9], (STEPS, 1))}

    action = {"kind": "joint_position", "gripper": {"index": 7, "open": 1.0, "closed": -1.0, "threshold": 0.5}}
    assert run(rig, infer, config={**CONFIG, "action": action}).ended == "time"
    assert gripper.state().width < 0.002
    assert asked[0] < 0.05
    assert asked[-1] > 0.95


# Two arms in one vector.

ALOHA: dict[str, Any] = {
    "robots": {
        name: {"model": "vx300s", "base": {"position": [0.0, y, 0.0]}} for name, y in (("left", 0.4), ("right", -0.4))
    },
    "cameras": {
        name: {
            "model": "realsense_d405",
            "output": {"width": 64, "height": 48},
            "look_at": {
                "target": [0.3, 0.0, 0.1],
                "distance": 0.8,
                "yaw_deg": 0.0,
                "pitch_deg": -40.0,
                "roll_deg": 0.0,
            },
        }
        for name in ("high", "low", "left_wrist", "right_wrist")
    },
}


def test_a_policy_of_two_arms_sees_and_moves_each_by_its_own_numbers() -> None:
    requests: list[dict[str, Any]] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(request)
        steps = np.arange(1, 51)[:, None] / 50.0
        rows = request["state"] + 0.1 * steps * (np.eye(14)[0] - np.eye(14)[8])  # left waist, right shoulder
        rows[:, 6], rows[:, 13] = 1.0, 0.0  # the left gripper opens, the right one closes
        return {"actions": rows}

    with hal.open(ALOHA, driver="mock") as rig, PolicyServer(infer) as server:
        config = load_policy_config("aloha")
        before = {name: np.array(arm.state().q) for name, arm in rig.robots.items()}
        policy = RemotePolicy(rig, PolicyClient(server.url), config, task="fold", latency=0.1)
        runner = PolicyRunner(rig, policy, robots=policy.robots.values(), rate_hz=50, seconds=1.5)
        runner.rehearse()
        outcome = runner.run()
        policy.close()
        assert (outcome.ended, outcome.reason) == ("time", "")
        moved = {name: arm.state().q - before[name] for name, arm in rig.robots.items()}
        opened = {
            name: 1.0 - arm.gripper.grip_at(arm.gripper.state().width)
            for name, arm in rig.robots.items()
            if arm.gripper
        }
        assert_within_limits(rig)
    assert moved["left"][0] > 0.1
    assert moved["right"][1] < -0.1
    assert np.abs(np.delete(moved["left"], 0)).max() < 1e-6
    assert np.abs(np.delete(moved["right"], 1)).max() < 1e-6
    assert opened["left"] > 0.95
    assert opened["right"] < 0.05
    first = requests[0]
    assert {picture.shape for picture in first["images"].values()} == {(3, 224, 224)}
    assert sorted(first["images"]) == ["cam_high", "cam_left_wrist", "cam_low", "cam_right_wrist"]
    np.testing.assert_allclose(first["state"][[0, 7]], [before["left"][0], before["right"][0]], atol=1e-6)


def test_two_arms_stop_together_and_the_reason_names_the_one_that_stopped() -> None:
    swing = hal.JointVelocity([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    lost: list[float] = []
    with hal.open({**ALOHA, "cameras": {}}, driver="mock") as both:
        left, right = both.robots.values()
        end = both.clock.now() + 1.0

        def act(observation: hal.Observation) -> dict[str, hal.JointVelocity]:
            if both.clock.now() > end:
                lost.append(both.clock.now())
                both.driver("left").inject(fault="lost")
            return {"left": swing, "right": swing}

        runner = PolicyRunner(both, act, robots=both.robots.values(), rate_hz=50, seconds=0.5)
        assert runner.run().ended == "time"
        assert left.state().q_set[0] > 0.1
        assert left.state().q_set[0] == right.state().q_set[0], "neither waits until the other one is at rest"
        outcome = PolicyRunner(both, act, robots=both.robots.values(), rate_hz=50, seconds=5.0).run()
        assert outcome.ended == "stopped"
        assert outcome.reason.startswith("left: ")
        assert np.abs(right.state().dq_set).max() < 1e-9
        assert both.clock.now() - lost[0] < 0.3, "the other arm does not wait for the first to come to rest"
        wrong = PolicyRunner(both, lambda observation: swing, robots=both.robots.values())
        with raises_code(hal.CommandError, "bad_answer"):
            wrong.rehearse()


@pytest.mark.parametrize(
    ("change", "error", "texts"),
    [
        ({"robot": "lefty"}, hal.DeviceNotFound, ["lefty", "left, right"]),
        ({"columns": [0, 8]}, hal.NotSupported, ["8", "7"]),
        ({"gripper": {"index": 7}}, hal.NotSupported, ["left", "7"]),
    ],
)
def test_arms_that_do_not_fit_the_file_are_refused_with_both_sides(
    change: dict[str, Any], error: type[hal.HalError], texts: list[str]
) -> None:
    aloha = load_policy_config("aloha").model_dump(exclude_none=True)
    aloha["arms"][0] |= change
    aloha["arms"][1]["columns"] = [8, 15]
    aloha["observation"] = {"state": {"state": "q"}}
    with hal.open({**ALOHA, "cameras": {}}, driver="mock") as rig, pytest.raises(error) as caught:
        load_policy_config(aloha).robots(rig, rig.robots["left"])
    assert all(text in str(caught.value) for text in texts)


def test_figures_count_late_and_steep_chunks_and_the_slowest_answer_counts_once(rig: Rig) -> None:
    start, away, requests = np.array(rig.robots["panda"].state().q), 0.0, list[int]()

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(1)
        return {"actions": np.tile([start[0] + away, *start[1:], 0.0], (40, 1))}

    with PolicyServer(infer) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG), latency=0.1)
        policy.reset()

        def chunk(seconds: float) -> Any:
            rig.clock.sleep(seconds)
            answer = policy(rig.observe(cameras=()))
            assert isinstance(answer, dict)
            return answer["panda"][0]

        assert chunk(0.0) is None
        first = chunk(0.6)
        assert len(first.t) == 2 * 8, "an arm does not move for long after its server's death"
        assert len(requests) == 2, "before the answer to the first request it is not known when to ask"
        assert isinstance(chunk(0.12), hal.JointChunk)
        assert len(requests) == 2, "the first answer of an episode, which is the slowest, is not expected again"
        away = 0.16  # within the arm's reach in time, but more than it travels in a step of the policy
        assert chunk(0.25) is None
        assert isinstance(chunk(0.3), hal.JointChunk)
        figures = policy.statistics()
        policy.close()
    assert (figures["chunks"], figures["late"], figures["steep"]) == (3, 1, 1)
    assert abs(figures["splice"] - away) < 1e-6


# Real-time chunking: a policy continues from what will be executed anyway.


@pytest.mark.parametrize("offered", [True, False])
def test_a_policy_that_continues_from_given_actions_joins_without_a_step(rig: Rig, offered: bool) -> None:
    wave, requests = sine(rig), []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(request)
        t = rig.clock.now() + np.arange(STEPS) / 15
        away = 0.03 if len(requests) % 2 else -0.03  # every second answer prefers another way
        rows = np.array([[*(wave(x) + away * np.eye(7)[0]), 0.0] for x in t])
        if "rtc" in request:
            given, delay = request["rtc"]["actions"], request["rtc"]["delay_steps"]
            share = np.clip((np.arange(len(given)) - delay) / 8.0, 0.0, 1.0)[:, None]
            rows[: len(given)] = given + share * (rows[: len(given)] - given)
        return {"actions": rows}

    outcome = run(rig, infer, latency=0.2, seconds=5.0, metadata={"rtc_max_delay_steps": 6} if offered else {})
    assert outcome.ended == "time"
    assert any("rtc" in request for request in requests) == offered
    assert (outcome.statistics["splice"] < 1e-3) == offered
    if offered:
        delays = {request["rtc"]["delay_steps"] for request in requests[2:]}
        assert delays <= {4, 5}, "of 15 targets a second: those of 0.2 s, and of a step in reserve"
        assert "rtc" not in requests[0], "there is no chunk to continue yet"


@pytest.mark.parametrize(("kind", "delay"), [("joint_position", 1), ("tcp_delta", None)])
def test_a_server_is_sent_no_more_given_actions_than_it_takes(rig: Rig, kind: str, delay: int | None) -> None:
    requests: list[dict[str, Any]] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(request)
        return stay(request) if kind == "joint_position" else {"actions": np.zeros((STEPS, 6))}

    action = {**CONFIG["action"], "kind": kind, "gripper": CONFIG["action"]["gripper"] if delay else None}
    config = load_policy_config({**CONFIG, "action": action})
    with PolicyServer(infer, metadata={"rtc_max_delay_steps": 1}) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), config)
        policy.reset()
        answer = policy(rig.observe(cameras=()))
        assert isinstance(answer, dict)
        assert isinstance(answer["panda"][0], hal.JointChunk), "without a latency, in the same turn"
        rig.clock.sleep(0.2)
        policy(rig.observe(cameras=()))
        rig.clock.sleep(0.3)
        policy(rig.observe(cameras=()))
        policy.close()
    assert len(requests) == 2
    assert requests[1].get("rtc", {}).get("delay_steps") == delay
