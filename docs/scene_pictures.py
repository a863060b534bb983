"""Draw 24 variations of the rig panda_table_randomized into docs/images/randomized.jpg: the seeds 0 to 23.

python docs/scene_pictures.py [--into FILE] [--engine ENGINE]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import hal
from hal.learning.episode import reset_scene

FILE = Path(__file__).resolve().parent / "images" / "randomized.jpg"
ROWS, COLUMNS, SIDE = 4, 6, 200
"""Pictures below and beside each other, and the side of one, pixels."""
OVERRIDES = [
    "cameras.scene.output={width: 400, height: 400}",
    "cameras.scene.look_at.distance=1.55",
    "cameras.wrist.output={width: 16, height: 16}",
]


def draw_sheet(engine: str | None) -> Image.Image:
    """Return the pictures of the camera beside the arm, in rows."""
    whole = Image.new("RGB", (COLUMNS * SIDE, ROWS * SIDE))
    options = {"sim": True, "clock": "lock_step", "pad": "none", "engine": engine, "overrides": OVERRIDES}
    with hal.open("panda_table_randomized", **options) as rig:
        for seed in range(ROWS * COLUMNS):
            reset_scene(rig, rig.robots["panda"], random=np.random.default_rng(seed), seed=seed)
            picture = Image.fromarray(np.asarray(rig.cameras["scene"].read().color))
            place = SIDE * (seed % COLUMNS), SIDE * (seed // COLUMNS)
            whole.paste(picture.resize((SIDE, SIDE), Image.Resampling.LANCZOS), place)
    return whole


def main() -> None:
    """Write the sheet and print its size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--into", metavar="FILE", type=Path, default=FILE, help="default: docs/images/randomized.jpg")
    parser.add_argument("--engine", help="engine of the simulation; the pictures do not depend on it")
    args = parser.parse_args()
    draw_sheet(args.engine).save(args.into, quality=85, optimize=True)
    print(f"{args.into.name}: {args.into.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
