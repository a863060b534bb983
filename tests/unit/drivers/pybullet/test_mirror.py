"""A mirror of PyBullet's world shows arms that are mirrors themselves, and objects that are attached."""

from __future__ import annotations

from contextlib import closing

import pytest
from specs import PANDA_HOME, box, floor, panda, world_spec

from hal.drivers.pybullet.world import PyBulletWorld
from hal.specs import BodySpec, WorldSpec, from_json, to_json


@pytest.mark.parametrize(
    "thing", [floor(), box("board", (0.03, 0.0, 0.19), (0.1, 0.1, 0.002), robot="arm", link="panda_hand")]
)
def test_a_mirror_shows_what_is_followed_and_attached(thing: BodySpec) -> None:
    spec = world_spec(thing, panda("arm", driver="franka"))
    mirrored = from_json(WorldSpec, to_json(spec))
    with closing(PyBulletWorld(spec)) as world, closing(PyBulletWorld(mirrored, mirror=True)) as mirror:
        world.follow("arm", [0.5, *PANDA_HOME[1:]], [0.0] * 7, 0.01)
        world.step()
        mirror.show(world.snapshot())
        for body, link in (("arm", "panda_hand"), ("arm", "panda_leftfinger"), (thing.name, None)):
            shown, there = mirror.pose(body, link), world.pose(body, link)
            assert shown["position"] == pytest.approx(there["position"], abs=1e-6)
