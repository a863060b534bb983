"""Where an object is and how wide, from points on it; and the grasp across its narrowest way."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.skills import grasp_pose, locate_by_truth, object_from_points
from hal.specs import BodySpec

TABLE = 0.2
WEDGE = """
v -30 -15 -20
v 30 -15 -20
v 30 15 -20
v -30 15 -20
v 0 -15 20
v 0 15 20
f 1 4 3 2
f 1 2 5
f 3 4 6
f 2 3 6 5
f 4 1 5 6
"""
"""A roof of 60 x 30 x 40 mm, with only six corners."""


def box(size: tuple[float, float, float], yaw: float, position: tuple[float, float]) -> np.ndarray:
    """Return points inside of a box that stands on the table, turned by ``yaw``."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)) * size + [0.0, 0.0, size[2] / 2.0]
    return hal.Pose.from_rpy([*position, TABLE], (0.0, 0.0, yaw)).transform(points)


@pytest.mark.parametrize("yaw", [0.0, 0.4, -1.2, 1.5])
def test_a_box_is_found_with_its_sides(yaw: float) -> None:
    found = object_from_points(box((0.06, 0.03, 0.08), yaw, (0.4, -0.1)), TABLE)
    assert found.size == pytest.approx((0.06, 0.03, 0.08), abs=2e-3)
    assert found.pose.position == pytest.approx([0.4, -0.1, TABLE], abs=1e-3)
    turned = found.pose.matrix()[:2, 0]
    assert abs(turned @ [math.cos(yaw), math.sin(yaw)]) > 0.999
    assert (found.width, found.height, found.table) == (found.size[1], found.size[2], TABLE)
    assert abs(found.widest) < 4e-3


def test_stray_points_and_a_handle_do_not_move_the_grasp() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 2000)
    cup = 0.03 * np.column_stack([np.cos(angles), np.sin(angles), angles / 0.6])
    cup[:, 2] = TABLE + 0.08 * np.random.default_rng(0).random(2000)
    handle = np.column_stack([np.linspace(0.03, 0.055, 150), np.zeros(150), np.full(150, TABLE + 0.04)])
    stray = [[-0.1, 0.1, TABLE + 0.05], [0.1, -0.1, TABLE + 0.2]]
    found = object_from_points(np.concatenate([cup, handle, stray]), TABLE)
    assert found.width == pytest.approx(0.06, abs=2e-3)
    assert found.pose.transform([found.widest, 0.0, 0.0])[:2] == pytest.approx([0.0, 0.0], abs=4e-3)
    assert found.height == pytest.approx(0.08, abs=3e-3)


def test_points_must_be_some() -> None:
    with pytest.raises(hal.CommandError):
        object_from_points(np.zeros((3, 3)))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> hal.Rig:
    mesh = tmp_path_factory.mktemp("meshes") / "wedge.obj"
    mesh.write_text(WEDGE)
    config = Path(__file__).parents[3] / "config" / "panda_table.yaml"
    objects = [
        "floor",
        "cube",
        "duck",
        "mug",
        {"name": "can", "shape": "cylinder", "radius": 0.025, "length": 0.08, "position": [0.1, 0.1, 0.64]},
        {"name": "ball", "shape": "sphere", "radius": 0.02, "position": [0.1, 0.3, 0.62]},
        {"name": "wedge", "shape": "mesh", "mesh": str(mesh), "scale": 0.001, "position": [0.2, 0.1, 0.6]},
        {"name": "pill", "shape": "capsule", "radius": 0.01, "length": 0.04, "position": [0.2, 0.3, 0.63]},
    ]
    with hal.open(
        str(config), sim=True, clock="lock_step", pad="none", overrides={"cameras": {}, "objects": objects}
    ) as rig:
        rig.world.add(BodySpec("late", (0.3, 0.3, 0.63), (0.0, 0.0, 0.0, 1.0), "box", half_extents=(0.04, 0.01, 0.03)))
        yield rig


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("cube", (0.06, 0.03, 0.06)),
        ("can", (0.05, 0.05, 0.08)),
        ("mug", (0.086, 0.06, 0.075)),
        ("duck", (0.067, 0.042, 0.06)),
        ("ball", (0.04, 0.04, 0.04)),
        ("pill", (0.02, 0.02, 0.06)),
        ("wedge", (0.06, 0.03, 0.04)),
        ("late", (0.08, 0.02, 0.06)),
    ],
)
def test_ground_truth_has_the_true_sides(rig: hal.Rig, name: str, size: tuple[float, float, float]) -> None:
    arm = rig.robots["panda"]
    found = locate_by_truth(rig, arm, name)
    assert found.name == name
    assert found.size == pytest.approx(size, abs=2e-3)
    at = found.pose.transform([found.widest, 0.0, 0.0])[:2]
    assert at == pytest.approx((arm.base.inverse() @ rig.world.pose(name)).position[:2], abs=8e-3)
    pose = grasp_pose(found, arm.gripper)
    assert pose.transform([0.0, 0.0, 1.0])[2] < pose.position[2], "the tcp points down"
    assert pose.position[2] >= found.table + 0.012
    assert found.table + found.height - pose.position[2] <= 0.048


def test_what_cannot_be_located_or_held_is_refused(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with pytest.raises(hal.DeviceNotFound):
        locate_by_truth(rig, arm, "cub")
    with raises_code(hal.NotSupported, "unknown_shape"):
        locate_by_truth(rig, arm, "floor")
    with raises_code(hal.CommandError, "is_robot"):
        locate_by_truth(rig, arm, "panda")
    with raises_code(hal.CommandError, "not_seen"):
        grasp_pose(None, arm.gripper)
    for wrong in ({"name": "it", "shape": "box"}, "cube"):
        with raises_code(hal.CommandError, "not_a_body"):
            rig.world.add(wrong)  # type: ignore[arg-type]  # the mistake
    with raises_code(hal.CommandError, "not_a_pose"):
        rig.world.set_pose("cube", [0.0, 0.0, 1.0])  # type: ignore[arg-type]  # the mistake
    with raises_code(hal.CommandError, "too_wide"):
        grasp_pose(object_from_points(box((0.1, 0.09, 0.05), 0.0, (0.4, 0.0)), TABLE), arm.gripper)
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"]) as mock:
        arm = mock.robots["panda"]
        with raises_code(hal.NotSupported, "no_world"):
            locate_by_truth(mock, arm, "cube")
