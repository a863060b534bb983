"""``apps/calibrate.py``: the controls that it uses, and what it prints of a lens."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import hal
from hal import calibration
from hal.apps import calibrate


@pytest.mark.parametrize(
    ("own", "arguments", "deadman"),
    [(None, [], "l2"), ("spacemouse", [], "l1"), ("spacemouse", ["--mapping", "default"], "l2")],
)
def test_the_dead_man_is_that_of_the_pads_own_mapping(
    own: str | None, arguments: list[str], deadman: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: dict[str, Any] = {}
    monkeypatch.setattr(calibration, "collect_views", lambda *_, **options: used.update(options))
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        rig.driver("pad").meant_for = own
        collector: Any = SimpleNamespace(robot=rig.robots["panda"])
        calibrate._collect(calibrate.parser().parse_args(["--auto", *arguments]), rig, collector, hal.Pose())
        rig.driver("pad").press(deadman)
        rig.clock.sleep(0.1)
        assert used["deadman"].held


@pytest.mark.parametrize("built_in", [False, True])
def test_a_lens_that_is_not_written_is_printed_beside_that_of_the_rig_file(
    built_in: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2", reason="needs OpenCV: pip install 'robot-hal[calibration]'")
    pytest.importorskip("av", reason="needs PyAV: pip install 'robot-hal[record]'")
    from webcam_kit import write_video

    write_video(tmp_path / "v.mkv", 3)
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "cameras: {scene: {model: webcam, drivers: {real: video}, capture: {width: 64, height: 48, rate_hz: 30},\n"
        "  intrinsics: {width: 64, height: 48, fx: 61, fy: 62, cx: 30, cy: 22, distortion: [0.1, 0, 0, 0, 0]},\n"
        "  real: {file: v.mkv}}}"
    )
    before = rig.read_bytes()
    found = calibration.LensFit(
        np.array([[60.5, 0, 31], [0, 60.25, 23], [0, 0, 1]]),
        np.array([-0.123, 0, 0, 0, 0]),
        (64, 48),
        np.ones(4),
        0.1,
        9,
        1.0,
        1.0,
    )
    monkeypatch.setattr(calibrate, "_take_pictures", lambda *_: None)
    monkeypatch.setattr(calibration.LensViews, "solve", lambda _: found)
    if built_in:
        monkeypatch.setattr(calibration.setup, "data_folder", lambda _: tmp_path)
    arguments = ["intrinsics", "--real", "--config", str(rig)]
    assert calibrate.main(arguments if built_in else [*arguments, "--compare"]) == 0
    said = capsys.readouterr().out
    assert f"intrinsics: {found.entry()}" in said
    assert "61.0, 62.0, 30.0, 22.0 px; distortion: 0.1000" in said
    assert rig.read_bytes() == before


def test_a_place_that_cannot_be_edited_is_refused_before_anything_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "robots: {panda: {model: panda}}\n"
        "cameras:\n"
        "  a: {model: webcam, pose: &p [0, 0, 1, 1, 0, 0, 0]}\n"
        "  b: {model: webcam, pose: *p}\n"
    )
    assert calibrate.main(["--sim", "--config", str(rig), "--camera", "b", "--dry-run"]) == 2
    assert "edit cameras.b by hand" in capsys.readouterr().err


@pytest.mark.parametrize("choice", ["sim: true", "sim: false, drivers: {real: mock}"])
def test_the_lens_of_a_simulated_camera_is_not_measured(
    choice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(calibrate, "_take_pictures", lambda *_: pytest.fail("it was opened"))
    path = tmp_path / "rig.yaml"
    path.write_text(f"cameras: {{scene: {{model: webcam, pose: [0, 0, 1, 1, 0, 0, 0], {choice}}}}}")
    assert calibrate.main(["intrinsics", "--config", str(path), "--compare"]) == 2
    assert "simulated" in capsys.readouterr().err
