"""The contract of simulated worlds, :class:`hal.world.WorldDriver`: bodies, poses, edits, contacts, resets, states.

The worlds of the checks consist of simple shapes, and of a small arm whose URDF the checks write themselves.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ..errors import CommandError, ConfigError, DeviceNotFound, HalError, NotSupported
from ..specs import to_json
from ..world import WorldDriver
from .benches import Contract, needs
from .world_bench import FINGERS, GRAVITY, JOINTS, UPRIGHT, WorldBench, body, cabinet, cube, floor

_PROPERTIES = (
    *("lateral_friction", "rolling_friction", "spinning_friction", "restitution"),
    *("linear_damping", "angular_damping", "contact_stiffness", "contact_damping"),
)
"""Properties of ``dynamics`` besides mass and inertia."""


def _steps(world: WorldDriver, seconds: float) -> WorldDriver:
    for _ in range(round(seconds / world.dt)):
        world.step()
    return world


def _position(world: WorldDriver, name: str, link: str | None = None) -> np.ndarray:
    return np.array(world.request("pose", {"name": name, "link": link})["position"])


def _speed(world: WorldDriver, name: str) -> float:
    """Return how fast a body moves, m/s."""
    return float(np.linalg.norm(world.request("velocity", {"name": name})[0]))


class WorldContract(Contract):
    """Checks of a simulated world. The bench is a :class:`~hal.testing.WorldBench`.

    ``left_out`` may name ``physics``, for an engine that only places bodies: without gravity, forces, contacts, shapes
    and dynamics, whose requests raise NotSupported or find nothing.
    """

    abilities = ("physics",)

    @pytest.fixture(autouse=True)
    def _close_worlds(self, bench: WorldBench) -> Iterator[None]:
        yield
        for world in bench.made:
            world.close()
            world.close()

    # Time.

    @needs("physics")
    def test_a_step_is_one_period_of_the_physics(self, bench: WorldBench) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)), physics_hz=500.0)
        assert (world.dt, world.t, world.steps) == (0.002, 0.0, 0)
        _steps(world, 0.5)
        assert world.steps == 250
        assert world.t == pytest.approx(0.5), "t is the number of steps times dt"
        assert 1.0 - _position(world, "cube")[2] == pytest.approx(0.5 * GRAVITY * 0.25, rel=0.02), "it falls freely"

    def test_two_worlds_that_are_made_alike_agree_to_the_bit(self, bench: WorldBench, tmp_path: Path) -> None:
        things = floor(), cube((0.3, 0.0, 0.2)), bench.arm(tmp_path)
        one, other = (_steps(bench.world(*things), 0.5) for _ in range(2))
        assert one.snapshot() == other.snapshot()

    def test_the_version_changes_with_whatever_may_look_different(self, bench: WorldBench) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)))
        seen = [world.version]
        for act in (
            world.step,
            lambda: world.request("set_color", {"name": "cube", "rgba": [1, 0, 0, 1]}),
            lambda: world.request("set_pose", {"name": "cube", "pose": {"position": [0, 0, 2]}}),
            lambda: world.request("reset", {}),
        ):
            act()
            seen.append(world.version)
        assert len(set(seen)) == len(seen)
        assert world.version == seen[-1], "and with nothing else"

    # Bodies and poses.

    def test_objects_come_before_robots_and_have_their_place_as_index(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(floor(), cube((1.0, 0.0, 0.5)), bench.arm(tmp_path))
        assert world.request("names", {}) == ["floor", "cube", "arm"]
        assert [world.request("describe", {"name": name})["index"] for name in ("floor", "cube", "arm")] == [0, 1, 2]
        arm = world.request("describe", {"name": "arm"})
        assert (arm["robot"], arm["spec"]) == (True, None)
        assert world.request("describe", {"name": "cube"})["spec"] == to_json(cube((1.0, 0.0, 0.5)))
        assert {"base", "upper", "hand", "left", "right"} <= set(arm["links"])
        assert {*JOINTS, *FINGERS} <= set(arm["joints"])

    def test_bodies_stand_where_their_records_place_them(self, bench: WorldBench, tmp_path: Path) -> None:
        turned = (0.0, 0.0, math.sin(0.2), math.cos(0.2))
        arm = bench.arm(tmp_path, base_position=(0.5, 0.6, 0.7), base_orientation=turned)
        world = bench.world(cube((1.0, 2.0, 3.0), orientation=turned), arm)
        for name, position in (("cube", (1.0, 2.0, 3.0)), ("arm", (0.5, 0.6, 0.7))):
            pose = world.request("pose", {"name": name})
            assert np.allclose(pose["position"], position, atol=1e-9)
            assert np.allclose(pose["orientation"], turned, atol=1e-9), "orientations are x, y, z, w"
        assert np.allclose(_position(world, "arm", "upper"), (0.5, 0.6, 0.75), atol=1e-9), "of the link's own frame"
        assert np.allclose(_position(world, "arm", "hand"), (0.5, 0.6, 1.05), atol=1e-9)

    def test_poses_are_of_one_moment(self, bench: WorldBench) -> None:
        world = _steps(bench.world(floor(), cube((0.0, 0.0, 1.0))), 0.1)
        found = world.request("poses", {"names": None})
        assert found["t"] == world.t
        assert found["poses"] == {name: world.request("pose", {"name": name}) for name in ("floor", "cube")}
        assert list(world.request("poses", {"names": ["cube"]})["poses"]) == ["cube"]

    @needs("physics")
    @pytest.mark.parametrize(
        ("shape", "size", "half"),
        [
            ("box", {"half_extents": (0.05, 0.06, 0.07)}, (0.05, 0.06, 0.07)),
            ("sphere", {"radius": 0.06}, (0.06, 0.06, 0.06)),
            ("cylinder", {"radius": 0.05, "length": 0.12}, (0.05, 0.05, 0.06)),
            ("capsule", {"radius": 0.05, "length": 0.12}, (0.05, 0.05, 0.11)),
        ],
    )
    def test_shapes_have_their_size_and_rest_on_a_plane(
        self, bench: WorldBench, shape: str, size: dict[str, Any], half: tuple[float, ...]
    ) -> None:
        world = bench.world(floor(), body("it", shape, (0.0, 0.0, 0.2), **size))
        box = world.request("aabb", {"name": "it"})
        assert np.allclose(box["lower"], np.array([0.0, 0.0, 0.2]) - half, atol=0.003)
        assert np.allclose(box["upper"], np.array([0.0, 0.0, 0.2]) + half, atol=0.003)
        _steps(world, 1.0)
        assert _position(world, "it")[2] == pytest.approx(half[2], abs=0.003)

    @needs("physics")
    def test_a_placed_body_is_at_rest(self, bench: WorldBench) -> None:
        world = _steps(bench.world(cube((0.0, 0.0, 1.0))), 0.3)
        assert _speed(world, "cube") > 2.0
        world.request("set_pose", {"name": "cube", "pose": {"position": [1, 2, 3], "orientation": [0, 0, 1, 0]}})
        pose = world.request("pose", {"name": "cube"})
        assert np.allclose(pose["position"], (1.0, 2.0, 3.0))
        assert np.allclose(np.abs(pose["orientation"]), (0.0, 0.0, 1.0, 0.0))
        assert _speed(world, "cube") == 0.0

    def test_a_velocity_moves_a_body(self, bench: WorldBench) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)), gravity=(0.0, 0.0, 0.0))
        world.request("set_velocity", {"name": "cube", "linear": [0.5, 0.0, -0.2], "angular": [0.0, 0.0, 1.0]})
        linear, angular = world.request("velocity", {"name": "cube"})
        assert np.allclose((*linear, *angular), (0.5, 0.0, -0.2, 0.0, 0.0, 1.0))
        _steps(world, 0.2)
        assert np.allclose(_position(world, "cube"), (0.1, 0.0, 0.96), atol=0.003)
        x, y, z, w = world.request("pose", {"name": "cube"})["orientation"]
        assert np.allclose((x, y), 0.0, atol=1e-6)
        assert 2 * math.atan2(z, w) == pytest.approx(0.2, abs=0.01)

    @needs("physics")
    def test_a_force_accelerates_a_body_for_as_long_as_it_acts(self, bench: WorldBench, tmp_path: Path) -> None:
        arm = bench.arm(tmp_path, base_position=(3.0, 0.0, 0.0))
        world = bench.world(cube((0.0, 0.0, 1.0)), cube((1.0, 0.0, 1.0), name="fixed", fixed=True), arm)
        assert world.request("set_gravity", {"gravity": [0, 0, 0]}) == [0.0, 0.0, -GRAVITY], "the gravity before"
        world.request("apply_force", {"name": "cube", "force": [1.5, 0, 0], "duration": 0.5})
        world.request("apply_force", {"name": "cube", "force": [0.5, 0, 0], "duration": 0.5})
        for _ in range(2):
            linear, angular = _steps(world, 0.5).request("velocity", {"name": "cube"})
            assert np.allclose((*linear, *angular), (1.0, 0, 0, 0, 0, 0), atol=0.1), "N s / kg, and no longer"
        world.request("reset", {})
        beside = (_position(world, "cube") + (0.0, 0.02, 0.0)).tolist()
        world.request("apply_force", {"name": "cube", "force": [1, 0, 0], "point": beside})
        world.step()
        linear, angular = world.request("velocity", {"name": "cube"})
        assert linear[0] == pytest.approx(world.dt, rel=0.01), "one step by default"
        inertia = world.request("dynamics", {"name": "cube"})["inertia"][2]
        assert angular[2] == pytest.approx(-0.02 * world.dt / inertia, rel=0.01), "a force beside the centre turns it"
        finger = _position(world, "arm", "left")
        world.request("apply_force", {"name": "arm", "link": "left", "force": [0, 5000, 0]})
        world.step()
        assert _position(world, "arm", "left")[1] > finger[1] + 1e-4, "more than its motor can hold"
        for params, code in (
            ({"name": "fixed"}, "base_fixed"),
            ({"name": "arm"}, "base_fixed"),
            ({"name": "cube", "force": [0, 0, math.nan]}, "not_finite"),
            ({"name": "cube", "duration": -1.0}, "bad_command"),
        ):
            with pytest.raises(CommandError) as refused:
                world.request("apply_force", {"force": [1, 0, 0], **params})
            assert refused.value.code == code, params

    @needs("physics")
    def test_a_ray_meets_the_nearest_body(self, bench: WorldBench) -> None:
        world = bench.world(floor(), cube((0.0, 0.0, 1.0)), cube((0.0, 0.0, 2.0), name="seen", collision=False))
        hit = world.request("ray", {"start": [0, 0, 3], "end": [0, 0, -1]})
        assert (hit["name"], hit["link"]) == ("cube", "base")
        assert np.allclose((*hit["position"], *hit["normal"]), (0, 0, 1.05, 0, 0, 1), atol=1e-3)
        assert hit["distance"] == pytest.approx(1.95, abs=1e-3)
        assert world.request("ray", {"start": [1, 0, 3], "end": [1, 0, -1]})["name"] == "floor"
        assert world.request("ray", {"start": [1, 0, 3], "end": [1, 0, 1]}) is None

    @needs("physics")
    def test_the_distance_of_two_bodies(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(floor(), cube((0.0, 0.0, 1.0)), bench.arm(tmp_path, base_position=(0.0, 1.0, 0.5)))
        base = world.request("distance", {"a": "arm", "b": "cube", "link_a": "base"})
        assert base == pytest.approx(math.hypot(0.9, 0.4), abs=3e-3)
        assert world.request("distance", {"a": "arm", "b": "cube"}) < base - 0.01
        for z, apart in ((1.0, 0.95), (0.03, -0.02)):
            world.request("set_pose", {"name": "cube", "pose": {"position": [0, 0, z]}})
            assert world.request("distance", {"a": "cube", "b": "floor"}) == pytest.approx(apart, abs=2e-3)
        with pytest.raises(CommandError) as refused:
            world.request("add", {"spec": to_json(cube((0.0, 0.0, 5.0), name="seen", collision=False))})
            world.request("distance", {"a": "cube", "b": "seen"})
        assert refused.value.code == "no_shape"

    def test_a_body_without_mass_and_a_fixed_one_stay(self, bench: WorldBench) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0), mass=0.0), cube((1.0, 0.0, 1.0), name="fixed", fixed=True))
        before = world.snapshot()
        assert _steps(world, 0.2).snapshot() == before
        with pytest.raises(CommandError) as refused:
            world.request("set_velocity", {"name": "cube", "linear": [1, 0, 0]})
        assert refused.value.code == "base_fixed"

    @needs("physics")
    def test_a_body_without_collision_touches_nothing(self, bench: WorldBench) -> None:
        world = _steps(bench.world(floor(), cube((0.0, 0.0, 0.1), collision=False)), 0.5)
        assert _position(world, "cube")[2] < -0.5

    # Joints of objects.

    def test_the_joints_of_an_object_can_be_placed(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(cabinet(tmp_path), bench.arm(tmp_path, base_position=(3.0, 0.0, 0.0)))
        found = world.request("describe", {"name": "cabinet"})
        assert found["links"] == ["frame", "drawer", "left", "right"]
        assert list(found["movable"]) == ["slide", "hinge", "other"]
        slide = {"kind": "prismatic", "lower": 0.0, "upper": 1.0, "damping": 5.0, "friction": 2.0, "follows": None}
        assert found["movable"]["slide"] == slide
        world.request("set_joint_positions", {"name": "cabinet", "positions": {"slide": 0.3, "hinge": 0.5}})
        there = {"slide": 0.3, "hinge": 0.5, "other": -0.5}
        assert world.request("joint_positions", {"name": "cabinet"}) == pytest.approx(there), "a mimic follows"
        assert _position(world, "cabinet", "drawer") == pytest.approx((0.3, 0.0, 1.0), abs=1e-6)
        for name, positions, code in (
            ("cabinet", {"slide": 1.5}, "out_of_range"),
            ("cabinet", {"other": 0.1}, "joint_follows"),
            ("cabinet", {"slide": math.nan}, "not_finite"),
            ("cabinet", {"slid": 0.1}, "unknown_joint"),
            ("arm", {"turn": 0.1}, "is_robot"),
        ):
            with pytest.raises(HalError) as refused:
                world.request("set_joint_positions", {"name": name, "positions": positions})
            assert refused.value.code == code, positions
        assert world.request("joint_positions", {"name": "cabinet"}) == pytest.approx(there), "nothing changed"

    @needs("physics")
    def test_the_joints_of_an_object_have_the_friction_and_damping_of_its_file(
        self, bench: WorldBench, tmp_path: Path
    ) -> None:
        world = bench.world(cabinet(tmp_path))
        world.request("apply_force", {"name": "cabinet", "link": "drawer", "force": [1.5, 0, 0], "duration": 0.5})
        assert _steps(world, 0.5).request("joint_positions", {"name": "cabinet"})["slide"] < 1e-4, "friction holds it"
        world.request("apply_force", {"name": "cabinet", "link": "drawer", "force": [10, 0, 0], "duration": 0.5})
        beyond = 10.0 - 2.0  # N; the speed approaches that / 5 Ns/m
        way = beyond / 5.0 * (0.5 - (1.0 - math.exp(-5.0 * 0.5)) / 5.0)
        moved = _steps(world, 0.5).request("joint_positions", {"name": "cabinet"})["slide"]
        assert moved == pytest.approx(way, rel=0.02)

    # Contacts and dynamics.

    @needs("physics")
    def test_contacts_hold_the_weight(self, bench: WorldBench) -> None:
        world = _steps(bench.world(floor(), cube((0.0, 0.0, 0.051), mass=2.0)), 1.0)
        contacts = world.request("contacts", {"a": "cube", "b": "floor"})
        assert sum(contact["force"] for contact in contacts) == pytest.approx(2.0 * GRAVITY, rel=0.05), "N"
        for contact in contacts:
            assert (contact["a"], contact["b"]) == ("cube", "floor")
            assert np.allclose(contact["normal"], (0.0, 0.0, 1.0), atol=0.01), "from b to a"
            assert abs(contact["distance"]) < 0.003, "m, negative where they overlap"
            assert abs(contact["position"][2]) < 0.003, "on b, in the world"
        turned = world.request("contacts", {"a": "floor", "b": "cube"})
        assert {(contact["a"], contact["b"]) for contact in turned} == {("floor", "cube")}
        assert len(world.request("contacts", {})) == len(contacts)
        assert world.request("contacts", {"a": "cube"}) == contacts

    @needs("physics")
    def test_directly_after_an_edit_there_are_no_contacts_yet(self, bench: WorldBench) -> None:
        world = _steps(bench.world(floor(), cube((0.0, 0.0, 0.051))), 0.5)
        for method, params in (
            ("set_dynamics", {"name": "cube", "lateral_friction": 0.4}),
            ("set_pose", {"name": "cube", "pose": {"position": [0.1, 0, 0.05]}}),
            ("reset", {}),
        ):
            found = _steps(world, 0.5).request("contacts", {"stamped": True})
            assert found["t"] == world.t, "of the last step"
            assert found["contacts"]
            world.request(method, params)
            assert world.request("contacts", {"stamped": True}) == {"t": None, "contacts": []}

    @needs("physics")
    def test_half_of_a_soft_contact_is_refused_with_the_other_half(self, bench: WorldBench) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)))
        with pytest.raises(CommandError) as refused:
            world.request("set_dynamics", {"name": "cube", "contact_damping": 1.0})
        assert refused.value.code == "contact_incomplete"
        proposed = str(refused.value).partition("add contact_stiffness=")[2].partition(" ")[0]
        world.request("set_dynamics", {"name": "cube", "contact_damping": 1.0, "contact_stiffness": float(proposed)})
        assert world.request("dynamics", {"name": "cube"})["contact_damping"] == pytest.approx(1.0)

    @needs("physics")
    def test_set_dynamics_returns_what_was_set_before(self, bench: WorldBench) -> None:
        world = bench.world(floor(), cube((0.0, 0.0, 0.05)))
        before = world.request("dynamics", {"name": "cube"})
        assert before["mass"] == pytest.approx(1.0)
        inertia = before["inertia"]
        old = world.request("set_dynamics", {"name": "cube", "mass": 3.0, "lateral_friction": 0.2})
        assert old == {key: before[key] for key in old}
        now = world.request("dynamics", {"name": "cube"})
        assert (now["mass"], now["lateral_friction"]) == (pytest.approx(3.0), pytest.approx(0.2))
        assert now["inertia"] == pytest.approx([3.0 * value for value in inertia]), "it scales with the mass"
        world.request("set_dynamics", {"name": "cube", **old, "inertia": inertia})
        again = world.request("dynamics", {"name": "cube"})
        assert again.pop("inertia") == pytest.approx(before.pop("inertia"))
        assert again == pytest.approx(before)

    @needs("physics")
    def test_less_friction_lets_a_body_slide_farther(self, bench: WorldBench) -> None:
        ways = []
        for friction in (0.4, 0.8):
            world = bench.world(floor(), cube((0.0, 0.0, 0.05)))
            for name in ("floor", "cube"):
                world.request("set_dynamics", {"name": name, "lateral_friction": friction})
            _steps(world, 0.1)
            world.request("set_velocity", {"name": "cube", "linear": [1.0, 0.0, 0.0]})
            ways.append(_position(_steps(world, 2.0), "cube")[0])
            assert _speed(world, "cube") < 0.02
        assert ways[0] > 1.3 * ways[1]

    @needs("physics")
    @pytest.mark.parametrize(
        "values", [{"mass": -1.0}, {"lateral_friction": math.nan}, {"colour": 1.0}, {"mass": "heavy"}]
    )
    def test_impossible_dynamics_are_refused(self, bench: WorldBench, values: dict[str, Any]) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)))
        before = world.request("dynamics", {"name": "cube"})
        with pytest.raises(CommandError):
            world.request("set_dynamics", {"name": "cube", **values})
        assert world.request("dynamics", {"name": "cube"}) == before

    @needs("physics")
    @pytest.mark.parametrize("name", _PROPERTIES)
    def test_a_property_exists_or_is_refused_by_name(self, bench: WorldBench, name: str) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)))
        before = world.request("dynamics", {"name": "cube"})
        value = 2e4 if name == "contact_stiffness" else 0.25
        both = {"contact_stiffness": 2e4, "contact_damping": 0.25}
        refused: NotSupported | None = None
        try:
            world.request("set_dynamics", {"name": "cube", **(both if name in both else {name: value})})
        except NotSupported as error:
            refused = error
        after = world.request("dynamics", {"name": "cube"})
        if refused is None:
            assert after[name] == pytest.approx(value)
        else:
            assert name in str(refused), "the error names the property"
            assert after == before, "nothing changed"

    # Edits.

    def test_edits_are_counted_and_announced(self, bench: WorldBench) -> None:
        world = bench.world(floor())
        announced: list[tuple[str, int]] = []
        world.on_edit(lambda method, params, revision: announced.append((method, revision)))
        assert world.request("add", {"spec": to_json(cube((0.0, 0.0, 1.0)))}) == 1
        assert world.request("set_color", {"name": "cube", "rgba": [1, 0, 0, 1]}) == 2
        world.request("set_pose", {"name": "cube", "pose": {"position": [0, 0, 2]}})
        _steps(world, 0.1)
        world.request("reset", {})
        assert world.revision == 2, "what changes poses only is no edit"
        assert world.request("remove", {"name": "cube"}) == world.revision == 3
        assert announced == [("add", 1), ("set_color", 2), ("remove", 3)]
        assert world.request("names", {}) == ["floor"]

    @needs("physics")
    def test_an_added_body_comes_last_and_takes_part(self, bench: WorldBench, tmp_path: Path) -> None:
        world = _steps(bench.world(floor(), bench.arm(tmp_path)), 0.2)
        before = world.snapshot()
        world.request("add", {"spec": to_json(cube((0.6, 0.0, 0.2)))})
        assert world.request("names", {}) == ["floor", "arm", "cube"]
        assert world.snapshot()[: len(before)] == before, "what was there keeps its state"
        _steps(world, 1.0)
        assert _position(world, "cube")[2] == pytest.approx(0.05, abs=0.003)
        world.request("remove", {"name": "cube"})
        assert world.request("describe", {"name": "arm"})["index"] == 1
        assert len(world.snapshot()) == len(before)

    def test_what_cannot_be_edited_is_refused(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(floor(), cube((1.0, 0.0, 1.0)), bench.arm(tmp_path))
        there = {"position": [0, 0, 1]}
        for method, params, code in (
            ("remove", {"name": "arm"}, "is_robot"),
            ("set_pose", {"name": "arm", "pose": there}, "is_robot"),
            ("reset", {"name": "arm", "pose": there}, "is_robot"),
            ("reset", {"q": [0.0, 0.0]}, "name_missing"),
            ("reset", {"name": "arm", "q": [0.0]}, "wrong_size"),
        ):
            with pytest.raises(CommandError) as refused:
                world.request(method, params)
            assert refused.value.code == code, method
        with pytest.raises(ConfigError) as wrong:
            world.request("add", {"spec": to_json(cube((0.0, 0.0, 1.0)))})
        assert wrong.value.problems[0].code == "duplicate_name"
        assert world.revision == 0, "a refused edit is none"

    # Requests.

    def test_unknown_names_are_device_not_found(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(cube((1.0, 0.0, 1.0)), bench.arm(tmp_path))
        for method, params, code in (
            ("pose", {"name": "cub"}, "unknown_body"),
            ("pose", {"name": "arm", "link": "elbow"}, "unknown_link"),
            ("contacts", {"a": "cub"}, "unknown_body"),
            ("remove", {"name": "cub"}, "unknown_body"),
        ):
            with pytest.raises(DeviceNotFound) as refused:
                world.request(method, params)
            assert refused.value.code == code, method

    def test_wrong_requests_are_command_errors(self, bench: WorldBench) -> None:
        world = bench.world(cube((0.0, 0.0, 1.0)))
        for method, params in (
            ("explode", {}),
            ("close", {}),
            ("pose", {}),
            ("pose", {"name": "cube", "colour": 1}),
            ("set_pose", {"name": "cube", "pose": {"position": [0, 0, math.nan]}}),
            ("set_pose", {"name": "cube", "pose": {"position": [0, 0]}}),
            ("set_velocity", {"name": "cube", "linear": [0, 0, math.inf]}),
            ("set_color", {"name": "cube", "rgba": [2, 0, 0, 1]}),
        ):
            with pytest.raises(CommandError):
                world.request(method, params)

    @needs("physics")
    def test_results_travel_as_json(self, bench: WorldBench, tmp_path: Path) -> None:
        world = _steps(bench.world(floor(), cube((1.0, 0.0, 0.05)), bench.arm(tmp_path)), 0.1)
        for method, params in (
            ("describe", {"name": "arm"}),
            ("pose", {"name": "arm", "link": "hand"}),
            ("poses", {}),
            ("velocity", {"name": "cube"}),
            ("dynamics", {"name": "arm", "link": "upper"}),
            ("contacts", {}),
            ("aabb", {"name": "arm"}),
        ):
            found = world.request(method, params)
            assert json.loads(json.dumps(found, allow_nan=False)) == found, method

    # Resets and states.

    def test_reset_returns_everything_to_its_start(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(floor(), cube((0.6, 0.0, 0.3)), bench.arm(tmp_path))
        resets: list[int] = []
        world.on_reset("arm", lambda: resets.append(world.steps))
        start = world.snapshot()
        first = _steps(world, 0.4).snapshot()
        world.request("reset", {})
        assert (world.snapshot(), resets) == (start, [world.steps])
        assert world.t == pytest.approx(0.4), "time continues"
        assert np.allclose(_steps(world, 0.4).snapshot(), first, atol=1e-9), "and takes the same course again"

    @needs("physics")
    def test_reset_of_one_body_to_another_state(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(cube((1.0, 0.0, 1.0)), bench.arm(tmp_path))
        _steps(world, 0.1)
        world.request("reset", {"name": "arm", "q": [0.0, math.pi / 2]})
        left = _position(world, "arm", "left")
        assert np.allclose(left[[0, 2]], (0.1, 0.35), atol=1e-6), "q are the positions of the arm's joints, rad"
        assert _position(world, "cube")[2] < 0.999, "other bodies stay"
        world.request("reset", {"name": "cube", "pose": {"position": [2, 0, 1]}})
        assert np.allclose(_position(world, "cube"), (2.0, 0.0, 1.0))
        assert _speed(world, "cube") == 0.0

    def test_a_snapshot_has_the_layout_of_every_engine(self, bench: WorldBench, tmp_path: Path) -> None:
        """Fixed bases first, then each body that moves: the pose of a free base, and its joints in the URDF's order."""
        world = bench.world(cube((1.0, 0.0, 1.0)), floor(), bench.arm(tmp_path))
        world.request("reset", {"name": "arm", "q": [0.1, 0.2, 0.01, 0.02]})
        ground, arm, box, joints = np.split(np.array(world.snapshot()), [7, 14, 21])
        assert np.allclose(ground, (0, 0, 0, *UPRIGHT), atol=1e-9)
        assert np.allclose(arm, (0, 0, 0, *UPRIGHT), atol=1e-9)
        assert np.allclose(box, (1, 0, 1, *UPRIGHT), atol=1e-9)
        assert np.allclose(joints, (0.1, 0.2, 0.01, 0.02), atol=1e-9)

    def test_a_restored_state_continues_as_it_did(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(floor(), cube((0.6, 0.0, 0.3)), bench.arm(tmp_path))
        _steps(world, 0.25)
        state, here = json.loads(json.dumps(world.request("save", {}))), world.snapshot()
        there = _steps(world, 0.5).snapshot()
        world.request("set_pose", {"name": "cube", "pose": {"position": [2, 2, 2]}})
        world.request("restore", {"state": state})
        assert np.allclose(world.snapshot(), here, atol=1e-9)
        assert world.t == pytest.approx(0.75), "time continues"
        assert _steps(world, 0.5).snapshot() == there, "to the bit"
        with pytest.raises(CommandError) as refused:
            bench.world(floor()).request("restore", {"state": state})
        assert refused.value.code == "wrong_state", "it is a state of other bodies"

    # The mirror of a real arm.

    def test_a_mirror_follows_its_arm(self, bench: WorldBench, tmp_path: Path) -> None:
        world = bench.world(floor(), bench.arm(tmp_path, driver="elsewhere"))
        for bend in np.linspace(0.0, 1.0, 49):
            world.follow("arm", [0.0, float(bend)], [0.0, 5.0], 0.04)
            world.step()
        z = _position(world, "arm", "left")[2]
        assert z == pytest.approx(0.35 + 0.1 * math.cos(1.0), abs=2e-3), "it is where the arm is"
        gap = _position(world, "arm", "left") - _position(world, "arm", "right")
        assert np.linalg.norm(gap) == pytest.approx(0.04, abs=2e-3), "and so are its fingers"
        for q in ([math.nan, 0.0], [0.0]):
            with pytest.raises(CommandError):
                world.follow("arm", q, [0.0, 0.0])
        with pytest.raises(CommandError) as refused:
            world.request("reset", {"name": "arm"})
        assert refused.value.code == "is_mirrored"
        with pytest.raises(HalError):
            world.follow("floor", [0, 0], [0, 0])
        assert all(math.isfinite(value) for value in itertools.chain(world.snapshot()))
