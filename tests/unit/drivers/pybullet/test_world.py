"""The simulated world: what stands in it, edits, resets, dynamics, contacts, mirrors, and bad input."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code
from numpy.typing import NDArray
from specs import IIWA_HOME, PANDA_HOME, box, cube, data, floor, iiwa, panda, world_spec

from hal.config.data_files import data_folder
from hal.config.loader import load
from hal.drivers.pybullet.world import PyBulletWorld
from hal.errors import CommandError, ConfigError, DeviceNotFound, NotSupported
from hal.geometry import Pose
from hal.specs import BodySpec, to_json

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


@pytest.fixture(scope="module")
def one_scene() -> Iterator[PyBulletWorld]:
    world = scene()
    yield world
    world.close()


@pytest.fixture
def world(one_scene: PyBulletWorld) -> PyBulletWorld:
    """The scene for tests that leave its bodies and their dynamics as they were: loading it is most of a test."""
    one_scene.reset()
    return one_scene


class TestStepping:
    def test_two_worlds_agree_bit_for_bit(self) -> None:
        one, other = run(scene(), 1000), run(scene(), 1000)
        assert np.abs(one[-1] - one[0]).max() > 0.01  # something fell
        assert np.array_equal(one, other)

    def test_free_fall(self) -> None:
        world = PyBulletWorld(world_spec(cube((0.0, 0.0, 10.0))))
        world.set_dynamics("cube", linear_damping=0.0)
        run(world, 240)
        n, dt = 240, world.dt
        assert world.t == n * dt == 1.0
        assert 10.0 - pose(world, "cube").position[2] == pytest.approx(9.81 * dt * dt * n * (n + 1) / 2, rel=1e-9)

    def test_importing_and_loading_print_nothing(self) -> None:
        code = (
            "import sys; sys.path.insert(0, sys.argv[1]);"
            "from specs import *; from hal.drivers.pybullet.world import PyBulletWorld;"
            "world = PyBulletWorld(world_spec(floor(), panda())); world.step(); world.close()"
        )
        command = [sys.executable, "-c", code, str(Path(__file__).parents[3] / "kits")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


class TestBodies:
    def test_names_and_numbers(self) -> None:
        world = scene()
        assert world.names() == ["floor", "cube", "lid", "mug", "panda", "iiwa"]
        assert [world.describe(name)["index"] for name in world.names()] == [0, 1, 2, 3, 4, 5]
        world.remove("cube")
        assert [world.describe(name)["index"] for name in world.names()] == [0, 1, 2, 3, 4]

    def test_an_arm_stands_where_its_base_link_should(self) -> None:
        base = Pose((-0.55, 0.1, 0.6), (0.0, 0.0, math.sin(0.3), math.cos(0.3)))
        spec = panda(base_position=tuple(base.position), base_orientation=tuple(base.orientation))
        world = PyBulletWorld(world_spec(spec))
        distance, angle = pose(world, "panda").distance(base)
        assert distance < 1e-12
        assert angle < 1e-7
        # Joint 1 of the Panda is 0.333 m above its base, and turns about the base's z axis.
        assert np.allclose(
            pose(world, "panda", "panda_link1").position, base.position + np.array([0.0, 0.0, 0.333]), atol=1e-6
        )

    def test_the_base_link_need_not_be_the_root(self) -> None:
        spec = panda(base_position=(0.0, 0.0, 1.0))
        spec = replace(spec, kinematics=replace(spec.kinematics, base_link="panda_link1"))
        world = PyBulletWorld(world_spec(replace(spec, initial=(0.0, *PANDA_HOME[1:]))))
        assert np.allclose(pose(world, "panda", "panda_link1").position, (0.0, 0.0, 1.0), atol=1e-6)

    def test_two_different_arms_stand_beside_each_other(self, world: PyBulletWorld) -> None:
        run(world, 240)
        for name, home in (("panda", PANDA_HOME), ("iiwa", IIWA_HOME)):
            body = world.body(name)
            joints = [body.joints[joint] for joint in body.spec.joints]  # type: ignore[union-attr]
            q = [state[0] for state in world.client.getJointStates(body.id, joints)]
            assert np.allclose(q, home, atol=1e-3), name

    @pytest.mark.parametrize(
        ("spec", "half"),
        [
            (box("it", (0.0, 0.0, 1.0), (0.1, 0.2, 0.3), mass=1.0), (0.1, 0.2, 0.3)),
            (BodySpec("it", (0.0, 0.0, 1.0), UPRIGHT, "sphere", radius=0.2, mass=1.0), (0.2, 0.2, 0.2)),
            (BodySpec("it", (0.0, 0.0, 1.0), UPRIGHT, "cylinder", radius=0.1, length=0.4, mass=1.0), (0.1, 0.1, 0.2)),
            (BodySpec("it", (0.0, 0.0, 1.0), UPRIGHT, "capsule", radius=0.1, length=0.4, mass=1.0), (0.1, 0.1, 0.3)),
        ],
    )
    def test_shapes_have_their_size_and_rest_on_the_floor(self, spec, half):
        world = PyBulletWorld(world_spec(floor(), spec))
        aabb = world.aabb("it")
        assert np.allclose(aabb["lower"], np.subtract((0.0, 0.0, 1.0), half), atol=0.002)
        assert np.allclose(aabb["upper"], np.add((0.0, 0.0, 1.0), half), atol=0.002)
        run(world, 480)
        assert pose(world, "it").position[2] == pytest.approx(half[2], abs=0.005)

    def test_massless_or_fixed_body_does_not_fall(self) -> None:
        world = PyBulletWorld(world_spec(box("wall", (0, 0, 1), (0.1, 0.1, 0.1)), mug(fixed=True), cube()))
        before = [pose(world, name) for name in ("wall", "mug", "cube")]
        run(world, 100)
        after = [pose(world, name) for name in ("wall", "mug", "cube")]
        assert [a == b for a, b in zip(before, after, strict=True)] == [True, True, False]

    def test_body_without_collision_falls_through_the_floor(self) -> None:
        world = PyBulletWorld(
            world_spec(floor(), box("ghost", (0, 0, 0.2), (0.1, 0.1, 0.1), mass=1.0, collision=False))
        )
        run(world, 240)
        assert pose(world, "ghost").position[2] < -1.0

    def test_a_urdf_object_is_posed_by_its_base_link_not_its_centre_of_mass(self, tmp_path: Path) -> None:
        urdf = tmp_path / "lopsided.urdf"
        urdf.write_text(
            '<robot name="lopsided"><link name="body"><inertial><origin xyz="0.1 0 0" rpy="0 0 0.5"/><mass value="1"/>'
            '<inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>'
            '<box size="0.2 0.2 0.2"/></geometry></collision></link></robot>'
        )
        there = Pose((1.0, 2.0, 3.0), (0.0, math.sin(0.4), 0.0, math.cos(0.4)))
        spec = BodySpec("it", tuple(there.position), tuple(there.orientation), "urdf", urdf=str(urdf))
        world = PyBulletWorld(world_spec(spec))
        assert pose(world, "it").distance(there) == pytest.approx((0.0, 0.0), abs=1e-7)
        elsewhere = Pose((0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0))
        world.set_pose("it", {"position": [0.0, 0.0, 1.0], "orientation": [0.0, 0.0, 1.0, 0.0]})
        assert pose(world, "it").distance(elsewhere) == pytest.approx((0.0, 0.0), abs=1e-7)
        # Half a turn about z takes the centre of mass to the other side of the base link.
        assert world.client.getBasePositionAndOrientation(world.body("it").id)[0] == pytest.approx((-0.1, 0.0, 1.0))


class TestRequests:
    def test_answers_travel_as_json(self) -> None:
        world = scene()
        run(world, 20)
        requests: list[tuple[str, dict[str, object]]] = [
            ("names", {}),
            ("describe", {"name": "panda"}),
            ("pose", {"name": "panda", "link": "panda_hand"}),
            ("poses", {"names": ["mug", "panda"]}),
            ("velocity", {"name": "cube"}),
            ("dynamics", {"name": "cube"}),
            ("contacts", {"a": "cube"}),
            ("aabb", {"name": "cube"}),
            ("add", {"spec": to_json(box("new", (1, 1, 1), (0.1, 0.1, 0.1)))}),
            ("set_pose", {"name": "new", "pose": {"position": [0, 1, 2], "orientation": [0, 0, 0, 1]}}),
            ("set_velocity", {"name": "cube", "linear": [0.0, 0.0, 1.0]}),
            ("set_dynamics", {"name": "cube", "mass": 3.0}),
            ("set_color", {"name": "new", "rgba": [1, 0, 0, 1]}),
            ("reset", {}),
            ("remove", {"name": "new"}),
            ("save", {}),
            ("restore", {"state": world.save()}),
        ]
        assert {method for method, _ in requests} == PyBulletWorld.REQUESTS
        for method, params in requests:
            json.dumps(world.request(method, json.loads(json.dumps(params))))

    def test_edits_count_revisions_and_others_do_not(self) -> None:
        world = PyBulletWorld(world_spec(floor()))
        assert world.request("add", {"spec": to_json(cube())}) == 1
        assert world.request("set_color", {"name": "cube", "rgba": [1, 0, 0, 1]}) == 2
        world.request("set_pose", {"name": "cube", "pose": {"position": [0, 0, 1]}})
        world.request("reset", {})
        assert world.request("remove", {"name": "cube"}) == world.revision == 3

    def test_pose_and_velocity_of_a_body(self) -> None:
        world = PyBulletWorld(world_spec(cube()))
        world.set_velocity("cube", (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
        assert world.velocity("cube") == [[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]]
        world.set_pose("cube", {"position": [1.0, 2.0, 3.0]})
        assert pose(world, "cube").position.tolist() == [1.0, 2.0, 3.0]
        assert world.velocity("cube") == [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]

    def test_poses_of_many_bodies_at_once(self, world: PyBulletWorld) -> None:
        run(world, 20)
        seen = world.poses()
        assert seen["t"] == world.t
        assert seen["poses"] == {name: world.pose(name) for name in world.names()}
        assert list(world.poses(["mug", "cube"])["poses"]) == ["mug", "cube"]
        with raises_code(DeviceNotFound, "unknown_body"):
            world.poses(["mug", "cub"])

    def test_contacts_carry_the_weight(self) -> None:
        world = PyBulletWorld(
            world_spec(floor(), cube((0.0, 0.0, 0.03)), box("far", (3, 3, 0.1), (0.1, 0.1, 0.1), mass=1.0))
        )
        run(world, 240)
        contacts = world.contacts("cube")
        assert {(contact["a"], contact["b"]) for contact in contacts} == {("cube", "floor")}
        assert sum(contact["force"] for contact in contacts) == pytest.approx(2.0 * 9.81, rel=0.02)
        for contact in contacts:
            assert contact["normal"] == pytest.approx([0.0, 0.0, 1.0], abs=1e-3)  # from the floor towards the cube
            assert abs(contact["distance"]) < 1e-3
        turned = world.contacts("floor", "cube")
        assert {(contact["a"], contact["b"]) for contact in turned} == {("floor", "cube")}
        assert turned[0]["normal"] == pytest.approx([0.0, 0.0, -1.0], abs=1e-3)
        assert world.contacts("cube", "far") == []


class TestReset:
    def test_reset_is_bit_for_bit_a_fresh_start(self) -> None:
        world = scene()
        first = run(world, 300)
        assert np.array_equal(run_after_reset(world), first)
        world.set_velocity("cube", (1.0, 0.0, 0.0))  # a mess this time
        run(world, 100)
        assert np.array_equal(run_after_reset(world), first)

    def test_reset_of_one_object_leaves_the_others(self, world: PyBulletWorld) -> None:
        run(world, 100)
        lid = pose(world, "lid")
        world.reset("mug")
        assert pose(world, "mug").position == pytest.approx([0.3, 0.4, 0.1])
        assert pose(world, "lid") == lid

    def test_reset_to_given_values(self, world: PyBulletWorld) -> None:
        world.reset("cube", pose={"position": [0.0, -0.5, 0.03]})
        assert pose(world, "cube").position.tolist() == [0.0, -0.5, 0.03]
        q = [0.1, -0.5, 0.2, -2.0, 0.1, 1.5, 0.5, 0.01, 0.01]
        world.reset("panda", q=q)
        body = world.body("panda")
        run(world, 100)  # and it holds there
        names = (*body.spec.joints, "panda_finger_joint1", "panda_finger_joint2")  # type: ignore[union-attr]
        states = world.client.getJointStates(body.id, [body.joints[name] for name in names])
        assert [state[0] for state in states] == pytest.approx(q, abs=1e-3)

    def test_impossible_resets_are_refused(self, world: PyBulletWorld) -> None:
        with raises_code(CommandError, "wrong_size"):
            world.reset("panda", q=[0.0, 0.0, 0.0])
        with raises_code(CommandError, "is_robot"):
            world.reset("panda", pose={"position": [0, 0, 0]})
        with raises_code(CommandError, "name_missing"):
            world.reset(q=[0.0] * 7)


def run_after_reset(world: PyBulletWorld) -> NDArray[np.float64]:
    world.reset()
    return run(world, 300)


DYNAMICS = {"mass": 3.0, "inertia": [0.01, 0.02, 0.03], "restitution": 0.5}
DYNAMICS |= {"lateral_friction": 0.9, "rolling_friction": 0.01, "spinning_friction": 0.02}
DYNAMICS |= {"linear_damping": 0.1, "angular_damping": 0.2}
WRONG_DYNAMICS = [{"mass": mass} for mass in (-1.0, math.nan, 0.0, "heavy")]
WRONG_DYNAMICS += [{"friction": 1.0}, {"inertia": [1.0, 2.0]}, {"contact_stiffness": 100.0}]


class TestDynamics:
    @pytest.mark.parametrize(("name", "value"), DYNAMICS.items())
    def test_each_value_is_taken_and_put_back(self, world: PyBulletWorld, name: str, value: object) -> None:
        for body, link in (("cube", None), ("panda", "panda_leftfinger")):
            original = world.dynamics(body, link)
            before = world.set_dynamics(body, link, **{name: value})
            assert world.dynamics(body, link)[name] == pytest.approx(value)
            assert original[name] != pytest.approx(value)
            world.set_dynamics(body, link, **before)
            assert world.dynamics(body, link) == original

    def test_all_frictions_at_once_do_not_disturb_each_other(self, world: PyBulletWorld) -> None:
        values = {"lateral_friction": 0.7, "rolling_friction": 0.01, "spinning_friction": 0.02}
        before = world.set_dynamics("cube", **values)
        held = world.dynamics("cube")
        world.set_dynamics("cube", **before)
        assert {name: held[name] for name in values} == values

    def test_a_new_mass_keeps_the_shape_of_the_inertia(self, world: PyBulletWorld) -> None:
        mass = world.dynamics("panda", "panda_link3")["mass"]
        before = world.set_dynamics("panda", "panda_link3", mass=2.0 * mass)
        after = world.set_dynamics("panda", "panda_link3", **before)
        assert after["mass"] == 2.0 * before["mass"] == 2.0 * mass
        assert after["inertia"] == pytest.approx([2.0 * value for value in before["inertia"]])

    def test_soft_contacts_sink_in_and_hard_ones_come_back(self) -> None:
        """Four corners on springs of k N/m give way by m g / 4k, and PyBullet itself cannot forget a stiffness."""
        world = PyBulletWorld(world_spec(floor(), cube((0.0, 0.0, 0.03))))
        run(world, 240)
        hard = pose(world, "cube").position[2]
        before = world.set_dynamics("cube", contact_stiffness=1000.0, contact_damping=50.0)
        assert before == {"contact_stiffness": None, "contact_damping": None}
        run(world, 480)  # it was at rest when they were set: they act in a contact that lasts, too
        assert hard - pose(world, "cube").position[2] == pytest.approx(2.0 * 9.81 / 4000.0, rel=0.01)
        world.set_dynamics("cube", **before)
        assert world.dynamics("cube")["contact_stiffness"] is None
        run(world, 480)
        assert pose(world, "cube").position[2] == pytest.approx(hard, abs=2e-5)

    def test_friction_acts_at_once(self) -> None:
        """A cube that slides stops after v^2 / (2 mu g), with mu the product of both frictions."""
        for friction in (0.4, 0.8):
            world = PyBulletWorld(world_spec(floor(), cube((0.0, 0.0, 0.03))))
            run(world, 60)
            world.set_velocity("cube", (1.0, 0.0, 0.0))
            before = world.set_dynamics("cube", lateral_friction=friction)
            assert (world.velocity("cube")[0], before["lateral_friction"]) == ([1.0, 0.0, 0.0], 0.5)
            run(world, 480)
            slid = pose(world, "cube").position[0]
            assert slid == pytest.approx(1.0 / (2.0 * friction * 0.5 * 9.81), rel=0.05)

    @pytest.mark.parametrize("values", WRONG_DYNAMICS)
    def test_impossible_dynamics_are_refused_and_change_nothing(self, world, values):
        original = world.dynamics("cube")
        with pytest.raises(CommandError):
            world.set_dynamics("cube", **{"lateral_friction": 0.123, **values})
        assert world.dynamics("cube") == original


class TestMirror:
    def assert_same(self, world: PyBulletWorld, mirror: PyBulletWorld) -> None:
        assert mirror.names() == world.names()
        for name in world.names():
            assert mirror.describe(name) == world.describe(name)
            for link in world.describe(name)["links"]:
                a, b = world.pose(name, link), mirror.pose(name, link)
                assert a["position"] == pytest.approx(b["position"], abs=1e-6), (name, link)
                assert a["orientation"] == pytest.approx(b["orientation"], abs=1e-6), (name, link)

    def test_shows_every_link_edits_and_fixed_bodies_that_were_moved(self) -> None:
        world = scene()
        mirror = PyBulletWorld(world.spec, mirror=True)
        edits: list[tuple[str, dict[str, object]]] = [
            ("add", {"spec": to_json(box("wall", (1, 1, 1), (0.1, 0.1, 0.1)))}),
            ("remove", {"name": "lid"}),
            ("set_color", {"name": "wall", "rgba": [1, 0, 0, 1]}),
        ]
        for method, params in edits:
            assert world.request(method, params) == mirror.request(method, params)
        world.set_pose("wall", {"position": [0.0, 2.0, 0.5]})
        world.reset("panda", q=[0.5, -0.5, 0.2, -2.0, 0.1, 1.5, 0.5])
        run(world, 30)
        before = pose(mirror, "panda", "panda_hand")
        mirror.show(world.snapshot())
        assert pose(mirror, "panda", "panda_hand").distance(before)[0] > 0.1
        assert pose(mirror, "wall").position.tolist() == [0.0, 2.0, 0.5]
        self.assert_same(world, mirror)

    def test_refuses_other_bodies_and_to_be_stepped(self) -> None:
        world = scene()
        mirror = PyBulletWorld(world.spec, mirror=True)
        world.add(box("wall", (1, 1, 1), (0.1, 0.1, 0.1)))
        with pytest.raises(ValueError, match="snapshot"):
            mirror.show(world.snapshot())
        with pytest.raises(NotSupported):
            mirror.step()


class TestBadInput:
    def test_unknown_names_are_refused(self, world: PyBulletWorld) -> None:
        with raises_code(DeviceNotFound, "unknown_body"):
            world.pose("cub")
        with raises_code(DeviceNotFound, "unknown_link"):
            world.pose("panda", "panda_hnd")

    @pytest.mark.parametrize(
        ("method", "params"),
        [
            ("explode", {}),
            ("close", {}),
            ("pose", {"nam": "cube"}),
            ("set_pose", {"name": "cube", "pose": [0, 0, 0]}),
            ("set_pose", {"name": "cube", "pose": {"position": [0, 0, math.nan]}}),
            ("set_pose", {"name": "cube", "pose": {"position": [0, 0, 0], "orientation": [0, 0, 0, 0]}}),
            ("set_pose", {"name": "panda", "pose": {"position": [0, 0, 0]}}),
            ("set_velocity", {"name": "floor", "linear": [0, 0, 1]}),
            ("set_color", {"name": "cube", "rgba": [1, 2, 3, 4]}),
            ("remove", {"name": "panda"}),
            ("add", {"spec": {"name": "what"}}),
        ],
    )
    def test_impossible_requests_are_refused(self, world, method, params):
        before = world.snapshot()
        with pytest.raises(CommandError):
            world.request(method, params)
        assert (world.snapshot(), world.revision) == (before, 0)

    def test_every_missing_mesh_is_named(self, tmp_path: Path) -> None:
        urdf = tmp_path / "broken.urdf"
        links = "".join(
            f'<link name="l{k}"><collision><geometry><mesh filename="package://gone/m{k}.obj"/></geometry></collision></link>'
            for k in (1, 2)
        )
        joint = '<joint name="j" type="fixed"><parent link="l1"/><child link="l2"/></joint>'
        urdf.write_text(f'<robot name="broken">{links}{joint}</robot>')
        body = BodySpec("broken", (0, 0, 0), UPRIGHT, "urdf", urdf=str(urdf))
        with pytest.raises(ConfigError) as error:
            PyBulletWorld(world_spec(body))
        assert [problem.file for problem in error.value.problems] == [str(urdf)] * 2
        assert "m1.obj" in str(error.value)
        assert "m2.obj" in str(error.value)

    def test_all_problems_of_a_world_at_once(self, tmp_path: Path) -> None:
        text = tmp_path / "text.urdf"
        text.write_text("this is no XML")
        bodies = [
            BodySpec("nowhere", (0, 0, 0), UPRIGHT, "urdf", urdf=str(tmp_path / "nowhere.urdf")),
            BodySpec("text", (0, 0, 0), UPRIGHT, "urdf", urdf=str(text)),
            BodySpec("ball", (0, 0, 0), UPRIGHT, "sphere"),
            BodySpec("odd", (0, 0, 0), UPRIGHT, "dodecahedron"),
            cube(),
            cube(),
        ]
        with pytest.raises(ConfigError) as error:
            PyBulletWorld(world_spec(*bodies, panda(joints=(*panda().joints[:6], "panda_jiont7"))))
        assert sorted(problem.code for problem in error.value.problems) == sorted(
            ("missing_file", "bad_urdf", "missing_key", "unknown_shape", "duplicate_name", "unknown_joint")
        )

    def test_overlapping_arms_are_refused(self) -> None:
        apart = panda("right", base_position=(0.0, 0.4, 0.0))
        fine = PyBulletWorld(world_spec(panda("left"), apart))
        fine.close()
        fine.close()  # a second close does nothing
        for right in (panda("right"), replace(apart, initial=(-1.57, *PANDA_HOME[1:]))):
            with pytest.raises(ConfigError) as error:
                PyBulletWorld(world_spec(panda("left"), right))
            (problem,) = error.value.problems
            assert (problem.key, problem.code) == ("robots.right", "robots_overlap")
            assert "'left'" in problem.message
        PyBulletWorld(
            world_spec(panda("left"), replace(panda("right"), driver="franka"))
        ).close()  # a copy of a real arm
        PyBulletWorld(world_spec(panda("left"), panda("right")), mirror=True).close()

    def test_a_link_without_mass_is_a_warning(self, tmp_path: Path) -> None:
        urdf = tmp_path / "massless.urdf"
        urdf.write_text(
            '<robot name="massless"><link name="shell"><collision><geometry><sphere radius="0.1"/></geometry>'
            "</collision></link></robot>"
        )
        world = PyBulletWorld(world_spec(BodySpec("it", (0, 0, 1), UPRIGHT, "urdf", urdf=str(urdf))))
        assert len(world.warnings) == 1
        assert "shell" in world.warnings[0]
        assert "1 kg" in world.warnings[0]

    @pytest.mark.parametrize("model", sorted(path.stem for path in data_folder("robots").glob("*.urdf")))
    def test_the_urdfs_of_this_project_load_without_a_warning(self, model: str) -> None:
        plan = load({"robots": {"arm": {"model": model}}}, sim=True).resolve()
        assert plan.world is not None
        assert (*plan.warnings, *PyBulletWorld(plan.world).warnings) == ()

    @pytest.mark.parametrize(("given", "kept"), [(0.001, True), (0.1, False)])
    def test_an_impossible_inertia_is_a_warning_and_replaced(self, tmp_path: Path, given: float, kept: bool) -> None:
        """A box of 0.1 m and 1 kg has 1/600 kg m2 if it is even, and at most three times that."""
        urdf = tmp_path / "box.urdf"
        urdf.write_text(
            f'<robot name="box"><link name="box"><inertial><mass value="1"/><inertia ixx="{given}" iyy="{given}" '
            f'izz="{given}" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><box size="0.1 0.1 0.1"/>'
            "</geometry></collision></link></robot>"
        )
        world = PyBulletWorld(world_spec(BodySpec("it", (0, 0, 1), UPRIGHT, "urdf", urdf=str(urdf))))
        inertia = world.dynamics("it")["inertia"]
        assert world.dynamics("it")["mass"] == 1.0
        if kept:
            assert (inertia, world.warnings) == ([given] * 3, [])
        else:
            assert inertia == pytest.approx([1.0 / 600.0] * 3, rel=0.1)
            assert "impossible: box" in world.warnings[0]
