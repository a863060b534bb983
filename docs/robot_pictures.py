"""Draw every built-in model of an arm into docs/images/robots/NAME.png, with the simulation's own renderer.

    python docs/robot_pictures.py [--into FOLDER] [MODEL ...]
    python docs/robot_pictures.py --sheet FOLDER ...    # those in folders side by side, into docs/images/robots.png

Models whose package is not installed are left out. The pictures have a palette of 64 colours, to be small.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

import hal
from hal.config.data_files import list_data
from hal.config.rigfile import LookAt
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.meshes import MeshLibrary
from hal.drivers.scene.shapes import parts_of
from hal.errors import ConfigError

sys.path.append(str(Path(__file__).resolve().parents[1]))
from benchmarks.robots import entries

FOLDER = Path(__file__).resolve().parent / "images" / "robots"
SIZE, SHARP, COLORS = 260, 3, 64
"""Side of a picture, pixels; it is drawn larger by a factor and then scaled down; colours of its palette."""
SMALL, LABEL, COLUMNS = 150, 12, 10
"""Side of a picture on the sheet, height of its label, pixels; columns."""
FIELD_DEG, MARGIN = 30.0, 1.12
"""Field of view; room around the arm."""


def draw(robots: dict[str, dict[str, Any]]) -> Image.Image:
    """Return the picture of the arms of a rig, at home on a floor."""
    rig: dict[str, Any] = {"sim": True, "robots": robots}
    points = drawn_points(rig)
    if points[:, 2].min() > -0.5:  # else an arm whose base is on a torso
        rig["objects"] = ["floor"]
        points = points[points[:, 2] > -0.01]  # without a cable below the base
    camera = {"model": "pinhole", "capture": {"width": SIZE * SHARP, "height": SIZE * SHARP, "rate_hz": 10}}
    camera |= {"streams": ["color"], "field_of_view": {"vertical_deg": FIELD_DEG}, "look_at": aim(points)}
    rig["cameras"] = {"picture": camera}
    with hal.open(rig, clock="lock_step", pad="none") as opened:
        color = opened.cameras["picture"].read().color
    return Image.fromarray(np.asarray(color)).resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def drawn_points(rig: dict[str, Any]) -> NDArray[np.float64]:
    """Return the corners (N, 3) of all that is drawn of a rig, in the world, m."""
    plan = hal.config.load(rig).resolve()
    assert plan.world is not None
    world, library, found = DrawnWorld(plan.world), MeshLibrary(), []
    for body in world.bodies.values():
        for part in parts_of(body.id, body.visuals, library.load):
            frame = world.link_frames([(body.id, part.link)])[0]
            found.append(part.mesh.positions @ frame[:3, :3].T + frame[:3, 3])
    return np.concatenate(found)


def aim(points: NDArray[np.float64]) -> dict[str, Any]:
    """Return the ``look_at`` of a camera that has all the points in its picture."""
    look = {"target": [0.0, 0.0, 0.0], "distance": 1.0, "yaw_deg": 50.0, "pitch_deg": -18.0}
    axes = LookAt.model_validate(look).pose().matrix()[:3, :3]
    seen = points @ axes
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    away = np.abs(seen - middle)[:, :2].max(axis=1) * MARGIN / np.tan(np.radians(FIELD_DEG / 2.0))
    distance = float((away - (seen - middle)[:, 2]).max())
    return look | {"target": (axes @ middle).tolist(), "distance": distance}


def pictures(models: list[str]) -> Iterator[tuple[str, Image.Image]]:
    """Yield name and picture of each model, and of both arms of a robot with two."""
    for model in models:
        arms = list(entries(model))
        try:
            yield model, draw({"arm": arms[0]})
        except ConfigError as error:
            print(f"{model}: left out: {error.problems[0].message}")
            continue
        if len(arms) > 1:
            same = {entry["arm"]: entry | {"same": arms[0]["arm"]} for entry in arms[1:]}
            yield f"{model}_both", draw({arms[0]["arm"]: arms[0], **same})


def sheet(folders: list[Path]) -> Image.Image:
    """Return the pictures of folders in one: a row of each folder, then the next models; blank where one has none."""
    names = sorted({path.stem for folder in folders for path in folder.glob("*.png")})
    lines = -(-len(names) // COLUMNS)
    whole = Image.new("RGB", (SMALL * COLUMNS, (SMALL + LABEL) * len(folders) * lines), "white")
    draw_on = ImageDraw.Draw(whole)
    for place, name in enumerate(names):
        for row, folder in enumerate(folders, place // COLUMNS * len(folders)):
            corner = SMALL * (place % COLUMNS), (SMALL + LABEL) * row
            label = f"{name}, {folder.name}" if len(folders) > 1 else name
            draw_on.text((corner[0] + 2, corner[1]), label, fill="black")
            if (path := folder / f"{name}.png").is_file():
                small = Image.open(path).convert("RGB").resize((SMALL, SMALL), Image.Resampling.LANCZOS)
                whole.paste(small, (corner[0], corner[1] + LABEL))
    return whole


def save(picture: Image.Image, path: Path, colors: int = COLORS) -> None:
    """Write a picture and print its size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(colors, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Write the pictures and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", help="default: all")
    parser.add_argument("--into", metavar="FOLDER", type=Path, default=FOLDER, help="default: docs/images/robots")
    parser.add_argument("--sheet", metavar="FOLDER", nargs="+", type=Path, help="put the pictures in folders into one")
    args = parser.parse_args()
    if args.sheet:
        save(sheet(args.sheet), FOLDER.parent / "robots.png", colors=256)
        return
    for name, picture in pictures(args.models or list(list_data("robots"))):
        save(picture, args.into / f"{name}.png")


if __name__ == "__main__":
    main()
