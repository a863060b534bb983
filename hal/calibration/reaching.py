"""How does the arm bring the board in front of the camera, or the camera in front of the board?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, Unreachable
from ..geometry import Pose
from .views import Eye

if TYPE_CHECKING:
    from ..robot import Robot

__all__ = ["Reach"]

Array = NDArray[np.float64]

FARTHEST = 1.6
"""rad: no joint goes farther from where the arm was in the first view, so that its posture stays the one that a person
chose and saw."""
NEAREST = 0.6
"""The camera and the board's middle come no nearer to each other on the way than this share of the nearest view."""
_ON_THE_WAY = 12
_STARTS = 3


class Reach:
    """One arm whose ``link`` carries the camera or the board."""

    def __init__(self, robot: Robot, link: str, eye: Eye, q: Array) -> None:
        """``q`` (n,) is where the arm is in the first view, rad."""
        self.robot, self.link, self.eye, self.first = robot, link, eye, np.asarray(q, float)
        self._tool = self._from_link(self.first)
        distance, angle = self._tool.distance(self._from_link(self.first + 0.3))
        if distance > 1e-6 or angle > 1e-6:
            raise CommandError(
                f"link {link!r} does not move with the tcp, so the arm cannot bring it anywhere by itself: take the "
                "views by hand (--record)"
            )

    def _from_link(self, q: Array) -> Pose:
        kinematics = self.robot.kinematics
        return kinematics.link_pose(self.link, q).inverse() @ kinematics.pose(q)

    def link_pose(self, q: Array) -> Pose:
        """Of the link in the world."""
        return self.robot.base @ self.robot.kinematics.link_pose(self.link, q)

    def seen_from(self, q: Array, camera: Pose, board: Pose) -> Pose:
        """The board in the camera's frame with the arm at ``q``, where both are where they are believed to be."""
        link = self.link_pose(q)
        if self.eye == "in-hand":
            return (link @ camera).inverse() @ board
        return camera.inverse() @ link @ board

    def joints(self, seen: Pose, camera: Pose, board: Pose, q_seed: Array) -> Array:
        """(n,) rad, from which the board is seen so. Raises Unreachable or CommandError where there are none."""
        if self.eye == "in-hand":
            link = board @ seen.inverse() @ camera.inverse()
        else:
            link = camera @ seen @ board.inverse()
        tcp = self.robot.base.inverse() @ link @ self._tool
        self._check_workspace(tcp)
        kinematics = self.robot.kinematics
        q = kinematics.solve(tcp, q_seed, position_tolerance=1e-3, rotation_tolerance=1e-2, starts=_STARTS)
        if np.abs(q - self.first).max() > FARTHEST:
            raise Unreachable("the arm would have to turn over", position_error=0.0, rotation_error=0.0)
        return q

    def _check_workspace(self, tcp: Pose) -> None:
        box = self.robot.spec.workspace
        if box is not None and ((tcp.position < box.lower) | (tcp.position > box.upper)).any():
            raise CommandError("the tcp would leave the workspace")

    def is_clear(self, start: Array, end: Array, camera: Pose, board: Pose, middle: Array, nearest: float) -> bool:
        """Do camera and board keep their distance on the straight way in joint space? ``middle`` is the board's."""
        for share in np.linspace(0.0, 1.0, _ON_THE_WAY)[1:]:
            seen = self.seen_from(start + share * (end - start), camera, board).transform(middle)
            if np.linalg.norm(seen) < NEAREST * nearest:
                return False
        return True
