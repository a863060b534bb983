"""What a page is told about a rig, once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hal.specs import CameraSpec, RobotSpec

if TYPE_CHECKING:
    from hal.rig import Rig

__all__ = ["about_rig", "shown_stream"]

_STREAMS = ("color", "infrared", "depth")
"""What is shown of a camera: the first of these that it has."""


def shown_stream(camera: CameraSpec) -> str | None:
    """The stream of this camera that pages show; None where there is none that a person could read."""
    return next((stream for stream in _STREAMS if stream in camera.streams), None)


def about_rig(rig: Rig, cameras: Sequence[CameraSpec], driven_by: str | None) -> dict[str, Any]:
    """Everything that does not change while the rig is open, as JSON."""
    return {
        "source": rig.plan.source,
        "sim": rig.plan.sim,
        "attended": rig.attended,
        "emulated": rig.emulated,
        "drivable": driven_by is None,
        "driven_by": driven_by,
        "demo": driven_by is None and (rig.emulated or not rig.attended),
        "pad_may_hold": not rig.attended or _accepts_silent_pads(rig),
        "robots": [_about_robot(robot) for robot in rig.plan.robots],
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "rate_hz": camera.rate_hz,
                "driver": camera.driver,
                "shows": camera.streams[0],
            }
            for camera in cameras
        ],
    }


def _about_robot(robot: RobotSpec) -> dict[str, Any]:
    return {
        "name": robot.name,
        "model": robot.model,
        "real": robot.attended,
        "driver": robot.driver,
        "rate_hz": robot.rate_hz,
        "joints": list(robot.joints),
        "lower": list(robot.limits.lower),
        "upper": list(robot.limits.upper),
        "velocity": list(robot.limits.velocity),
        "width_max": robot.gripper.width_max if robot.gripper is not None else None,
    }


def _accepts_silent_pads(rig: Rig) -> bool:
    ours = [pad for pad in rig.plan.pads if pad.driver in ("auto", "web")]
    return any(pad.options.get("accept_silent_pad") is True for pad in ours)
