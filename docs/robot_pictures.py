"""Draw every built-in model of an arm into docs/images/robots/NAME.png, with the simulation's own renderer.

    python docs/robot_pictures.py [MODEL ...]

Models whose package is not installed are left out. The pictures have a palette of 64 colours, to be small.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import hal
from hal.config.data_files import list_data
from hal.errors import ConfigError

sys.path.append(str(Path(__file__).resolve().parents[1]))
from benchmarks.robots import entries

FOLDER = Path(__file__).resolve().parent / "images" / "robots"
SIZE, SHARP, COLORS = 260, 3, 64
"""Side of a picture, pixels; it is drawn larger by a factor and then scaled down; colours of its palette."""


def draw(robots: dict[str, dict[str, Any]]) -> Image.Image:
    """Return the picture of the arms of a rig, at home on a floor."""
    camera = {"model": "pinhole", "capture": {"width": SIZE * SHARP, "height": SIZE * SHARP, "rate_hz": 10}}
    camera |= {"streams": ["color"], "field_of_view": {"vertical_deg": 35}}
    rig: dict[str, Any] = {"sim": True, "robots": robots, "objects": ["floor"]}
    with hal.open(rig, clock="lock_step", pad="none") as opened:
        lower, upper = np.array([opened.world.aabb(name) for name in robots]).swapaxes(0, 1)
        low, high = lower.min(axis=0), upper.max(axis=0)
    low[2] = max(low[2], 0.0) if low[2] > -0.2 else low[2]
    middle, size = (low + high) / 2.0, float(np.linalg.norm(high - low))
    look = {"target": middle.tolist(), "distance": 1.62 * size, "yaw_deg": 50, "pitch_deg": -18}
    objects = [] if low[2] < -0.2 else ["floor"]  # an arm whose base is on a torso
    rig |= {"objects": objects, "cameras": {"picture": camera | {"look_at": look}}}
    with hal.open(rig, clock="lock_step", pad="none") as opened:
        color = opened.cameras["picture"].read().color
    image = Image.fromarray(np.asarray(color)).resize((SIZE, SIZE), Image.Resampling.LANCZOS)
    return image.quantize(COLORS, dither=Image.Dither.NONE)


def save(picture: Image.Image, name: str) -> None:
    """Write a picture and print its size."""
    path = FOLDER / f"{name}.png"
    picture.save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1024:.0f} kB")


def main() -> None:
    """Write the pictures and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", help="default: all")
    args = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    for model in args.models or list_data("robots"):
        try:
            picture = draw({"arm": next(entries(model))})
        except ConfigError as error:
            print(f"{model}: left out: {error.problems[0].message}")
            continue
        save(picture, model)
        arms = list(entries(model))
        if len(arms) > 1:
            same = {entry["arm"]: entry | {"same": arms[0]["arm"]} for entry in arms[1:]}
            save(draw({arms[0]["arm"]: arms[0], **same}), f"{model}_both")
    print(f"together {sum(path.stat().st_size for path in FOLDER.glob('*.png')) / 1024:.0f} kB")


if __name__ == "__main__":
    main()
