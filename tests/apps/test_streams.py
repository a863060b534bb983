"""Programs whose standard streams are closed, full or not read: they end in order, and what they drive stops."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TELEOP = f"{sys.executable} -m hal.apps.teleop"
DRIVE = f"{TELEOP} --sim --pad demo --duration 1 --set simulation.clock=lock_step --set cameras={{}}"
RIG = """
import hal
with hal.open({"robots": {"arm": {"model": "panda"}}}, sim=True) as rig:
    moved = rig.robots["arm"].move_to(rig.robots["arm"].home, unattended=True)
    open("done.txt", "w").write("done")
"""


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("closed", ["<&-", "<&- >&-", "<&- >&- 2>&-"])
def test_a_rig_opens_without_standard_streams(closed: str, tmp_path: Path) -> None:
    (tmp_path / "rig.py").write_text(RIG)
    done = shell(f"{sys.executable} rig.py {closed}", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "done.txt").read_text() == "done"


def test_a_program_runs_without_standard_streams(tmp_path: Path) -> None:
    done = shell(f"{DRIVE} --report run.json <&- >&- 2>&-", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "run.json").is_file()


@pytest.mark.parametrize("command", [DRIVE, f"{sys.executable} -m hal.apps.main list"])
def test_a_full_disk_is_one_line(command: str, tmp_path: Path) -> None:
    done = shell(f"{command} > /dev/full", tmp_path)
    assert done.returncode == 2
    assert "No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_output_that_nothing_reads_ends_the_program_quietly(tmp_path: Path) -> None:
    """The reader is gone before the first line is written."""
    done = shell(f"(sleep 0.3; exec {DRIVE}) | true; exit ${{PIPESTATUS[0]}}", tmp_path)
    assert done.returncode == 1
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("robots", "word"),
    [
        ('{arm: {model: panda, drivers: {sim: ":"}}}', "module:CLASS"),
        ("{__proto__: {model: panda}}", "robots.__proto__"),
        ("{arm: {model: panda}}", ""),
    ],
)
def test_a_wrong_rig_is_a_message_also_on_a_terminal_without_its_letters(
    tmp_path: Path, robots: str, word: str
) -> None:
    folder = tmp_path / "lab_\u00fc"
    folder.mkdir()
    (folder / "rig.yaml").write_text(f"robots: {robots}\n")
    command = [sys.executable, "-m", "hal.apps.teleop", "--sim", "--dry-run", "--config", str(folder / "rig.yaml")]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONIOENCODING": "ascii"}, capture_output=True, text=True, timeout=60
    )
    printed = done.stdout + done.stderr
    assert "Traceback" not in printed
    assert "lab_\\xfc" in printed
    assert word in printed
    assert (done.returncode == 0) == (not word)
