"""Copies, in a simulated world, of arms that other groups move."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ..specs import GroupSpec
from .records import GripperMail, GroupMemory, RobotMail


class RobotMirror:
    """Kinematic copy, in a simulated world, of an arm that another group moves."""

    def __init__(self, name: str, mail: RobotMail, gripper: GripperMail | None) -> None:
        self.name = name
        self._mail = mail
        self._gripper = gripper

    def follow(self, world: Any) -> None:
        """Move the copy to the arm's newest state. Before the first state it stays where the rig's file puts it."""
        state = self._mail.get_state()
        if state is None:
            return
        gripper = self._gripper.get() if self._gripper is not None else None
        world.follow(self.name, state.q, state.dq, gripper.state.width if gripper is not None else None)


def make_mirrors(group: GroupSpec, memories: Iterable[GroupMemory]) -> tuple[RobotMirror, ...]:
    """Return the mirrors of the arms that stand in this group's world and belong to the groups behind ``memories``."""
    if group.world is None:
        return ()
    robots: dict[str, RobotMail] = {}
    grippers: dict[str, GripperMail] = {}
    for memory in memories:
        robots |= memory.robots
        grippers |= memory.grippers
    own = {robot.name for robot in group.robots}
    others = [robot for robot in group.world.robots if robot.name not in own and robot.name in robots]
    return tuple(
        RobotMirror(robot.name, robots[robot.name], grippers.get(robot.gripper.name) if robot.gripper else None)
        for robot in others
    )
