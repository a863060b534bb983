"""``apps/rollout.py`` as a program: a policy that is late in real time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

APP = Path(__file__).resolve().parents[2] / "apps" / "rollout.py"
POLICY = """
import time

import hal


def late(observation):
    time.sleep(0.01 if observation.robots["panda"].target_seq < 10 else 0.5)
    return hal.Twist([0.0, 0.0, 0.02])
"""


def test_a_late_policy_stops_the_arm_in_each_episode(tmp_path: Path) -> None:
    (tmp_path / "policies.py").write_text(POLICY)
    command = [sys.executable, str(APP), "--policy", "policies:late", "--episodes", "3", "--report", "report.json"]
    command += ["--sim", "--set", "cameras={}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=90)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "the arm is at rest" in done.stdout
    report = json.loads((tmp_path / "report.json").read_text())
    assert [episode["ended"] for episode in report["episodes"]] == ["stopped"] * 3
    assert report["reasons"] == {"command_deadline": 3}
