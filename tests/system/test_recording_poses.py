"""Pictures show what the row beside them says: put everything back where the row has it, and draw it again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_kit import check_layout, small

import hal
from hal.pose import Pose
from hal.recording import Dataset, Recorder

pytestmark = pytest.mark.slow
pytest.importorskip("pybullet", reason="pip install 'robot-hal[sim]'")

OVERRIDES = small(256, 192)


def open_rig() -> hal.Rig:
    return hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=OVERRIDES)


def test_every_picture_shows_its_row(tmp_path: Path) -> None:
    with open_rig() as rig, Recorder(rig, tmp_path / "out", task="push") as recorder:
        arm = rig.robots["panda"]
        recorder.start(seed=1)
        rig.world.set_velocity("cube", linear=[0.15, 0.1, 0.0])
        with arm.control(rate_hz=30) as control:
            for tick in rig.clock.rate(30):
                if tick.elapsed > 2.0:
                    break
                control.send(hal.Twist([0.1, 0.1 * np.sin(3 * tick.elapsed), -0.1], [0.0, 0.0, 0.5]))
        recorder.save(wait=True)
    check_layout(tmp_path / "out")
    episode = Dataset(tmp_path / "out").episodes[0]
    q, cube = episode.columns["observation.state"][:, :7], episode.columns["observation.object.cube"]
    assert np.ptp(q, axis=0).max() > 0.1, "the arm moved"
    assert np.ptp(cube[:, :3], axis=0).max() > 0.02, "and so did the cube"
    rows = range(0, episode.length, 6)
    wrong = []
    with open_rig() as rig:
        for camera in ("scene", "wrist"):
            frames, depths = list(episode.frames(camera)), list(episode.depth(camera))
            stay = []
            for k in rows:
                rig.world.reset("panda", q=q[k])
                for name in ("cube", "duck"):
                    pose = episode.columns[f"observation.object.{name}"][k]
                    rig.world.reset(name, pose=Pose(pose[:3], pose[3:]))
                drawn = rig.cameras[camera].read()
                assert drawn.color is not None
                assert drawn.depth is not None
                wrong.append(_psnr(frames[k], drawn.color))
                stay.append(_psnr(frames[max(0, k - 6)], drawn.color))
                step = episode.info["cameras"][camera]["depth_unit_m"]
                close = np.abs(depths[k] - drawn.depth) <= 0.5 * step + 1e-3
                assert close.mean() > 0.995, f"{camera}, row {k}: depth of {1 - close.mean():.2%} of the pixels differs"
                where = episode.columns[f"observation.camera_pose.{camera}"][k]
                assert drawn.T_world_camera is not None
                distance, angle = drawn.T_world_camera.distance(Pose(where[:3], where[3:]))
                assert distance < 1e-4
                assert angle < 2e-3
            assert np.mean(stay[1:]) < min(wrong) - 3.0, "rows 0.2 s apart could be told from each other"
    assert min(wrong) > 30.0, f"dB, what the codec takes away: {min(wrong):.1f}"


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = np.square(a.astype(float) - b.astype(float)).mean()
    return float(10.0 * np.log10(255.0**2 / max(error, 1e-9)))
