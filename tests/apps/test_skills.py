"""``hal grasp`` and ``hal push`` on the built-in rig, in lock-step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from app_kit import run_here
from PIL import Image

from hal.apps import grasp, push

QUICK = ("--sim", "--set", "simulation.clock=lock_step", "--speed", "0.3")


def test_the_duck_is_found_by_depth_grasped_and_drawn(tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    done = run_here(grasp.main, *QUICK, "--set", "objects=[floor, table, duck]", "--picture", str(picture))
    assert done.returncode == 0, done.stdout
    assert "grasp: hold (6 of 6)" in done.stdout
    pixels = np.asarray(Image.open(picture)).reshape(-1, 3)
    for color in ((60, 220, 90), (250, 70, 60), (70, 140, 255)):
        assert (pixels == color).all(axis=1).sum() > 100, "the box, the way and the fingers are drawn"


@pytest.mark.parametrize("more", [["--goal", "0.5", "-0.1"], ["--by", "-0.05", "0.05"]])
def test_the_cube_is_pushed(more: list[str]) -> None:
    done = run_here(push.main, *QUICK, "--object", "cube", *more)
    assert done.returncode == 0, done.stdout
    assert "push: push (4 of 6)" in done.stdout


def test_what_fails_is_the_exit_status() -> None:
    assert run_here(grasp.main, *QUICK, "--set", "objects=[floor, table]").returncode == 1
    assert run_here(push.main, *QUICK, "--object", "cube", "--goal", "2", "0").returncode == 1
    assert run_here(grasp.main, *QUICK, "--object", "cub").returncode == 2
    assert run_here(grasp.main, *QUICK, "--speed", "3").returncode == 2
    assert run_here(grasp.main, *QUICK, "--gentle", "--dry-run").returncode == 0
