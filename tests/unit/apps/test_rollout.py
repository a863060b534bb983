"""``apps/rollout.py``, in lock-step and in this process."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from app_kit import CIRCLE, CROSS, PS, SQUARE, Done, run_here, write_pad

import hal
from hal.apps._common import find_deadman
from hal.apps.rollout import RolloutRun, main, parser
from hal.errors import CommandError
from hal.recording import Dataset

ROOT = Path(__file__).resolve().parents[3]
APP = ROOT / "apps" / "rollout.py"
FAST = ("--sim", "--set", "cameras={}", "--set", "simulation.clock=lock_step")

POLICIES = """
import numpy as np
import hal


class Reach:
    def __init__(self, rig):
        self.rig, self.arm = rig, rig.robots["panda"]

    def __call__(self, observation):
        away = goal(self.rig) - observation.robots["panda"].tcp_set.position
        return hal.Twist(away * min(2.0, 0.15 / np.linalg.norm(away))), 0.0

    def statistics(self):
        return {"mean": np.float32(0.5), "worst": np.array([np.nan])}


def goal(rig):
    cube = rig.robots["panda"].base.inverse() @ rig.world.pose("cube")
    return cube.position + [0.0, 0.0, 0.1]


def above(rig, observation):
    return np.linalg.norm(goal(rig) - observation.robots["panda"].tcp.position) < 0.005


def put(rig, random):
    rig.world.reset("cube", pose=hal.Pose([random.uniform(-0.1, 0.1), random.uniform(-0.2, 0.2), 0.65]))


def check(rig, random):
    with open("at.txt", "w") as file:
        print(*rig.world.pose("cube").position, file=file)


def unplugged(rig, random):
    if rig.clock.now() > 0.5:
        raise hal.ConnectionLost("no arm")


def lost(observation):
    if observation.t > 1.0:
        raise ValueError("no idea")
    return hal.Twist([0.0, 0.0, 0.02])


class Stuck:
    def __init__(self, rig):
        self.arm = rig.robots["panda"]

    def __call__(self, observation):
        self.arm.inject(fault="held")
        return hal.Twist([0.0, 0.0, 0.02])


def soft(rig, observation):
    return observation.robots["panda"].controller is hal.ControlMode.OPERATIONAL_SPACE and observation.t > 0.3


def dumb(observation):
    return np.zeros(7)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, with the policies in it."""
    (tmp_path / "policies.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("policies", None)
    yield tmp_path
    sys.modules.pop("policies", None)


def rollout(*arguments: object) -> Done:
    return run_here(main, "--report", "report.json", *arguments)


def report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


def test_a_policy_reaches_its_goal_in_every_episode(folder: Path) -> None:
    reach = ("--policy", "policies:Reach", "--reset", "policies:put", "--success", "policies:above", "--seed", 3)
    done = rollout(*reach, "--episodes", 3, *FAST)
    assert done.returncode == 0, done.stderr
    found = report(folder)
    assert [episode["success"] for episode in found["episodes"]] == [True] * 3
    assert len({round(episode["seconds"], 3) for episode in found["episodes"]}) > 1, "the cube lay elsewhere"
    for episode in found["episodes"]:
        assert episode["missed"] == 0
        assert 0.0 < episode["inference_ms"]["p50"] <= episode["inference_ms"]["p99"]
    assert "3 of 3 marked episodes succeeded" in done.stdout
    rollout(*reach, "--episodes", 3, *FAST)
    assert [e["seconds"] for e in report(folder)["episodes"]] == [e["seconds"] for e in found["episodes"]]
    too_short = rollout(*reach, "--seconds", 0.5, *FAST)
    assert too_short.returncode == 0
    assert report(folder)["episodes"][0]["success"] is False


def test_a_policy_drives_with_the_controller_of_the_command_line(folder: Path) -> None:
    options = ("--policy", "policies:Reach", "--success", "policies:soft", "--seconds", 1.0)
    controller = ("--controller", "OperationalSpace", "stiffness=[500, 500, 200]", "rotation_stiffness=30")
    assert rollout(*options, *FAST, *controller).returncode == 0
    assert report(folder)["episodes"][0]["success"] is True
    assert report(folder)["controller"].startswith("OperationalSpace stiffness")


def test_the_seed_of_an_episode_places_the_objects(folder: Path) -> None:
    def places(*options: object) -> list[str]:
        done = rollout("--policy", "policies:Reach", "--seconds", 0.2, *options, *FAST)
        assert done.returncode == 0, done.stderr
        return re.findall(r"cube at x (.*?) m", done.stdout)

    three = places("--episodes", 3, "--seed", 5)
    assert len(set(three)) == 3
    assert places("--episodes", 2, "--seed", 6) == three[1:], "the next episode has one more"
    assert places("--reset", "policies:check", "--seed", 5) == [], "the hook has the last word"
    at = np.array((folder / "at.txt").read_text().split(), float)
    assert [f"{value:.3f}" for value in at] == re.findall(r"-?[0-9.]+", three[0].replace("y", "").replace("z", ""))


def test_episodes_are_recorded(folder: Path) -> None:
    for library in ("pyarrow", "av", "zstandard"):
        pytest.importorskip(library, reason="pip install 'robot-hal[record]'")
    from hal.recording import Dataset

    options = ("--policy", "policies:Reach", "--success", "policies:above", "--out", "runs", "--task", "reach it")
    done = rollout(*options, "--episodes", 2, "--seed", 5, *FAST)
    assert done.returncode == 0, done.stderr
    episodes = Dataset(folder / "runs").episodes
    assert [episode.success for episode in episodes] == [True, True]
    assert [episode.info["seed"] for episode in episodes] == [5, 6]
    assert episodes[0].task == "reach it"
    assert episodes[0].info["info"]["policy"] == "policies:Reach"
    for episode, told in zip(episodes, report(folder)["episodes"], strict=True):
        assert episode.length / 30 == pytest.approx(told["seconds"], abs=1.0)
        assert np.ptp(episode.columns["observation.tcp"][:, 0]) > 0.05
        assert episode.info["result"]["policy"] == told["policy"] == {"mean": 0.5, "worst": [None]}


def test_buttons_of_the_pad_mark_an_episode(folder: Path) -> None:
    pad = write_pad(folder, (1.5, CROSS), (2.2, PS), (3.0, CIRCLE), (4.0, SQUARE), until=5.0, held=(0.5, 2.0))
    done = rollout("--policy", "policies:Reach", "--episodes", 2, "--deadman", "--pad", pad, *FAST)
    assert done.returncode == 0, done.stderr
    succeeded, failed = report(folder)["episodes"]
    assert (succeeded["ended"], succeeded["success"]) == ("success", True)
    assert 1.3 < succeeded["seconds"] < 1.6, "it counts while the dead-man is held"
    assert (failed["ended"], failed["success"], failed["turns"]) == ("failure", False, 0)
    assert "PS: success; Square: failure" in done.stdout


def test_a_person_takes_over_and_the_recording_says_when(folder: Path) -> None:
    pad = write_pad(folder, (1.5, "BTN_TL"), until=4.0, held=(0.5, 3.5))
    options = (
        "--policy",
        "policies:Reach",
        "--seconds",
        2.0,
        "--takeover",
        "--pad",
        pad,
        "--out",
        "runs",
        "--rate",
        50,
    )
    done = rollout(*options, *FAST)
    assert done.returncode == 0, done.stderr
    assert "1 takeover(s)" in done.stdout
    ((begin, end),) = report(folder)["episodes"][0]["interventions"]
    assert 0.3 < end - begin < 0.6
    episode = Dataset(folder / "runs").episodes[0]
    grid, columns = episode.stamps["grid"], episode.columns
    by_hand = columns["intervention"]
    assert by_hand[(grid > begin + 1e-6) & (grid < end - 1e-6)].all()
    assert not by_hand[(grid < begin - 1e-6) | (grid > end + 0.03)].any()
    assert set(columns["source"][by_hand]) == {1}
    assert set(columns["source"][~by_hand]) == {2}
    assert columns["next.done"].tolist() == [False] * (episode.length - 1) + [True]
    about = episode.info
    assert about["result"]["interventions"] == [[begin, end]]
    assert about["t_start"] < begin < end < about["t_start"] + about["length"] / about["fps"] + 0.1


def test_pages_show_who_drives_and_the_figures_of_a_policy_while_it_drives(folder: Path) -> None:
    pytest.importorskip("msgpack")
    from hal.learning.asynchronous import RemotePolicy
    from hal.learning.policy_config import load_policy_config
    from hal.learning.remote import PolicyClient, PolicyServer

    config = load_policy_config(
        {"rate_hz": 20, "observation": {"state": {"state": "q"}}, "action": {"kind": "joint_position"}}
    )
    pad = write_pad(folder, (2.0, "BTN_TL"), until=4.0, held=(0.5, 3.5))
    args = parser().parse_args(["--policy", "ws://", "--takeover", "--seconds", "2.0"])
    overrides = ["cameras={}"]
    with (
        PolicyServer(lambda request: {"actions": np.tile(request["state"], (16, 1))}) as server,
        hal.open("panda_table", sim=True, clock="lock_step", pad=pad, overrides=overrides) as rig,
        contextlib.closing(PolicyClient(server.url)) as client,
    ):
        rig.console = console = Mock(spec=["say", "show_driving"])
        policy = RemotePolicy(rig, client, config, latency=0.1)
        assert RolloutRun(rig, rig.robots["panda"], args, policy, None, *find_deadman(rig)).run() == 0
        notes = [call.args[0].note for call in console.show_driving.call_args_list]
        rig.console = None
    chunks = [int(found[1]) for note in notes if (found := re.search(r"(\d+) chunk", note))]
    assert chunks == sorted(chunks)
    assert len(set(chunks)) > 1
    assert any(note.startswith("person: ") for note in notes)
    assert re.fullmatch(r"policy: \d+ chunk\(s\), 0 late, 0 steep, latency p50 1\d\d, p99 1\d\d ms", notes[-2]), notes
    assert notes[-1] == ""


def test_a_recorded_pad_that_has_ended_ends_the_run(folder: Path) -> None:
    pad = write_pad(folder, until=0.3)
    done = rollout("--policy", "policies:Reach", "--deadman", "--pad", pad, "--out", "runs", *FAST)
    assert done.returncode == 2
    assert "the recorded pad has ended" in done.stderr
    assert Dataset(folder / "runs").episodes[0].info["result"]["ended"] == "stopped"


def test_takeover_needs_a_dead_man(folder: Path) -> None:
    assert rollout("--policy", "policies:Reach", "--takeover", "--unattended", *FAST).returncode == 2


def test_a_terminal_that_makes_steps_cannot_hold_the_dead_man() -> None:
    rig = SimpleNamespace(gamepads={"pad": SimpleNamespace(can_hold=False)})
    with pytest.raises(CommandError) as caught:
        find_deadman(rig)  # type: ignore[arg-type]
    assert caught.value.code == "cannot_hold"


def test_an_error_of_the_policy_is_a_failed_episode_and_the_run_continues(folder: Path) -> None:
    done = rollout("--policy", "policies:lost", "--episodes", 3, "--out", "runs", *FAST)
    assert done.returncode == 1, done.stderr
    found = report(folder)
    assert [(episode["ended"], episode["success"]) for episode in found["episodes"]] == [("error", False)] * 3
    assert (found["ended"], found["reasons"]) == ("", {"ValueError": 3})
    assert [episode.info["result"]["code"] for episode in Dataset(folder / "runs").episodes] == ["ValueError"] * 3
    assert "3 ValueError" in done.stdout
    for text in ("ValueError: no idea", "policies.py"):
        assert done.stderr.count(text) == 1


def test_a_fault_of_a_simulated_arm_is_a_failed_episode_and_the_run_continues(folder: Path) -> None:
    done = rollout("--policy", "policies:Stuck", "--episodes", 2, *FAST)
    assert done.returncode == 1, done.stderr
    found = report(folder)
    assert [(episode["code"], episode["success"]) for episode in found["episodes"]] == [("robot_fault", False)] * 2
    assert (found["ended"], found["reasons"]) == ("", {"robot_fault": 2})


def test_an_error_of_a_policys_server_is_one_line(folder: Path) -> None:
    pytest.importorskip("msgpack")
    from hal.learning.remote import PolicyServer

    (folder / "joints.yaml").write_text("rate_hz: 20\nobservation: {q: {state: q}}\naction: {kind: joint_position}\n")
    requests: list[int] = []

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        requests.append(1)
        if len(requests) == 3:
            raise ValueError("out of memory")
        return {"actions": np.tile(request["q"], (16, 1))}

    with PolicyServer(infer) as server:
        url = server.url.replace("ws", "http")
        done = rollout("--policy", url, "--policy-config", "joints.yaml", "--seconds", 2.0, *FAST)
    assert done.returncode == 1, done.stderr
    assert "ValueError: out of memory" in report(folder)["episodes"][0]["reason"]
    assert done.stderr.count("Traceback") == 1, "that of the server, which runs in this process"


def test_an_arm_that_is_lost_between_episodes_keeps_the_results(folder: Path) -> None:
    options = ("--policy", "policies:Reach", "--reset", "policies:unplugged", "--seconds", 1.0, "--episodes", 3)
    done = rollout(*options, *FAST)
    assert done.returncode == 2, done.stderr
    found = report(folder)
    assert len(found["episodes"]) == 1
    assert found["ended"] == "ConnectionLost: no arm"


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--policy", "policies"], ["--policy", "module:name"]),
        (["--policy", "policys:Reach"], ["--policy", "policys"]),
        (["--policy", "policies:reach"], ["reach"]),
        (["--policy", "policies:dumb"], ["ndarray"]),
        (["--policy", "policies:Reach", "--success", "policies:over"], ["--success", "over"]),
        (["--policy", "policies:Reach", "--rate", "0"], ["--rate must be positive"]),
        (["--policy", "policies:Reach", "--seed", "-1"], ["--seed must be 0 or more"]),
        (["--policy", "policies:Reach", "--rate", "1"], ["too slow"]),
        (["--policy", "policies:Reach", "--controller", "Springs"], ["Springs", "JointImpedance"]),
        (["--policy", "policies:Reach", "--controller", "JointImpedance", "stifness=3"], ["stifness"]),
        (["--policy", "policies:Reach", "--controller", "JointImpedance", "stiffness=-3"], ["stiffness"]),
        (["--policy", "policies:Reach", "--robot", "pandas"], ["did you mean 'panda'"]),
    ],
)
def test_a_mistake_is_a_message(folder: Path, arguments: list[str], texts: list[str]) -> None:
    done = rollout(*FAST, *arguments)
    assert done.returncode == 2, done.stdout + done.stderr
    for text in texts:
        assert text in done.stderr


def test_a_policy_on_a_server_drives_two_arms(folder: Path) -> None:
    pytest.importorskip("msgpack")
    from hal.learning.remote import PolicyServer

    (folder / "two.yaml").write_text("""
rate_hz: 20
observation: {state: {state: [left.q, right.q]}}
arms:
  - {robot: left, columns: [0, 7], kind: joint_position}
  - {robot: right, columns: [7, 14], kind: joint_position}
""")

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        return {"actions": request["state"] + 0.01 * np.arange(16)[:, None] * np.eye(14)[[0, 7]].sum(axis=0)}

    options = ("--seconds", 0.6, "--out", "runs", "--config", "openarm", *FAST)
    with PolicyServer(infer) as server:
        done = rollout("--policy", server.url, "--policy-config", "two.yaml", *options)
    assert done.returncode == 0, done.stderr
    assert report(folder)["robot"] == "left,right"
    (episode,) = Dataset(folder / "runs").episodes
    names = episode.names("observation.state")
    moved = np.ptp(episode.columns["observation.state"], axis=0) > 0.05
    assert [name for name, far in zip(names, moved, strict=True) if far] == [names[0], names[8]]


def test_a_checkpoint_that_is_not_loaded_is_an_error_with_what_its_server_printed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = folder / "server.sh"
    server.write_text("#!/bin/sh\necho $$ > pid\necho no such weights >&2\nexit 1\n")
    server.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(server))
    pytest.importorskip("msgpack")
    done = rollout("--policy", "lerobot:checkpoint", *FAST)
    assert done.returncode == 2, done.stderr
    assert "no such weights" in done.stderr
    with pytest.raises(ProcessLookupError):
        os.kill(int((folder / "pid").read_text()), 0)


def test_a_folder_that_is_no_checkpoint_is_named_by_its_own_process(folder: Path) -> None:
    pytest.importorskip("msgpack")
    done = rollout("--policy", "lerobot:checkpoint", *FAST)
    assert done.returncode == 2, done.stderr
    assert "checkpoint has no config.json" in done.stderr


def test_a_dry_run_opens_nothing(folder: Path) -> None:
    done = rollout("--policy", "policies:Reach", "--dry-run", *FAST)
    assert done.returncode == 0, done.stderr
    assert "policies:Reach" in done.stdout
    assert not (folder / "report.json").exists()
