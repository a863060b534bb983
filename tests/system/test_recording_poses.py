"""Pictures show what the rows beside them say: put everything back where they have it, and draw it again.

Depth is kept without loss, so not one pixel may differ; colour comes back as well as the codec lets it.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from recording_kit import CAMERAS, ROUNDED, Likeness, Scene, Stage, at_row, at_time, check_layout, check_stamps, small

import hal
from hal.geometry import Pose
from hal.recording import Dataset, Episode, Recorder

pytestmark = pytest.mark.slow

OVERRIDES = small(160, 120)


def open_rig(clock: str = "lock_step") -> hal.Rig:
    return hal.open("panda_table", sim=True, clock=clock, pad="none", overrides=OVERRIDES)


def drive(rig: hal.Rig, seconds: float) -> None:
    """Move the arm, close the gripper, and push the cube about."""
    arm, pushes = rig.robots["panda"], 0
    with arm.control(rate_hz=10) as control:
        for tick in rig.clock.rate(30):
            if tick.elapsed > seconds:
                break
            if tick.elapsed >= 0.8 * pushes:
                rig.world.set_velocity("cube", linear=[0.4, 0.3, 0.0])
                pushes += 1
            try:
                turning = hal.Twist([0.1, 0.1 * math.sin(3 * tick.elapsed), -0.1], [0.0, 0.0, 0.5])
                control.send(turning, grip=min(1.0, tick.elapsed / seconds))
            except hal.MotionStopped:  # a busy machine, in real time
                control.rearm()


def recorded(out: Path, clock: str, seconds: float) -> Episode:
    with open_rig(clock) as rig, Recorder(rig, out, task="push") as recorder:
        recorder.start(seed=1)
        drive(rig, seconds)
        recorder.save(wait=True)
    check_layout(out)
    episode = Dataset(out).episodes[0]
    check_stamps(episode)
    state = episode.columns["observation.state"]
    assert np.ptp(state[:, :7], axis=0).max() > 0.1, "the arm moved"
    assert np.ptp(state[:, 7]) > 0.05, "the gripper closed"
    assert np.ptp(episode.columns["rig.object.cube"][:, :2], axis=0).max() > 0.03, "the cube was pushed"
    return episode


def test_every_picture_shows_its_row(tmp_path: Path) -> None:
    episode = recorded(tmp_path / "out", "lock_step", 2.0)
    right: list[Likeness] = []
    later: list[Likeness] = []
    with open_rig() as rig:
        stage = Stage(rig, episode)
        for k in range(0, episode.length - 3, 6):
            scene = at_row(episode, k)
            stage.put(scene)
            for camera in CAMERAS:
                right.append(stage.look(camera, k))
                where = episode.columns[f"rig.camera_pose.{camera}"][k]
                distance, angle = stage.pose(camera).distance(Pose(where[:3], where[3:]))
                assert distance < 1e-4
                assert angle < 2e-3
            for part, moved in _slightly_moved(scene).items():
                stage.put(moved)
                seen = sum(stage.look(camera, k).wrong for camera in CAMERAS)
                assert seen > 3 * ROUNDED, f"row {k}: that the {part} is elsewhere would not have been seen"
            stage.put(at_row(episode, k + 3))
            later += [stage.look(camera, k) for camera in CAMERAS]
    assert max(like.wrong for like in right) <= ROUNDED
    assert min(like.psnr for like in right) > 30.0, "dB, what the codec takes away"
    assert min(like.wrong for like in later) > 100 * ROUNDED, "rows 0.1 s apart can be told from each other"
    assert np.mean([like.psnr for like in later]) < min(like.psnr for like in right) - 3.0


def _slightly_moved(scene: Scene) -> dict[str, Scene]:
    """The scene with one thing in it a little elsewhere: so much is seen."""
    turned = scene.q.copy()
    turned[3] += 0.02  # rad
    found = {"arm": scene._replace(q=turned), "fingers": scene._replace(width=scene.width + 0.01)}
    for name, pose in scene.things.items():
        moved = pose.copy()
        moved[0] += 0.01
        found[name] = scene._replace(things=scene.things | {name: moved})
    return found


def test_in_real_time_every_picture_shows_the_time_of_its_stamp(tmp_path: Path) -> None:
    """It is older than its row. Where things were at its own time is found between the rows."""
    episode = recorded(tmp_path / "out", "real_time", 2.5)
    right: list[Likeness] = []
    wins = 0
    with open_rig() as rig:
        stage = Stage(rig, episode)
        for camera in CAMERAS:
            for k in range(2, episode.length - 2, 8):
                t = float(episode.stamps[f"camera.{camera}"][k])
                looks = []
                for off in (0.0, 0.02, -0.02):
                    stage.put(at_time(episode, t + off))
                    looks.append(stage.look(camera, k))
                right.append(looks[0])
                wins += 2 * looks[0].wrong < min(look.wrong for look in looks[1:])
    median = float(np.median([like.wrong for like in right]))
    assert median <= 60, "pixels, where a busy machine moves in jerks; 0 to 3 elsewhere, and hundreds 20 ms away"
    assert np.median([like.psnr for like in right]) > 30.0
    assert wins >= 0.6 * len(right), "20 ms too early and too late were both twice as wrong"
