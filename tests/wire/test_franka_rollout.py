"""After an episode of a policy that failed, an emulated arm moves again only when a person has pressed anew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from app_kit import run_here

import hal
from hal.apps.rollout import main

from .calm_tour import DEADMAN, Held, write_pad
from .franka_kit import Emulator

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytestmark = pytest.mark.slow

POLICY = """
import hal


class Rises:
    def reset(self, seed):
        self.seed = seed

    def __call__(self, observation):
        if self.seed == 0 and observation.t > 4.5:
            raise ValueError("no idea")
        return hal.Twist([0.0, 0.0, 0.03])


def raised(rig, observation):
    arm = rig.robots["arm"]
    return observation.robots["arm"].tcp.position[2] > arm.fk(arm.home).position[2] + 0.06
"""
PRESSES = [(0.3, 2.0), (3.0, 7.0), (8.0, 11.0), (12.0, 15.0)]
"""Begin and end, s: home, an episode that fails while L2 is held on, home, and one that succeeds."""


def test_the_run_continues_after_a_failed_episode_with_the_persons_next_press(
    fr3: Emulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[Held] = [(start, end, *control) for start, end in PRESSES for control in DEADMAN]
    pad = write_pad(tmp_path / "pad.jsonl", held, 16.0)
    opened, moved = hal.open, list[tuple[float, float]]()

    def watch(**options: Any) -> hal.Rig:
        rig = opened(**options)
        arm = rig.robots["arm"]
        rig.clock.call_every(0.02, lambda: moved.append((rig.clock.now(), float(np.abs(arm.state().dq_set).max()))))
        return rig

    monkeypatch.setattr(hal, "open", watch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "rising.py").write_text(POLICY)
    options = [f"robots.arm.real.host={fr3.host}", "robots.arm.gripper.enabled=false"]
    options += ["cameras={}", "simulation.clock=lock_step"]
    words = [word for option in options for word in ("--set", option)]
    policy = ["--policy", "rising:Rises", "--success", "rising:raised", "--episodes", 2, "--report", "report.json"]
    done = run_here(main, "--real", "--config", "franka_emulator", "--pad", pad, *policy, *words)
    assert done.returncode == 1, done.stdout + done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert [(one["ended"], one["code"]) for one in report["episodes"]] == [("error", "ValueError"), ("success", "")]
    assert (report["ended"], report["reasons"]) == ("", {"ValueError": 1})
    t, speed = np.array(moved).T
    for begin, end in PRESSES:
        inside = speed[(t > begin) & (t < end)]
        assert begin == PRESSES[0][0] or inside.max() > 0.01, "it moved while L2 was held"
    failed = t[(t > PRESSES[1][0]) & (speed > 1e-6)]
    rest = failed[np.argmax(np.diff(failed) > 0.5)]
    assert rest < PRESSES[1][1] - 1.0, "L2 was still held when the policy failed"
    assert not speed[(t > rest + 0.05) & (t < PRESSES[2][0])].any(), "and nothing moved until it was pressed anew"
    assert not fr3.events("reflex")
