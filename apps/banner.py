"""What drives what: printed before anything moves."""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from hal.rig import Rig
    from hal.specs import CameraSpec, GripperSpec, Plan, RobotSpec

__all__ = ["banner", "invitation", "listing"]


def listing(plan: Plan) -> list[str]:
    """The devices of a rig that is not open, one a line."""
    lines = []
    for robot in plan.robots:
        simulated = not robot.attended or (plan.world is not None and robot.driver == plan.world.driver)
        where = f"simulated ({robot.driver})" if simulated else _real(robot, robot)
        gripper = robot.gripper
        hand = f", gripper 0..{gripper.width_max:g} m" if gripper else ""
        if gripper and robot.attended and simulated:
            hand += f", {_real(robot, gripper)}"
        lines.append(f"robot    {robot.name:10s} {robot.model}, {where}, {robot.rate_hz:g} Hz{hand}")
        if robot.attended:
            lines.append(f"limits   {robot.name:10s} {_limits(robot)}")
    for camera in plan.cameras:
        streams = "+".join(camera.streams)
        lines.append(
            f"camera   {camera.name:10s} {camera.model} ({camera.driver}{_stands_in(camera)}), "
            f"{camera.width}x{camera.height} {streams} at {camera.rate_hz:g} Hz"
        )
    lines.extend(f"gamepad  {pad.name:10s} {pad.driver}" for pad in plan.pads)
    if plan.world is not None:
        things = ", ".join(body.name for body in plan.world.bodies) or "nothing else"
        lines.append(f"world    {plan.world.driver}, {plan.world.physics_hz:g} Hz: {things}")
    lines.append(f"clock    {plan.clock.replace('_', ' ')}")
    return lines


def _stands_in(camera: CameraSpec) -> str:
    """What a real camera's pictures come from where that is no camera."""
    if camera.options.get("emulated"):
        return ", EMULATED"
    played = camera.options.get("play")
    return f", playing {played}" if played else ""


def _real(robot: RobotSpec, device: RobotSpec | GripperSpec) -> str:
    """What drives a device that counts as real, and where: nobody may take a robot for its stand-in."""
    host = f" at {device.options['host']}" if "host" in device.options else ""
    return f"{'EMULATED' if robot.emulated else 'REAL'} ({device.driver}{host})"


def _limits(robot: RobotSpec) -> str:
    """What holds an arm back that really moves."""
    box = robot.workspace
    where = "no workspace" if box is None else f"workspace {_triple(box.lower)} to {_triple(box.upper)} m"
    most = f"at most {max(robot.limits.acceleration):g} rad/s2, {max(robot.limits.jerk):g} rad/s3"
    return f"{robot.speed:g} of the joint speeds, tcp {robot.tcp_speed:g} m/s, {most}; {where}"


def _triple(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def banner(rig: Rig) -> str:
    """The same for an open rig, with what was found."""
    plan = rig.plan
    lines = [f"rig      {plan.source}"]
    for line in listing(plan):
        if line.startswith("gamepad"):
            continue
        lines.append(line)
        if line.startswith("world") and rig.renderer:
            lines.append(f"renderer {rig.renderer}")
    lines.extend(f"gamepad  {pad.name:10s} {pad.describe()}" for pad in rig.gamepads.values())
    lines.extend(f"note     {note}" for note in rig.notes)
    return "\n".join(f"  {line}" for line in lines)


def invitation(rig: Rig) -> str:
    """What a person should open in a browser; nothing where there is nothing to open."""
    lines = []
    if rig.console is not None:
        does = "drive, watch and stop" if rig.console.driven_by is None else "watch and stop"
        lines += [
            "",
            f"  Open this in a browser to {does}:",
            "",
            f"      {rig.console.link}",
            "",
        ]
        if rig.console.tunnel:
            lines += ["  From another computer, type this there first:", "", f"      {rig.console.tunnel}", ""]
    if rig.viewer3d is not None:
        if not lines:
            lines.append("")
        lines += ["  The arms in three dimensions, on this machine:", "", f"      {rig.viewer3d.link}", ""]
        if rig.console is not None and rig.console.tunnel:
            port = urlsplit(rig.viewer3d.link).port
            lines += [f"  (from another computer, add to the ssh line: -L {port}:127.0.0.1:{port})", ""]
    return "\n".join(lines)
