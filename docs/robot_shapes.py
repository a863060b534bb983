"""Write robots/shapes/*.obj: what is drawn of the Panda and the FR3 where no meshes are installed, and of the iiwa.

    python docs/robot_shapes.py

The shapes are this project's own. Each part is a loft: a skin over cross-sections along an axis of the link's frame.
Their places follow from the lengths of the arms (see the heads of the URDF files); the tubes of the Panda are 110 mm
thick, its hand is 204 mm wide, the iiwa is 136 to 172 mm thick. The files are in mm and have no normals: the reader of
meshes computes them.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).resolve().parents[1] / "robots" / "shapes"
MATERIALS = {
    "white": (0.93, 0.93, 0.92),
    "dark": (0.2, 0.21, 0.24),
    "silver": (0.76, 0.77, 0.78),
    "orange": (0.95, 0.42, 0.08),
}
CORNERS = 20
"""Corners of a cross-section."""

Section = tuple[float, ...]
"""Place along the axis; centre (2) and half widths (2) across it, in cyclic order of the axes, mm; how square: 2, the
default, is an ellipse."""
Part = tuple[str, str, list[Section]]
"""Material, axis, cross-sections."""


def barrel(profile: list[tuple[float, float]], a: float = 0.0, b: float = 0.0) -> list[Section]:
    """Return round cross-sections with these places and radii, around an axis through (a, b)."""
    return [(place, a, b, radius, radius) for place, radius in profile]


def mirrored(sections: list[Section]) -> list[Section]:
    """Return the sections on the other side of the origin."""
    return [(-place, *rest) for place, *rest in sections]


SHOULDER = barrel([(0.5, 52), (3, 55), (70, 55), (92, 52), (110, 44), (122, 30), (129, 10)])
ELBOW = [(0.5, 52), (3, 55), (62, 55)]
ELBOW_RIM = [(62, 54), (80, 55), (96, 52), (106, 44), (107, 36)]
ELBOW_CAP = [(100, 37), (108, 35), (111, 26), (112, 10)]

FRANKA: dict[str, list[Part]] = {
    "link0": [
        ("white", "z", [
            (0, -40, 0, 111, 93, 2.6), (8, -40, 0, 112, 94, 2.6), (40, -30, 0, 96, 83, 2.5), (80, -15, 0, 76, 69, 2.3),
            (115, -4, 0, 60, 59, 2.1), (130, 0, 0, 55, 55), (138, 0, 0, 55, 55), (140.5, 0, 0, 53, 53),
        ]),
    ],
    "link1": [
        ("white", "z", [
            (-192, 0, 0, 53, 53), (-189, 0, 0, 55, 55), (-110, 0, 0, 55, 55), (-75, 0, -9, 55, 54),
            (-45, 0, -27, 54, 52), (-15, 0, -50, 52, 50), (10, 0, -63, 46, 45), (35, 0, -68, 34, 36),
            (50, 0, -66, 14, 20),
        ]),
        ("white", "y", mirrored(SHOULDER)),
    ],
    "link2": [
        ("white", "y", [
            (-194, 0, 0, 53, 53), (-191, 0, 0, 55, 55), (-110, 0, 0, 55, 55), (-75, 9, 0, 54, 55),
            (-45, 27, 0, 52, 54), (-15, 50, 0, 50, 52), (10, 63, 0, 45, 46), (35, 68, 0, 36, 34), (50, 66, 0, 20, 14),
        ]),
        ("white", "z", SHOULDER),
    ],
    "link3": [
        ("white", "z", [
            (-121.5, 0, 0, 53, 53), (-118, 0, 0, 55, 55), (-85, 0, 0, 55, 55), (-60, 10, 6, 56, 54),
            (-35, 32, 17, 57, 50), (-10, 58, 30, 52, 46), (12, 74, 36, 46, 42), (32, 80, 38, 34, 34),
            (46, 82, 38, 16, 16),
        ]),
        ("white", "y", barrel(ELBOW, 0, 82.5)),
        ("dark", "y", barrel(ELBOW_RIM, 0, 82.5)),
        ("white", "y", barrel(ELBOW_CAP, 0, 82.5)),
    ],
    "link4": [
        ("white", "y", [
            (124, 0, -82.5, 53, 53), (121, 0, -82.5, 55, 55), (85, 0, -82.5, 55, 55), (60, 6, -72, 54, 56),
            (35, 17, -50, 50, 57), (10, 30, -24, 46, 52), (-12, 36, -8, 42, 46), (-32, 38, -2, 34, 34),
            (-46, 38, 0, 16, 16),
        ]),
        ("white", "z", barrel(ELBOW)),
        ("dark", "z", barrel(ELBOW_RIM)),
        ("white", "z", barrel(ELBOW_CAP)),
    ],
    "link5": [
        ("white", "z", [
            (-259.5, 0, 0, 53, 53), (-256, 0, 0, 55, 55), (-205, 0, 0, 55, 55), (-165, 0, 10, 53, 55),
            (-125, 0, 34, 49, 53), (-85, 0, 62, 44, 48), (-45, 0, 80, 42, 44), (-10, 0, 86, 46, 42),
            (20, 0, 86, 46, 42), (40, 0, 86, 32, 38), (50, 0, 86, 12, 28),
        ]),
        ("white", "y", barrel([(45, 49), (48, 51), (105, 51), (120, 47), (127, 40)])),
        ("dark", "y", [(110, -30, 0, 80, 40, 2.4), (124, -30, 0, 78, 38, 2.4), (130, -30, 0, 70, 32, 2.4)]),
        ("white", "y", [(120, -24, 0, 62, 24, 2.4), (132, -24, 0, 60, 22, 2.4)]),
    ],
    "link6": [
        ("white", "z", barrel([(-44.5, 46), (-42, 48), (20, 48), (30, 48)])),
        ("dark", "z", barrel([(30, 48), (46, 47), (54, 40), (57, 28)])),
        ("white", "x", [(0, 4, -2, 44, 40), (40, 10, -2, 40, 38), (70, 14, 0, 42, 40), (100, 16, 0, 40, 38)]),
        ("white", "y", barrel([(-51.5, 42), (-49, 44), (50, 44), (66, 41), (74, 36)], 0, 88)),
        ("dark", "y", barrel([(66, 39), (78, 36), (82, 28)], 0, 88)),
    ],
    "link7": [
        ("white", "z", barrel([(52, 42), (54, 44), (96, 44), (104, 42), (106.5, 40)])),
        ("white", "z", [(62, 34, 34, 38, 38), (66, 38, 38, 42, 42), (92, 38, 38, 42, 42), (97, 34, 34, 38, 38)]),
        ("dark", "z", [(70, 47, 47, 36, 36), (88, 47, 47, 36, 36)]),
    ],
    "hand": [
        ("white", "z", [
            (0.5, 0, 0, 32, 38, 2.2), (10, 0, 0, 32, 60, 3), (18, 0, 0, 32, 92, 5), (24, 0, 0, 32, 101, 6),
            (56, 0, 0, 32, 102, 6), (63, 0, 0, 30, 99, 6), (66, 0, 0, 27, 95, 6),
        ]),
        ("dark", "x", [(-33, 0, 40, 70, 8, 6), (33, 0, 40, 70, 8, 6)]),
    ],
    "finger": [
        ("white", "z", [
            (0, 0, 15.5, 10, 9.5, 5), (8, 0, 16, 10.5, 10, 5), (24, 0, 17, 10.5, 9, 5), (36, 0, 12, 9.5, 10, 5),
            (44, 0, 8, 9, 7.5, 5),
        ]),
        ("dark", "z", [(36, 0, 7, 9.2, 7, 6), (52, 0, 7, 9.2, 7, 6), (54, 0, 7, 8, 6, 6)]),
    ],
}  # fmt: skip

LOWER = barrel([(0, 80), (4, 85), (62, 85), (88, 80), (106, 66), (118, 44), (126, 14)])
UPPER = barrel([(0, 64), (4, 68), (56, 68), (80, 63), (98, 51), (109, 33), (114, 11)])

IIWA: dict[str, list[Part]] = {
    "link0": [
        ("dark", "z", [
            (0, 0, 0, 121, 121), (6, 0, 0, 121, 121), (40, 0, 0, 112, 112), (100, 0, 0, 96, 96), (146, 0, 0, 88, 88),
            (151, 0, 0, 86, 86),
        ]),
        ("dark", "z", [(0, -80, 0, 56, 70, 10), (142, -80, 0, 55, 69, 10), (151, -77, 0, 50, 64, 10)]),
    ],
    "link1": [
        ("orange", "z", [(-6.5, 0, 0, 83, 83), (-2, 0, 0, 86, 86), (6, 0, 0, 86, 86)]),
        ("silver", "z", [
            (5, 0, 0, 85, 85), (40, 0, 0, 85, 84), (80, 0, -4, 84, 80), (120, 0, -16, 82, 72), (160, 0, -34, 80, 66),
            (202, 0, -46, 78, 58), (240, 0, -50, 66, 46), (268, 0, -50, 42, 30), (282, 0, -50, 14, 10),
        ]),
        ("silver", "y", [(-place, 202.5, b, *rest) for place, _, b, *rest in LOWER]),
    ],
    "link2": [
        ("silver", "y", [
            (204.5, 0, 0, 64, 64), (200, 0, 0, 68, 68), (170, 0, 0, 69, 69), (130, 6, 0, 70, 72), (90, 24, 0, 68, 76),
            (40, 42, 0, 62, 79), (0, 50, 0, 56, 78), (-40, 52, 0, 44, 66), (-68, 52, 0, 28, 40), (-80, 52, 0, 10, 14),
        ]),
        ("silver", "z", LOWER),
    ],
    "link3": [
        ("orange", "z", [(0, 0, 0, 66, 66), (3, 0, 0, 69, 69), (14, 0, 0, 69, 69)]),
        ("silver", "z", [
            (13, 0, 0, 68, 68), (70, 0, 0, 68, 68), (110, 0, 8, 67, 65), (150, 0, 26, 66, 58), (190, 0, 42, 64, 50),
            (220, 0, 48, 60, 46), (250, 0, 50, 46, 36), (270, 0, 50, 28, 22), (279, 0, 50, 9, 8),
        ]),
        ("silver", "y", [(place, 215.5, b, *rest) for place, _, b, *rest in UPPER]),
    ],
    "link4": [
        ("silver", "y", [
            (184, 0, 0, 64, 64), (180, 0, 0, 68, 68), (130, 0, 0, 68, 68), (95, 8, 0, 65, 67), (55, 26, 0, 58, 66),
            (20, 42, 0, 50, 64), (-10, 48, 0, 46, 60), (-36, 50, 0, 36, 46), (-56, 50, 0, 22, 28), (-64, 50, 0, 8, 9),
        ]),
        ("silver", "z", UPPER),
    ],
    "link5": [
        ("orange", "z", [(0, 0, 0, 66, 66), (3, 0, 0, 69, 69), (14, 0, 0, 69, 69)]),
        ("silver", "z", [
            (13, 0, 0, 68, 68), (50, 0, 2, 68, 68), (90, 0, 14, 64, 66), (130, 0, 40, 58, 52), (170, 0, 62, 54, 34),
            (200, 0, 68, 54, 28), (228, 0, 70, 50, 26), (250, 0, 70, 36, 22), (262, 0, 70, 20, 16), (267, 0, 70, 7, 6),
        ]),
        ("silver", "y", [(place, 215.5, 0, r, r) for place, r in ((44, 46), (48, 50), (86, 50), (97, 42))]),
    ],
    "link6": [
        ("silver", "y", [
            (81, 0, 0, 48, 48), (76, 0, 0, 52, 52), (50, 0, 0, 58, 58), (20, 0, 0, 64, 64), (-10, 0, 0, 66, 66),
            (-40, 0, 0, 60, 60), (-62, 0, 0, 47, 47), (-78, 0, 0, 27, 27), (-85, 0, 0, 9, 9),
        ]),
        ("silver", "z", barrel([(-70, 38), (-62, 48), (-30, 57), (0, 59), (30, 57), (58, 48), (66, 38)])),
    ],
    "link7": [
        ("orange", "z", barrel([(-0.5, 48), (2, 51), (8, 51), (10, 50)])),
        ("dark", "z", barrel([(9, 48), (12, 50), (38, 50), (44, 47), (45, 44)])),
    ],
}  # fmt: skip

ROBOTS = {"franka": FRANKA, "iiwa": IIWA}


def skin(axis: str, sections: list[Section]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return the corners (N, 3) of a part and its faces, whose outer sides are counter-clockwise."""
    angle = np.arange(CORNERS) * 2 * np.pi / CORNERS
    rings = []
    for place, a, b, half_a, half_b, *square in sorted(sections):
        power = 2 / (square[0] if square else 2)
        cos, sin = (np.sign(f) * np.abs(f) ** power for f in (np.cos(angle), np.sin(angle)))
        rings.append(np.stack([np.full(CORNERS, place), a + half_a * cos, b + half_b * sin], axis=1))
    first = [np.arange(CORNERS) + CORNERS * k for k in range(len(rings))]
    faces = [
        [int(lower[i]), int(lower[i - CORNERS + 1]), int(upper[i - CORNERS + 1]), int(upper[i])]
        for lower, upper in pairwise(first)
        for i in range(CORNERS)
    ]
    faces += [first[0][::-1].tolist(), first[-1].tolist()]
    return np.roll(np.concatenate(rings), "xyz".index(axis), axis=1), faces


def main() -> None:
    """Write the files and print their sizes."""
    FOLDER.mkdir(exist_ok=True)
    looks = "".join(f"newmtl {name}\nKd {' '.join(map(str, color))}\n" for name, color in MATERIALS.items())
    (FOLDER / "shapes.mtl").write_text(looks)
    named = {f"{robot}_{link}": parts for robot, links in ROBOTS.items() for link, parts in links.items()}
    for name, parts in named.items():
        lines, count = ["mtllib shapes.mtl"], 1
        for material, axis, sections in parts:
            corners, faces = skin(axis, sections)
            lines += [f"v {' '.join(f'{value:.4g}' for value in corner)}" for corner in corners.round(1) + 0.0]
            lines += [f"usemtl {material}", *(f"f {' '.join(str(count + i) for i in face)}" for face in faces)]
            count += len(corners)
        path = FOLDER / f"{name}.obj"
        path.write_text("\n".join(lines) + "\n")
        print(f"{path.name}: {path.stat().st_size / 1000:.1f} kB")


if __name__ == "__main__":
    main()
