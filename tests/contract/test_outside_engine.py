"""An engine of another package: found by its entry point, and tested with what robot-hal installs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_an_engine_of_another_package_passes_the_contract_and_moves_the_arm_of_a_rig(tmp_path: Path) -> None:
    for file in (*(ROOT / "tests" / "engine_package").glob("*.py"), ROOT / "examples" / "tcp_arm" / "tcp_arm.yaml"):
        shutil.copy(file, tmp_path)
    about = tmp_path / "kinematic_engine-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: kinematic-engine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[hal.drivers]\nkinematic = kinematic_engine:DRIVER\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_kinematic_engine.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
