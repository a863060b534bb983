"""A picture of what was seen and planned: the object, the box around it and the way of the tcp, over an image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError
from ..geometry import Pose
from .objects import LocatedObject

if TYPE_CHECKING:
    from ..robot import Robot
    from ..types import Frame

Array = NDArray[np.float64]

_POINT, _BOX, _WAY, _FINGERS = (255, 220, 60), (60, 220, 90), (250, 70, 60), (70, 140, 255)
"""Colours of the points of the object, its box, the way of the tcp, and the line between the fingers."""
_SMALLEST = 768
"""Least width of a picture, pixels."""


def draw_plan(
    arm: Robot, frame: Frame, found: LocatedObject, way: Sequence[Pose], opening: float = 0.0
) -> NDArray[np.uint8]:
    """Return a camera's image (h, w, 3) with what was seen and planned.

    Yellow are the points of the object, green is the upright box around it, red the way of the tcp, and blue, at each
    of its poses, the line between the fingers.

    Args:
        arm: The arm, in whose base frame the object and the way are.
        frame: The image, with colour and the camera's pose.
        found: The object.
        way: Poses of the tcp in the order in which they are visited.
        opening: Distance between the fingers, m.

    Raises:
        CommandError: The frame has no colour, or the camera's pose is unknown.
    """
    from PIL import Image, ImageDraw

    if frame.color is None or frame.T_world_camera is None:
        raise CommandError("a picture of the plan needs colour and the pose of the camera", code="no_picture")
    scale = max(1, -(-_SMALLEST // frame.color.shape[1]))
    image = Image.fromarray(frame.color)
    image = image.resize((scale * image.width, scale * image.height))
    draw = ImageDraw.Draw(image)
    from_base = (arm.base.inverse() @ frame.T_world_camera).inverse()

    def project(points: Array) -> list[tuple[float, float]]:
        """Return where points (k, 3) of the base frame are in the picture; those behind the camera are left out."""
        seen = from_base.transform(points)
        seen = seen[seen[:, 2] > 0.01] @ frame.K.T
        return [(scale * (u / z + 0.5), scale * (v / z + 0.5)) for u, v, z in seen.tolist()]

    for x, y in project(found.points[:: max(1, len(found.points) // 2000)]):
        draw.point([(x, y)], _POINT)
    length, width, height = found.size
    for z in (0.0, height):
        corners = [(a * length, b * width, z) for a, b in ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))]
        ring = project(found.pose.transform(corners))
        draw.line([*ring, *ring[:1]], _BOX, 2)
    draw.line(project(np.array([pose.position for pose in way])), _WAY, 3)
    for pose in way:
        draw.line(project(pose.transform([[0.0, -0.5 * opening, 0.0], [0.0, 0.5 * opening, 0.0]])), _FINGERS, 4)
        for x, y in project(pose.position[None]):
            draw.ellipse([x - 4, y - 4, x + 4, y + 4], _WAY)
    return np.asarray(image)


def save_plan(
    path: str | Path, arm: Robot, frame: Frame, found: LocatedObject, way: Sequence[Pose], opening: float = 0.0
) -> None:
    """Save the picture of :func:`draw_plan` to a file, such as ``plan.png``."""
    from PIL import Image

    Image.fromarray(draw_plan(arm, frame, found, way, opening)).save(path)
