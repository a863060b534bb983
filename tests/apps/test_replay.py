"""``apps/replay.py`` as a program: an episode in real time, and Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from recording_kit import record_tour

for library in ("pyarrow", "av", "zstandard"):
    pytest.importorskip(library, reason="pip install 'robot-hal[record]'")

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "replay.py"
BARE = ("--sim", "--set", "cameras={}")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first three seconds of the recorded tour, driven in simulation."""
    return record_tour(tmp_path_factory.mktemp("replay") / "beginning", 3.0)


@pytest.mark.slow
def test_an_episode_in_real_time(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.json"
    command = [sys.executable, str(APP), str(dataset), "--report", str(out), *BARE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(out.read_text())
    assert found["finished"] is True
    assert found["servo"]["ticks"] > 500
    joints = found["deviation"]["joints_rad"]
    if found["servo"]["missed"] < 0.05 * found["servo"]["ticks"]:  # else it cannot be where it should
        assert max(joint["rms"] for joint in joints.values()) < 0.01
    else:
        assert "computer is overloaded" in done.stdout


@pytest.mark.slow
def test_ctrl_c_stops_the_replay(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.json"
    command = [sys.executable, "-u", str(APP), str(dataset), "--report", str(out), *BARE]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "moving to the first pose" in line:
            break
    os.kill(process.pid, signal.SIGINT)
    text, errors = process.communicate(timeout=30)
    assert process.returncode == 1, errors
    assert "Traceback" not in errors
    assert "ENDED" in text
    assert "Ctrl-C" in text
    assert json.loads(out.read_text())["finished"] is False
