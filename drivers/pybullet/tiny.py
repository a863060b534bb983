"""The renderer of last resort: PyBullet's own, in software, which is always there and several times slower."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose
from hal.specs import CameraSpec

from .rendering import BACKGROUND, Images, Renderer
from .scene import Scene
from .shaders import LUMINANCE

__all__ = ["TinyRenderer"]

_NEAR, _FAR = 0.05, 20.0
"""m. Its depth is stored as a share between the two, so they bound its resolution (3 um at 1 m)."""
_SAMPLE = (0.0, 1.0)
"""Where in a pixel it looks, from the upper left corner: not at the centre (measured against tilted planes)."""


class TinyRenderer(Renderer):
    """PyBullet's TinyRenderer, without shadows."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.description = "PyBullet's TinyRenderer, several times slower than OpenGL"

    def render(self, camera: CameraSpec, T_world_camera: Pose) -> Images:
        client = self._scene.client
        wanted = camera.streams
        flags = 0 if "segmentation" in wanted else client.ER_NO_SEGMENTATION_MASK
        _, _, rgba, depth, segmentation = client.getCameraImage(
            camera.width,
            camera.height,
            _column_major(np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(T_world_camera.matrix())),
            _column_major(_projection(camera)),
            shadow=0,
            flags=flags,
            renderer=client.ER_TINY_RENDERER,
        )
        shape = (camera.height, camera.width)
        share = np.asarray(depth, np.float32).reshape(shape)
        color = np.ascontiguousarray(np.asarray(rgba, np.uint8).reshape(*shape, 4)[..., :3])
        color[share == 1.0] = np.round(255 * np.array(BACKGROUND))
        return Images(
            color if "color" in wanted else None,
            _metres(share, camera.depth_min, camera.depth_max) if "depth" in wanted else None,
            np.round(color @ np.array(LUMINANCE)).astype(np.uint8) if "infrared" in wanted else None,
            self._indices(np.asarray(segmentation).reshape(shape)) if "segmentation" in wanted else None,
        )

    def _indices(self, numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        bodies = {body.id: body.index for body in self._scene.bodies.values()}
        table = np.full(max(bodies, default=0) + 2, -1, np.int32)
        table[list(bodies)] = list(bodies.values())
        return table[numbers]  # -1, for nothing, takes the last one, which is -1


def _metres(share: NDArray[np.float32], nearest: float, farthest: float) -> NDArray[np.float32]:
    """From OpenGL's share between near and far to depth along the axis; 0 outside the camera's range."""
    depth: NDArray[np.float32] = np.float32(_FAR * _NEAR) / (np.float32(_FAR) - np.float32(_FAR - _NEAR) * share)
    depth[(depth < nearest) | (depth > farthest) | (share == 1.0)] = 0
    return depth


def _projection(camera: CameraSpec) -> NDArray[np.float64]:
    """OpenGL's projection (4, 4) for any K; rows of the picture downwards, camera looking along -z."""
    K = np.array(camera.K)
    matrix = np.zeros((4, 4))
    matrix[0, :3] = K[0] * 2 / camera.width
    matrix[0, 2] += 2 * _SAMPLE[0] / camera.width - 1
    matrix[1, :3] = K[1] * 2 / camera.height
    matrix[1, 2] += 2 * _SAMPLE[1] / camera.height - 1
    matrix[1] *= -1
    matrix[2, 2:] = (_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)
    matrix[3, 2] = 1
    projection: NDArray[np.float64] = matrix @ np.diag([1.0, -1.0, -1.0, 1.0])
    return projection


def _column_major(matrix: NDArray[np.float64]) -> list[float]:
    values: list[float] = matrix.T.reshape(-1).tolist()
    return values
