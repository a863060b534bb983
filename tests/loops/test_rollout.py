"""An evaluation of a policy on a server, from the command line: failures are episodes with a reason, and it goes on."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from app_kit import run_here

from hal.apps.rollout import main

pytest.importorskip("msgpack")

SERVER = """
import os, signal, sys
import numpy as np
from hal.learning.remote import PolicyServer

port, steps = map(int, sys.argv[1:])
asked = {}

def infer(request):
    episode = request["session_id"][-1]
    asked[episode] = asked.get(episode, 0) + 1
    if episode == "2" and asked[episode] == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    actions = request["q"] + 0.01 * np.arange(1, steps + 1)[:, None] * np.eye(7)[0]
    if episode == "4" and asked[episode] == 2:
        actions[-1, 3] = 1e30
    return {"actions": actions[0] if steps == 1 else actions}

with PolicyServer(infer, metadata={"action_space": "joint_position"}, port=port) as server:
    server.wait()
"""
WATCH = """
peaks, reached = [], []

def success(rig, observation):
    peaks.append(max(rig.statistics()["simulation"]["robots"]["panda"]["peak"].values()))
    reached.append(observation.robots["panda"].q_set[0])
    return False
"""
POLICY = "{rate_hz: 15, execute: 8, observation: {q: {state: q}}, action: {kind: joint_position}}"


@pytest.mark.parametrize("steps", [1, 16])
def test_all_episodes_run_although_the_server_is_killed_and_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    (tmp_path / "server.py").write_text(SERVER)
    (tmp_path / f"watching_{steps}.py").write_text(WATCH)
    (tmp_path / "policy.yaml").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    lives: list[subprocess.Popen[bytes]] = []

    def serve() -> None:
        for _ in range(2):
            lives.append(subprocess.Popen([sys.executable, "server.py", str(port), str(steps)], cwd=tmp_path))
            lives[-1].wait()

    serving = threading.Thread(target=serve, daemon=True)
    serving.start()
    _wait_for(port)
    options: list[Any] = ["--policy", f"ws://127.0.0.1:{port}", "--policy-config", "policy.yaml", "--seed", 1]
    options += ["--episodes", 5, "--seconds", 1.5, "--rate", 50, "--success", f"watching_{steps}:success"]
    try:
        done = run_here(
            main,
            *options,
            "--report",
            "report.json",
            "--sim",
            "--set",
            "cameras={}",
            "--set",
            "simulation.clock=lock_step",
        )
    finally:
        for life in lives:
            life.kill()
        serving.join(10.0)
    assert done.returncode == 1, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert [episode["code"] for episode in report["episodes"]] == ["", "policy_lost", "", "policy_bad_actions", ""]
    assert report["reasons"] == {"policy_lost": 1, "policy_bad_actions": 1}
    assert report["ended"] == ""
    watching = sys.modules[f"watching_{steps}"]
    assert max(watching.reached) - watching.reached[0] > 0.05
    assert max(watching.peaks) <= 1.0 + 1e-6


def _wait_for(port: int) -> None:
    """Wait until a server listens, at most 30 s."""
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        except OSError:
            threading.Event().wait(0.1)
    raise AssertionError("the server did not start")
