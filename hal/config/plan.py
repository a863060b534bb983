"""What a rig's configuration comes to: every device with its driver, checked, nothing opened."""

from __future__ import annotations

from dataclasses import dataclass

from ..specs import CameraSpec, PadSpec, RobotSpec, WorldSpec

__all__ = ["Plan"]


@dataclass(frozen=True)
class Plan:
    """What ``hal.open`` opens."""

    sim: bool
    """The rig's flag."""
    clock: str
    """``real_time`` or ``lock_step``."""
    world: WorldSpec | None
    """The simulated world, where a device stands in one."""
    robots: tuple[RobotSpec, ...]
    cameras: tuple[CameraSpec, ...]
    pads: tuple[PadSpec, ...]
    renderer: str
    """What draws simulated pictures: ``auto``, ``gl`` or ``tiny``."""
    warnings: tuple[str, ...]
    """What a person should know, though it is not wrong."""
    source: str
    """The rig's file, or ``<dict>``."""

    @property
    def attended(self) -> bool:
        """Whether something real moves, so that a person must be there."""
        return any(robot.attended for robot in self.robots)

    @property
    def emulated(self) -> bool:
        """Whether a program stands in for everything that counts as real, so that nothing can be hurt."""
        return self.attended and all(robot.emulated for robot in self.robots if robot.attended)
