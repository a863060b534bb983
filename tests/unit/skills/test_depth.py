"""An object on a table, from points as a depth camera measures them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.skills import find_by_depth, locate_by_depth, look_at
from hal.skills.depth import collect_points, find_table, largest_cluster

SLOPE = (0.05, -0.03, -0.1)


def table(count: int = 4000, noise: float = 0.001) -> np.ndarray:
    """Return points on a table that is not quite level."""
    random = np.random.default_rng(1)
    xy = random.uniform((0.3, -0.3), (0.8, 0.3), (count, 2))
    return np.column_stack([xy, xy @ SLOPE[:2] + SLOPE[2] + random.normal(0.0, noise, count)])


def block(x: float, y: float, size: float, count: int = 600) -> np.ndarray:
    """Return points on top of a block on that table."""
    random = np.random.default_rng(2)
    xy = random.uniform(-size / 2.0, size / 2.0, (count, 2)) + [x, y]
    return np.column_stack([xy, xy @ SLOPE[:2] + SLOPE[2] + 0.05])


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.005])
def test_the_plane_of_the_table_is_found_among_other_points(noise: float) -> None:
    wall = np.column_stack([np.full(1500, 0.8), *np.random.default_rng(3).uniform(-0.3, 0.3, (2, 1500))])
    plane = find_table(np.concatenate([table(noise=noise), block(0.5, 0.0, 0.08), wall]))
    assert plane is not None
    assert (plane.a, plane.b, plane.c) == pytest.approx(SLOPE, abs=0.004)
    assert plane.noise == pytest.approx(noise, abs=1.5e-3)
    assert plane.height(block(0.5, 0.0, 0.08)).mean() == pytest.approx(0.05, abs=1e-3)


def test_there_may_be_no_table() -> None:
    assert find_table(np.zeros((3, 3))) is None
    assert find_table(np.random.default_rng(0).uniform(size=(500, 3)) * [0.001, 1.0, 1.0]) is None


def test_the_largest_of_several_clusters_is_kept_whole() -> None:
    small, large = block(0.4, 0.1, 0.03, 900), block(0.6, -0.1, 0.07, 300)
    kept = largest_cluster(np.concatenate([small, large]))
    assert len(kept) == len(large), "by its size, not by its number of points"
    assert np.array_equal(np.sort(kept, axis=0), np.sort(large, axis=0))


@pytest.fixture(scope="module")
def rig() -> Any:
    overrides = {"objects": ["floor", "table", "cube"], "cameras.scene.streams": ["color"]}
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        yield rig


def test_a_camera_on_the_hand_looks_from_near(rig: hal.Rig) -> None:
    arm, camera = rig.robots["panda"], rig.cameras["wrist"]
    truth = (arm.base.inverse() @ rig.world.pose("cube")).position
    home = arm.state().tcp
    found = find_by_depth(arm, camera, count=2, speed=0.5)
    assert found is not None
    assert home.distance(arm.state().tcp)[0] > 0.05, "it has moved"
    assert found.pose.position[:2] == pytest.approx(truth[:2], abs=2e-3)
    assert found.size == pytest.approx((0.06, 0.03, 0.06), abs=3e-3)
    frame = camera.read()
    seen = (arm.base.inverse() @ frame.T_world_camera).inverse().transform([*truth[:2], found.table])
    assert seen == pytest.approx([0.0, 0.0, 0.4], abs=0.01), "in the middle of the picture, 0.4 m away"
    nowhere = locate_by_depth(arm, [frame], lower=[0.4, 0.2, -1.0], upper=[0.5, 0.3, 1.0])
    assert nowhere is None
    arm.move_to(arm.home, speed=0.5)


def test_what_happens_on_the_way_to_the_second_look_is_reported(rig: hal.Rig) -> None:
    arm, camera = rig.robots["panda"], rig.cameras["wrist"]
    with pytest.warns(RuntimeWarning, match="longer than 0.2 s"):
        assert find_by_depth(arm, camera, count=1, timeout=0.2) is not None
    with raises_code(hal.MotionStopped, "rig_stop"):
        find_by_depth(arm, camera, count=1, progress=lambda now: rig.stop())
    rig.rearm()
    arm.move_to(arm.home, speed=0.5)


def test_what_a_camera_cannot_do_is_refused(rig: hal.Rig) -> None:
    arm, fixed = rig.robots["panda"], rig.cameras["scene"]
    with raises_code(hal.CommandError, "not_on_the_hand"):
        look_at(arm, fixed, [0.5, 0.0, 0.0])
    with raises_code(hal.NotSupported, "no_depth"):
        collect_points(arm, [fixed.read()])
    assert look_at(arm, rig.cameras["wrist"], [3.0, 0.0, 0.0]).reason in ("unreachable", "outside_limits")
