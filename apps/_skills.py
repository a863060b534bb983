"""What the programs of the skills share: how an object is found, the picture of the plan, progress and the result."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hal
from hal.apps._common import (
    add_deadman_options,
    add_rig_options,
    check_one_robot,
    check_report,
    check_speed,
    find_deadman,
    needs_deadman,
    resolve_plan,
    rig_options,
    select_robots,
)
from hal.apps._display import banner, list_links
from hal.errors import CommandError, ConnectionLost, MotionStopped, RobotFault

if TYPE_CHECKING:
    from hal.camera import Camera
    from hal.geometry import Pose
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.skills import LocatedObject, SkillProgress, SkillResult
    from hal.types import Frame

FAILED = 1
"""Exit status if the skill did not succeed."""


def add_skill_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options that all programs of skills have."""
    add_rig_options(parser)
    group = parser.add_argument_group("finding and moving")
    group.add_argument("--robot", metavar="NAME", help="arm (default: the first)")
    group.add_argument(
        "--object", metavar="NAME", help="object of the simulation, found by ground truth (default: found by depth)"
    )
    group.add_argument("--camera", metavar="NAME", help="camera (default: one on the hand, else the first with depth)")
    group.add_argument("--speed", type=float, metavar="SHARE", help="share of the joint speed limits (the rig's)")
    group.add_argument("--picture", metavar="FILE", help="save a picture of what was seen and planned")
    add_deadman_options(group)
    return group


def run_skill(args: argparse.Namespace, what: str, act: Callable[[SkillApp], SkillResult | None]) -> int:
    """Open the rig that the options name, run a skill on it, and print how it ended.

    ``act`` returns None if no object was found.

    Returns:
        The exit status.
    """
    check_speed(args)
    check_one_robot(args)
    check_report(args.picture)
    plan = resolve_plan(args, what, cameras=[args.camera] if args.camera else [])
    holds = needs_deadman(plan, args)
    with hal.open(**rig_options(args, pad=holds)) as rig:
        (robot,) = select_robots(rig, args)
        print(f"{banner(rig)}\n  {what}\n{list_links(rig)}", flush=True)
        app = SkillApp(rig, robot, args)
        if holds:
            app.motion["deadman"], _, button = find_deadman(rig)
            app.print(f"hold {button} until the arm is done")
        app.motion["unattended"] = args.unattended or not holds
        try:
            result = act(app)
        except (MotionStopped, RobotFault, ConnectionLost) as stop:
            app.print(f"STOPPED: {stop}")
            return FAILED
        if result is None:
            app.print("FAILED: no object was seen on the table")
            return FAILED
        how = "done" if result else f"FAILED in phase {result.phase} ({result.reason})"
        app.print(f"{how} after {result.duration:.1f} s: {result.message}")
        return 0 if result else FAILED


class SkillApp:
    """One run of a program on an open rig."""

    def __init__(self, rig: Rig, robot: Robot, args: argparse.Namespace) -> None:
        self.rig, self.robot, self.args = rig, robot, args
        self.motion: dict[str, Any] = {"speed": args.speed, "progress": self._show}
        """Arguments that all skills take."""
        self._frame: Frame | None = None

    def print(self, text: str) -> None:
        """Print a line, here and in the console."""
        print(f"  {text}", flush=True)
        self.rig.say(text)

    def _show(self, now: SkillProgress) -> None:
        self.print(f"{now.skill}: {now.phase} ({now.number} of {now.count})")

    def find(self) -> LocatedObject | None:
        """Find the object, by ground truth or by depth; None if it is not seen."""
        from hal.skills import find_by_depth, locate_by_truth

        camera = self._camera()
        if self.args.object:
            found: LocatedObject | None = locate_by_truth(self.rig, self.robot, self.args.object)
        else:
            found = find_by_depth(self.robot, camera, **self.motion) if camera else None
        if camera is not None and self.args.picture:
            self._frame = camera.read(after=self.rig.clock.now())
        if found is not None:
            x, y, _ = found.pose.position
            sides = " x ".join(f"{1e3 * side:.0f}" for side in found.size)
            self.print(f"found    {found.name or 'an object'} at x {x:.3f} y {y:.3f} m, {sides} mm")
        return found

    def _camera(self) -> Camera | None:
        """Return the camera to look with: the one of ``--camera``, or one on the hand, or any with depth.

        Raises:
            CommandError: No camera has depth, and none is named.
        """
        from hal.skills.depth import is_on_hand

        if self.args.camera:
            return self.rig.cameras[self.args.camera]
        able = [camera for camera in self.rig.cameras.values() if "depth" in camera.spec.streams]
        able.sort(key=lambda camera: not is_on_hand(self.robot, camera))
        if not able and not self.args.object:
            raise CommandError("no camera of this rig has depth; name an object of the simulation with --object")
        return able[0] if able else None

    def save_picture(self, found: LocatedObject, way: Sequence[Pose], opening: float) -> None:
        """Save the picture of the plan, if it is wanted and can be drawn."""
        from hal.skills.pictures import save_plan

        if self.args.picture and self._frame is not None:
            save_plan(self.args.picture, self.robot, self._frame, found, way, opening)
            self.print(f"picture  {Path(self.args.picture)}")
