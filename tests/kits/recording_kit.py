"""Small recordings of rigs, and what every recording must keep (:mod:`recording_layout`).

First recordings of mock rigs, then one to export, then a second rig in which recorded scenes are drawn again.
"""

from __future__ import annotations

import atexit
import json
import math
import shutil
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import hal
from hal.config.data_files import find_data
from hal.geometry import Pose
from hal.rig import Rig

pytest.importorskip("zstandard", reason="pip install 'robot-hal[record]'")

from recording_layout import check_layout, check_stamps

from hal.recording import Dataset, Episode, Recorder

__all__ = [
    "CAMERAS",
    "ROUNDED",
    "SIZE",
    "Likeness",
    "Scene",
    "Stage",
    "at_row",
    "at_time",
    "check_layout",
    "check_stamps",
    "drive",
    "join_metadata",
    "kill_writer",
    "make_recording",
    "mock_rig",
    "pictures",
    "record",
    "record_tour",
    "small",
]

CAMERAS = ("scene", "wrist")
SIZE = (64, 48)


def small(width: int = SIZE[0], height: int = SIZE[1]) -> list[str]:
    """Overrides that make both cameras' pictures small."""
    return [
        f"cameras.{name}.output.{key}={value}"
        for name in CAMERAS
        for key, value in (("width", width), ("height", height))
    ]


def mock_rig(clock: str = "lock_step", *overrides: str, **more: Any) -> Rig:
    """A mock of the built-in rig."""
    return hal.open("panda_table", driver="mock", clock=clock, overrides=[*small(), *overrides], **more)


def drive(rig: Rig, seconds: float) -> None:
    """Move the arm a little."""
    arm = rig.robots["panda"]
    with arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            if tick.elapsed > seconds:
                break
            control.send(hal.Twist([0.0, 0.0, 0.05]), grip=0.5)


def record(recorder: Recorder, seconds: float, success: bool | None = True) -> None:
    """One episode."""
    recorder.start(seed=1)
    drive(recorder.rig, seconds)
    recorder.save(success, wait=True)


def record_tour(out: Path, seconds: float = 60.0) -> Path:
    """Record the built-in tour of a pad, at most so long of it, driven in simulation."""
    tour = str(find_data("config", "teleop/tour.jsonl"))
    with (
        hal.open("panda_table", sim=True, clock="lock_step", pad=tour, overrides=["cameras={}"]) as rig,
        Recorder(rig, out, fps=30, task="a tour") as recorder,
    ):
        arm, pad = rig.robots["panda"], rig.gamepads["pad"]
        teleop = hal.Teleop(arm)
        recorder.start(seed=1)
        with arm.control(deadman=pad.hold("l2"), rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                motion, grip = teleop.step(pad.state(), tick.dt)
                control.send(motion, grip=grip)
                if pad.finished or tick.elapsed > seconds:
                    break
        recorder.save(success=True, wait=True)
    return out


def kill_writer(recorder: Recorder) -> None:
    """Kill the process that writes the present episode, once some rows are on the disk."""
    deadline = time.monotonic() + 30.0
    while (recorder.status().frames < 5 or recorder._queue.waiting) and time.monotonic() < deadline:
        time.sleep(0.01)
    recorder._child.process.kill()
    recorder._child.process.wait()


MARKS = (True, False, None)


def make_recording(folder: Path) -> Dataset:
    """Return a dataset of 0.6, 0.4 and 0.3 s: a success with a stop in it, a failure, and one that is not marked.

    It is recorded once; ``folder`` gets a copy.
    """
    return Dataset(Path(shutil.copytree(_recording(), folder)))


@cache
def _recording() -> Path:
    made = Path(tempfile.mkdtemp(prefix="hal-recording-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    folder = made / "demo"
    with mock_rig() as rig, Recorder(rig, out=folder, fps=20, task="lift the cube") as recorder:
        recorder.start(seed=1)
        drive(rig, 0.3)
        arm = rig.robots["panda"]
        with arm.control(rate_hz=50, unattended=True) as control:
            for tick in rig.clock.rate(50):
                if tick.elapsed > 0.1:
                    break
                control.send(hal.Twist([0.0, 0.05, 0.0]))
            rig.stop()
            rig.clock.sleep(0.2)
            with pytest.raises(hal.MotionStopped):
                control.send(hal.Twist([0.0, 0.05, 0.0]))
        recorder.save(MARKS[0], wait=True)
        rig.rearm()
        record(recorder, 0.4, MARKS[1])
        record(recorder, 0.3, MARKS[2])
    return folder


def join_metadata(root: Path) -> None:
    """Put all metadata of each episode into its own file, as earlier versions did."""
    for path in root.glob("episodes/[0-9]*.json"):
        about = json.loads(path.read_text())
        common = json.loads(path.with_name(f"{about.pop('common')}.json").read_text())
        path.write_text(json.dumps(common | about))
    for path in root.glob("episodes/common-*.json"):
        path.unlink()


def pictures(dataset: Dataset, what: str, camera: str) -> list[np.ndarray[Any, Any]]:
    """Return the frames or depth of a camera, one array per episode."""
    return [
        np.stack(list(episode.frames(camera) if what == "rgb" else episode.depth(camera)))
        for episode in dataset.episodes
    ]


THINGS = ("cube", "duck")
ROUNDED = 3
"""Pixels on edges that may go either way: rows hold positions as 32-bit numbers."""


class Scene(NamedTuple):
    """Where everything was."""

    q: NDArray[np.float64]
    width: float
    things: dict[str, NDArray[np.float64]]


class Likeness(NamedTuple):
    """The difference of a recorded picture and one that was rendered again."""

    psnr: float
    """Of the colours, dB."""
    wrong: int
    """Pixels whose depth differs by more than its rounding and a millimetre."""


def at_row(episode: Episode, k: int) -> Scene:
    state = episode.columns["observation.state"][k].astype(float)
    return Scene(state[:7], state[7], {name: episode.columns[f"rig.object.{name}"][k] for name in THINGS})


def at_time(episode: Episode, t: float) -> Scene:
    """Between two rows, in proportion, each by its own stamps."""

    def between(key: str, stamps: str) -> NDArray[np.float64]:
        values, times = episode.columns[key].astype(float), episode.stamps[stamps]
        return np.array([np.interp(t, times, column) for column in values.T])

    state = between("observation.state", "robot.panda")
    return Scene(state[:7], state[7], {name: between(f"rig.object.{name}", "objects") for name in THINGS})


class Stage:
    """A second rig of the same configuration, in which recorded scenes are put up."""

    def __init__(self, rig: hal.Rig, episode: Episode) -> None:
        self.rig, self.episode = rig, episode
        self.frames = {name: list(episode.frames(name)) for name in CAMERAS}
        self.depths = {name: list(episode.depth(name)) for name in CAMERAS}

    def put(self, scene: Scene) -> None:
        self.rig.world.reset("panda", q=[*scene.q, scene.width / 2, scene.width / 2])
        for name, pose in scene.things.items():
            self.rig.world.reset(name, pose=Pose(pose[:3], pose[3:]))

    def look(self, camera: str, k: int) -> Likeness:
        """Compare a new picture with that of row ``k``."""
        drawn = self.rig.cameras[camera].read()
        error = np.square(self.frames[camera][k].astype(float) - drawn.color).mean()
        rounding = 0.5 * self.episode.info["cameras"][camera]["depth_unit_m"]
        wrong = np.abs(self.depths[camera][k] - drawn.depth) > rounding + 1e-3
        return Likeness(10.0 * math.log10(255.0**2 / max(error, 1e-9)), int(wrong.sum()))

    def pose(self, camera: str) -> Pose:
        where = self.rig.cameras[camera].read_latest().T_world_camera
        assert where is not None
        return where
