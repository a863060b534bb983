"""``apps/replay.py`` in this process, in lock-step, on episodes that the recorder wrote."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from app_kit import run_here
from recording_kit import record_tour

import hal
from hal.apps.replay import main

for library in ("pyarrow", "av", "zstandard"):
    pytest.importorskip(library, reason="pip install 'robot-hal[record]'")

ROOT = Path(__file__).resolve().parents[3]
FAST = ("--sim", "--set", "cameras={}", "--set", "simulation.clock=lock_step")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recorded tour, driven in simulation."""
    return record_tour(tmp_path_factory.mktemp("replay") / "demo")


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_a_simulated_episode_replayed_in_simulation(dataset: Path, tmp_path: Path, speed: float) -> None:
    out = tmp_path / "report.json"
    done = run_here(main, dataset, "--episode", "-1", "--speed", speed, "--report", out, *FAST)
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    joints = found["deviation"]["joints_rad"]
    assert len(joints) == 7
    assert max(joint["rms"] for joint in joints.values()) < 0.01
    assert found["deviation"]["tcp_mm"]["rms"] < 5.0
    assert found["finished"] is True
    assert found["pauses"] == 0
    assert found["duration_s"] > 10.0
    assert found["took_s"] == pytest.approx(found["duration_s"] / speed, abs=2.0)
    assert re.search(r"panda_joint7 +rms 0\.00", done.stdout)
    assert "a tour" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--episode", "3"], ["--episode 3", "has 1"]),
        (["--speed", "1.5"], ["--speed", "at most 1"]),
        (["--report", "/nowhere/at/all.json"], ["/nowhere/at"]),
        (["--robot", "pandas"], ["no robot 'pandas'", "did you mean 'panda'"]),
        (["--robot", "left,right"], ["--robot left,right", "one arm"]),
        (["--set", "robots.panda.speed=0.02"], ["CommandError", "rad/s", "at speed"]),
        (["--set", "robots.panda.limits.upper=[2,1.7,2,-2.3,2,3.7,2]"], ["panda_joint4 goes through"]),
        (["--set", "objects=[floor, table]"], ["cube, duck"]),
    ],
)
def test_an_episode_that_cannot_be_replayed_is_a_message(dataset: Path, arguments: list[str], texts: list[str]) -> None:
    done = run_here(main, dataset, *FAST, *arguments)
    assert done.returncode == 2, done.stdout + done.stderr
    for text in texts:
        assert text in done.stderr


def test_a_folder_without_episodes_and_another_arm(dataset: Path, tmp_path: Path) -> None:
    done = run_here(main, tmp_path, *FAST)
    assert done.returncode == 2
    assert "no episode" in done.stderr
    other = run_here(main, dataset, *FAST, "--set", "robots.panda.model=fr3")
    assert other.returncode == 2, other.stdout + other.stderr
    assert "recorded with the model panda, and this arm is a fr3" in other.stderr


def test_a_dry_run_opens_nothing(dataset: Path) -> None:
    done = run_here(main, dataset, "--dry-run", *FAST)
    assert done.returncode == 0, done.stderr
    assert "'a tour'" in done.stdout


TWO = """
robots:
  left: {model: panda, base: {position: [0, 0.5, 0]}}
  right: {model: panda, base: {position: [0, -0.5, 0]}}
"""


def drive_two(out: Path, rig_file: Path, arms: tuple[str, ...], info: dict[str, str]) -> Path:
    """Some of two arms move for a moment."""
    from hal.recording import Recorder

    rig_file.write_text(TWO)
    with hal.open(rig_file, sim=True, clock="lock_step", pad="none") as rig, Recorder(rig, out, fps=30) as recorder:
        recorder.start(info=info)
        for name in arms:
            with rig.robots[name].control(rate_hz=50) as control:
                for tick in rig.clock.rate(50):
                    control.send(hal.Twist([0.0, 0.0, 0.1]), grip=0.0)
                    if tick.elapsed > 0.6:
                        break
        recorder.save(wait=True)
    return out


@pytest.mark.parametrize(
    ("arms", "info", "arguments", "replayed", "still"),
    [
        (("right",), {"robot": "right"}, (), "right", []),
        (("left", "right"), {"robot": "right"}, (), "right", ["left"]),
        (("left", "right"), {"robot": "right"}, ("--robot", "left"), "left", ["right"]),
        (("left", "right"), {"robot": "middle"}, (), "left", ["right"]),
    ],
)
def test_of_two_arms_the_one_that_was_driven_is_replayed(
    tmp_path: Path,
    arms: tuple[str, ...],
    info: dict[str, str],
    arguments: tuple[str, ...],
    replayed: str,
    still: list[str],
) -> None:
    rig_file, report = tmp_path / "two.yaml", tmp_path / "report.json"
    out = drive_two(tmp_path / "out", rig_file, arms, info)
    options = ("--config", rig_file, "--sim", "--set", "simulation.clock=lock_step", "--report", report)
    done = run_here(main, out, *options, *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(report.read_text())["robot"] == replayed
    assert re.findall(r"^  replays +(\w+)$", done.stdout, re.MULTILINE) == [replayed]
    told = re.findall(r"^  still +(\w+) moved in the recording; it is not replayed$", done.stdout, re.MULTILINE)
    assert told == still


@pytest.mark.parametrize("keep", [0.0, 0.5, 1.0])
def test_a_damaged_episode_is_named_before_anything_is_opened(dataset: Path, tmp_path: Path, keep: float) -> None:
    root = Path(shutil.copytree(dataset, tmp_path / "demo"))
    file = root / "data/chunk-000/file-000.parquet"
    file.write_bytes(file.read_bytes()[: int(keep * file.stat().st_size)])
    if keep == 1.0:
        file.unlink()
    done = run_here(main, root, *FAST)
    assert done.returncode == 2
    assert done.stderr.startswith("DatasetError: episode 0: data/chunk-000/file-000.parquet: "), done.stderr
    assert "simulated" not in done.stdout
