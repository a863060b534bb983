"""A policy on a server: messages, chunks that overlap in time, and everything that a server can do wrong."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyOutcome, PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer, pack, unpack

pytest.importorskip("msgpack")

Rig = hal.Rig
STEPS = 16
CONFIG: dict[str, Any] = {
    "rate_hz": 15,
    "execute": 8,
    "observation": {"state": {"state": ["q", "closed"]}, "prompt": {"text": "task"}},
    "action": {"kind": "joint_position", "gripper": {"index": 7, "threshold": 0.5}},
}


@pytest.fixture
def rig() -> Iterator[Rig]:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        yield rig


def stay(request: dict[str, Any]) -> dict[str, Any]:
    """Answer with the positions of the request, and an open gripper."""
    return {"actions": np.tile([*request["state"][:7], 0.0], (STEPS, 1))}


def assert_within_limits(rig: Rig) -> None:
    """Check every set-point that the drivers were given since the rig was opened."""
    for group in rig.statistics().values():
        for robot in group["robots"].values():
            assert max(robot["peak"].values()) <= 1.0 + 1e-6, robot["peak"]


def run(
    rig: Rig,
    infer: Callable[[dict[str, Any]], Any],
    *,
    config: dict[str, Any] = CONFIG,
    latency: float = 0.0,
    seconds: float = 3.0,
    timeout: float = 5.0,
    metadata: dict[str, Any] | None = None,
    rehearse: bool = False,
    on_turn: Callable[[float], None] = lambda seconds: None,
) -> PolicyOutcome:
    """Run an episode of a policy on a server of its own."""
    with PolicyServer(infer, metadata=metadata) as server:
        policy = RemotePolicy(
            rig, PolicyClient(server.url, timeout=timeout), load_policy_config(config), task="wave", latency=latency
        )
        runner = PolicyRunner(rig, policy, rate_hz=50, seconds=seconds, cameras=())
        try:
            if rehearse:
                runner.rehearse()
            return runner.run(seed=1, on_turn=on_turn)
        finally:
            policy.close()


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


def sine(rig: Rig) -> Callable[[float], np.ndarray]:
    start = np.array(rig.robots["panda"].state().q_set)
    begun = rig.clock.now()
    return lambda t: start + 0.1 * np.sin(2 * np.pi * 0.3 * max(0.0, t - begun)) * np.eye(7)[0]


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
        widths = {
            name: arm.gripper.state().width / arm.gripper.width_max for name, arm in rig.robots.items() if arm.gripper
        }
        assert_within_limits(rig)
    assert moved["left"][0] > 0.1
    assert moved["right"][1] < -0.1
    assert np.abs(np.delete(moved["left"], 0)).max() < 1e-6
    assert np.abs(np.delete(moved["right"], 1)).max() < 1e-6
    assert widths["left"] > 0.95
    assert widths["right"] < 0.05
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


# What a server can do wrong.


def far_away(request: dict[str, Any]) -> dict[str, Any]:
    away = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.501]  # the last joint is faster
    return {"actions": np.tile([*(request["state"][:7] + away), 0.0], (STEPS, 1))}


def fails(request: dict[str, Any]) -> NoReturn:
    raise ValueError("out of memory")


ANSWERS: list[tuple[Any, str]] = [
    (lambda request: {"actions": np.zeros((STEPS, 9))}, "policy_bad_actions"),
    (lambda request: {"actions": np.zeros((0, 8))}, "policy_bad_actions"),
    (lambda request: {"actions": np.full((STEPS, 8), np.nan)}, "policy_bad_actions"),
    (lambda request: {"actions": "none"}, "policy_bad_actions"),
    (lambda request: {"action": np.zeros((STEPS, 8))}, "policy_bad_actions"),
    (fails, "policy_error"),
]


@pytest.mark.parametrize(("infer", "code"), ANSWERS)
def test_a_bad_answer_shows_before_anything_moves(rig: Rig, infer: Any, code: str) -> None:
    before = rig.robots["panda"].state().q_set
    with raises_code(hal.PolicyError, code):
        run(rig, infer, rehearse=True)
    np.testing.assert_array_equal(rig.robots["panda"].state().q_set, before)


@pytest.mark.parametrize(
    ("infer", "code"),
    [
        *ANSWERS,
        (far_away, "policy_jump"),
        (lambda request: {"actions": stay(request)["actions"][:2]}, "policy_too_late"),
    ],
)
def test_a_bad_answer_later_ends_the_episode_at_rest(rig: Rig, infer: Any, code: str) -> None:
    arm, calls = rig.robots["panda"], []

    def turns_bad(request: dict[str, Any]) -> Any:
        calls.append(1)
        return stay(request) if len(calls) < 3 else infer(request)

    # A short answer is too late for a policy that takes longer to answer than its actions last.
    outcome = run(rig, turns_bad, latency=0.3 if code == "policy_too_late" else 0.0)
    assert outcome.ended == "error"
    assert isinstance(outcome.error, hal.PolicyError)
    assert outcome.error.code == code
    assert code != "policy_jump" or "panda_joint1 of panda" in str(outcome.error)
    assert np.abs(arm.state().dq_set).max() < 1e-9
    assert outcome.seconds < 2.0
    assert_within_limits(rig)


def test_a_policy_that_is_faster_than_the_rig_allows_is_followed_at_the_rigs_speed(rig: Rig) -> None:
    """It used to leave the arm behind, until the next chunk, which begins where the arm is, seemed to jump."""
    action = {"kind": "joint_velocity", "scale": 0.2, "gripper": {"index": 7}}
    row = np.array([0.5, 0, 0, 0, 0, 0, 0, 0])
    outcome = run(
        rig, lambda request: {"actions": np.tile(row, (16, 1))}, config={**CONFIG, "action": action}, seconds=2.0
    )
    assert (outcome.ended, outcome.statistics["steep"]) == ("time", 0)
    assert rig.robots["panda"].state().q_set[0] > 0.5
    assert_within_limits(rig)


def test_a_policy_slower_than_its_chunks_is_named_as_the_cause(rig: Rig) -> None:
    outcome = run(rig, stay, latency=1.2)
    assert isinstance(outcome.error, hal.PolicyError)
    assert (outcome.error.code, outcome.statistics["chunks"]) == ("policy_too_late", 1)


def test_an_answer_that_cannot_be_read_closes_the_connection() -> None:
    class UnreadableServer(PolicyServer):
        def _reply(self, data: bytes) -> bytes:
            return b"\xc1"

    with UnreadableServer(stay) as server:
        client = PolicyClient(server.url)
        client.connect()
        with raises_code(hal.PolicyError, "policy_protocol"):
            client.request({}).result(10.0)
        assert not client.connected
        client.close()


def test_a_first_target_far_away_is_refused(rig: Rig) -> None:
    outcome = run(rig, far_away)
    assert outcome.ended == "error"
    assert isinstance(outcome.error, hal.CommandError)


def test_a_server_that_freezes_stops_the_arm_within_its_last_chunk(rig: Rig) -> None:
    wave, calls, ended = sine(rig), [], threading.Event()

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        calls.append(rig.clock.now())
        if len(calls) == 3:
            ended.wait(10.0)  # as if the server were frozen
        t = rig.clock.now() + np.arange(STEPS) / 15
        return {"actions": np.array([[*wave(x), 0.0] for x in t])}

    with PolicyServer(infer) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url, timeout=0.3), load_policy_config(CONFIG))
        try:
            outcome = PolicyRunner(rig, policy, rate_hz=50, seconds=5.0, cameras=()).run()
        finally:
            ended.set()
            policy.close()
    assert isinstance(outcome.error, hal.PolicyError)
    assert outcome.error.code == "policy_timeout"
    assert rig.clock.now() < calls[-1] + STEPS / 15 + 1.0
    assert np.abs(rig.robots["panda"].state().dq_set).max() < 1e-9


def test_a_request_that_the_server_does_not_take_closes_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    async def block(*_: Any) -> None:
        await asyncio.sleep(60.0)  # as a full buffer does

    aiohttp = pytest.importorskip("aiohttp")
    with PolicyServer(stay) as server:
        client = PolicyClient(server.url, timeout=0.05)
        client.connect()
        monkeypatch.setattr(aiohttp.ClientWebSocketResponse, "send_bytes", block)
        with raises_code(hal.PolicyError, "policy_timeout"):
            client.request({}).result(5.0)
        assert not client.connected, "a later answer cannot pass for that to the next request"
        client.close()


def test_the_answer_of_a_rehearsal_may_take_longer(rig: Rig) -> None:
    def infer(request: dict[str, Any]) -> dict[str, Any]:
        time.sleep(0.2)  # as a policy that is compiled at its first request
        return stay(request)

    with PolicyServer(infer) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url, timeout=0.05), load_policy_config(CONFIG))
        policy.rehearse(rig.observe(cameras=()))
        policy.close()


def test_a_client_that_left_before_its_answer_is_no_error_of_the_server() -> None:
    aiohttp = pytest.importorskip("aiohttp")
    asked, left, ended, errors = threading.Event(), threading.Event(), threading.Event(), list[BaseException]()

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        asked.set()
        left.wait(10.0)
        return {"actions": np.zeros((1, 1))}

    class WatchedServer(PolicyServer):
        async def _serve(self, request: Any) -> Any:
            try:
                return await super()._serve(request)
            except BaseException as error:
                errors.append(error)
                raise
            finally:
                ended.set()

    async def leave(url: str) -> None:
        async with aiohttp.ClientSession() as session:
            socket = await session.ws_connect(url, timeout=aiohttp.ClientWSTimeout(ws_close=0.01))
            await socket.receive()
            await socket.send_bytes(pack({}))
            await asyncio.to_thread(asked.wait, 10.0)
            await socket.close()

    with WatchedServer(infer) as server:
        asyncio.run(leave(server.url))
        left.set()
        assert ended.wait(10.0)
    assert errors == []


class TalkativeServer(PolicyServer):
    """Sends a second, older answer to its third request and to all that follow."""

    async def _serve(self, request: Any) -> Any:
        aiohttp = pytest.importorskip("aiohttp")
        socket = aiohttp.web.WebSocketResponse()
        await socket.prepare(request)
        await socket.send_bytes(pack({}))
        answers: list[bytes] = []
        async for message in socket:
            reply = self._reply(message.data)
            assert isinstance(reply, bytes)
            answers.append(reply)
            for answer in [answers[-1]] if len(answers) < 3 else answers[-1:-3:-1]:
                await socket.send_bytes(answer)
        return socket


def test_an_answer_out_of_turn_ends_the_episode(rig: Rig) -> None:
    with TalkativeServer(stay) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG))
        outcome = PolicyRunner(rig, policy, rate_hz=50, seconds=5.0, cameras=()).run()
        policy.close()
    assert isinstance(outcome.error, hal.PolicyError)
    assert outcome.error.code == "policy_protocol"
    assert outcome.statistics["chunks"] == 3
    assert_within_limits(rig)


def test_a_server_without_its_library_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "msgpack", None)
    with pytest.raises(hal.DriverMissing):
        PolicyServer(stay)


def test_no_server_is_an_error_before_anything_moves(rig: Rig) -> None:
    with PolicyServer(stay) as server:
        gone = server.url
    policy = RemotePolicy(rig, PolicyClient(gone), load_policy_config(CONFIG))
    with raises_code(hal.PolicyError, "policy_unreachable"):
        PolicyRunner(rig, policy, cameras=()).rehearse()
    policy.close()


def test_a_new_connection_is_made_for_the_next_episode(rig: Rig) -> None:
    calls: list[int] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        calls.append(1)
        if len(calls) == 2:
            raise ValueError("once")
        return stay(request)

    with PolicyServer(infer) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG))
        runner = PolicyRunner(rig, policy, rate_hz=50, seconds=1.0, cameras=())
        outcomes = [runner.run(), runner.run()]
        assert [outcome.ended for outcome in outcomes] == ["error", "time"]
        policy.close()


def test_an_answer_from_before_a_pause_is_not_used(rig: Rig) -> None:
    requests: list[int] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(1)
        return stay(request)

    with PolicyServer(infer) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG), latency=0.2)
        policy.reset()

        def chunk() -> Any:
            answer = policy(rig.observe(cameras=()))
            assert isinstance(answer, dict)
            return answer["panda"][0]

        assert chunk() is None
        policy.restart()
        rig.clock.sleep(0.3)
        assert chunk() is None, "the answer is to a question from before the pause"
        assert len(requests) == 2
        rig.clock.sleep(0.3)
        assert isinstance(chunk(), hal.JointChunk)
        policy.restart()
        rig.clock.sleep(3.0)
        assert chunk() is None, "the chunk from before a pause does not end in it"
        policy.close()


# RoboArena's servers say what they need.

ARENA: dict[str, Any] = {
    "image_resolution": None,
    "needs_wrist_camera": False,
    "n_external_cameras": 0,
    "action_space": "joint_position",
}


def test_a_roboarena_server_is_reset_and_told_its_session(rig: Rig) -> None:
    seen: list[dict[str, Any]] = []
    with PolicyServer(stay, reset=seen.append, metadata=ARENA) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG))
        assert PolicyRunner(rig, policy, rate_hz=50, seconds=0.5, cameras=()).run(seed=7).ended == "time"
        policy.close()
    assert [sorted(request) for request in seen] == [["session_id"]]


def test_a_reset_that_fails_on_the_server_is_named_as_the_cause(rig: Rig) -> None:
    with PolicyServer(stay, reset=fails, metadata=ARENA) as server:
        policy = RemotePolicy(rig, PolicyClient(server.url), load_policy_config(CONFIG))
        outcome = PolicyRunner(rig, policy, rate_hz=50, seconds=0.5, cameras=()).run()
        policy.close()
    assert isinstance(outcome.error, hal.PolicyError)
    assert (outcome.error.code, outcome.turns) == ("policy_error", 0)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"action_space": "joint_velocity"}, "policy_mismatch"),
        ({"needs_wrist_camera": True}, "policy_mismatch"),
        ({"n_external_cameras": "two"}, "policy_protocol"),
        ({"n_external_cameras": 10**9}, "policy_protocol"),
        ({"image_resolution": 224}, "policy_protocol"),
        ({"image_resolution": [224, 10**6]}, "policy_protocol"),
    ],
)
def test_what_a_server_needs_and_the_file_lacks_is_named(rig: Rig, change: dict[str, Any], code: str) -> None:
    with raises_code(hal.PolicyError, code):
        run(rig, stay, metadata={**ARENA, **change}, rehearse=True)


def test_pictures_have_the_size_that_a_server_asks_for() -> None:
    requests: list[dict[str, Any]] = []
    image = {"image": {"camera": "scene", "size": [32, 32]}, "state": {"state": "q"}}
    config = load_policy_config({**CONFIG, "observation": image})

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(request)
        return stay(request)

    with (
        PolicyServer(infer, metadata={**ARENA, "image_resolution": [16, 24]}) as server,
        hal.open("panda_table", driver="mock") as rig,
    ):
        policy = RemotePolicy(rig, PolicyClient(server.url), config)
        policy.rehearse(rig.observe())
        policy.close()
    assert requests[0]["image"].shape == (16, 24, 3)


@pytest.mark.parametrize("described", ["droid", 3, {"rate_hz": 0}, {**CONFIG, "arms": 1}])
def test_a_server_that_describes_its_policy_wrongly_is_an_error(rig: Rig, described: Any) -> None:
    with PolicyServer(stay, metadata={"policy_config": described}) as server:
        client = PolicyClient(server.url)
        with raises_code(hal.PolicyError, "policy_protocol"):
            RemotePolicy(rig, client)
        client.close()


def test_an_answer_far_into_the_future_is_decoded_only_as_far_as_it_can_be_used(rig: Rig) -> None:
    arm = rig.robots["panda"]
    calls: list[int] = []
    ik = arm.ik

    def counted(*args: Any) -> Any:
        calls.append(1)
        return ik(*args)

    config = {**CONFIG, "action": {"kind": "tcp_delta", "scale": 1e-6, "turn": 1e-6}}
    arm.ik = counted  # type: ignore[method-assign]
    outcome = run(rig, lambda request: {"actions": np.ones((5000, 6))}, config=config, seconds=0.1)
    assert outcome.ended == "time"
    assert len(calls) < 60
