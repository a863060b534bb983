"""Policies from the command line: failures are episodes with a reason, and a leader takes over without a jump."""

from __future__ import annotations

import importlib
import json
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from app_kit import CROSS, run_here, write_pad

from hal.apps.rollout import main
from hal.drivers.servo_bus import bus
from hal.recording import Dataset
from hal_emulators.servo_bus.server import ServoBusEmulator, find_leaders

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


LED = """
import hal

seen, act = [], lambda observation: hal.JointVelocity([0.1, 0, 0, 0, 0])


def watch(rig, observation):
    now = rig.clock.now()
    far.advance(now - (seen[-1][0] if seen else now))
    if seen and seen[-1][0] < moves_at <= now:
        far.execute("hand 0.3 0.4 -0.3 0.35 0.2 0 0")
    seen.append((now, *observation.robots["arm"].q_set))
    return False
"""


def test_a_leader_takes_over_without_a_jump_and_the_policy_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motors of the leader are emulated, and moved in simulated time; it is elsewhere than the arm."""
    rig = {
        "robots": {"arm": {"model": "so101"}},
        "leaders": {"leader": {"model": "so101_leader", "port": str(tmp_path / "leader.emulated")}},
        "gamepads": {"pad": {"model": "auto"}},
        "simulation": {"clock": "lock_step"},
    }
    (tmp_path / "led.py").write_text(LED)
    (tmp_path / "rig.yaml").write_text(json.dumps(rig))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(bus, "_ANSWER", 2.0)
    led = importlib.import_module("led")
    pad = write_pad(tmp_path, (0.6, CROSS, 0.9), until=2.8, held=(0.2, 2.5))
    with ServoBusEmulator(find_leaders(rig), paced=False) as emulator:
        emulator.arms["leader"].place([0.4, -0.3, 0.2, 0.2, 0.0])
        led.far, led.moves_at = emulator, 1.0
        words = ["--config", "./rig.yaml", "--sim", "--policy", "led:act", "--success", "led:watch", "--takeover"]
        done = run_here(
            main, *words, "--pad", pad, "--seconds", 1.9, "--rate", 50, "--out", "runs", "--report", "report.json"
        )
    assert done.returncode == 0, done.stderr
    t, q = np.array(led.seen)[:, 0], np.array(led.seen)[:, 1:]
    (outcome,) = json.loads(Path("report.json").read_text())["episodes"]
    ((begin, end),) = outcome["interventions"]
    waits, led_at, goes_on = (t > 0.85) & (t < 1.0), q[t < end][-1], q[t > end]
    assert np.ptp(q[waits], axis=0).max() < 1e-12, "taken over, before the leader moves"
    assert led_at - q[waits][0] == pytest.approx([0, 0, 0.15, 0, 0], abs=0.01), "the leader moves its elbow"
    assert np.abs(np.diff(q, axis=0)).max() < 0.03
    assert goes_on[-1] - led_at == pytest.approx([0.1 * (t[-1] - end), 0, 0, 0, 0], abs=0.005)
    assert goes_on[-1][0] - led_at[0] > 0.01
    episode = Dataset("runs").episodes[0]
    grid, by_hand = episode.stamps["grid"], episode.columns["intervention"]
    assert by_hand[(grid > begin + 1e-6) & (grid < end - 1e-6)].all()
    assert not by_hand[(grid < begin - 1e-6) | (grid > end + 0.03)].any()
    assert (set(episode.columns["source"][by_hand]), set(episode.columns["source"][~by_hand])) == ({1}, {2})


def _wait_for(port: int) -> None:
    """Wait until a server listens, at most 30 s."""
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        except OSError:
            threading.Event().wait(0.1)
    raise AssertionError("the server did not start")
