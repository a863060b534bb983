"""Skills: plain functions over Robot, Gripper and Camera that grasp and push, in simulation and on a real arm alike.

A skill returns a :class:`SkillResult`, which is false, with a named reason, for what may go wrong in the world. Stops,
faults and lost devices are the exceptions that they are everywhere else.
"""

from __future__ import annotations

from .depth import find_by_depth, locate_by_depth, look_at, read_frames
from .grasping import gentle_grasp, grasp
from .objects import LocatedObject, grasp_pose, locate_by_truth, object_from_points
from .pictures import draw_plan, save_plan
from .pushing import push, push_path, push_to
from .running import Reason, SkillOptions, SkillPhase, SkillProgress, SkillResult

__all__ = [
    "LocatedObject",
    "Reason",
    "SkillOptions",
    "SkillPhase",
    "SkillProgress",
    "SkillResult",
    "draw_plan",
    "find_by_depth",
    "gentle_grasp",
    "grasp",
    "grasp_pose",
    "locate_by_depth",
    "locate_by_truth",
    "look_at",
    "object_from_points",
    "push",
    "push_path",
    "push_to",
    "read_frames",
    "save_plan",
]
