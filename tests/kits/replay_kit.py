"""Episodes in memory, and rigs that replay them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import hal
from hal.learning.replay import RecordedTrajectory

__all__ = ["BARE", "FPS", "Recorded", "course_of", "opened"]

FPS = 30
BARE = ["cameras={}"]


@dataclass
class Recorded:
    """An episode in memory, in the place of one on disk."""

    columns: dict[str, Any] = field(default_factory=dict)
    stamps: dict[str, Any] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    joints: tuple[str, ...] = ()

    def names(self, key: str) -> list[str]:
        return ["x", "y", "z", "qx", "qy", "qz", "qw"] if key == "observation.tcp" else [*self.joints, "gripper"]


def opened(driver: str, **options: Any) -> hal.Rig:
    kind: dict[str, Any] = {"driver": "mock"} if driver == "mock" else {"sim": True, "clock": "lock_step"}
    return hal.open("panda_table", **{"overrides": BARE, "pad": "none", **kind, **options})


def course_of(episode: Recorded, robot: hal.Robot) -> RecordedTrajectory:
    return RecordedTrajectory.of(episode, robot)  # type: ignore[arg-type]
