"""The stand-ins of real arms in a simulated world, so that simulated cameras see them and objects feel them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ..specs import GroupSpec, RobotSpec
from .gripper_mail import GripperMail
from .records import GroupMemory, RobotMail

__all__ = ["Copy", "copies_of"]


class Copy:
    """One arm that another group moves, followed by the newest state that it published."""

    def __init__(self, name: str, mail: RobotMail, hand: GripperMail | None) -> None:
        self.name = name
        self._mail = mail
        self._hand = hand

    def follow(self, world: Any) -> None:
        """Put the copy where the arm is. One that has not said anything yet stays where the rig's file puts it."""
        state = self._mail.get_state()
        if state is None:
            return
        hand = self._hand.get() if self._hand is not None else None
        world.follow(self.name, state.q, state.dq, hand.state.width if hand is not None else None)


def copies_of(group: GroupSpec, memories: Iterable[GroupMemory]) -> tuple[Copy, ...]:
    """Copies of the arms that stand in this group's world and are moved by others, found in the others' memories."""
    if group.world is None:
        return ()
    robots: dict[str, RobotMail] = {}
    hands: dict[str, GripperMail] = {}
    for memory in memories:
        robots |= memory.robots
        hands |= memory.grippers
    own = {robot.name for robot in group.robots}
    others = [robot for robot in group.world.robots if robot.name not in own and robot.name in robots]
    return tuple(Copy(robot.name, robots[robot.name], _hand_of(robot, hands)) for robot in others)


def _hand_of(robot: RobotSpec, hands: dict[str, GripperMail]) -> GripperMail | None:
    return hands.get(robot.gripper.name) if robot.gripper is not None else None
