"""An engine of another package: found by its entry point, and tested with what robot-hal installs."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_an_engine_of_another_package_passes_the_contract_and_moves_the_arm_of_a_rig(tmp_path: Path) -> None:
    folder = tmp_path / "kinematic_engine"
    shutil.copytree(ROOT / "tests" / "engine_package", folder, ignore=shutil.ignore_patterns("__pycache__"))
    about = folder / "kinematic_engine-1.0.dist-info"  # what pip would make of pyproject.toml
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: kinematic-engine\nVersion: 1.0\n")
    points = re.search(r'entry-points."(.*?)"\].*\n((?:\w.*\n)+)', (folder / "pyproject.toml").read_text())
    assert points is not None
    (about / "entry_points.txt").write_text(f"[{points[1]}]\n{points[2].replace(chr(34), '')}")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
