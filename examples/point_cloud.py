"""Drive the camera on the hand to five poses, and save what it saw as one coloured point cloud.

python examples/point_cloud.py [cloud.ply]
"""

from __future__ import annotations

import sys

import numpy as np
import trimesh

import hal

OFFSETS = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-0.1, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, -0.15, 0.0)]
"""Of the tcp from where it is at home, m."""


def main(file: str = "cloud.ply") -> None:
    """Drive, look, and write the file."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        arm, camera = rig.robots["panda"], rig.cameras["wrist"]
        home = arm.fk(arm.home)
        seen = []
        for offset in OFFSETS:
            arm.move_to(hal.Pose(home.position + offset, home.orientation), speed=0.5)
            frame = camera.read()
            seen.append((frame.points(frame="world"), frame.color[frame.depth > 0]))
    points, colors = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    trimesh.PointCloud(points, colors).export(file)
    print(f"{len(points)} points from {len(seen)} poses are in {file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
