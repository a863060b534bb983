"""Two simulated arms in lock-step: ``teleop`` and ``collect`` with two recorded pads or one, and ``replay``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

import yaml
from app_kit import CROSS, PS, run_here, write_pad

from hal.apps import collect, replay, teleop
from hal.recording import Dataset

SHARE = "BTN_SELECT"
FORWARD, UP = ("ABS_HAT0Y", -1), ("BTN_TL", 1)
"""What the d-pad and L1 do to the tcp."""


def pad(folder: Path, drives: Sequence[tuple[float, float, tuple[str, int]]], *taps: tuple[float, str]) -> str:
    """Write a recorded pad, and return its path.

    Args:
        folder: Gets the file.
        drives: From when to when a control is held with the dead-man, s.
        taps: Buttons that are tapped, with the dead-man released.
    """
    folder.mkdir()
    file = Path(write_pad(folder, *taps, until=9.5))
    header, *lines = (json.loads(line) for line in file.read_text().splitlines())
    header["ranges"]["ABS_HAT0Y"] = [-1, 1, 0]
    for start, end, (code, value) in drives:
        for t, share in ((start, 1), (end, 0)):
            kind = "key" if code.startswith("BTN") else "abs"
            lines.append({"t": t, "type": kind, "code": code, "value": value * share})
            lines.append({"t": t, "type": "abs", "code": "ABS_Z", "value": 255 * share})
            lines.append({"t": t, "type": "key", "code": "BTN_TL2", "value": share})
    lines.sort(key=lambda line: line["t"])
    file.write_text("\n".join(json.dumps(line) for line in [header, *lines]) + "\n")
    return str(file)


def rig(folder: Path, **pads: dict[str, Any]) -> Path:
    """Write a rig of two Pandas, and return its path."""
    arms = {name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("left", 0.5), ("right", -0.5))}
    content = {"robots": arms, "gamepads": pads, "simulation": {"clock": "lock_step"}}
    file = folder / "rig.yaml"
    file.write_text(yaml.safe_dump(content))
    return file


def recorded(file: str, **keys: Any) -> dict[str, Any]:
    return {"driver": "playback", "file": file, **keys}


def ends(report: Path) -> dict[str, np.ndarray]:
    """Where the tcp of each arm ended, m."""
    found = json.loads(report.read_text())
    assert found["trips"] == found["faults"] == []
    return {name: np.array(arm["tcp_end"]["position"]) for name, arm in found["arms"].items()}


def test_two_pads_drive_two_arms_at_once(tmp_path: Path) -> None:
    two = [pad(tmp_path / "a", [(0.5, 2.0, UP)]), pad(tmp_path / "b", [(1.0, 3.0, FORWARD)])]
    config = rig(tmp_path, one=recorded(two[0], drives="right"), two=recorded(two[1], drives="left"))
    out = tmp_path / "report.json"
    arguments = ("--config", config, "--sim", "--robot", "left,right", "--report", out)
    done = run_here(teleop.main, *arguments, "--duration", 4)
    assert done.returncode == 0, done.stderr
    assert "two drives left" in done.stdout
    after = ends(out)
    done = run_here(teleop.main, *arguments, "--duration", 0.2)
    before = ends(out)
    moved = {name: after[name] - before[name] for name in after}
    assert moved["left"] == pytest.approx([0.38, 0.0, 0.0], abs=0.05)
    assert moved["right"] == pytest.approx([0.0, 0.0, 0.28], abs=0.05)


def test_one_pad_drives_one_arm_after_the_other(tmp_path: Path) -> None:
    file = pad(tmp_path / "a", [(0.5, 1.5, UP), (3.0, 4.0, UP)], (2.0, SHARE))
    out = tmp_path / "report.json"
    config = rig(tmp_path, pad=recorded(file))
    done = run_here(teleop.main, "--config", config, "--sim", "--robot", "left,right", "--duration", 5, "--report", out)
    assert done.returncode == 0, done.stderr
    assert "driving right" in done.stdout
    assert json.loads(out.read_text())["tcp_travel_m"] == pytest.approx(0.36, abs=0.06)


@pytest.mark.slow
def test_episodes_of_two_arms_are_collected_and_each_arm_is_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    taps = [(0.5, CROSS), (4.0, PS), (5.0, CROSS), (8.5, PS)]
    left = pad(tmp_path / "a", [(1.0, 2.5, UP), (5.5, 7.0, FORWARD)], *taps)
    right = pad(tmp_path / "b", [(1.5, 3.0, FORWARD), (6.0, 8.0, UP)])
    config = rig(tmp_path, one=recorded(left, drives="left"), two=recorded(right, drives="right"))
    arguments = (
        "--config",
        config,
        "--sim",
        "--robot",
        "left,right",
        "--out",
        "data",
        "--episodes",
        2,
        "--cameras",
        "",
    )
    done = run_here(collect.main, *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    episodes = Dataset("data").episodes
    assert [episode.success for episode in episodes] == [True, True]
    for number, episode in enumerate(episodes):
        names = episode.names("rig.setpoint")
        assert {name.partition(".")[0] for name in names} == {"left", "right"}
        for arm in ("left", "right"):
            which = ("--episode", number, "--robot", arm, "--report", "r.json")
            done = run_here(replay.main, "data", "--config", config, "--sim", *which)
            assert done.returncode == 0, done.stdout + done.stderr
            joints = json.loads(Path("r.json").read_text())["deviation"]["joints_rad"]
            assert len(joints) == 7
            assert max(joint["rms"] for joint in joints.values()) < 0.003, "measured positions; they lag a little"
