"""The simulated world of each engine, beyond its contract: URDF files, resets, dynamics, bad input, differences."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine
from numpy.typing import NDArray
from specs import PANDA_HOME, box, cube, data, floor, iiwa, panda

from hal.config.data_files import data_folder, list_data
from hal.config.loader import load
from hal.errors import ConfigError
from hal.geometry import Pose
from hal.specs import BodySpec

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
URDFS = tuple(data_folder("robots").glob("*.urdf"))


def run(world: Any, steps: int) -> NDArray[np.float64]:
    """Step, and give every snapshot on the way (steps, n)."""
    seen = []
    for _ in range(steps):
        world.step()
        seen.append(world.snapshot())
    return np.array(seen)


def pose(world: Any, name: str, link: str | None = None) -> Pose:
    answer = world.pose(name, link)
    return Pose(answer["position"], answer["orientation"])


def trimesh_inertia(radius: float, length: float, mass: float) -> list[float]:
    """The moments of a capsule (3,), kg m2, computed from its surface."""
    import trimesh

    capsule = trimesh.creation.capsule(height=length, radius=radius, count=(64, 64))
    return [float(value) * mass / capsule.volume for value in np.diag(capsule.moment_inertia)]


def mug(**changes: object) -> BodySpec:
    """An object from a URDF."""
    return BodySpec("mug", (0.3, 0.4, 0.1), UPRIGHT, "urdf", urdf=data("objects/mug.urdf"), **changes)


def scene(engine: Engine) -> Any:
    """Floor, a stack of two boxes that touch at the start, a URDF object, two different arms."""
    lid = box("lid", (0.5, -0.2, 0.09), (0.03, 0.03, 0.03), mass=0.5)
    arms = panda(), iiwa(base_position=(0.0, 1.0, 0.0))
    return engine.world(floor(), cube((0.5, -0.2, 0.03)), lid, mug(), *arms)


@pytest.fixture(scope="module")
def one_scene(engine: Engine) -> Iterator[Any]:
    world = scene(engine)
    yield world
    world.close()


@pytest.fixture
def world(one_scene: Any) -> Any:
    """The scene for tests that leave its bodies and their dynamics as they were: loading it is most of a test."""
    one_scene.reset()
    return one_scene


class TestStepping:
    def test_importing_and_loading_print_nothing(self, engine: Engine) -> None:
        code = (
            "import sys; sys.path.insert(0, sys.argv[1]);"
            "from specs import *; from engines_kit import Engine;"
            "world = Engine(sys.argv[2]).world(floor(), panda()); world.step(); world.close()"
        )
        command = [sys.executable, "-c", code, str(Path(__file__).parents[3] / "kits"), engine.name]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


class TestBodies:
    def test_the_base_link_need_not_be_the_root(self, engine: Engine) -> None:
        spec = panda(base_position=(0.0, 0.0, 1.0))
        spec = replace(spec, kinematics=replace(spec.kinematics, base_link="panda_link1"))
        world = engine.world(replace(spec, initial=(0.0, *PANDA_HOME[1:])))
        assert np.allclose(pose(world, "panda", "panda_link1").position, (0.0, 0.0, 1.0), atol=1e-6)

    def test_the_link_of_an_object_without_a_file_is_its_base(self, world: Any) -> None:
        assert world.dynamics("cube", "base") == world.dynamics("cube")

    def test_a_urdf_object_is_posed_by_its_base_link(self, engine: Engine, tmp_path: Path) -> None:
        urdf = tmp_path / "lopsided.urdf"
        urdf.write_text(
            '<robot name="lopsided"><link name="body"><inertial><origin xyz="0.1 0 0" rpy="0 0 0.5"/><mass value="1"/>'
            '<inertia ixx="0.005" iyy="0.008" izz="0.006" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>'
            '<box size="0.2 0.2 0.2"/></geometry></collision></link></robot>'
        )
        there = Pose((1.0, 2.0, 3.0), (0.0, math.sin(0.4), 0.0, math.cos(0.4)))
        spec = BodySpec("it", tuple(there.position), tuple(there.orientation), "urdf", urdf=str(urdf))
        world = engine.world(spec)
        assert pose(world, "it").distance(there) == pytest.approx((0.0, 0.0), abs=1e-7)
        elsewhere = Pose((0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0))
        world.set_pose("it", {"position": [0.0, 0.0, 1.0], "orientation": [0.0, 0.0, 1.0, 0.0]})
        assert pose(world, "it").distance(elsewhere) == pytest.approx((0.0, 0.0), abs=1e-7)
        assert world.dynamics("it")["inertia"] == pytest.approx([0.005, 0.008, 0.006]), "in the file's order"


class TestReset:
    def test_reset_is_bit_for_bit_a_fresh_start(self, engine: Engine) -> None:
        world = scene(engine)
        first = run(world, 300)
        assert np.array_equal(run_after_reset(world), first)
        world.set_velocity("cube", (1.0, 0.0, 0.0))  # a mess this time
        run(world, 100)
        assert np.array_equal(run_after_reset(world), first)


def run_after_reset(world: Any) -> NDArray[np.float64]:
    world.reset()
    return run(world, 300)


class TestDynamics:
    def test_round_objects_have_the_inertia_of_their_shape(self, engine: Engine) -> None:
        pole = BodySpec("pole", (1, 0, 1), UPRIGHT, "cylinder", radius=0.2, length=0.6, mass=3.0)
        pill = replace(pole, name="pill", position=(2, 0, 1), shape="capsule")
        ball = replace(pole, name="ball", position=(0, 0, 1), shape="sphere", length=None)
        world = engine.world(ball, pole, pill)
        assert world.dynamics("ball")["inertia"] == pytest.approx([3.0 * 0.4 * 0.04] * 3)
        assert world.dynamics("pole")["inertia"] == pytest.approx([0.12, 0.12, 0.06])
        if engine.name == "mujoco":  # PyBullet takes a box around a capsule
            assert world.dynamics("pill")["inertia"] == pytest.approx(trimesh_inertia(0.2, 0.6, 3.0), rel=0.01)
        world.close()

    def test_soft_contacts_sink_in_and_hard_ones_come_back(self, engine: Engine) -> None:
        """Four corners on springs of k N/m give way by m g / 4k, and PyBullet itself cannot forget a stiffness."""
        world = engine.world(floor(), cube((0.0, 0.0, 0.03)))
        run(world, 240)
        hard = pose(world, "cube").position[2]
        before = world.set_dynamics("cube", contact_stiffness=1000.0, contact_damping=50.0)
        assert before == {"contact_stiffness": None, "contact_damping": None}
        run(world, 480)  # it was at rest when they were set: they act in a contact that lasts, too
        assert hard - pose(world, "cube").position[2] == pytest.approx(2.0 * 9.81 / 4000.0, rel=0.02)
        world.set_dynamics("cube", **before)
        assert world.dynamics("cube")["contact_stiffness"] is None
        run(world, 480)
        assert pose(world, "cube").position[2] == pytest.approx(hard, abs=2e-5)

    def test_an_object_at_rest_sinks_in_by_less_than_0_1_mm(self, engine: Engine) -> None:
        world = engine.world(floor(), cube((0.0, 0.0, 0.03)))
        run(world, 240)
        assert pose(world, "cube").position[2] == pytest.approx(0.03, abs=1e-4)

    @pytest.mark.parametrize("height", [0.8606, 1.0, 1.07])
    def test_a_ball_comes_back_wherever_in_a_step_it_touches(self, engine: Engine, height: float) -> None:
        """It is there after (1 + e) times the time of its fall; from 0.8606 m a step ends 0.5 mm above the floor."""
        e, radius = 0.7, 0.05
        ball = BodySpec("ball", (0.0, 0.0, height + radius), UPRIGHT, "sphere", radius=radius, mass=0.3)
        world = engine.world(floor(), ball)
        world.set_dynamics("floor", restitution=1.0)
        before = world.set_dynamics("ball", restitution=e)
        assert world.dynamics("ball")["contact_stiffness"] is None
        run(world, round(240 * (1.0 + e) * math.sqrt(2.0 * height / 9.81)))
        assert pose(world, "ball").position[2] - radius == pytest.approx(e**2 * height, rel=0.04)
        run(world, 960)
        assert pose(world, "ball").position[2] == pytest.approx(radius, abs=2e-4)
        world.reset("ball")
        world.set_dynamics("ball", **before)
        run(world, 480)
        assert pose(world, "ball").position[2] == pytest.approx(radius, abs=1e-3)


class TestBadInput:
    def test_every_missing_mesh_is_named(self, engine: Engine, tmp_path: Path) -> None:
        urdf = tmp_path / "broken.urdf"
        links = "".join(
            f'<link name="l{k}"><collision><geometry><mesh filename="gone/m{k}.obj"/></geometry></collision></link>'
            for k in (1, 2)
        )
        joint = '<joint name="j" type="fixed"><parent link="l1"/><child link="l2"/></joint>'
        urdf.write_text(f'<robot name="broken">{links}{joint}</robot>')
        body = BodySpec("broken", (0, 0, 0), UPRIGHT, "urdf", urdf=str(urdf))
        with pytest.raises(ConfigError) as error:
            engine.world(body)
        assert [problem.file for problem in error.value.problems] == [str(urdf)] * 2
        assert "m1.obj" in str(error.value)
        assert "m2.obj" in str(error.value)

    def test_all_problems_of_a_world_at_once(self, engine: Engine, tmp_path: Path) -> None:
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
            engine.world(*bodies, panda(joints=(*panda().joints[:6], "panda_jiont7")))
        assert sorted(problem.code for problem in error.value.problems) == sorted(
            ("missing_file", "bad_urdf", "missing_key", "unknown_shape", "duplicate_name", "unknown_joint")
        )

    def test_overlapping_arms_are_refused(self, engine: Engine) -> None:
        apart = panda("right", base_position=(0.0, 0.4, 0.0))
        fine = engine.world(panda("left"), apart)
        fine.close()
        fine.close()  # a second close does nothing
        for right in (panda("right"), replace(apart, initial=(-1.57, *PANDA_HOME[1:]))):
            with pytest.raises(ConfigError) as error:
                engine.world(panda("left"), right)
            (problem,) = error.value.problems
            assert (problem.key, problem.code) == ("robots.right", "robots_overlap")
            assert "'left'" in problem.message
        engine.world(panda("left"), replace(panda("right"), driver="franka")).close()  # a copy of a real arm

    def test_a_free_object_inside_of_another_one_is_a_warning(self, engine: Engine) -> None:
        table = box("table", (0.5, 0.0, 0.1), (0.2, 0.2, 0.1))
        on_it = cube((0.5, 0.1, 0.23))
        world = engine.world(floor(), table, on_it, box("low", (0.5, -0.1, 0.22), (0.03, 0.03, 0.03), mass=0.1))
        (warning,) = world.warnings
        assert all(word in warning for word in ("low", "0.010 m", "table"))
        world.add(replace(on_it, name="other", position=(0.52, 0.1, 0.23)))
        assert [text.split()[0] for text in world.warnings] == ["low", "other"]
        world.close()

    def test_a_link_without_mass_is_a_warning(self, engine: Engine, tmp_path: Path) -> None:
        urdf = tmp_path / "massless.urdf"
        urdf.write_text(
            '<robot name="massless"><link name="shell"><collision><geometry><sphere radius="0.1"/></geometry>'
            "</collision></link></robot>"
        )
        world = engine.world(BodySpec("it", (0, 0, 1), UPRIGHT, "urdf", urdf=str(urdf)))
        assert len(world.warnings) == 1
        assert "shell" in world.warnings[0]
        assert "1 kg" in world.warnings[0]

    @pytest.mark.parametrize("model", sorted({*list_data("robots")} & {path.stem for path in URDFS}))
    def test_the_urdfs_of_this_project_load_without_a_warning(self, engine: Engine, model: str) -> None:
        try:
            plan = load({"robots": {"arm": {"model": model}}}, sim=True, engine=engine.name).resolve()
            assert plan.world is not None
            world = engine.world_of(plan.world)
        except ConfigError as error:
            if {problem.code for problem in error.problems} == {"missing_package"}:
                pytest.skip(error.problems[0].message)
            raise
        assert (*plan.warnings, *world.warnings) == ()

    @pytest.mark.parametrize(("given", "kept"), [(0.001, True), (0.1, False)])
    def test_an_impossible_inertia_is_replaced_with_a_warning(
        self, engine: Engine, tmp_path: Path, given: float, kept: bool
    ) -> None:
        """A box of 0.1 m and 1 kg has 1/600 kg m2 if it is even, and at most three times that."""
        urdf = tmp_path / "box.urdf"
        urdf.write_text(
            f'<robot name="box"><link name="box"><inertial><mass value="1"/><inertia ixx="{given}" iyy="{given}" '
            f'izz="{given}" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><box size="0.1 0.1 0.1"/>'
            "</geometry></collision></link></robot>"
        )
        world = engine.world(BodySpec("it", (0, 0, 1), UPRIGHT, "urdf", urdf=str(urdf)))
        inertia = world.dynamics("it")["inertia"]
        assert world.dynamics("it")["mass"] == 1.0
        if kept:
            assert (inertia, world.warnings) == ([given] * 3, [])
        else:
            assert inertia == pytest.approx([1.0 / 600.0] * 3, rel=0.1)
            assert "impossible: box" in world.warnings[0]
