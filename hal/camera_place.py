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

LONGEST = 0.2
"""s between a picture and the state that its pose is worked out from; beyond that nobody knows where it was."""


def place_of(spec: CameraSpec, robots: Mapping[str, Robot]) -> Place | None:
    """Pose in the world of the optical frame that colour and depth are handed out in; None where the rig does not
    say where the camera is."""
    view = spec.view
    if view is None:
        return None
    here = Pose(view.position, view.orientation) @ handed_out(spec)
    if view.robot is None:
        return lambda t: here
    return Moving(robots[view.robot], view, here)


def handed_out(spec: CameraSpec) -> Pose:
    """Pose of the optical frame of colour and depth, as they are handed out, in that of the colour sensor."""
    depth = spec.sensors.get("depth") if spec.align == "depth" else None
    return Pose(depth.position, depth.orientation) if depth is not None else Pose()


class Moving:
    """A camera on an arm's link: by the arm's newest state, carried back to the time of the picture.

    Within :data:`LONGEST` the joints are taken to turn at a constant speed; at 0.03 s and an acceleration of 10 rad/s2
    that is wrong by 4.5 mrad (a t^2 / 2).
    """

    def __init__(self, robot: Robot, view: ViewSpec, pose: Pose) -> None:
        from .kinematics import Kinematics

        self._robot = robot
        self._link = str(view.link)
        self._pose = pose
        self._kinematics = Kinematics(robot.spec.kinematics)  # its own: one for each thread
        self._base = Pose(robot.spec.base_position, robot.spec.base_orientation)

    def __call__(self, t: float) -> Pose | None:
        try:
            state = self._robot.state(max_age=LONGEST)
        except HalError:
            return None
        if abs(state.stamp.t - t) > LONGEST:
            return None
        q = state.q - state.dq * (state.stamp.t - t)
        return self._base @ self._kinematics.link_pose(self._link, q) @ self._pose
