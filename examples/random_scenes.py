"""Draw pictures of random scenes, with the true pose of every thing beside each of them.

python examples/random_scenes.py [scenes]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import hal

SCENES = 5
BLOCKS = 6


def random_block(name: str, random: np.random.Generator) -> hal.BodySpec:
    """Return a block of random size, colour and pose over the table."""
    position = random.uniform([-0.2, -0.3, 0.7], [0.2, 0.3, 1.0])
    turned = hal.Pose.from_rpy(position, random.uniform(-np.pi, np.pi, 3).tolist())
    return hal.BodySpec(
        name,
        tuple(turned.position),
        tuple(turned.orientation),
        "box",
        half_extents=tuple(random.uniform(0.015, 0.04, 3)),
        mass=0.2,
        rgba=(*random.uniform(0.1, 1.0, 3), 1.0),
    )


def main(folder: str = "scenes") -> None:
    """Write ``scene_0.png`` and ``scene_0.json``, and so on."""
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    names = [f"block_{k}" for k in range(BLOCKS)]
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        for scene in range(SCENES):
            for name in names:
                rig.world.add(random_block(name, random))
            rig.clock.sleep(2.0)  # they fall, and come to rest
            frame = rig.cameras["scene"].read()
            Image.fromarray(frame.color).save(out / f"scene_{scene}.png")
            _, poses = rig.world.poses(names)
            truth = {name: [*pose.position, *pose.orientation] for name, pose in poses.items()}
            (out / f"scene_{scene}.json").write_text(json.dumps(truth, indent=2))
            for name in names:
                rig.world.remove(name)
    print(f"{SCENES} scenes of {BLOCKS} blocks are in {out}")


if __name__ == "__main__":
    main(*sys.argv[1:])
