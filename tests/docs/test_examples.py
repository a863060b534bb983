"""The examples run as their first lines say, and use nothing private."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(name: str, folder: Path, *arguments: str) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=90)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_point_cloud_shows_the_table_where_it_is(tmp_path: Path) -> None:
    assert "5 poses" in run("point_cloud.py", tmp_path)
    heights = trimesh.load(tmp_path / "cloud.ply").vertices[:, 2]
    assert len(heights) > 100_000
    assert np.median(heights) == pytest.approx(0.6, abs=0.002)
    assert heights.max() > 0.63, "the things on the table are there too"


@pytest.mark.parametrize("seed", ["0", "1", "2"])
def test_the_cube_is_picked_up_wherever_it_lies(tmp_path: Path, seed: str) -> None:
    assert "lifted: True" in run("pick.py", tmp_path, seed)


def test_random_scenes_have_pictures_and_true_poses(tmp_path: Path) -> None:
    run("random_scenes.py", tmp_path, "here")
    pictures = [np.asarray(Image.open(file)) for file in sorted((tmp_path / "here").glob("*.png"))]
    assert len(pictures) == 5
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 50
    poses = json.loads((tmp_path / "here" / "scene_0.json").read_text())
    assert len(poses) == 6
    assert all(len(pose) == 7 for pose in poses.values())


def test_what_a_policy_is_trained_on_says_how_far_the_hand_is_from_the_cube_and_the_cube_from_its_goal() -> None:
    """``train_pick_cube.py`` itself needs Stable-Baselines3 and half an hour."""
    env = runpy.run_path(str(EXAMPLES / "train_pick_cube.py"))["make"]()
    seen, _ = env.reset(seed=1000)
    first, terminated = seen, False
    for action in env.unwrapped.solve():
        seen, _, terminated, truncated, info = env.step(action)
        assert env.observation_space.contains(seen)
        assert not truncated, info
        if terminated:
            break
    env.close()
    assert terminated
    hand, goal = np.linalg.norm(first[:3]), np.linalg.norm(first[3:6])
    assert hand > 0.05 > 0.025 > np.linalg.norm(seen[:3])
    assert goal > 0.05 > 0.025 > np.linalg.norm(seen[3:6])
    assert abs(seen[9]) < 0.05, "the fingers are along the cube's sides"


def test_an_arm_of_ones_own_goes_up(tmp_path: Path) -> None:
    pytest.importorskip("pybullet_data", reason="its URDF comes with PyBullet")
    assert "6 joints" in run("own_arm.py", tmp_path)


def test_the_unit_tests_with_the_mock_pass(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(EXAMPLES / "test_circle.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=90)
    assert "3 passed" in done.stdout, done.stdout


@pytest.mark.pair
def test_the_driver_to_copy_passes_its_tests_outside_and_is_found_by_name_once_installed(tmp_path: Path) -> None:
    """``tcp_arm.py`` with ``fake_arm.py`` and ``test_tcp_arm.py``: first as a folder, then as a package.

    ``docs/write-a-driver.md`` runs its ``hand_and_pedal.py``.
    """
    folder = tmp_path / "tcp_arm"
    shutil.copytree(EXAMPLES / "tcp_arm", folder, ignore=shutil.ignore_patterns("__pycache__"))
    assert len((folder / "tcp_arm.py").read_text().splitlines()) <= 120
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tcp_arm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=90)
    assert "27 passed" in done.stdout, done.stdout + done.stderr
    about = folder / "tcp_arm-1.0.dist-info"  # what pip would make of pyproject.toml
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: tcp-arm\nVersion: 1.0\n")
    points = re.search(r'entry-points."(.*?)"\].*\n((?:\w.*\n)+)', (folder / "pyproject.toml").read_text())
    (about / "entry_points.txt").write_text(f"[{points[1]}]\n{points[2].replace(chr(34), '')}")
    words = ["teleop", "--config", "rig.yaml", "--real", "--dry-run", "--set", "robots.arm.drivers.real=tcp_arm"]
    done = subprocess.run(
        [sys.executable, "-m", "hal.apps.main", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"arm\b.*\btcp_arm\b", done.stdout), done.stdout


def test_the_camera_to_copy_is_short() -> None:
    """Its ``fake_camera.py`` and ``test_net_camera.py`` run where ``docs/test-a-driver.md`` shows them."""
    assert len((EXAMPLES / "net_camera" / "net_camera.py").read_text().splitlines()) <= 65


def test_every_example_is_tested_here_and_uses_nothing_private() -> None:
    here = Path(__file__).read_text()
    for file in EXAMPLES.rglob("*.py"):
        assert file.name in here
        assert "._" not in file.read_text()
