"""What is known of arms that the hal has a model of, and of what Ark makes of them."""

from __future__ import annotations

from pathlib import Path

from ..config import load
from ..geometry import Pose
from ..kinematics.urdf import read_urdf
from ..specs import RobotSpec

__all__ = ["FIXED_LINKS", "FRANKAS", "JOINT_COUNTS", "LINKS", "TCP_LINK", "KnownArm", "franka_with"]

FRANKAS = {"panda": "panda_", "fr3": "fr3_"}
"""Models of Franka's arms, and what the names of their joints and links begin with."""
JOINT_COUNTS = (7, 9, 10, 12)
"""How many joints Ark's Panda can have: the arm's alone; with the fingers' (fixed ones merged); with the hand's fixed
one, too; with those of its camera and its tcp."""
LINKS = {
    "camera_link": ("panda_hand", Pose.from_rpy([-0.05, 0.0, 0.0], [1.3, 0.0, -1.57])),
    "tcp_link": ("panda_hand", Pose.from_rpy([0.0, 0.0, 0.1], [0.0, 0.0, 3.14])),
}
"""Links that ark_franka's URDF had besides Franka's own while the tutorial was written (July 2025): on which link, and
where. All its links have their centres of mass at their origins."""
FIXED_LINKS = ("panda_hand", *LINKS)
"""Links there that PyBullet can merge with others."""
TCP_LINK = 11
"""The number of ``tcp_link`` there."""


class KnownArm:
    """A model that comes with the hal."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.spec: RobotSpec = load({"robots": {"arm": {"model": name}}}, driver="mock").resolve().robots[0]
        self.links = tuple(read_urdf(Path(self.spec.urdf)).links)

    @property
    def base_link(self) -> str:
        """The frame of its base."""
        return self.spec.kinematics.base_link or self.links[0]

    @property
    def is_franka(self) -> bool:
        """A Panda or an FR3?"""
        return self.name in FRANKAS

    def place(self, link: str) -> tuple[str, Pose] | None:
        """One of Ark's Panda's links, as a link of this arm and a pose in its frame; None where it has no such link."""
        own, pose = LINKS.get(link, (link, Pose()))
        if self.is_franka:
            own = FRANKAS[self.name] + own.removeprefix("panda_")
        return (own, pose) if own in self.links else None


def franka_with(joints: set[str]) -> str | None:
    """Which of Franka's arms has these joints among its own; None where neither has."""
    for model, prefix in FRANKAS.items():
        if joints.issuperset(f"{prefix}joint{k}" for k in range(1, 8)):
            return model
    return None
