"""Demonstrations with a UR and two webcams, as a lab collects and replays them; the cameras' kernel is in memory."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("av", reason="needs PyAV: pip install 'robot-hal[record]'")

from operator_kit import Operator
from webcam_kit import grey, webcams

from hal.apps import collect, replay
from hal.recording import Dataset

from .network_kit import UrEmulator

pytestmark = [pytest.mark.slow, pytest.mark.alone]

RATE = 30


def test_what_a_ur_and_two_webcams_collect_is_replayed_within_2_mm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulator, person = UrEmulator(), Operator()
    camera = {"model": "webcam", "capture": {"width": 64, "height": 48, "rate_hz": RATE}}
    ports = {"left": "1-1", "right": "1-2"}
    rig = emulator.rig() | {"gamepads": {"pad": {"driver": "mock"}}}
    rig["cameras"] = {name: camera | {"real": {"port": port}} for name, port in ports.items()}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    options = ["--real", "--config", str(tmp_path / "rig.yaml")]
    data, report = str(tmp_path / "data"), tmp_path / "report.json"
    try:
        with (
            webcams(tmp_path, *({"port": port} for port in ports.values())),
            person.operate(monkeypatch),
        ):
            words = ["--speed", "0.1", "--out", data, "--episodes", "1", "--task", "reach"]
            assert collect.main([*options, *words]) == 0, person.getvalue()
        (episode,) = Dataset(data).episodes
        for name in ports:
            late = episode.stamps["grid"] - episode.stamps[f"camera.{name}"]
            assert ((late >= 0.0) & (late < 1.5 / RATE)).all(), "each row has the newest picture when it was due"
            numbers = episode.columns[f"rig.time.camera.{name}"][:, 2].astype(int)
            shown = np.array([frame.mean() for frame in episode.frames(name)])
            assert np.abs(shown - [grey(number) for number in numbers]).max() < 6.0, "and it is that picture"
        assert np.ptp(episode.columns["observation.state"][:, :6], axis=0).max() > 0.05, "the arm was driven"

        assert replay.main([data, *options, "--set", "cameras={}", "--unattended", "--report", str(report)]) == 0
        deviation = json.loads(report.read_text())["deviation"]["tcp_mm"]
        print(f"tcp {deviation['max']:.2f} mm")
        assert deviation["max"] < 2.0
    finally:
        emulator.close()
