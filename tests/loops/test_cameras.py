"""Any camera in a rig: the same program with a video, and in simulation (docs/cameras.md)."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("av", reason="needs PyAV: pip install 'robot-hal[record]'")

from webcam_kit import write_video

from hal.apps import replay
from hal.recording import Dataset, Episode

RATE, FRAMES = 30, 30
RIG = """
robots: {panda: {model: panda, base: [-0.55, 0, 0.6, 0, 0, 0, 1]}}
objects: [table]
cameras:
  scene:
    model: webcam
    sim: false
    drivers: {real: video}
    capture: {width: 64, height: 48, rate_hz: 30}
    look_at: {target: [0, 0, 0.7], distance: 1.2, pitch_deg: -40}
    real: {file: video.mkv}
"""
PROGRAM = """
import hal
from hal.recording import Recorder

with hal.open(rig, sim=sim, clock=clock, pad="none", engine="mujoco") as opened, Recorder(opened, out) as recorder:
    arm = opened.robots["panda"]
    recorder.start()
    arm.move_to(arm.home + 0.15)
    recorder.save(True)
"""


def record(folder: Path, out: str, sim: bool | None) -> Episode:
    """Run the same program file with the rig's own cameras, or with all devices simulated."""
    (folder / "rig.yaml").write_text(RIG)
    (folder / "program.py").write_text(PROGRAM)
    clock = "lock_step" if sim else "real_time"
    given = {"rig": str(folder / "rig.yaml"), "sim": sim, "clock": clock, "out": str(folder / out)}
    runpy.run_path(str(folder / "program.py"), given)
    (episode,) = Dataset(folder / out).episodes
    return episode


@pytest.mark.slow
@pytest.mark.pair
def test_a_program_records_a_video_camera_and_with_sim_a_simulated_one(tmp_path: Path) -> None:
    write_video(tmp_path / "video.mkv", FRAMES, rate=RATE)
    episode = record(tmp_path, "real", None)
    shown = np.array([round(frame.mean() / 8.0) for frame in episode.frames("scene")])
    assert len(shown) == episode.length > RATE // 3
    names = episode.names("rig.time.camera.scene")
    t, t_device, number = episode.columns["rig.time.camera.scene"].T
    assert len(names) == 3
    assert (shown == number % FRAMES).all(), "each row has the picture whose time it names"
    assert np.allclose(t_device, number / RATE, atol=2e-3)
    assert np.allclose(t - t[0], t_device - t_device[0], atol=1e-5)
    late = episode.stamps["grid"] - episode.stamps["camera.scene"]
    assert ((late >= 0.0) & (late < 1.5 / RATE)).all(), "and it is the newest one when the row was due"
    assert np.ptp(episode.columns["observation.state"], axis=0).max() > 0.03
    play = [str(tmp_path / "real"), "--sim", "--config", str(tmp_path / "rig.yaml"), "--engine", "mujoco"]
    assert replay.main([*play, "--set", "cameras={}", "--set", "simulation.clock=lock_step"]) == 0

    simulated = record(tmp_path, "sim", True)
    assert simulated.cameras == episode.cameras == ("scene",)
    assert next(simulated.frames("scene")).shape == (48, 64, 3)
    assert np.ptp(next(simulated.frames("scene"))) > 50, "the simulated camera sees the arm"
