"""Mistakes in models of arms and cameras, in objects and in URDFs, alone and many at once."""

from __future__ import annotations

import copy
import random
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from errors_kit import NONSENSE, places

from hal.config import load
from hal.config.data_files import find_data
from hal.config.files import parse_yaml
from hal.errors import ConfigError, Problem

DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@cache
def built_in() -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], str]:
    """Return a rig, its arm, its camera, and the arm's URDF; read once."""
    files = ("config", "panda_table.yaml"), ("robots", "panda.yaml"), ("sensors", "cameras", "realsense_d435.yaml")
    rig, arm, camera = (parse_yaml(find_data(*file).read_text()) for file in files)
    return rig, arm | {"urdf": "arm.urdf"}, camera, Path(load("panda_table").resolve().robots[0].urdf).read_text()


class Bench:
    """A valid rig with its models, in files to be broken."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rig, self.arm, self.camera, self.urdf = copy.deepcopy(built_in())
        self.cup = {"name": "cup", "urdf": "cup.urdf"}
        self.overrides: list[str] = []
        self.panda: dict[str, Any] = self.rig["robots"]["panda"]
        self.panda["model"] = "arm.yaml"
        self.wrist: dict[str, Any] = self.rig["cameras"]["wrist"]
        self.wrist["model"] = "camera.yaml"
        self.rig["gamepads"]["pad"] = {"model": "dualshock4", "driver": "evdev"}
        self.pad: dict[str, Any] = self.rig["gamepads"]["pad"]
        self.rig["robots"]["other"] = {"model": "fr3", "base": [2, 0, 0, 0, 0, 0, 1]}
        self.objects: list[Any] = self.rig["objects"]
        self.objects += ["cup.yaml", {"file": "cube", "name": "brick"}]

    def attach(self, camera: str, **where: str) -> None:
        """Add a camera on an arm."""
        place = {"robot": "panda", "link": "panda_hand", **where}
        self.rig["cameras"][camera] = {"model": "realsense_d435", "attached": place}

    def load(self, **options: Any) -> Sequence[Problem]:
        """Write the files and load the rig; the problems found."""
        for name in ("rig", "arm", "camera", "cup"):
            (self.folder / f"{name}.yaml").write_text(yaml.dump(getattr(self, name), Dumper=DUMPER))
        (self.folder / "arm.urdf").write_text(self.urdf)
        (self.folder / "cup.urdf").write_text("<robot name='cup'><link name='cup'/></robot>")
        try:
            load(self.folder / "rig.yaml", overrides=self.overrides, **options)
        except ConfigError as error:
            return error.problems
        return ()

    def found(self) -> set[tuple[str, str, str]]:
        """File, key and code of each problem; every one is reported once."""
        found = self.load()
        places = [(Path(problem.file).name, problem.key, problem.code) for problem in found]
        assert len(places) == len(set(places)), "\n".join(map(str, found))
        return set(places)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.mark.parametrize(
    ("change", "key", "code"),
    [
        (lambda m: m["joints"].__setitem__(6, "panda_joint8"), "joints.6", "wrong_joint"),
        (lambda m: m["joints"].__setitem__(6, "panda_joint1"), "joints.6", "duplicate_name"),
        (lambda m: m["joints"].__setitem__(6, "panda_finger_joint1"), "joints.6", "wrong_joint"),
        (lambda m: m["gripper"]["joints"].__setitem__(0, "panda_joint7"), "gripper.joints", "wrong_joint"),
        (lambda m: m["tcp"].update(link="panda_hnad"), "tcp.link", "unknown_link"),
        (lambda m: m["limits"].pop("acceleration"), "limits.acceleration", "missing_key"),
        (lambda m: m["limits"]["upper"].pop(), "limits.upper", "wrong_count"),
        (lambda m: m["home"].pop(), "home", "wrong_count"),
        (lambda m: m.update(urdf={"package": "no_such_robots", "path": "a.urdf"}), "urdf.package", "missing_package"),
        (lambda m: m.update(urdf="amr.urdf"), "urdf", "missing_file"),
        (lambda m: m.update(urdf={"package": "yaml", "path": "a.urdf"}), "urdf", "missing_file"),
        (lambda m: m.pop("tcp"), "tcp", "missing_key"),
        (lambda m: m.update(joints=[]), "joints", "wrong_count"),
        (lambda m: m["gripper"].update(width=0.08), "gripper.width", "unknown_key"),
    ],
)
def test_mistakes_in_a_robot_model(
    bench: Bench, change: Callable[[dict[str, Any]], object], key: str, code: str
) -> None:
    change(bench.arm)
    assert bench.found() == {("arm.yaml", key, code)}


def test_the_hard_limits_of_a_real_arm_hold_for_its_model_too(bench: Bench) -> None:
    bench.arm["real_limits"] = {}
    bench.arm["limits"]["acceleration"] = 150
    assert bench.load() == ()
    bench.rig["robots"] = {"panda": bench.panda | {"drivers": {"real": "mock"}}}
    found = bench.load(sim=False)
    assert ("arm.yaml", "limits.acceleration") in {(Path(problem.file).name, problem.key) for problem in found}


def test_a_finger_that_turns_is_refused(bench: Bench) -> None:
    urdf = ElementTree.fromstring(bench.urdf)
    (finger,) = (joint for joint in urdf.iter("joint") if joint.get("name") == "panda_finger_joint2")
    finger.set("type", "revolute")
    bench.urdf = ElementTree.tostring(urdf, "unicode")
    assert bench.found() == {("arm.yaml", "gripper.joints.1", "wrong_joint")}


# Many mistakes at once: each is reported as it is alone, and nothing else is.


def _hide_speed_limit(bench: Bench) -> None:
    del bench.arm["limits"]["velocity"]
    bench.urdf = bench.urdf.replace('velocity="2.175"', 'velocity="0"')


MISTAKES: dict[tuple[str, str, str], Callable[[Bench], object]] = {
    # The arm's entry in the rig: a key, a type, a unit, and what only its model or its URDF can tell.
    ("rig.yaml", "robots.panda.colour", "unknown_key"): lambda b: b.panda.update(colour="red"),
    ("rig.yaml", "robots.panda.move_sped", "unknown_key"): lambda b: b.panda.update(move_sped=0.2),
    ("rig.yaml", "robots.panda.speed", "wrong_type"): lambda b: b.panda.update(speed="fast"),
    ("rig.yaml", "robots.panda.base", "wrong_count"): lambda b: b.panda.update(base=[0, 0, 1]),
    ("rig.yaml", "robots.panda.initial", "out_of_range"): lambda b: b.panda.update(
        initial=[0, -45, 0, -135, 0, 90, 45]
    ),
    ("rig.yaml", "robots.panda.limits.torque", "looser_limit"): lambda b: b.panda.update(limits={"torque": 1000}),
    ("rig.yaml", "robots.panda.gripper.speed", "out_of_range"): lambda b: b.panda.update(gripper={"speed": 9.0}),
    ("rig.yaml", "robots.panda.drivers.rael", "unknown_key"): lambda b: b.panda.update(drivers={"rael": "franka"}),
    ("rig.yaml", "robots.panda.workspace", "empty_range"): lambda b: b.panda.update(
        workspace={"upper": [1, 1, 0], "table_height": 1}
    ),
    ("rig.yaml", "robots.other.model", "unknown_model"): lambda b: b.rig["robots"]["other"].update(model="iwia"),
    # Its model.
    ("arm.yaml", "driver", "unknown_key"): lambda b: b.arm.update(driver=b.arm.pop("drivers")),
    ("arm.yaml", "description", "wrong_type"): lambda b: b.arm.update(description=7),
    ("arm.yaml", "joints.2", "unknown_joint"): lambda b: b.arm["joints"].__setitem__(2, "panda_jiont3"),
    ("arm.yaml", "tcp.lnk", "unknown_key"): lambda b: b.arm["tcp"].update(lnk=b.arm["tcp"].pop("link")),
    ("arm.yaml", "base_link", "unknown_link"): lambda b: b.arm.update(base_link="panda_lnik0"),
    ("arm.yaml", "home", "out_of_range"): lambda b: b.arm["home"].__setitem__(3, 0.5),
    ("arm.yaml", "limits.jerk", "missing_key"): lambda b: b.arm["limits"].pop("jerk"),
    ("arm.yaml", "limits.acceleration", "out_of_range"): lambda b: b.arm["limits"].update(acceleration=0),
    ("arm.yaml", "limits.velocity", "missing_key"): _hide_speed_limit,
    ("arm.yaml", "limits", "empty_range"): lambda b: b.arm["limits"]["lower"].__setitem__(0, 3.0),
    ("arm.yaml", "limits.effort", "unknown_key"): lambda b: b.arm["limits"].update(effort=9),
    ("arm.yaml", "gripper.joints.0", "unknown_joint"): lambda b: b.arm["gripper"]["joints"].__setitem__(0, "finger"),
    # Cameras and their model.
    ("rig.yaml", "cameras.wrist.attached.lnk", "unknown_key"): lambda b: b.wrist["attached"].update(
        lnk=b.wrist["attached"].pop("link")
    ),
    ("rig.yaml", "cameras.wrist.output.width", "wrong_type"): lambda b: b.wrist["output"].update(width="wide"),
    ("rig.yaml", "cameras.wrist.capture", "unknown_mode"): lambda b: b.wrist.update(
        capture={"width": 9, "height": 9, "rate_hz": 9}
    ),
    ("rig.yaml", "cameras.wrist.drivers.sim", "wrong_type"): lambda b: b.wrist.update(drivers={"sim": 3}),
    ("rig.yaml", "cameras.scene.model", "unknown_model"): lambda b: b.rig["cameras"]["scene"].update(
        model="realsense_d453"
    ),
    ("rig.yaml", "cameras.scene.look_at.yaw", "unknown_key"): lambda b: b.rig["cameras"]["scene"]["look_at"].update(
        yaw=3
    ),
    ("rig.yaml", "cameras.ear.attached.robot", "unknown_device"): lambda b: b.attach("ear", robot="pnada"),
    ("rig.yaml", "cameras.nose.attached.link", "unknown_link"): lambda b: b.attach("nose", link="panda_hadn"),
    ("rig.yaml", "cameras.eye", "missing_key"): lambda b: b.rig["cameras"].update(eye={"model": "realsense_d435"}),
    ("camera.yaml", "mode", "unknown_key"): lambda b: b.camera.update(mode=[]),
    ("camera.yaml", "distortion", "wrong_count"): lambda b: b.camera.update(distortion=[0, 0]),
    # Objects: in files, in the rig, changed.
    ("cup.yaml", "colour", "unknown_key"): lambda b: b.cup.update(colour="red"),
    ("cup.yaml", "urdf", "missing_file"): lambda b: b.cup.update(urdf="cpu.urdf"),
    ("cup.yaml", "random.z", "empty_range"): lambda b: b.cup.setdefault("random", {}).update(z=[2, 1]),
    ("cup.yaml", "random.yaw", "unknown_key"): lambda b: b.cup.setdefault("random", {}).update(yaw=[0, 1]),
    ("rig.yaml", "objects.5.mas", "unknown_key"): lambda b: b.objects[5].update(mas=1),
    ("rig.yaml", "objects.6", "conflict"): lambda b: b.objects.append({"file": "cube", "name": "ball", "radius": 0.1}),
    # The pad, the simulation, the caller.
    ("rig.yaml", "gamepads.pad.driver", "unknown_driver"): lambda b: b.pad.update(driver="evdve"),
    ("rig.yaml", "gamepads.pad.model", "unknown_model"): lambda b: b.pad.update(model="dualshok4"),
    ("rig.yaml", "gamepads.pad.dead_zone", "out_of_range"): lambda b: b.pad.update(dead_zone=2),
    ("rig.yaml", "simulation.physics_rate", "unknown_key"): lambda b: b.rig["simulation"].update(physics_rate=1000),
    ("rig.yaml", "simulation.clock", "invalid_choice"): lambda b: b.rig["simulation"].update(clock="lockstep"),
    ("--set", "cameras.wrsit.output.width", "unknown_device"): lambda b: b.overrides.append(
        "cameras.wrsit.output.width=3"
    ),
    ("--set", "robots.panda.tcp_speed", "out_of_range"): lambda b: b.overrides.append("robots.panda.tcp_speed=-1"),
}


def test_the_bench_is_valid(bench: Bench) -> None:
    assert bench.found() == set()
    assert len(load(bench.folder / "rig.yaml").resolve().robots) == 2


@pytest.mark.parametrize("place", MISTAKES, ids=" ".join)
def test_each_mistake_alone_is_one_problem(bench: Bench, place: tuple[str, str, str]) -> None:
    MISTAKES[place](bench)
    assert bench.found() == {place}


def test_all_mistakes_on_all_levels_are_reported_at_once(bench: Bench) -> None:
    for make in MISTAKES.values():
        make(bench)
    assert bench.found() == set(MISTAKES)
    text = str(ConfigError(bench.load()))
    assert text.startswith(f"{len(MISTAKES)} problems")
    assert f"{bench.folder / 'rig.yaml'}: robots.panda.colour: " in text


@pytest.mark.parametrize("seed", range(15))
def test_no_mistake_hides_another_and_none_invents_one(bench: Bench, seed: int) -> None:
    some = random.Random(seed).sample(list(MISTAKES), 2 + seed % 6)
    for place in some:
        MISTAKES[place](bench)
    assert bench.found() == set(some)


def test_the_value_of_a_misspelt_key_is_checked_and_reported_under_that_key(bench: Bench) -> None:
    bench.arm["limts"] = bench.arm.pop("limits") | {"jerk": 0, "velocity": "fast"}
    bench.overrides = ["robots.other.wrokspace.table_height=high"]
    assert bench.found() == {
        ("arm.yaml", "limts", "unknown_key"),
        ("arm.yaml", "limts.jerk", "out_of_range"),
        ("arm.yaml", "limts.velocity", "wrong_type"),
        ("--set", "robots.other.wrokspace", "unknown_key"),
        ("--set", "robots.other.wrokspace.table_height", "wrong_type"),
    }


def test_a_key_that_only_looks_like_another_is_one_problem(bench: Bench) -> None:
    bench.wrist["depth_min"] = 0.1  # nearest: depth, which holds min and max
    assert bench.found() == {("rig.yaml", "cameras.wrist.depth_min", "unknown_key")}


@pytest.mark.parametrize("name", ["arm", "camera", "cup"])
def test_nonsense_in_a_model_or_an_object_is_a_config_error_or_nothing_worse(bench: Bench, name: str) -> None:
    refused = 0
    good = getattr(bench, name)
    for k, place in enumerate(places(good)[::8]):
        setattr(bench, name, copy.deepcopy(good))
        target = getattr(bench, name)
        for part in place[:-1]:
            target = target[part]
        target[place[-1]] = NONSENSE[k % len(NONSENSE)]
        refused += bool(bench.found())
    assert refused > len(places(good)) / 16


def test_a_joint_that_does_not_move_lacks_no_limits(bench: Bench) -> None:
    bench.arm["limits"] = {"acceleration": 10, "jerk": 500}  # the rest is the URDF's, which has none for this joint
    bench.arm["real_limits"] = {}
    assert bench.found() == set()
    bench.arm["joints"][6] = "panda_joint8"
    assert bench.found() == {("arm.yaml", "joints.6", "wrong_joint")}


def test_a_mistake_in_an_objects_file_is_reported_once(bench: Bench) -> None:
    bench.cup["rgba"] = [255, 0, 0, 1]
    bench.objects.append({"file": "cup.yaml", "name": "mug", "fixd": True})
    assert bench.found() == {("cup.yaml", "rgba", "out_of_range"), ("rig.yaml", "objects.6.fixd", "unknown_key")}
