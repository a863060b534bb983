"""What a policy's server can do wrong, and what it can ask for."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from typing import Any, NoReturn

import aiohttp
import numpy as np
import pytest
from errors_kit import raises_code
from remote_policy_kit import CONFIG, STEPS, assert_within_limits, run, stay

import hal
from hal.learning.asynchronous import RemotePolicy
from hal.learning.policy import PolicyRunner
from hal.learning.policy_config import load_policy_config
from hal.learning.remote import PolicyClient, PolicyServer, pack

pytest.importorskip("msgpack")

Rig = hal.Rig


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


KINDS = ("joint_position", "joint_delta", "joint_velocity")
MISTAKES = ("nan", "huge", "past a limit", "jump", "too fast")


@pytest.mark.parametrize("number", range(15))
def test_a_mistake_in_any_later_target_is_refused_when_it_arrives(rig: Rig, number: int) -> None:
    arm, chance, calls = rig.robots["panda"], np.random.default_rng(number), list[float]()
    kind = KINDS[number % 3]
    mistake = chance.choice(MISTAKES[:2] if kind == "joint_velocity" else MISTAKES)
    row, joint, sign = int(chance.integers(1, STEPS)), int(chance.integers(7)), float(chance.choice([-1.0, 1.0]))
    size = {"nan": np.nan, "huge": 10.0 ** chance.uniform(1.5, 300.0), "past a limit": chance.uniform(0.06, 9.0)}
    size |= {"jump": 0.11 + arm.limits.velocity[joint] * row / 15, "too fast": 4.0 / 15}

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        calls.append(rig.clock.now())
        q = request["state"][:7].astype(float)
        actions = np.tile(q if kind == "joint_position" else np.zeros(7), (STEPS, 1))
        if len(calls) == 3:
            limit = (arm.limits.upper if sign > 0.0 else arm.limits.lower)[joint]
            begin = limit - q[joint] if mistake == "past a limit" else 0.0
            rows = np.arange(STEPS) if mistake == "too fast" else np.arange(STEPS) == row
            actions[:, joint] += rows * begin + np.where(rows > 0, sign * size[mistake] * rows, 0.0)
        return {"actions": actions}

    outcome = run(rig, infer, config={**CONFIG, "action": {"kind": kind}}, seconds=2.0)
    assert isinstance(outcome.error, hal.PolicyError), (mistake, row, joint)
    assert outcome.error.code in ("policy_bad_actions", "policy_jump")
    assert len(calls) == 3
    assert rig.clock.now() - calls[-1] < 0.1, "when it arrives, not when it is due"
    assert np.abs(arm.state().dq_set).max() < 1e-9
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
    assert run(rig, stay, reset=seen.append, metadata=ARENA, seconds=0.5).ended == "time"
    assert [sorted(request) for request in seen] == [["session_id"]]


def test_a_reset_that_fails_on_the_server_is_named_as_the_cause(rig: Rig) -> None:
    outcome = run(rig, stay, reset=fails, metadata=ARENA, seconds=0.5)
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


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:8000", "null"])
def test_a_page_in_a_browser_is_refused(origin: str) -> None:
    async def connect(url: str, headers: dict[str, str]) -> str:
        async with aiohttp.ClientSession() as session, session.ws_connect(url, headers=headers) as socket:
            await socket.receive_bytes()
            await socket.send_bytes(pack({"state": np.zeros(2)}))
            return await socket.receive_str()

    def fail(request: dict[str, object]) -> dict[str, object]:
        raise ValueError("out of memory\nwith details")

    with PolicyServer(fail) as server:
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            asyncio.run(connect(server.url, {"Origin": origin}))
        assert refused.value.status == 403
        assert asyncio.run(connect(server.url, {})) == "Error: ValueError: out of memory"
