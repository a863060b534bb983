"""``apps/collect.py`` as a program: two demonstrations with images, and Ctrl-C while an episode is recorded."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

from app_kit import CROSS, seed_of, write_pad
from recording_kit import ROUNDED, Stage, at_row, small
from recording_layout import check_layout, check_stamps

import hal
from hal.recording import Dataset, Episode

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "collect.py"
PAD = ROOT / "config" / "teleop" / "demonstrations.jsonl"
SMALL = small(160, 120)


def report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


def episodes(folder: Path) -> list[Episode]:
    return list(Dataset(folder / "data").episodes)


def test_two_demonstrations_by_one_command(tmp_path: Path) -> None:
    """The recorded pad lifts both cubes."""
    command = [sys.executable, str(APP), "--sim", "--out", "data", "--report", "report.json", "--pad", str(PAD)]
    command += ["--episodes", "2", "--task", "lift the cube"]
    command += [word for override in ("simulation.clock=lock_step", *SMALL) for word in ("--set", override)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    for text in ("Cross: start recording", "2 of 2 in this run", "2 succeeded, 0 failed, 0 discarded"):
        assert text in done.stdout
    check_report_and_columns(tmp_path)
    starts = [check_demonstration(number, episode) for number, episode in enumerate(episodes(tmp_path))]
    assert len({tuple(start.round(2)) for start in starts}) == 2, "the cube was placed elsewhere"
    check_images(tmp_path)


def check_report_and_columns(folder: Path) -> None:
    found, info = report(folder), check_layout(folder / "data")
    assert (found["trips"], found["faults"], found["ended"], found["discarded"]) == ([], [], "", 0)
    assert [one["dropped"] for one in found["episodes"]] == [0, 0]
    documented = {f"observation.{name}" for name in ("state", "velocity", "effort", "tcp", "twist")}
    extra = {"setpoint", "setpoint_velocity", "setpoint_force", "tcp_set", "status", "pad"}
    extra |= {
        "object.cube",
        "object.duck",
        "time.grid",
        "time.objects",
        "time.robot.panda",
        "time.gripper.panda",
        "time.pad.pad",
    }
    for camera in ("scene", "wrist"):
        documented |= {f"observation.images.{camera}"}
        extra |= {f"camera_pose.{camera}", f"time.camera.{camera}"}
    columns = {key for key in info["features"] if key.startswith(("observation.", "rig."))}
    documented |= {f"rig.{name}" for name in extra}
    assert columns == documented


def check_demonstration(number: int, episode: Episode) -> np.ndarray:
    """Check that the cube was lifted by the fingers; return its start, x and y, m."""
    assert (episode.success, episode.task) == (True, "lift the cube")
    assert episode.info["seed"] == seed_of(number)
    assert episode.info["info"] == {"program": "collect", "robot": "panda", "mapping": "default", "speed": 1.0}
    assert episode.info["gaps"] == []
    check_stamps(episode)
    cube, tcp = episode.columns["rig.object.cube"], episode.columns["observation.tcp"]
    pad, names = episode.columns["rig.pad"], episode.names("rig.pad")
    width, target = episode.columns["observation.state"][:, -1], episode.columns["action"][:, -1]
    assert 8.0 < episode.length / 30 < 15.0
    assert cube[0, 2] == pytest.approx(0.63, abs=0.002), "it was on the table"
    assert cube[-1, 2] > 0.63 + 0.05, "and is in the air at the end"
    assert np.abs(cube[-1, :3] - [-0.55, 0.0, 0.6] - tcp[-1, :3]).max() < 0.025, "between the fingers"
    assert width[0] > 0.075, "which were open"
    assert 0.025 < width[-1] < 0.036, "and hold its thin side"
    assert target[-1] < 0.01
    assert (episode.columns["rig.status"][:, 1] == 0).all(), "no trip"
    assert pad[:, names.index("l2")].max() == 1.0
    for camera in ("scene", "wrist"):
        assert sum(1 for _ in episode.frames(camera)) == sum(1 for _ in episode.depth(camera)) == episode.length
    return np.asarray(cube[0, :2])


def check_images(folder: Path) -> None:
    """Check that every image shows the state of its row: rendered again in another world, depth does not differ."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=SMALL) as rig:
        for episode in episodes(folder):
            stage = Stage(rig, episode)
            for row in (0, episode.length // 2, episode.length - 1):
                stage.put(at_row(episode, row))
                for camera in stage.frames:
                    assert stage.look(camera, row).wrong <= ROUNDED, (episode.number, row, camera)
                    other = 0 if row > 0 else episode.length - 1
                    assert stage.look(camera, other).wrong > 100 * ROUNDED, "the image of another row differs"


def test_ctrl_c_saves_the_recording_unmarked(tmp_path: Path) -> None:
    """In real time. Cross is pressed again and again, for on a busy computer the first press comes too early."""
    pad = write_pad(tmp_path, *((float(t), CROSS) for t in range(1, 30, 2)), until=60.0)
    command = [sys.executable, str(APP), "--sim", "--set", "cameras={}", "--out", "data", "--report", "report.json"]
    with subprocess.Popen(
        [*command, "--pad", pad], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as app:
        assert app.stdout is not None
        printed = ""
        for line in app.stdout:
            printed += line
            if "RECORDING" in line:
                break
        app.send_signal(signal.SIGINT)
        printed += app.communicate(timeout=60.0)[0]
    assert app.returncode == 1, printed
    assert "Traceback" not in printed
    (episode,) = episodes(tmp_path)
    assert episode.success is None
    assert report(tmp_path)["ended"] == "interrupted"
