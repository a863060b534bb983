"""A calibration in words and tables, for a terminal."""

from __future__ import annotations

import numpy as np

from ..geometry import Pose
from .solving import Calibration

__all__ = ["difference_lines", "report_lines"]


def report_lines(found: Calibration) -> list[str]:
    """Residuals of every view, their rms, and how certain the answer is."""
    lines = ["view            corners      board is off       without it, the answer moves"]
    for one in found.residuals:
        influence = ""
        if one.influence is not None:
            influence = f"{1e3 * one.influence[0]:6.2f} mm {np.degrees(one.influence[1]):6.3f} deg"
        off = f"{one.px:6.2f} px {1e3 * one.distance:7.2f} mm {np.degrees(one.angle):6.3f} deg"
        lines.append(f"{one.name:14s}{off}   {influence if one.used else 'left out'}")
    px, distance, angle = found.rms()
    lines.append(f"{'rms':14s}{px:6.2f} px {1e3 * distance:7.2f} mm {np.degrees(angle):6.3f} deg")
    doubt = found.doubt
    lines.append(
        f"the camera's pose is certain to {1e3 * doubt.position:.2f} mm and {np.degrees(doubt.rotation):.3f} degrees "
        f"(one standard deviation, {len(found.used)} views)"
    )
    return [*lines, *(f"WARNING: {text}" for text in found.warnings)]


def difference_lines(old: Pose | None, new: Pose, frame: str) -> list[str]:
    """The new pose beside the rig's."""
    lines = [f"{'now':8s}{_words(new)}   in {frame}"]
    if old is not None:
        distance, angle = old.distance(new)
        lines.insert(0, f"{'rig':8s}{_words(old)}")
        lines.append(f"{'differ':8s}by {1e3 * distance:.2f} mm and {np.degrees(angle):.3f} degrees")
    return lines


def _words(pose: Pose) -> str:
    position = " ".join(f"{1e3 * value:9.2f}" for value in pose.position)
    orientation = " ".join(f"{value:9.5f}" for value in pose.orientation)
    return f"{position} mm  {orientation}"
