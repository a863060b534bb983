"""``apps/export.py`` in this process."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from app_kit import Done, run_here
from recording_kit import make_recording

from hal.apps.export import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("apps") / "demo").root


def run(*arguments: str | Path) -> Done:
    return run_here(main, *arguments)


def test_the_output_is_described(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run(folder, "--to", "npz", "--out", out, "--episodes", "0,2", "--resize", "32x24", "--no-depth")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"wrote {out}: 2 episodes, 21 rows, ")
    assert done.stderr == "", "progress is for a terminal"
    about = json.loads((out / "export.json").read_text())
    assert about["camera_names"] == {"scene": "camera", "wrist": "gripper_camera"}
    with np.load(out / "episode_000002.npz") as file:
        assert file["camera_rgb"].shape == (7, 24, 32, 3)
        assert "camera_depth" not in file.files


def test_an_existing_output_needs_force(folder: Path, tmp_path: Path) -> None:
    command = (folder, "--to", "zarr", "--out", tmp_path / "out.zarr", "--successful-only", "--cameras", "none")
    assert run(*command).returncode == 0
    again = run(*command)
    assert again.returncode == 2
    assert "--force" in again.stderr
    assert run(*command, "--force").returncode == 0


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (("--resize", "96"), "--resize takes a width and a height"),
        (("--episodes", "9"), "no episode 9"),
        (("--cameras", "front,wrist"), "no camera front"),
    ],
)
def test_a_mistake_is_a_message(folder: Path, tmp_path: Path, wrong: tuple[str, str], says: str) -> None:
    done = run(folder, "--to", "zarr", "--out", tmp_path / "out", *wrong)
    assert done.returncode == 2
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_recording(tmp_path: Path) -> None:
    done = run(tmp_path, "--to", "npz")
    assert done.returncode == 2
    assert "there is no episode in" in done.stderr
