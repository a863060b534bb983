"""The recorded tour in simulation and, in real time, through the emulators of a UR5e and an xArm7: ten times each.

``HAL_SOAK=1 pytest tests/wire/test_tours.py`` on a computer that does nothing else, which takes minutes: a cycle of an
arm that is missed is never caught up, so the arm comes less far. Without HAL_SOAK nothing of this file is collected.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hal.geometry import Pose

from .network_kit import UrEmulator, XArmEmulator

pytestmark = [pytest.mark.slow, pytest.mark.alone]

ROOT = Path(__file__).parents[2]
SPEED = 0.3
"""Share of the mapping's speeds."""
APART, TURNED = 0.001, 0.003
"""By how much the ends may differ, m and rad."""


def drive(rig: dict[str, Any], folder: Path, *arguments: str) -> dict[str, Any]:
    """Drive the tour with the app; return its report."""
    (folder / "rig.json").write_text(json.dumps(rig))
    command = [sys.executable, str(ROOT / "apps" / "teleop.py"), "--config", str(folder / "rig.json")]
    command += ["--pad", str(ROOT / "tests" / "data" / "pads" / "tour.jsonl"), "--speed", str(SPEED)]
    done = subprocess.run([*command, "--report", str(folder / "report"), *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    report: dict[str, Any] = json.loads((folder / "report").read_text())
    assert report["trips"] == report["faults"] == []
    assert report["tcp_travel_m"] > 0.5
    return report


def end_of(report: dict[str, Any]) -> Pose:
    return Pose(report["tcp_end"]["position"], report["tcp_end"]["orientation"])


Bench = tuple[UrEmulator | XArmEmulator, Pose]


@pytest.fixture(scope="module", params=["ur5e", "xarm7"])
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """An emulated arm, and where the tour ends in a simulation at the arm's own rate."""
    emulator: UrEmulator | XArmEmulator = UrEmulator() if request.param == "ur5e" else XArmEmulator()
    rate = 500 if request.param == "ur5e" else 250
    simulated = ["--sim", "--set", "simulation.clock=lock_step", "--set", f"simulation.physics_hz={rate}"]
    try:
        rig = emulator.rig() | {"gamepads": {"pad": {}}}
        yield emulator, end_of(drive(rig, tmp_path_factory.mktemp("simulated"), *simulated))
    finally:
        emulator.close()


@pytest.mark.parametrize("run", range(10))
def test_the_recorded_tour_ends_where_it_ends_in_simulation(bench: Bench, run: int, tmp_path: Path) -> None:
    emulator, simulated = bench
    emulator.control.send("refresh")
    report = drive(emulator.rig() | {"gamepads": {"pad": {}}}, tmp_path, "--real")
    distance, angle = end_of(report).distance(simulated)
    print(f"run {run}: {1e3 * distance:.2f} mm, {angle:.4f} rad, {report['servo']['missed']} cycles missed")
    assert distance <= APART
    assert angle <= TURNED
