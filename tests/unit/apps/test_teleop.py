"""``apps/teleop.py`` in this process: the recorded tour in lock-step, dry runs, mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from app_kit import run_here
from engines_kit import AUTO

from hal.apps.teleop import main

ROOT = Path(__file__).resolve().parents[3]
TOUR = ROOT / "tests" / "data" / "pads" / "tour.jsonl"
FAST = ("--set", "cameras={}", "--set", "simulation.clock=lock_step")


def test_the_recorded_tour_drives_the_arm(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    done = run_here(main, "--sim", "--pad", TOUR, "--duration", 15, "--report", out, *FAST)
    assert (done.returncode, done.stderr) == (0, "")
    assert "the recorded pad has ended after 12.5 s" in done.stdout
    found = json.loads(out.read_text())
    assert (found["backend"], found["clean_exit"], found["trips"], found["faults"]) == (AUTO, True, [], [])
    assert found["tcp_travel_m"] >= 0.3
    assert found["servo"]["rate_hz"] == 240
    assert found["servo"]["ticks"] > 133 * 15
    peak = found["peak"]
    assert set(peak) == {"velocity", "acceleration", "jerk", "position"}
    assert 0.1 < peak["velocity"] <= 0.3 + 1e-6, "the greatest speed of a session is 0.3 of the joint limits"
    assert max(peak.values()) <= 1.0 + 1e-6


def test_arms_that_start_inside_each_other_are_found_by_a_dry_run() -> None:
    second = "robots.second={model: panda, base: {position: [-0.5, 0, 0.6]}}"
    done = run_here(main, "--sim", "--dry-run", "--set", second)
    assert done.returncode == 2
    assert "inside robot 'panda'" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--config", "panda_tabel"], ["ConfigError", "panda_tabel", "panda_table"]),
        (["--config", "nowhere/rig.yaml"], ["ConfigError", "nowhere/rig.yaml"]),
        (["--set", "cameras.wrist.output.widht=320"], ["--set", "widht", "did you mean 'width'"]),
        (["--set", "robots.panda.base.position=[1,2]"], ["robots.panda.base.position"]),
        (["--mapping", "defualt"], ["defualt", "default"]),
        (["--robot", "pandas", "--pad", str(TOUR)], ["no robot 'pandas'", "did you mean 'panda'"]),
        (["--speed", "2"], ["--speed must be above 0 and at most 1"]),
        (["--duration", "-1"], ["--duration must be positive"]),
    ],
)
def test_a_mistake_is_a_message(arguments: list[str], texts: list[str]) -> None:
    bare = "cameras={}" if "widht" not in str(arguments) else "sim=true"
    done = run_here(main, "--sim", "--set", bare, *arguments)
    assert done.returncode == 2
    for text in texts:
        assert text in done.stderr
