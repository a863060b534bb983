"""Where a camera is that cannot know it itself: by the rig's file, and on an arm by that arm's state."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .camera import Place
from .errors import HalError
from .pose import Pose
from .specs import CameraSpec, ViewSpec

if TYPE_CHECKING:
    from collections.abc import Mapping

    from .robot import Robot

__all__ = ["Moving", "place_of"]


def place_of(spec: CameraSpec, robots: Mapping[str, Robot]) -> Place | None:
    """Pose in the world of the colour sensor's optical frame; None where the rig does not say where the camera is."""
    view = spec.view
    if view is None:
        return None
    here = Pose(view.position, view.orientation)
    if view.robot is None:
        return lambda t: here
    return Moving(robots[view.robot], view, here)


def handed_out(spec: CameraSpec) -> Pose:
    """Pose of the optical frame that the frames have, in that of the colour sensor, by the model's figures."""
    sensor = spec.sensors.get(spec.reference)
    return Pose(sensor.position, sensor.orientation) if sensor is not None else Pose()


class Moving:
    """A camera on an arm's link: by the arm's state at the time of the picture."""

    def __init__(self, robot: Robot, view: ViewSpec, pose: Pose) -> None:
        from .kinematics import Kinematics

        self._robot = robot
        self._link = str(view.link)
        self._pose = pose
        self._kinematics = Kinematics(robot.spec.kinematics)  # its own: one for each thread

    def __call__(self, t: float) -> Pose | None:
        try:
            q = self._robot.state_at(t).q
        except HalError:
            return None
        return self._robot.base @ self._kinematics.link_pose(self._link, q) @ self._pose
