"""What is to be found out on this rig: which camera, on or beside which arm, and what is known of it so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from yaml import YAMLError

from ..config.files import nearest, parse_yaml
from ..config.rigfile import RigFile
from ..config.schema import PoseConfig
from ..errors import CommandError
from ..geometry import Pose
from ..kinematics.urdf import read_urdf
from ..specs import Plan, RobotSpec
from .views import Eye

__all__ = ["Setting", "guess_of", "setting_of"]

Spec = TypeVar("Spec")


@dataclass(frozen=True)
class Setting:
    """One camera and one arm."""

    camera: str
    robot: str
    eye: Eye
    link: str
    """Of the URDF: what carries the camera (in-hand) or the board (to-hand)."""
    link_name: str
    """The same as the rig's file calls it."""
    known: Pose | None
    """Where the rig's file says that the camera is, in the frame that it is fixed in; None where it does not."""

    @property
    def frame(self) -> str:
        """The frame that the camera is fixed in, in words."""
        return f"the frame of {self.link_name}" if self.eye == "in-hand" else "the world"

    def entry(self, pose: Pose) -> tuple[str, str]:
        """What belongs into the rig's file: key and value."""
        numbers = [f"{value:.6f}" for value in pose.position] + [f"{value:.8f}" for value in pose.orientation]
        seven = f"[{', '.join(numbers)}]"
        if self.eye == "to-hand":
            return "pose", seven
        return "attached", f"{{robot: {self.robot}, link: {self.link_name}, pose: {seven}}}"


def setting_of(
    rig: RigFile,
    plan: Plan,
    camera: str | None = None,
    robot: str | None = None,
    eye: Eye | None = None,
    link: str | None = None,
) -> Setting:
    """From the rig, and what a person says on top of it. CommandError, with what there is, where that is not enough."""
    spec = _one("camera", camera, {camera.name: camera for camera in plan.cameras})
    attached = rig.cameras[spec.name].attached
    if robot is None and attached is not None:
        robot = attached.robot
    arm = _one("robot", robot, {robot.name: robot for robot in plan.robots})
    if eye is None:
        if spec.view is None:
            raise CommandError(
                f"the rig does not say where camera {spec.name} is: add --eye in-hand if it is on the arm, --eye "
                "to-hand if it stands still"
            )
        eye = "to-hand" if attached is None else "in-hand"
    known = spec.view
    ours = known is not None and (known.robot == arm.name if eye == "in-hand" else known.robot is None)
    if known is not None and ours and eye == "in-hand" and link in (None, known.link) and attached is not None:
        chosen, name = known.link or arm.kinematics.tcp_link, link or attached.link
    else:
        chosen = name = link or arm.kinematics.tcp_link
        ours = ours and eye == "to-hand"
    _check_link(arm, chosen)
    return Setting(
        spec.name, arm.name, eye, chosen, name, Pose(known.position, known.orientation) if known and ours else None
    )


def guess_of(setting: Setting, text: str | None) -> Pose:
    """Where the camera is, roughly: seven numbers as a person wrote them, or what the rig says. CommandError."""
    if text is not None:
        try:
            given = PoseConfig.model_validate(parse_yaml(text))
        except (ValueError, YAMLError) as error:
            raise CommandError(f"--guess must be [x, y, z, qx, qy, qz, qw], m and a unit quaternion: {error}") from None
        return Pose(given.position, given.orientation)
    if setting.known is None:
        raise CommandError(
            f"the rig does not say where camera {setting.camera} is in {setting.frame}: add --guess with its pose to "
            "some cm and degrees, or take the views by hand (--record)"
        )
    return setting.known


def _one(kind: str, name: str | None, specs: Mapping[str, Spec]) -> Spec:
    if name is None:
        if len(specs) == 1:
            return next(iter(specs.values()))
        raise CommandError(f"which {kind}? Add --{kind} and one of: {', '.join(specs) or 'this rig has none'}")
    if name not in specs:
        raise CommandError(f"this rig has no {kind} {name!r}{nearest(name, specs)}")
    return specs[name]


def _check_link(arm: RobotSpec, link: str) -> None:
    """It must be there, and move with the arm's joints alone."""
    urdf = read_urdf(Path(arm.urdf))
    if link not in urdf.links:
        raise CommandError(f"robot {arm.name!r} has no link {link!r}{nearest(link, urdf.links)}")
    others = [joint.name for joint in urdf.above(link) if joint.movable and joint.name not in arm.joints]
    if others:
        raise CommandError(f"link {link!r} moves with {', '.join(others)} as well; take one that only the arm moves")
