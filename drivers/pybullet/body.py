"""One thing that stands in the world: its PyBullet number, its names, and the frame that its pose is given in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hal.specs import BodySpec, RobotSpec

from .library import Client
from .transforms import Transform, compose, inverse

if TYPE_CHECKING:
    from .motors import Gear

__all__ = ["Body"]


@dataclass
class Body:
    """A robot or an object.

    PyBullet keeps a body's pose in the frame of its base link's *centre of mass* (its "inertial frame"); everybody
    else means the base link's own frame. ``inertial`` is the constant transform between the two.
    """

    name: str
    id: int
    """PyBullet's number."""
    spec: BodySpec | RobotSpec
    links: dict[str, int]
    """Link indices by name; the base link is -1."""
    joints: dict[str, int]
    """Indices of all joints by name, the fixed ones too."""
    movable: tuple[int, ...]
    """Indices of the joints that move."""
    floating: bool
    """Can physics move its base?"""
    inertial: Transform
    """The centre of mass's frame in the frame of the base link."""
    index: int = -1
    """Its place among the world's bodies: what segmentation images show."""
    home: dict[int, float] = field(default_factory=dict)
    """Where each movable joint starts: rad, or m."""
    efforts: dict[int, float] = field(default_factory=dict)
    """Greatest torque or force of each driven joint: Nm, or N."""
    speeds: dict[int, float] = field(default_factory=dict)
    """Greatest speed of each driven joint: rad/s, or m/s."""
    base: Transform = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    """Where the base link starts, in the world."""
    damping: tuple[float, float] = (0.04, 0.04)
    """Linear and angular damping. PyBullet does not give them back; 0.04 is what it starts with."""
    gears: list[Gear] = field(default_factory=list)
    """Between joints that move together (fingers)."""
    hardened: set[int] = field(default_factory=set)
    """Links whose contacts were made soft and then hard again (see :mod:`.dynamics`)."""

    def __post_init__(self) -> None:
        self.link_names = {index: name for name, index in self.links.items()}

    @property
    def is_robot(self) -> bool:
        return isinstance(self.spec, RobotSpec)

    @property
    def carried(self) -> bool:
        """Does it go where a link of an arm goes?"""
        return isinstance(self.spec, BodySpec) and self.spec.robot is not None

    @property
    def roams(self) -> bool:
        """May its base be elsewhere in the next step?"""
        return self.floating or self.carried

    @property
    def moves(self) -> bool:
        """May any of it?"""
        return self.roams or bool(self.movable)

    def base_pose(self, client: Client) -> Transform:
        """The pose of the base link in the world."""
        return compose(client.getBasePositionAndOrientation(self.id), inverse(self.inertial))

    def set_base_pose(self, client: Client, pose: Transform) -> None:
        """Put the base link there. Velocities stay."""
        client.resetBasePositionAndOrientation(self.id, *compose(pose, self.inertial))
