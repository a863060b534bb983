"""PyBullet's own renderer: needs no OpenGL, and is several times slower."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.lighting import BACKGROUND
from hal.drivers.scene.renderer import LUMINANCE, RenderedImages, Renderer
from hal.drivers.scene.shapes import Visual
from hal.geometry import Pose, matrix_to_quaternion
from hal.specs import CameraSpec

from .engine import PyBulletClient, silence_output

_NEAR, _FAR = 0.05, 20.0
"""Range of its depth, m; depth is stored as a share between the two, so they set its resolution (3 um at 1 m)."""
_SAMPLE = (0.0, 1.0)
"""Place in a pixel at which it samples, from the upper left corner; measured against tilted planes."""


class TinyRenderer(Renderer):
    """Draws in software and without shadows: available wherever PyBullet is, several times slower than OpenGL.

    It has a PyBullet client of its own, in which each visual shape is a body that nothing touches. Raises
    DriverMissing.
    """

    def __init__(self, scene: DrawnWorld) -> None:
        self._scene = scene
        self._client = PyBulletClient()
        self._revision: int | None = None
        self._shapes: dict[int, tuple[tuple[Visual, ...], list[int]]] = {}
        """The visual shapes of each body, and PyBullet's number of each."""
        self.description = "PyBullet's TinyRenderer, several times slower than OpenGL"

    def close(self) -> None:
        self._client.close()

    def render(self, camera: CameraSpec, T_world_camera: Pose) -> RenderedImages:
        client = self._client
        if self._revision != self._scene.revision:
            self._build()
        self._pose()
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
        return RenderedImages(
            color if "color" in wanted else None,
            _metres(share, camera.depth_min, camera.depth_max) if "depth" in wanted else None,
            np.round(color @ np.array(LUMINANCE)).astype(np.uint8) if "infrared" in wanted else None,
            self._indices(np.asarray(segmentation).reshape(shape)) if "segmentation" in wanted else None,
        )

    def _build(self) -> None:
        """Bring the shapes up to date with the scene's bodies."""
        before, self._shapes = self._shapes, {}
        for body in self._scene.bodies.values():
            visuals = self._scene.visuals(body.id)
            known = before.pop(body.id, None)
            if known is not None and known[0] != visuals:
                self._remove(known[1])
                known = None
            self._shapes[body.id] = known or (visuals, [self._add(visual) for visual in visuals])
        for _, numbers in before.values():
            self._remove(numbers)
        self._revision = self._scene.revision

    def _add(self, visual: Visual) -> int:
        client, size = self._client, visual.size
        kinds = {
            "mesh": lambda: {"shapeType": client.GEOM_MESH, "fileName": visual.file, "meshScale": size},
            "box": lambda: {"shapeType": client.GEOM_BOX, "halfExtents": [side / 2 for side in size]},
            "sphere": lambda: {"shapeType": client.GEOM_SPHERE, "radius": size[0]},
            "cylinder": lambda: {"shapeType": client.GEOM_CYLINDER, "radius": size[0], "length": size[1]},
            "capsule": lambda: {"shapeType": client.GEOM_CAPSULE, "radius": size[0], "length": size[1]},
        }
        with silence_output():
            shape = client.createVisualShape(
                **kinds[visual.kind](),
                rgbaColor=visual.rgba,
                visualFramePosition=visual.position,
                visualFrameOrientation=visual.orientation,
            )
            number: int = client.createMultiBody(baseVisualShapeIndex=shape)
        return number

    def _remove(self, numbers: list[int]) -> None:
        for number in numbers:
            self._client.removeBody(number)

    def _pose(self) -> None:
        places = [(body, visual.link) for body, (visuals, _) in self._shapes.items() for visual in visuals]
        numbers = [number for _, own in self._shapes.values() for number in own]
        for number, frame in zip(numbers, self._scene.link_frames(places), strict=True):
            position, orientation = frame[:3, 3], matrix_to_quaternion(frame[:3, :3])
            self._client.resetBasePositionAndOrientation(number, position, orientation)

    def _indices(self, numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        indices = {body.id: body.index for body in self._scene.bodies.values()}
        shapes = {number: indices[body] for body, (_, own) in self._shapes.items() for number in own}
        table = np.full(max(shapes, default=0) + 2, -1, np.int32)
        table[list(shapes)] = list(shapes.values())
        return table[numbers]  # -1, the background, takes the last one, which is -1


def _metres(share: NDArray[np.float32], nearest: float, farthest: float) -> NDArray[np.float32]:
    """Return depth along the axis, m, 0 outside the camera's range, of OpenGL's share between near and far."""
    depth: NDArray[np.float32] = np.float32(_FAR * _NEAR) / (np.float32(_FAR) - np.float32(_FAR - _NEAR) * share)
    depth[(depth < nearest) | (depth > farthest) | (share == 1.0)] = 0
    return depth


def _projection(camera: CameraSpec) -> NDArray[np.float64]:
    """Return OpenGL's projection (4, 4) for any K; rows of the picture downwards, camera looking along -z."""
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
