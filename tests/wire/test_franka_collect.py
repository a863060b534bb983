"""Demonstrations are collected on an emulated arm by the program that collects them in simulation."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hal.recording import Dataset

from .calm_tour import DEADMAN, Held, write_pad
from .franka_kit import Emulator

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytestmark = pytest.mark.slow

APP = Path(__file__).parents[2] / "apps" / "collect.py"


def test_the_arm_drives_home_before_each_episode_and_moves_only_while_l2_is_held(fr3: Emulator, tmp_path: Path) -> None:
    presses = [(2.4, "BTN_SOUTH"), (6.0, "BTN_MODE"), (14.4, "BTN_SOUTH"), (17.0, "BTN_WEST")]
    squeezes = [(0.3, 2.0), (3.0, 5.0), (6.5, 14.0), (15.0, 16.5)]
    held: list[Held] = [(t, t + 0.2, button, 1, 0) for t, button in presses]
    held += [(start, end, *control) for start, end in squeezes for control in DEADMAN]
    held += [(3.5, 5.6, "ABS_HAT0Y", -1, 0), (15.2, 16.0, "BTN_TL", 1, 0)]  # forwards, also after L2 was let go of; up
    pad = write_pad(tmp_path / "pad.jsonl", held, 18.0)
    out, report = tmp_path / "data", tmp_path / "report.json"
    command = [sys.executable, str(APP), "--real", "--config", "franka_emulator", "--pad", str(pad), "--speed", "0.3"]
    command += ["--out", str(out), "--episodes", "2", "--task", "reach", "--report", str(report)]
    options = [f"robots.arm.real.host={fr3.host}", "robots.arm.gripper.enabled=false"]
    options += ["cameras={}", "simulation.clock=lock_step"]
    command += [word for option in options for word in ("--set", option)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "release L2, then hold it until the arm is home" in done.stdout
    assert "place the objects; Cross: start recording" in done.stdout
    assert json.loads(report.read_text())["trips"] == []

    reached, lifted = Dataset(out).episodes
    assert (reached.success, lifted.success) == (True, False)
    home = np.array(reached.info["rig"]["resolved"]["robots"][0]["home"])
    for episode in (reached, lifted):
        q = episode.columns["rig.setpoint"][:, :7]
        assert np.abs(q[0] - home).max() < 1e-3, "each begins at home"
        assert np.abs(q[-1] - home).max() > 0.02, "and the arm was driven"
        assert episode.info["dropped"] == 0
    pressed = reached.columns["rig.pad"][:, reached.names("rig.pad").index("l2")]
    moving = np.abs(reached.columns["rig.setpoint_velocity"]).max(axis=1) > 0.02
    assert moving.any()
    assert not moving[: np.argmax(pressed > 0.5)].any(), "nothing moved before L2 was held"
    assert not moving[-10:].any(), "nor after it was let go of, though the d-pad was still pressed"
    assert not fr3.events("reflex")
    assert "success" in fr3.events("motion ended")[-1]["text"]
