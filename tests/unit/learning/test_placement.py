"""Where things start in an episode: drawn from their ranges, never into each other, and the same for the same seed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal import Pose
from hal.learning.episode import reset_scene, sample_poses

TABLE = {"name": "table", "shape": "box", "half_extents": [0.5, 0.5, 0.3], "position": [0, 0, 0.3]}
FAR = {"arm": {"model": "panda", "base": [0, -2, 0, 0, 0, 0, 1]}}


def brick(name: str, **keys: Any) -> dict[str, Any]:
    """A box of 20 x 10 x 6 cm over the middle of the table."""
    shape = {"shape": "box", "half_extents": [0.1, 0.05, 0.03], "mass": 1.0, "position": [0, 0, 0.7]}
    return {"name": name, **shape, **keys}


@contextmanager
def bench(*objects: Any, clock: str = "lock_step") -> Iterator[hal.Rig]:
    """A floor, a table, and these; an arm that is far away."""
    config = {"robots": FAR, "objects": ["floor", TABLE, *objects]}
    with hal.open(config, sim=True, clock=clock, pad="none") as rig:
        yield rig


def drawn(rig: hal.Rig, seed: int) -> dict[str, Pose]:
    rig.world.reset()
    return sample_poses(rig, np.random.default_rng(seed))


def overlap(rig: hal.Rig, a: str, b: str) -> bool:
    """Do the boxes around two things overlap, where they are now?"""
    (low_a, high_a), (low_b, high_b) = rig.world.aabb(a), rig.world.aabb(b)
    return bool((low_a < high_b).all() and (low_b < high_a).all())


def turns(pose: Pose) -> tuple[float, float, float]:
    """Roll, pitch, yaw, degrees."""
    m = pose.matrix()
    roll, yaw = np.arctan2(m[2, 1], m[2, 2]), np.arctan2(m[1, 0], m[0, 0])
    return tuple(np.degrees([roll, -np.arcsin(m[2, 0]), yaw]))


# What is drawn.


def test_values_with_a_range_are_sampled_and_the_rest_stays() -> None:
    ranges = {"x": [-0.3, 0.1], "z": [0.75, 0.8], "yaw_deg": [-30, 60]}
    with bench(brick("brick", position=[0.0, 0.2, 0.7], random=ranges), brick("other", position=[0, -0.3, 0.7])) as rig:
        found = [drawn(rig, seed) for seed in range(300)]
        assert all(list(poses) == ["brick"] for poses in found)
        places = np.array([poses["brick"].position for poses in found])
        angles = np.array([turns(poses["brick"]) for poses in found])
        assert rig.world.pose("brick").position == pytest.approx([0.0, 0.2, 0.7]), "drawing moves nothing"
    for values, least, greatest in ((places[:, 0], -0.3, 0.1), (places[:, 2], 0.75, 0.8), (angles[:, 2], -30, 60)):
        span = greatest - least
        assert least <= values.min() < least + 0.05 * span
        assert greatest - 0.05 * span < values.max() <= greatest
        assert values.mean() == pytest.approx((least + greatest) / 2, abs=0.1 * span)
    assert (places[:, 1] == 0.2).all()
    assert angles[:, :2] == pytest.approx(0.0, abs=1e-9)


def test_turns_are_about_the_worlds_axes_on_top_of_the_orientation() -> None:
    lying = Pose.from_rpy([0, 0, 0], [np.pi / 2, 0, 0])
    with bench(brick("brick", orientation=lying.orientation.tolist(), random={"yaw_deg": [90, 90]})) as rig:
        pose = drawn(rig, 0)["brick"]
        assert pose.transform([0, 0, 1]) - pose.position == pytest.approx([1, 0, 0], abs=1e-9), "-y, turned by yaw"
    with bench(brick("brick", random={"roll_deg": [90, 90], "yaw_deg": [90, 90]})) as rig:
        pose = drawn(rig, 0)["brick"]
        assert pose.transform([0, 1, 0]) - pose.position == pytest.approx([0, 0, 1], abs=1e-9)
        assert pose.transform([1, 0, 0]) - pose.position == pytest.approx([0, 1, 0], abs=1e-9)


def test_the_same_seed_gives_the_same_poses_to_the_bit() -> None:
    def some(rig: hal.Rig, seed: int) -> list[bytes]:
        poses = drawn(rig, seed)
        assert list(poses) == ["first", "second"], "as configured"
        return [part.tobytes() for pose in poses.values() for part in (pose.position, pose.orientation)]

    ranges = {"x": [-0.3, 0.3], "y": [-0.3, 0.3], "yaw_deg": [-180, 180]}
    things = [brick("first", random=ranges), brick("second", random=ranges)]
    with bench(*things) as rig:
        once = [some(rig, seed) for seed in (7, 8)]
        rig.world.set_pose("first", Pose([0.4, 0.4, 0.9], [0.5, 0.5, 0.5, 0.5]))
        rig.clock.sleep(0.5)
        assert [some(rig, seed) for seed in (7, 8)] == once, "whatever happened in between"
    with bench(*things) as rig:
        assert [some(rig, seed) for seed in (7, 8)] == once
    assert once[0] != once[1]


def test_a_rig_without_ranges_or_without_a_world_draws_nothing() -> None:
    random = np.random.default_rng(1)
    with bench(brick("brick")) as rig:
        assert sample_poses(rig, random) == {}
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        assert sample_poses(rig, random) == {}
        assert reset_scene(rig, rig.robots["panda"], random=random) == {}
    assert random.bit_generator.state == np.random.default_rng(1).bit_generator.state


# Never into each other.


def test_sampled_objects_overlap_neither_each_other_nor_fixed_bodies() -> None:
    """Half of the table is covered, so most first draws overlap something."""
    ranges = {"x": [-0.35, 0.35], "y": [-0.35, 0.35], "z": [0.66, 0.75], "yaw_deg": [-180, 180]}
    ranges |= {"roll_deg": [-20, 20], "pitch_deg": [-20, 20]}
    names = ["one", "two", "three"]
    ball = {"name": "ball", "shape": "sphere", "radius": 0.1, "position": [0.25, 0.25, 0.7]}
    duck = {"file": "duck", "position": [-0.2, 0, 0.7], "random": {"x": [-0.3, 0.3], "y": [-0.3, 0.3]}}
    with bench(*(brick(name, random=ranges) for name in names), ball, duck) as rig:
        for seed in range(40):
            for name, pose in drawn(rig, seed).items():
                rig.world.reset(name, pose=pose)
            for a, b in combinations([*names, "duck", "ball", "table"], 2):
                assert (a, b) == ("ball", "table") or not overlap(rig, a, b), f"{a} and {b}, seed {seed}"
            rig.clock.sleep(1 / 240)
            depths = [-contact.distance for contact in rig.world.contacts()]
            assert max(depths, default=0.0) < 0.001, "the boxes are no smaller than the things"


def test_what_touches_as_configured_may_touch_and_what_stands_in_something_may_stand_in_it() -> None:
    crate = brick("crate", half_extents=[0.2, 0.2, 0.2], position=[0.2, 0.2, 0.8], fixed=True)
    resting = brick("resting", position=[-0.3, 0, 0.628], random={"x": [-0.35, -0.25], "yaw_deg": [-20, 20]})
    inside = brick("inside", position=[0.2, 0.05, 0.75], random={"x": [0.15, 0.25], "y": [0.05, 0.25]})
    with bench(crate, resting, inside) as rig:
        assert list(drawn(rig, 3)) == ["resting", "inside"]
    # Tilted, its edges would be in the table.
    with bench({**resting, "random": {"pitch_deg": [10, 20]}}) as rig, raises_code(hal.CommandError, "no_room"):
        drawn(rig, 3)


def test_a_plane_is_solid_below_also_where_it_is_tilted() -> None:
    slope = Pose.from_rpy([0, 0, 0], [0, -np.pi / 4, 0]).orientation.tolist()  # it rises with x
    hill = {"name": "hill", "shape": "plane", "position": [0.5, 0, 0.7], "orientation": slope}
    with bench(hill, brick("brick", position=[0, 0, 0.9], random={"x": [-0.3, 0.6]})) as rig:
        found = [drawn(rig, seed)["brick"].position[0] for seed in range(100)]
    # The edge that is lowest and farthest, at (x + 0.1, 0.87), is above it where x + 0.1 - 0.5 < 0.17.
    assert 0.5 < max(found) < 0.5700001


def test_bodies_without_collision_are_no_obstacles() -> None:
    ranges = {"x": [-0.04, 0.04], "y": [-0.04, 0.04]}  # too small for two
    goal = brick("goal", collision=False, random=ranges)
    with bench(goal, brick("here", collision=False), brick("brick", random=ranges)) as rig:
        size = {"half_extents": (0.2, 0.2, 0.2), "collision": False}
        rig.world.add(hal.BodySpec("there", (0.0, 0.0, 0.7), (0, 0, 0, 1), "box", **size))
        assert list(drawn(rig, 1)) == ["goal", "brick"]


def test_a_full_bench_is_an_error_that_names_the_obstacles() -> None:
    ranges = {"x": [-0.05, 0.05]}
    red, blue, wall = brick("red", random=ranges), brick("blue", random=ranges), brick("wall")
    message = r"no room for 'blue'.*overlapped 'red'; .*`random`"
    with bench(red, blue) as rig, pytest.raises(hal.CommandError, match=message):
        drawn(rig, 1)
    red |= {"position": [0.25, 0, 0.7]}
    with bench(red, wall) as rig, pytest.raises(hal.CommandError, match=r"no room for 'red'.*overlapped 'wall'"):
        drawn(rig, 1)


def test_when_one_takes_the_room_of_the_next_both_are_resampled() -> None:
    """The second fits only where the first is at one of the ends of its range."""
    first = brick("first", position=[0.3, 0.3, 0.7], random={"x": [-0.3, 0.3], "y": [0, 0]})
    second = brick("second", position=[0.3, 0.3, 0.7], random={"x": [-0.1, 0.1], "y": [0, 0]})
    with bench(first, second) as rig:
        for seed in range(20):
            poses = drawn(rig, seed)
            assert abs(poses["first"].position[0] - poses["second"].position[0]) >= 0.2


def test_a_removed_object_is_not_sampled_and_an_added_one_is_an_obstacle() -> None:
    ranges = {"x": [-0.3, 0.3]}
    with bench(brick("red", random=ranges), brick("blue", random=ranges)) as rig:
        rig.world.remove("blue")
        rig.world.add(hal.BodySpec("post", (0.1, 0.0, 0.8), (0, 0, 0, 1), "box", half_extents=(0.2, 0.2, 0.2)))
        for seed in range(20):
            poses = drawn(rig, seed)
            assert list(poses) == ["red"]
            assert poses["red"].position[0] < -0.2


# Putting them there.


def test_given_poses_win_and_the_others_keep_clear_of_them() -> None:
    ranges = {"x": [-0.35, 0.35], "y": [-0.2, 0.2]}
    things = [brick("red", random=ranges), brick("blue", random=ranges), brick("duck", position=[0, 0.4, 0.7])]
    here = Pose([0.05, 0.0, 0.7])  # where blue would be without a draw
    with bench(*things) as rig:
        for seed in range(20):
            put = reset_scene(rig, rig.robots["arm"], poses={"red": here}, random=np.random.default_rng(seed))
            assert list(put) == ["red", "blue"]
            assert put["red"] == here
            for name, pose in put.items():
                assert rig.world.pose(name).distance(pose) == pytest.approx((0, 0), abs=1e-5)
            assert not overlap(rig, "red", "blue")
        assert reset_scene(rig, rig.robots["arm"]) == {}, "without a generator nothing is drawn"
        assert rig.world.pose("blue").position == pytest.approx([0, 0, 0.7])


def test_in_real_time_the_same_seed_gives_the_same_poses() -> None:
    """Things fall while they are asked for."""
    ranges = {"x": [-0.3, 0.3], "y": [-0.3, 0.3], "yaw_deg": [-180, 180]}
    duck = {"file": "duck", "random": ranges}
    things = [brick("red", random=ranges), brick("blue", random=ranges), duck]
    with bench(*things, clock="real_time") as rig:
        first = [drawn(rig, seed) for seed in range(2)]
        again = [drawn(rig, seed) for seed in range(2)]
    assert first == again


def test_a_real_arm_beside_a_simulated_world_moves_before_objects_are_placed() -> None:
    mock = {"drivers": {"real": "mock"}}
    eye = {"model": "pinhole", "sim": True, "look_at": {"target": [0, 0, 0.6], "distance": 1.5, "pitch_deg": -40}}
    config = {
        "sim": False,
        "robots": {"arm": {**FAR["arm"], **mock, "gripper": mock}},
        "cameras": {"eye": {**eye, "output": {"width": 64, "height": 48}}},
        "objects": ["floor", TABLE, brick("red", random={"x": [-0.3, 0.3]}), brick("blue", position=[0, 0.3, 0.7])],
    }
    with hal.open(config, clock="real_time", pad="none") as rig:
        arm = rig.robots["arm"]
        q = arm.home + 0.05
        with pytest.raises(hal.CommandError, match="dead"):
            reset_scene(rig, arm, q, random=np.random.default_rng(2))
        put = reset_scene(rig, arm, q, random=np.random.default_rng(2), unattended=True)
        assert np.abs(arm.state().q - q).max() < 0.01
        assert list(put) == ["red"]
        assert rig.world.pose("red").position[:2] == pytest.approx(put["red"].position[:2], abs=0.01)
        lower, upper = rig.world.aabb("red")
        assert upper[2] > lower[2] > 0.59


def test_the_builtin_bench_has_a_cube_that_starts_in_front_of_the_arm() -> None:
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        for seed in range(8):
            put = reset_scene(rig, rig.robots["panda"], random=np.random.default_rng(seed))
            assert list(put) == ["cube"]
            assert not overlap(rig, "cube", "duck")
            rig.clock.sleep(0.5)
            assert rig.world.pose("cube").position == pytest.approx([*put["cube"].position[:2], 0.63], abs=0.005)
            frame = rig.cameras["scene"].read()
            x, y, z = frame.T_world_camera.inverse().transform(rig.world.pose("cube").position)
            u, v, _ = frame.K @ [x / z, y / z, 1.0]
            assert frame.depth[round(v), round(u)] == pytest.approx(z, abs=0.06), "nothing hides it"
            red, green, blue = (int(value) for value in frame.color[round(v), round(u)])
            assert red > green + 20
            assert blue > green
