"""Emulated leaders, moved as by hands, drive arms in real time, by the command line: two SO-101, and a GELLO."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

from app_kit import CROSS, PS, run_here, write_pad
from operator_kit import Operator
from servo_bus_kit import ServoBusProcess
from waiting import wait_until

from hal.apps import collect, replay
from hal.recording import Dataset
from hal.types import RobotStatus
from hal_emulators.servo_bus.server import ServoBusEmulator, find_leaders

from .franka_kit import Emulator

pytestmark = [pytest.mark.slow, pytest.mark.alone]

RIG = """
robots:
  small: {model: so101}
  large: {model: panda, base: {position: [0, 1, 0]}}
leaders:
  left: {model: so101_leader, port: left.emulated, drives: small}
  right: {model: so101_leader, port: right.emulated, drives: large}
gamepads:
  pad: {model: auto}
"""
GELLO = [0, 0.3, 0, -1.9, 0, -1.6, 0], [0.15, 0.45, 0.1, -2.1, 0.1, -1.5, 0.2]
POSES = ("0 0 0 0 0 0", "0.15 0.2 -0.2 0.15 0.2 1", "-0.15 -0.1 0.2 -0.1 0.1 0")


def test_two_leaders_drive_two_arms_and_the_recording_is_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Joint to joint an SO-101, by poses a Panda."""
    monkeypatch.chdir(tmp_path)
    Path("rig.yaml").write_text(RIG)
    taps = [(float(t), CROSS) for t in (1, 2, 3)]  # on a busy computer the first ones come too early
    pad = write_pad(tmp_path, *taps, (5.8, PS), until=20.0, held=(3.4, 5.5))
    rig = ["--config", "./rig.yaml", "--sim"]
    with ServoBusEmulator(find_leaders("./rig.yaml")) as emulator:
        for turn in range(60):
            for leader in ("left", "right"):
                emulator.execute(f"{leader} hand 1 {POSES[turn % 3]}")
        options = [
            "--robot",
            "small,large",
            "--pad",
            pad,
            "--episodes",
            1,
            "--out",
            "data",
            "--report",
            "collected.json",
        ]
        done = run_here(collect.main, *rig, *options)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(Path("collected.json").read_text())["trips"] == []
    (episode,) = Dataset("data").episodes
    moved = dict(zip(episode.names("action"), np.ptp(episode.columns["action"], axis=0), strict=True))
    assert min(moved["small.shoulder_lift"], moved["large.panda_joint1"]) > 0.05, moved
    played = run_here(replay.main, "data", *rig, "--robot", "large", "--unattended", "--report", "played.json")
    assert played.returncode == 0, played.stdout + played.stderr
    assert json.loads(Path("played.json").read_text())["deviation"]["tcp_mm"]["max"] < 2.0, played.stdout


def test_a_gello_drives_an_emulated_fr3_and_the_recording_is_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
    monkeypatch.chdir(tmp_path)

    def drive(person: Operator) -> None:
        """Engage, move the leader, and disengage once both are at rest."""
        arm = person.rig.robots["arm"]
        person.pad.press("l2")
        wait_until(lambda: arm.state().status is RobotStatus.FOLLOWING, "following")
        arm.clock.sleep(0.2)
        emulator.execute(f"hand 1 {' '.join(map(str, GELLO[1]))}")
        wait_until(lambda: np.allclose(emulator.execute("state")["q"], GELLO[1], atol=1e-3), "moved")
        wait_until(lambda: np.abs(arm.state().dq_set).max() < 1e-3, "at rest")

    person = Operator(drive)
    leader = {"model": "gello_franka", "port": str(tmp_path / "gello.emulated"), "options": {"lever_deg": [223, 180]}}
    with Emulator("--lockstep", robot="fr3") as arm:  # a set-point that is late is no fault of the arm here
        changes = [f"robots.arm.real.host={arm.host}", "robots.arm.gripper.enabled=false", "cameras={}"]
        changes += [f"leaders={json.dumps({'gello': leader})}", "gamepads={pad: {driver: mock}}"]
        rig = ["--real", "--config", "franka_emulator", *(word for change in changes for word in ("--set", change))]
        with ServoBusProcess("franka_emulator", changes) as emulator, person.operate(monkeypatch):
            emulator.execute(f"place {' '.join(map(str, GELLO[0]))}")
            words = ["--episodes", "1", "--out", "data", "--report", "collected.json"]
            assert collect.main([*rig, *words]) == 0, person.getvalue()
        assert json.loads(Path("collected.json").read_text())["trips"] == []
        (episode,) = Dataset("data").episodes
        moved = np.ptp(episode.columns["rig.setpoint"][:, :7], axis=0)
        assert np.count_nonzero(moved > 0.05) >= 4, moved
        # Slowly: what an emulator that waits for a busy computer reports is dated too early.
        options = ["--unattended", "--report", "played.json", "--speed", "0.4"]
        played = run_here(replay.main, "data", *rig, *options)
        assert played.returncode == 0, played.stdout + played.stderr
        deviation = json.loads(Path("played.json").read_text())["deviation"]["tcp_mm"]
        print(f"tcp {deviation['max']:.2f} mm")
        assert deviation["max"] < 2.0, played.stdout
        assert not arm.events("reflex")
