"""Synthetic views and images of a board from known poses, and simulated rigs whose camera's pose is hidden."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hal
from hal.calibration import (
    Board,
    BoardDetection,
    Calibration,
    Collector,
    Detector,
    Eye,
    View,
    collect_views,
    find_setup,
    load_board,
    solve,
)
from hal.calibration.detection import flat_pose
from hal.calibration.solving import inverse, motion
from hal.config import load
from hal.geometry import Pose
from hal.images import distort_points, undistort_pixels

BOARD = Board(7, 5, 0.035, 0.027)
SIZE = (640, 480)
K = np.array([[614.0, 0.0, 319.5], [0.0, 612.0, 240.5], [0.0, 0.0, 1.0]])
X = motion(np.array([0.05, -0.02, 0.06, 0.1, -0.2, 1.5]))
"""Pose of the camera: in the link's frame, or in the world."""
Z = motion(np.array([0.5, 0.1, 0.02, 3.0, 0.1, 0.3]))
"""Pose of the board: in the world, or in the link's frame."""
CAMERA = Pose.from_matrix(X)
LENS = (0.12, -0.25, 0.001, -0.0008, 0.05)
WEBCAM = (0.1, -0.2, 0.001, -0.0008, 0.0)

Array = NDArray[np.float64]


def poses(count: int, seed: int = 0, turns: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> list[Array]:
    """Poses of the board in the camera's frame: facing it, turned by up to ``turns`` rad about each of its axes."""
    chance, found = np.random.default_rng(seed), []
    for _ in range(count):
        pose = motion(np.array([0.0, 0.0, 0.0, *(chance.uniform(-1.0, 1.0, 3) * turns)]))
        middle = np.array([*chance.uniform(-0.04, 0.04, 2), chance.uniform(0.4, 0.6)])
        pose[:3, 3] = middle - pose[:3, :3] @ BOARD.centre
        found.append(pose)
    return found


def hold(count: int, tilt: float = 0.5, aside: float = 0.15) -> list[Array]:
    """The board in the camera's frame, held as a person does: tilted by up to ``tilt`` rad, up to ``aside`` m aside."""
    chance = np.random.default_rng(3)
    seen = poses(count, seed=3, turns=(tilt, tilt, 0.5))
    for pose in seen:
        pose[:2, 3] += chance.uniform(-aside, aside, 2) * (1.0, 0.7)
    return seen


def pixels_of(pose: Array, lens: tuple[float, ...] = (0.0,) * 5, board: Board = BOARD) -> Array:
    """Pixels (n, 2) at which the camera sees the corners of a board at ``pose``."""
    p = board.corners @ pose[:3, :3].T + pose[:3, 3]
    seen = distort_points(p[:, :2] / p[:, 2:], lens)
    return np.column_stack([seen, np.ones(len(seen))]) @ K[:2].T


def views(
    eye: Eye,
    seen: list[Array],
    *,
    noise_px: float = 0.0,
    arm: float = 0.0,
    lens: tuple[float, ...] = (0.0,) * 5,
    believed: Array = K,
    real_board: Board = BOARD,
    seed: int = 1,
) -> list[View]:
    """The views that an arm and a detector would produce.

    Args:
        eye: Where the camera is.
        seen: The board in the camera's frame, in each view.
        noise_px: Of each corner's coordinates, standard deviation.
        arm: Error of the arm's pose, standard deviation: m along, and twice as many rad about each axis.
        lens: The known distortion.
        believed: The K that the camera reports.
        real_board: The true board; ``BOARD`` is the assumed one.
        seed: Of the noise.
    """
    chance, made = np.random.default_rng(seed), []
    for k, pose in enumerate(seen):
        pixels = pixels_of(pose, lens, real_board)
        pixels = undistort_pixels(pixels + noise_px * chance.normal(size=pixels.shape), believed, lens)
        C, error = flat_pose(BOARD.corners, pixels, believed)
        A = Z @ inverse(pose) @ inverse(X)
        link = (A if eye == "in-hand" else inverse(A)) @ motion(arm * chance.normal(size=6) * [1, 1, 1, 2, 2, 2])
        made.append(
            View(f"view {k}", Pose.from_matrix(link), BoardDetection(BOARD.corners, pixels, believed, C, error))
        )
    return made


def picture(pose: Array, cv2: Any, lens: tuple[float, ...] = (0.0,) * 5, finer: int = 4) -> NDArray[np.uint8]:
    """A grey image (480, 640) of the board on a grey ground, with smooth edges as a camera's."""
    scale, width, height = 20.0, *SIZE
    paper = np.pad(BOARD.picture(scale), int(10 * scale), constant_values=255)
    v, u = np.mgrid[-1 : height + 1, -1 : width + 1]
    ideal = np.dstack([u, v]).astype(float)
    if any(lens):  # at every pixel, and in between as if it were straight, which it is to 1e-4 pixels
        ideal = undistort_pixels(ideal.reshape(-1, 2), K, lens).reshape(ideal.shape)
    fine = cv2.resize(ideal, None, fx=finer, fy=finer, interpolation=cv2.INTER_LINEAR)
    ideal = fine[finer:-finer, finer:-finer].reshape(-1, 2)
    plane = K @ np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]])
    on_paper = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(plane).T
    x, y = (on_paper[:, :2] / on_paper[:, 2:] * 1e3 * scale + 10 * scale - 0.5).T
    shape = (height * finer, width * finer)
    maps = [values.reshape(shape).astype(np.float32) for values in (x, y)]
    drawn = cv2.remap(paper, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    blocks = drawn.reshape(height, finer, width, finer).mean(axis=(1, 3))
    return np.clip(np.round(40.0 + 0.7 * blocks), 0, 255).astype(np.uint8)


def degrees(angle: float) -> float:
    return float(np.degrees(angle))


# Simulated rigs.


def wrong(pose: Pose, seed: int) -> Pose:
    """Return a pose that is 3 cm and 5 degrees away from another, in random directions."""
    twist = np.random.default_rng(seed).normal(size=6)
    twist[:3] *= 0.03 / np.linalg.norm(twist[:3])
    twist[3:] *= np.radians(5.0) / np.linalg.norm(twist[3:])
    return pose @ Pose.from_matrix(motion(twist))


class CalibrationBench:
    """An open rig, a collector without access to the camera's true pose, and that pose (``truth``)."""

    def __init__(self, rig: hal.Rig, name: str) -> None:
        config = load(name, sim=True)
        setup = find_setup(config, config.resolve())
        assert setup.known is not None
        self.rig, self.truth = rig, setup.known
        self.collector = Collector(rig, replace(setup, known=None), Detector(load_board()))
        camera = self.collector.camera
        read = camera.read

        def blind(*arguments: Any, **options: Any) -> hal.Frame:
            return replace(read(*arguments, **options), T_world_camera=None)

        camera.read = blind
        self.told: list[str] = []

    def drive(self, wanted: int, seed: int = 0, **options: Any) -> Calibration:
        """Take views, from an initial guess that is wrong, and solve."""
        collect_views(self.collector, wrong(self.truth, seed), wanted, self.told.append, **options)
        return solve(self.collector.views, self.collector.setup.eye)

    def off(self, found: Calibration) -> tuple[float, float]:
        """Return the error of a result, mm and degrees."""
        distance, angle = found.camera.distance(self.truth)
        return 1e3 * distance, degrees(angle)
