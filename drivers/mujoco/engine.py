"""MuJoCo, imported when it is first used, and the bodies of a world that it steps."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any

from hal.drivers.scene.engine import SimulatedBody
from hal.errors import DriverMissing
from hal.geometry import Transform
from hal.kinematics.urdf import UrdfMimic


def load_mujoco() -> Any:
    """Import and return the ``mujoco`` module. Raises DriverMissing."""
    if "mujoco" in sys.modules:
        return sys.modules["mujoco"]
    try:
        import mujoco
    except ImportError as error:
        raise DriverMissing(
            f"the simulation needs MuJoCo ({error}); install it with: pip install 'robot-hal[mujoco]'"
        ) from error
    mujoco.set_mju_user_warning(_ignore)  # it writes a file into the working directory; unstable steps are checked for
    return mujoco


def _ignore(message: str) -> None:
    """Take a warning of MuJoCo."""


@dataclass
class LinkContact:
    """Properties of the contacts of one link, which MuJoCo keeps in its shapes."""

    lateral_friction: float = 0.5
    rolling_friction: float = 0.0
    spinning_friction: float = 0.0
    restitution: float = 0.0
    contact_stiffness: float | None = None
    """N/m; None where contacts are as hard as the step allows."""
    contact_damping: float | None = None
    """Ns/m"""
    pad: bool = False
    """Whether it is a gripper's: what it holds must not sink in, for that would be an error of the width."""


@dataclass(kw_only=True)
class Body(SimulatedBody):
    """A robot or an object. Links are numbered from the base outwards, joints in the order of the URDF."""

    efforts: dict[int, float] = field(default_factory=dict)
    """Greatest torque or force of each driven joint: Nm, or N."""
    speeds: dict[int, float] = field(default_factory=dict)
    """Greatest speed of each driven joint: rad/s, or m/s."""
    damping: dict[int, float] = field(default_factory=dict)
    """Damping of the joints that have any, Nm s/rad."""
    contacts: list[LinkContact] = field(default_factory=list)
    """By link."""
    solids: list[int] = field(default_factory=list)
    """Number of collision shapes of each link."""
    place: Transform = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    """Present pose of a base that physics does not move."""
    ids: list[int] = field(default_factory=list)
    """MuJoCo's number of each link."""
    shapes: list[list[int]] = field(default_factory=list)
    """MuJoCo's numbers of the collision shapes of each link."""
    free: tuple[int, int] | None = None
    """Where a free base begins in MuJoCo's ``qpos`` and ``qvel``."""
    qpos: dict[int, int] = field(default_factory=dict)
    """Place of each movable joint in MuJoCo's ``qpos``."""
    qvel: dict[int, int] = field(default_factory=dict)
    """The same in ``qvel`` and all that is sorted like it."""
    followers: tuple[UrdfMimic, ...] = ()
    """Joints without a motor that follow the driven fingers of a gripper."""
    couplings: list[tuple[frozenset[int], int]] = field(default_factory=list)
    """Joints that move together, with MuJoCo's number of the constraint."""

    def link_path(self, link: int) -> str:
        """Return the name in MuJoCo of the link of this number."""
        return self.mujoco_name(self.link_name(link))

    def mujoco_name(self, part: str = "") -> str:
        """Return the name in MuJoCo of a link or joint of this body."""
        return f"{self.name}/{part}"


def wxyz(orientation: Any) -> list[float]:
    x, y, z, w = orientation
    return [w, x, y, z]
