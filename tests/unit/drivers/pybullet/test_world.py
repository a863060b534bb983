"""PyBullet's world, beyond what every engine owes: air resistance, and mirrors for its window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from specs import box, cube, data, floor, iiwa, panda, world_spec

import hal
from hal.drivers.pybullet.world import PyBulletWorld
from hal.geometry import Pose
from hal.specs import BodySpec

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def run(world: PyBulletWorld, steps: int) -> NDArray[np.float64]:
    """Step, and give every snapshot on the way (steps, n)."""
    seen = []
    for _ in range(steps):
        world.step()
        seen.append(world.snapshot())
    return np.array(seen)


def pose(world: PyBulletWorld, name: str, link: str | None = None) -> Pose:
    answer = world.pose(name, link)
    return Pose(answer["position"], answer["orientation"])


def mug(**changes: object) -> BodySpec:
    """An object from a URDF."""
    return BodySpec("mug", (0.3, 0.4, 0.1), UPRIGHT, "urdf", urdf=data("objects/mug.urdf"), **changes)


def scene() -> PyBulletWorld:
    """Floor, a stack of two boxes that touch at the start, a URDF object, two different arms."""
    lid = box("lid", (0.5, -0.2, 0.09), (0.03, 0.03, 0.03), mass=0.5)
    arms = panda(), iiwa(base_position=(0.0, 1.0, 0.0))
    return PyBulletWorld(world_spec(floor(), cube((0.5, -0.2, 0.03)), lid, mug(), *arms))


def test_free_fall() -> None:
    world = PyBulletWorld(world_spec(cube((0.0, 0.0, 10.0))))
    world.set_dynamics("cube", linear_damping=0.0)
    run(world, 240)
    n, dt = 240, world.dt
    assert world.t == n * dt == 1.0
    assert 10.0 - pose(world, "cube").position[2] == pytest.approx(9.81 * dt * dt * n * (n + 1) / 2, rel=1e-9)


def test_a_rate_at_which_contacts_give_way_is_a_warning() -> None:
    for rate, count in ((60.0, 1), (240.0, 0)):
        assert len(PyBulletWorld(world_spec(floor(), physics_hz=rate)).warnings) == count


def test_hulls_are_kept_for_the_next_start_and_made_anew_if_they_are_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made, times = [], []
    for _ in range(2):
        with hal.open("ur5e_robotiq", sim=True, pad="none", clock="lock_step", overrides=["cameras={}"]) as rig:
            assert rig.robots["arm"].gripper is not None
        kept = sorted(tmp_path.glob("robot-hal/hulls/*.json"))
        made.append({file: file.read_bytes() for file in kept})
        times.append([file.stat().st_mtime_ns for file in kept])
        for file in kept[::2]:
            file.write_bytes(file.read_bytes()[:100])
    assert len(made[0]) > 1
    assert made[0] == made[1]
    assert times[0][1::2] == times[1][1::2], "those that were whole are not made again"
