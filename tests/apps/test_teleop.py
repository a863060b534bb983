"""``apps/teleop.py`` as a program: the recorded tour in real time, Ctrl-C, and what is missing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "teleop.py"
TOUR = ROOT / "tests" / "data" / "pads" / "tour.jsonl"


def teleop(*arguments: str, timeout: float = 90.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(APP), *arguments], capture_output=True, text=True, timeout=timeout)


def report(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text())
    return found


@pytest.mark.slow
def test_the_recorded_tour_drives_the_arm_in_real_time(tmp_path: Path) -> None:
    """The first five seconds of it."""
    out = tmp_path / "out.json"
    done = teleop("--sim", "--pad", str(TOUR), "--duration", "5", "--report", str(out))
    assert (done.returncode, done.stderr) == (0, "")
    found = report(out)
    assert found["clean_exit"] is True
    assert found["tcp_travel_m"] > 0.1
    assert found["latency_ms"]["p50"] > 0.0
    assert found["servo"]["period_ms"]["p50"] == pytest.approx(1000 / 240, rel=0.2)
    assert set(found["cameras"]) == {"scene", "wrist"}
    assert all(camera["frames"] > 30 for camera in found["cameras"].values())


def test_without_an_engine_the_message_is_one_line() -> None:
    code = (
        "import importlib.util as u, sys; find = u.find_spec\n"
        "u.find_spec = lambda name, *rest: None if name in ('pybullet', 'mujoco') else find(name, *rest)\n"
        "from hal.apps.teleop import main; sys.exit(main(['--sim']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("DriverMissing: ")
    assert line.count("pip install") == 2


def test_a_missing_camera_is_a_message() -> None:
    done = teleop("--real", "--set", "robots.panda.sim=true")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "DeviceNotFound: camera scene" in done.stderr or "robot-hal[realsense]" in done.stderr


@pytest.mark.slow
def test_ctrl_c_stops_reports_and_ends(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    process = subprocess.Popen(
        [sys.executable, str(APP), "--sim", "--pad", str(TOUR), "--report", str(out), "--set", "cameras={}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip().startswith("home:"):  # the last line before it drives
            break
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert report(out)["clean_exit"] is True
