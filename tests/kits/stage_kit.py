"""A second rig of the same configuration, in which what was recorded is put up and drawn again."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from recording_kit import CAMERAS

import hal
from hal.geometry import Pose
from hal.recording import Episode

__all__ = ["ROUNDED", "Likeness", "Scene", "Stage", "at_row", "at_time"]

THINGS = ("cube", "duck")
ROUNDED = 3
"""Pixels on edges that may go either way: rows hold positions as 32-bit numbers."""


class Scene(NamedTuple):
    """Where everything was."""

    q: NDArray[np.float64]
    width: float
    things: dict[str, NDArray[np.float64]]


class Likeness(NamedTuple):
    """How a recorded picture and one that was drawn anew differ."""

    psnr: float
    """Of the colours, dB."""
    wrong: int
    """Pixels whose depth differs by more than its rounding and a millimetre."""


def at_row(episode: Episode, k: int) -> Scene:
    state = episode.columns["observation.state"][k].astype(float)
    return Scene(state[:7], state[7], {name: episode.columns[f"observation.object.{name}"][k] for name in THINGS})


def at_time(episode: Episode, t: float) -> Scene:
    """Between two rows, in proportion, each by its own stamps."""

    def between(key: str, stamps: str) -> NDArray[np.float64]:
        values, times = episode.columns[key].astype(float), episode.stamps[stamps]
        return np.array([np.interp(t, times, column) for column in values.T])

    state = between("observation.state", "robot.panda")
    return Scene(state[:7], state[7], {name: between(f"observation.object.{name}", "objects") for name in THINGS})


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
        """What is there now, against the picture of row ``k``."""
        drawn = self.rig.cameras[camera].read()
        assert drawn.color is not None
        assert drawn.depth is not None
        error = np.square(self.frames[camera][k].astype(float) - drawn.color).mean()
        rounding = 0.5 * self.episode.info["cameras"][camera]["depth_unit_m"]
        wrong = np.abs(self.depths[camera][k] - drawn.depth) > rounding + 1e-3
        return Likeness(10.0 * math.log10(255.0**2 / max(error, 1e-9)), int(wrong.sum()))

    def pose(self, camera: str) -> Pose:
        where = self.rig.cameras[camera].latest().T_world_camera
        assert where is not None
        return where
