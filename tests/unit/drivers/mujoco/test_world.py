"""What is MuJoCo's own: files that it refuses, contacts, unstable simulations, and steps that it divides."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine, need_engine
from errors_kit import raises_code
from specs import PANDA_HOME, box, cube, floor, panda

from hal.driver import Setpoint
from hal.errors import CommandError, ConfigError, NotSupported
from hal.specs import BodySpec

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
LINK = (
    '<robot name="it"><link name="plate"><inertial><mass value="0.5"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" '
    'ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>'
    "</robot>"
)
CORNERS = [(x, y, z) for x in (-0.05, 0.05) for y in (-0.04, 0.04) for z in (-0.03, 0.03)]


@pytest.fixture(scope="module")
def engine() -> Engine:
    return need_engine("mujoco")


@pytest.fixture(scope="module")
def scene(engine: Engine) -> Iterator[Any]:
    """Floor, cube and arm, for tests that reset them."""
    world = engine.world(floor(), cube((0.5, -0.2, 0.03)), panda())
    yield world
    world.close()


def steps(world: Any, count: int) -> Any:
    for _ in range(count):
        world.step()
    return world


def mesh_object(folder: Path, mesh: str, text: str) -> BodySpec:
    (folder / mesh).write_text(text)
    urdf = folder / "it.urdf"
    urdf.write_text(LINK.format(mesh=mesh))
    return BodySpec("it", (0.0, 0.0, 0.2), UPRIGHT, "urdf", urdf=str(urdf))


def obj(*groups: list[tuple[float, float, float]]) -> str:
    """An OBJ file with a group of two triangles or more for each list of vertices."""
    lines, first = [], 1
    for k, vertices in enumerate(groups):
        lines += [f"o part{k}", *("v {} {} {}".format(*vertex) for vertex in vertices)]
        lines += [f"f {first} {first + n} {first + n + 1}" for n in range(1, len(vertices) - 1)]
        first += len(vertices)
    return "\n".join(lines)


class TestFiles:
    def test_a_flat_mesh_is_refused_with_its_link(self, engine: Engine, tmp_path: Path) -> None:
        flat = [(x, y, 0.0) for x, y, _ in CORNERS]
        world = engine.world(floor())
        with pytest.raises(ConfigError) as refused:
            world.add(mesh_object(tmp_path, "flat.obj", obj(flat)))
        (problem,) = refused.value.problems
        assert problem.code == "bad_mesh"
        assert "MuJoCo" in problem.message
        assert "'plate'" in problem.message
        assert world.names() == ["floor"]
        world.add(cube((0.0, 0.0, 0.03)))  # and the world is as it was
        steps(world, 2)

    @pytest.mark.parametrize("kind", ["obj", "stl", "dae"])
    def test_meshes_have_their_size(self, engine: Engine, tmp_path: Path, kind: str) -> None:
        if kind == "obj":
            it = mesh_object(tmp_path, "it.obj", obj(CORNERS))
        else:
            import trimesh

            it = mesh_object(tmp_path, f"it.{kind}", "")
            trimesh.creation.box(extents=(0.1, 0.08, 0.06)).export(tmp_path / f"it.{kind}")
        world = engine.world(floor(), it)
        box_of = world.aabb("it")
        assert np.subtract(box_of["upper"], box_of["lower"]) == pytest.approx((0.1, 0.08, 0.06), abs=1e-6)
        assert steps(world, 240).pose("it")["position"][2] == pytest.approx(0.03, abs=1e-3)

    def test_parts_of_an_obj_are_convex_each_by_itself(self, engine: Engine, tmp_path: Path) -> None:
        """A ball falls between two plates, whose common hull it would rest on."""
        plates = [[(x + side, y, z) for x, y, z in CORNERS] for side in (-0.1, 0.1)]
        it = mesh_object(tmp_path, "plates.obj", obj(*plates))
        ball = BodySpec("ball", (0.0, 0.0, 0.4), UPRIGHT, "sphere", radius=0.02, mass=0.1)
        world = steps(engine.world(floor(), it, ball), 240)
        assert world.pose("ball")["position"][2] == pytest.approx(0.02, abs=2e-3)


class TestSleep:
    """Objects at rest sleep; nothing that a user can see depends on it, but the time of a step."""

    @pytest.fixture
    def stack(self, engine: Engine) -> Iterator[Any]:
        """A stack of two cubes on a fixed shelf, asleep."""
        shelf = box("shelf", (0.5, -0.2, 0.1), (0.1, 0.1, 0.1), fixed=True)
        lid = box("lid", (0.5, -0.2, 0.29), (0.03, 0.03, 0.03), mass=0.5)
        world = steps(engine.world(floor(), shelf, cube((0.5, -0.2, 0.23)), lid, panda()), 240)
        assert (world.data.tree_asleep >= 0).sum() == 2
        yield world
        world.close()

    def test_contacts_are_reported(self, stack: Any) -> None:
        weight = {
            pair: sum(one["force"] for one in stack.contacts(*pair)) for pair in (("lid", "cube"), ("cube", "shelf"))
        }
        mass = stack.dynamics("cube")["mass"]
        assert weight["lid", "cube"] == pytest.approx(0.5 * 9.81, rel=0.01)
        assert weight["cube", "shelf"] == pytest.approx((0.5 + mass) * 9.81, rel=0.01)
        assert len(stack.contacts()) == len(stack.contacts("cube"))

    @pytest.mark.parametrize("edit", ["shelf", "cube", "velocity", "force", "gravity", "arm"])
    def test_what_changes_wakes_them(self, stack: Any, edit: str) -> None:
        before = stack.pose("lid")["position"]
        if edit == "shelf":
            stack.set_pose("shelf", {"position": (0.8, 0.5, 0.1), "orientation": UPRIGHT})
        elif edit == "cube":
            stack.set_pose("cube", {"position": (0.5, 0.5, 0.03), "orientation": UPRIGHT})
        elif edit == "velocity":
            stack.set_velocity("lid", (0.3, 0.0, 0.5))
        elif edit == "force":
            stack.apply_force("lid", (0.0, 0.0, 10.0), duration=0.5)
        elif edit == "gravity":
            stack.set_gravity((0.0, 0.0, 9.81))
        else:
            stack.reset("panda", q=[-0.4, 0.62, 0.0, -2.3, 0.0, 2.9, 0.8])  # its hand is in the lid
        assert math.dist(steps(stack, 20).pose("lid")["position"], before) > 0.01

    def test_a_restored_world_sleeps_and_wakes_as_the_saved_one(self, stack: Any) -> None:
        state = json.loads(json.dumps(stack.save()))

        def run() -> list[Any]:
            seen = [steps(stack, 5).snapshot(), stack.data.tree_asleep.tolist(), stack.contacts()]
            stack.set_velocity("lid", (0.0, 0.3, 0.3))
            return [*seen, *(steps(stack, 20).snapshot() for _ in range(8)), stack.contacts()]

        first = run()
        stack.set_pose("shelf", {"position": (0.8, 0.5, 0.1), "orientation": UPRIGHT})
        steps(stack, 30)
        stack.restore(state)
        assert run() == first
        for part in ("tree_asleep", "body_awake_ind"):
            wrong = [99] * len(state["state"]["sleep"][part])
            with raises_code(CommandError, "wrong_state"):
                stack.restore({**state, "state": {**state["state"], "sleep": {**state["state"]["sleep"], part: wrong}}})


class TestContacts:
    @pytest.mark.parametrize(("cube_has", "floor_has"), [(0.3, 0.5), (0.8, 0.5), (0.8, 0.9)])
    def test_frictions_are_multiplied(self, scene: Any, cube_has: float, floor_has: float) -> None:
        scene.reset()
        given = {"cube": cube_has, "floor": floor_has}
        before = {name: scene.set_dynamics(name, lateral_friction=value) for name, value in given.items()}
        steps(scene, 10)
        start = scene.pose("cube")["position"][0]
        scene.set_velocity("cube", (0.7, 0.0, 0.0))
        slid = steps(scene, 240).pose("cube")["position"][0] - start
        assert slid == pytest.approx(0.7**2 / (2.0 * cube_has * floor_has * 9.81), rel=0.05)
        for name, values in before.items():
            scene.set_dynamics(name, **values)

    def test_corners_on_springs_give_way_by_their_stiffness(self, scene: Any) -> None:
        scene.reset()
        hard = steps(scene, 60).pose("cube")["position"][2]
        before = scene.set_dynamics("cube", contact_stiffness=1000.0, contact_damping=50.0)
        assert hard - steps(scene, 480).pose("cube")["position"][2] == pytest.approx(2.0 * 9.81 / 4000.0, rel=0.02)
        scene.set_dynamics("cube", **before)
        assert steps(scene, 240).pose("cube")["position"][2] == pytest.approx(hard, abs=2e-5)

    @pytest.mark.parametrize("name", ["linear_damping", "angular_damping"])
    def test_what_it_lacks_is_refused_by_name(self, scene: Any, name: str) -> None:
        with pytest.raises(NotSupported, match=name):
            scene.set_dynamics("cube", **{name: 0.1})

    @pytest.mark.parametrize("inertia", [(1.0, 0.1, 0.1), (0.0, 0.0, 0.0)])
    def test_an_impossible_inertia_is_refused_and_changes_nothing(self, scene: Any, inertia: Any) -> None:
        before = scene.dynamics("cube")
        with raises_code(CommandError, "bad_dynamics"):
            scene.set_dynamics("cube", inertia=inertia)
        assert scene.dynamics("cube") == before
        scene.add(box("more", (1.0, 1.0, 1.0), (0.1, 0.1, 0.1), mass=1.0))  # which compiles the model again
        scene.remove("more")

    def test_a_drawer_of_twice_the_size_opens_twice_as_far(self, engine: Engine, tmp_path: Path) -> None:
        part = '<link name="{}"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>'
        joint = (
            '<joint name="slide" type="prismatic"><parent link="frame"/><child link="drawer"/><axis xyz="0 0 -1"/>'
            '<limit lower="0" upper="0.2" effort="0" velocity="0"/></joint>'
        )
        urdf = tmp_path / "drawer.urdf"
        urdf.write_text(f'<robot name="it">{part.format("frame")}{part.format("drawer")}{joint}</robot>')
        it = BodySpec("it", (0.0, 0.0, 1.0), UPRIGHT, "urdf", urdf=str(urdf), fixed=True, scale=2.0)
        world = steps(engine.world(it), 240)
        assert world.pose("it", "drawer")["position"][2] == pytest.approx(0.6, abs=1e-3)
        world.close()


class TestSteps:
    def test_an_arm_whose_numbers_are_not_finite_reports_the_last_sound_ones(self, engine: Engine, scene: Any) -> None:
        scene.reset()
        robot, gripper = engine.robot(scene), engine.gripper(scene)
        robot.open()
        gripper.open()
        steps(scene, 2).motors.target[3] = math.nan
        reading, grip = (steps(scene, 2), robot.read(1.0))[1], gripper.read(1.0)
        assert reading.fault is not None
        assert np.isfinite([*reading.q, *reading.dq, *reading.tau, grip.width, grip.force]).all()
        scene.reset()
        steps(scene, 20)
        assert robot.read(2.0).fault is None
        assert robot.read(2.0).q == pytest.approx(PANDA_HOME, abs=1e-3)
        robot.close()
        gripper.close()

    def test_an_unstable_simulation_is_a_fault_until_a_reset(self, engine: Engine, scene: Any) -> None:
        scene.reset()
        robot = engine.robot(scene)
        robot.open()
        sound = robot.read(0.0)
        scene.set_velocity("cube", (1e6, 0.0, 0.0))
        steps(scene, 3)
        reading = robot.read(1.0)
        assert reading.fault is not None
        assert reading.fault.code == "simulation_unstable"
        assert reading.q == pytest.approx(sound.q, abs=1e-6)
        assert np.isfinite(scene.snapshot()).all()
        scene.reset()
        assert robot.read(2.0).fault is None
        assert steps(scene, 5).pose("cube")["position"][2] == pytest.approx(0.03, abs=1e-3)
        robot.close()

    def test_a_slow_world_makes_several_steps_in_one(self, engine: Engine) -> None:
        world = engine.world(panda(), physics_hz=60.0)
        robot = engine.robot(world)
        robot.open()
        assert world.substeps == 4
        for tick in range(1, 61):
            t = tick / 60.0
            q = [home + 0.2 * (1.0 - math.cos(2.0 * t)) for home in PANDA_HOME]
            robot.write(Setpoint(q, [0.4 * math.sin(2.0 * t)] * 7, [0.0] * 7))
            world.step()
            assert robot.read(0.0).q == pytest.approx(q, abs=1e-3)
        world.close()

    def test_an_edit_leaves_the_other_bodies_to_the_bit(self, engine: Engine) -> None:
        """The model is compiled again, in between and at the same time as things move and touch."""
        plain, edited = (engine.world(floor(), cube((0.5, -0.2, 0.05)), panda()) for _ in range(2))
        for world in (plain, edited):
            steps(world, 20)
        edited.add(box("far", (3.0, 0.0, 0.5), (0.1, 0.1, 0.1)))
        steps(edited, 20)
        edited.remove("far")
        steps(plain, 20)
        assert steps(edited, 20).snapshot() == steps(plain, 20).snapshot()
