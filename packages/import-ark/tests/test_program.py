"""The program ``hal import-ark``, and the rig that it writes, driven like any other."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from ark_kit import DATA, TUTORIAL

from hal.apps.main import main


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


class ImportArk:
    """``hal import-ark`` in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: str) -> Done:
        try:
            status = main(["import-ark", *arguments])
        except SystemExit as ended:  # argparse
            status = int(ended.code or 0)
        return Done(status, *self._capsys.readouterr())


@pytest.fixture
def import_ark(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ImportArk:
    monkeypatch.chdir(tmp_path)
    return ImportArk(capsys)


def run(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hal.apps.main", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, cwd=cwd)


def test_the_tutorial_is_imported_and_teleoperated(tmp_path: Path) -> None:
    done = run("import-ark", str(TUTORIAL), "-o", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(
        r"^\s+21\s+kept\s+config.sim_config.fix.yaw: -90\s+cameras.camera.look_at.yaw_deg$", done.stdout, re.M
    )
    assert re.search(r"^\d+ keys: \d+ kept, \d+ changed, \d+ ignored$", done.stdout, re.M)
    assert f"written: {tmp_path / 'mine.yaml'}" in done.stdout
    assert done.stdout.splitlines()[-1] == "start: hal teleop --sim --config mine.yaml"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["mine.yaml"]

    driven = run("teleop", "--sim", "--config", "mine.yaml", "--pad", "demo", "--duration", "1.5", cwd=tmp_path)
    assert driven.returncode == 0, driven.stdout + driven.stderr
    assert "Franka" in driven.stdout


def test_a_file_that_is_there_is_written_over_only_by_force(tmp_path: Path, import_ark: ImportArk) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("mine\n")
    done = import_ark(str(TUTORIAL), "-o", str(mine))
    assert done.returncode == 2
    assert "exists; --force" in done.stderr
    assert mine.read_text() == "mine\n"
    done = import_ark(str(TUTORIAL), "-o", str(mine), "--force")
    assert done.returncode == 0, done.stderr
    assert "look_at" in mine.read_text()


def test_check_writes_nothing(tmp_path: Path, import_ark: ImportArk) -> None:
    done = import_ark(str(TUTORIAL), "--check")
    assert done.returncode == 0, done.stderr
    assert "valid; nothing is written (--check)" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_an_unclosed_quote_is_a_message_with_file_and_line(tmp_path: Path) -> None:
    shutil.copytree(TUTORIAL.parents[1], tmp_path / "tutorial")
    config = tmp_path / "tutorial" / "config"
    shutil.copy(DATA / "unclosed_quote.yaml", config / "objects" / "table.yaml")
    done = run("import-ark", str(config / "global_config.yaml"), "-o", str(tmp_path / "mine.yaml"), cwd=tmp_path)
    assert done.returncode == 2
    assert f"{config / 'objects' / 'table.yaml'}:1: the quote that opens here is not closed" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nowhere.yaml", "--check"], "nowhere.yaml: there is no such file"),
        ([str(TUTORIAL), "-o", "mine.txt"], "a rig's file ends in .yaml"),
        ([str(TUTORIAL), "-o", "nowhere/mine.yaml"], "there is no folder nowhere"),
        ([str(TUTORIAL), "--check", "--arm", "Franka"], "--arm Franka: must be NAME=..."),
        ([str(TUTORIAL), "--check", "--without", "Mugg"], "did you mean 'Mug'?"),
        ([str(TUTORIAL), "--check", "--urdf", "Mug=nowhere.urdf"], "nowhere.urdf, which --urdf names"),
        ([str(TUTORIAL)], "one of the arguments -o/--out --check is required"),
    ],
)
def test_a_mistake_is_a_message(tmp_path: Path, import_ark: ImportArk, arguments: list[str], text: str) -> None:
    done = import_ark(*arguments)
    assert done.returncode == 2
    assert text in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_objects_are_left_out_and_files_named(tmp_path: Path, import_ark: ImportArk) -> None:
    mug = tmp_path / "my_mug.urdf"
    shutil.copy(TUTORIAL.parent / "objects" / "mug" / "model.urdf", mug)
    done = import_ark(str(TUTORIAL), "-o", "mine.yaml", "--without", "ball", "--urdf", "Mug=my_mug.urdf")
    assert done.returncode == 0, done.stderr
    assert "left out (--without): ball" in done.stdout
    text = (tmp_path / "mine.yaml").read_text()
    assert "urdf: my_mug.urdf" in text
    assert "ball" not in text
