"""The app as a person starts it: the board, the drive around it, the rig's file, and what it says of mistakes."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
from app_kit import Done, run_here

from hal.apps.calibrate import main
from hal.config import load
from hal.config.data_files import find_data
from hal.geometry import Pose

pytest.importorskip("cv2", reason="pip install opencv-python-headless")

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "calibrate.py"
STEPPED = ("--set", "simulation.clock=lock_step")


def program(*arguments: str, answer: str = "", timeout: float = 110.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(APP), *arguments], input=answer, capture_output=True, text=True, timeout=timeout
    )


def calibrate(*arguments: str, answer: str = "") -> Done:
    return run_here(main, *arguments, answer=answer)


def place(path: Path | str) -> Pose:
    view = load(path, sim=True).resolve().cameras[0].view
    assert view is not None
    return Pose(view.position, view.orientation)


def copy(tmp_path: Path, name: str) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_bytes(find_data("config", f"{name}.yaml").read_bytes())
    return path


def guess(name: str) -> str:
    """3 cm and 5 degrees from the truth."""
    turn = Pose([0.02, -0.02, 0.01], [0.0, math.sin(math.radians(2.5)), 0.0, math.cos(math.radians(2.5))])
    pose = place(name) @ turn
    return str([*pose.position.tolist(), *pose.orientation.tolist()])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda_calibration", "panda_calibration_held"])
def test_the_answer_stands_in_the_rig(tmp_path: Path, name: str) -> None:
    path = copy(tmp_path, name)
    before = path.read_text()
    done = calibrate(
        "--sim", "--config", str(path), "--auto", "--views", "8", "--guess", guess(name), "--yes", *STEPPED
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    distance, angle = place(path).distance(place(name))
    assert 0.0 < distance <= 2e-3
    assert math.degrees(angle) <= 0.3
    assert (tmp_path / "rig.yaml.bak").read_text() == before
    now = path.read_text()
    assert [line for line in before.splitlines() if "#" in line and line not in now] == []
    assert re.search(r"difference +[\d.]+ mm and [\d.]+ degrees", done.stdout)
    assert re.search(r"rms +[\d.]+ px +[\d.]+ mm +[\d.]+ deg", done.stdout)
    assert len(re.findall(r"^view \d+ .*px.*mm.*deg", done.stdout, re.MULTILINE)) == 8


@pytest.mark.slow
def test_in_real_time_with_the_board_in_the_hand_it_only_compares(tmp_path: Path) -> None:
    path = copy(tmp_path, "panda_calibration_held")
    before = path.read_bytes()
    done = program(
        "--sim", "--config", str(path), "--auto", "--views", "6", "--compare", "--set", "robots.panda.move_speed=0.3"
    )
    assert done.returncode == 0, done.stderr
    found = re.search(r"difference +([\d.]+) mm and ([\d.]+) degrees", done.stdout)
    assert found is not None
    assert float(found[1]) <= 2.0
    assert float(found[2]) <= 0.3
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["rig.yaml"]


@pytest.mark.slow
@pytest.mark.parametrize(("answer", "written"), [("y\n", True), ("", False)])
def test_it_asks_before_it_writes(tmp_path: Path, answer: str, written: bool) -> None:
    out = tmp_path / "mine.yaml"
    done = calibrate(
        "--sim", "--config", "panda_calibration", "--auto", "--views", "6", "--out", str(out), *STEPPED, answer=answer
    )
    assert done.returncode == 0, done.stderr
    assert "Write it? [y/N]" in done.stdout
    assert out.exists() is written
    if written:
        assert place(out).distance(place("panda_calibration"))[0] < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(("extra", "answer", "written"), [(["--yes"], "y\n", False), ([], "y\n", True)])
def test_a_doubtful_answer_is_written_by_a_person_only(
    tmp_path: Path, extra: list[str], answer: str, written: bool
) -> None:
    path = copy(tmp_path, "panda_calibration")
    before = path.read_bytes()
    wrong = ["--square", "0.0343"]  # 2 % too small
    done = calibrate("--sim", "--config", str(path), "--auto", "--views", "8", *wrong, *extra, *STEPPED, answer=answer)
    assert "WARNING: " in done.stdout
    assert (path.read_bytes() != before) is written
    if written:
        assert done.returncode == 0, done.stderr
        assert "Write it despite the warning? [y/N]" in done.stdout
    else:
        assert done.returncode == 2
        assert "--square" in done.stderr
        assert [entry.name for entry in tmp_path.iterdir()] == ["rig.yaml"]


def test_by_hand_with_enter_and_too_few_views_nothing_is_written(tmp_path: Path) -> None:
    path = copy(tmp_path, "panda_calibration")
    before = path.read_bytes()
    done = program("--sim", "--config", str(path), "--yes", *STEPPED, answer="\n\nq\n")
    assert "Traceback" not in done.stderr
    assert done.returncode == 2
    assert "view 1: 24 corners" in done.stdout
    assert "rejected: too similar to view 1" in done.stdout
    assert "CalibrationFailed: at least 6 views" in done.stderr
    assert path.read_bytes() == before


@pytest.mark.parametrize("ending", ["pdf", "png"])
def test_a_board_to_print(tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"board.{ending}"
    done = calibrate("board", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert "297 x 210 mm" in done.stdout
    assert out.stat().st_size > 1000


def test_dry_run_opens_nothing_and_says_what_would_be_found_out() -> None:
    done = calibrate("--config", "panda_calibration", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "task     camera wrist on hand of panda; board of 7 x 5 squares of 35 mm" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--config", "panda_table"], ["--camera", "scene", "wrist"]),
        (["--camera", "wirst"], ["did you mean 'wrist'"]),
        (["--views", "3"], ["--views must be at least 6"]),
        (["--board", "chess"], ["charuco_board"]),
        (["--square", "35"], ["metres"]),
        (["--auto", "--guess", "[1, 2]"], ["--guess must be"]),
        (["--auto", "--link", "panda_link7"], ["--guess"]),
        (["--out", "/nowhere/rig.yaml"], ["no folder /nowhere"]),
        (["--mapping", "defualt", "--auto"], ["defualt", "default"]),
    ],
)
def test_a_persons_mistake_is_a_message_not_a_traceback(arguments: list[str], texts: list[str]) -> None:
    done = calibrate("--sim", "--config", "panda_calibration", *STEPPED, *arguments)
    assert done.returncode == 2
    for text in texts:
        assert text in done.stderr
