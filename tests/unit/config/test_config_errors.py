"""Mistakes in configuration files: all of them are reported at once, each with its file, key and code."""

from __future__ import annotations

import copy
import random
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from hal.calibration.board import BoardConfig
from hal.config import load
from hal.config.data_files import find_data
from hal.config.mapping import TeleopMapping
from hal.config.models import CameraModel, RobotModel
from hal.config.objects import ObjectConfig
from hal.config.rigfile import RigFile
from hal.errors import ConfigError, Problem

ROBOT = {"model": "panda"}
LOOK = {"target": [0, 0, 0], "distance": 1.0}
CAMERA = {"model": "realsense_d435", "look_at": LOOK}


def problems(config: Any, **arguments: Any) -> list[Problem]:
    """The problems of a rig, which has some."""
    with pytest.raises(ConfigError) as caught:
        load(config, **arguments)
    return list(caught.value.problems)


def only(config: Any, **arguments: Any) -> Problem:
    """The only problem of a rig."""
    found = problems(config, **arguments)
    assert len(found) == 1, "\n".join(map(str, found))
    return found[0]


def robot(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": {**ROBOT, **keys}}}


def camera(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": ROBOT}, "cameras": {"eye": {**CAMERA, **keys}}}


def held(**keys: Any) -> dict[str, Any]:
    return camera(look_at=None, attached={"robot": "arm", "link": "panda_hand", **keys})


def thing(**keys: Any) -> dict[str, Any]:
    return {"objects": [{"name": "brick", "shape": "box", "half_extents": [1, 1, 1], **keys}]}


@pytest.mark.parametrize(
    ("config", "key", "code"),
    [
        # Unknown keys, with the nearest right one.
        ({"robtos": {}}, "robtos", "unknown_key"),
        (robot(sped=0.2), "robots.arm.sped", "unknown_key"),
        (robot(base={"positon": [0, 0, 0]}), "robots.arm.base.positon", "unknown_key"),
        (robot(gripper={"sped": 0.05}), "robots.arm.gripper.sped", "unknown_key"),
        (camera(look_at={**LOOK, "yaw": 3}), "cameras.eye.look_at.yaw", "unknown_key"),
        (camera(streams={"colour": {}}), "cameras.eye.streams.colour", "invalid_choice"),
        (camera(streams={"color": {"fromat": "bgr8"}}), "cameras.eye.streams.color.fromat", "unknown_key"),
        ({"simulation": {"physics_rate": 1}}, "simulation.physics_rate", "unknown_key"),
        (thing(half_extent=[1, 1, 1]), "objects.0.half_extent", "unknown_key"),
        # Unknown names, with the nearest right one.
        ({"robots": {"arm": {"model": "pnada"}}}, "robots.arm.model", "unknown_model"),
        ({"cameras": {"e": {**CAMERA, "model": "realsens_d435"}}}, "cameras.e.model", "unknown_model"),
        ({"gamepads": {"p": {"model": "dualshok4"}}}, "gamepads.p.model", "unknown_model"),
        ({"gamepads": {"p": {"driver": "evdve"}}}, "gamepads.p.driver", "unknown_driver"),
        ({"objects": ["cub"]}, "objects.0", "unknown_object"),
        (robot(drivers={"sim": "pybulet"}), "robots.arm", "unknown_driver"),
        (robot(drivers={"sim": "evdev"}), "robots.arm", "wrong_driver"),
        ({"simulation": {"clock": "lockstep"}}, "simulation.clock", "invalid_choice"),
        ({"simulation": {"renderer": "opengl"}}, "simulation.renderer", "invalid_choice"),
        # A camera on a robot or a link that is not there.
        (
            held(robot="arn"),
            "cameras.eye.attached.robot",
            "unknown_device",
        ),
        (
            held(link="panda_hnad"),
            "cameras.eye.attached.link",
            "unknown_link",
        ),
        # A mode or a stream that the model lacks.
        (camera(capture={"width": 640, "height": 480, "rate_hz": 31}), "cameras.eye.capture", "unknown_mode"),
        (camera(capture={"width": 641, "height": 480, "rate_hz": 30}), "cameras.eye.capture", "unknown_mode"),
        (camera(depth={"min": 0.1, "max": 1.0}), "cameras.eye.depth", "not_adjustable"),
        (camera(streams=[]), "cameras.eye.streams", "missing_key"),
        # Wrong types and wrong counts.
        ({"sim": "yes"}, "sim", "wrong_type"),
        ({"robots": ["panda"]}, "robots", "wrong_type"),
        ({"robots": {"arm": "panda"}}, "robots.arm", "wrong_type"),
        ({"objects": {"cube": 1}}, "objects", "wrong_type"),
        ({"objects": [7]}, "objects.0", "wrong_type"),
        (robot(speed="fast"), "robots.arm.speed", "wrong_type"),
        (robot(speed=1.5), "robots.arm.speed", "out_of_range"),
        (robot(speed=True), "robots.arm.speed", "wrong_type"),
        (robot(model=5), "robots.arm.model", "wrong_type"),
        ({"robots": {"arm": {}}}, "robots.arm.model", "missing_key"),
        ({"robots": {"my arm": ROBOT}}, "robots.my arm", "bad_name"),
        (camera(output={"width": 256.5, "height": 256}), "cameras.eye.output.width", "wrong_type"),
        (camera(output={"width": "256", "height": 256}), "cameras.eye.output.width", "wrong_type"),
        (camera(output={"width": 0, "height": 256}), "cameras.eye.output.width", "out_of_range"),
        ({"simulation": {"physics_hz": float("nan")}}, "simulation.physics_hz", "wrong_type"),
        ({"simulation": {"gravity": -9.81}}, "simulation.gravity", "wrong_type"),
        ({"simulation": {"gravity": [0, 0, "down"]}}, "simulation.gravity", "wrong_type"),
        # Wrong units: a pose of 3 numbers where 7 are due, degrees, a quaternion that is none.
        (camera(look_at=None, pose=[0, 0, 1]), "cameras.eye.pose", "wrong_count"),
        (robot(base=[0, 0, 0]), "robots.arm.base", "wrong_count"),
        (robot(base={"position": [0, 0]}), "robots.arm.base.position", "wrong_count"),
        (robot(base={"orientation": [0, 0, 90]}), "robots.arm.base.orientation", "wrong_count"),
        (robot(base={"orientation": [0, 0, 90, 1]}), "robots.arm.base.orientation", "bad_rotation"),
        (robot(initial=[0, -45, 0, -135, 0, 90, 45]), "robots.arm.initial", "out_of_range"),
        (robot(initial=[0, 0, 0]), "robots.arm.initial", "wrong_count"),
        (
            held(rotation=[1, 2]),
            "cameras.eye.attached.rotation",
            "wrong_count",
        ),
        (
            held(target=[0, 0, 0]),
            "cameras.eye.attached.target",
            "out_of_range",
        ),
        # A simulated camera must stand somewhere, and in one place.
        (camera(look_at=None), "cameras.eye", "missing_key"),
        (camera(pose={}), "cameras.eye", "conflict"),
        # Numbers that are out of every plausible range are mostly in another unit.
        (robot(tcp_speed=250), "robots.arm.tcp_speed", "out_of_range"),
        (camera(look_at={**LOOK, "distance": 1200}), "cameras.eye.look_at.distance", "out_of_range"),
        (camera(look_at={**LOOK, "target": [0, 500, 0]}), "cameras.eye.look_at.target", "out_of_range"),
        (camera(look_at={**LOOK, "pitch_deg": 1e9}), "cameras.eye.look_at.pitch_deg", "out_of_range"),
        (thing(half_extents=[1, 10, 1]), "objects.0.half_extents", "out_of_range"),
        (thing(half_extents=[1, 0, 1]), "objects.0.half_extents", "out_of_range"),
        (thing(mass=100), "objects.0.mass", "out_of_range"),
        (thing(position=[0, 0, 600]), "objects.0.position", "out_of_range"),
        (robot(base={"position": [-550, 0, 0]}), "robots.arm.base.position", "out_of_range"),
        (robot(limits={"velocity": 150}), "robots.arm.limits.velocity", "out_of_range"),
        (robot(limits={"upper": 170, "allow_looser_limits": True}), "robots.arm.limits.upper", "out_of_range"),
        (robot(workspace={"table_height": 200}), "robots.arm.workspace.table_height", "out_of_range"),
        (robot(gripper={"speed": 50}), "robots.arm.gripper.speed", "out_of_range"),
        (robot(rate_hz=1e6), "robots.arm.rate_hz", "out_of_range"),
        ({"simulation": {"gravity": [0, 0, -981]}}, "simulation.gravity", "out_of_range"),
        (
            held(rotation=[0, 90, 0]),
            "cameras.eye.attached.rotation",
            "out_of_range",
        ),
        (
            held(translation=[90, 0, 0]),
            "cameras.eye.attached.translation",
            "out_of_range",
        ),
        # Limits.
        (robot(limits={"velocity": [1, 1]}), "robots.arm.limits.velocity", "wrong_count"),
        (robot(limits={"velocity": 3.0}), "robots.arm.limits.velocity", "looser_limit"),
        (robot(limits={"lower": -3.0}), "robots.arm.limits.lower", "looser_limit"),
        (robot(limits={"velocity": -1.0}), "robots.arm.limits.velocity", "out_of_range"),
        (robot(gripper={"speed": 0.9}), "robots.arm.gripper.speed", "looser_limit"),
        pytest.param(
            {"robots": {"a": {"model": "iiwa", "gripper": {"speed": 0.1}}}},
            "robots.a.gripper",
            "no_gripper",
            marks=pytest.mark.skipif(find_spec("pybullet_data") is None, reason="needs pybullet_data"),
        ),
        (robot(workspace={"upper": [1, 1, 0.1], "table_height": 0.2}), "robots.arm.workspace", "empty_range"),
        # Objects.
        (thing(half_extents=None), "objects.0", "missing_key"),
        (thing(radius=1), "objects.0", "conflict"),
        (thing(shape="cone"), "objects.0.shape", "invalid_choice"),
        (thing(mass=-1), "objects.0.mass", "out_of_range"),
        (thing(rgba=[255, 0, 0, 1]), "objects.0.rgba", "out_of_range"),
        ({"objects": ["cube", "cube"]}, "name", "duplicate_name"),
        ({"robots": {"cube": ROBOT}, "objects": ["cube"]}, "name", "duplicate_name"),
        ({"objects": ["cubes/brick.yaml"]}, "objects.0", "missing_file"),
        (thing(random={"x": [0.1, -0.1]}), "objects.0.random.x", "empty_range"),
        (thing(random={"y": 0.3}), "objects.0.random.y", "wrong_type"),
        (thing(random={"z": [1, 2, 3]}), "objects.0.random.z", "wrong_count"),
        (thing(random={"x": [0, float("nan")]}), "objects.0.random.x", "wrong_type"),
        (thing(random={"x": [0, "far"]}), "objects.0.random.x", "wrong_type"),
        (thing(random={"yaw_deg": [-400, 0]}), "objects.0.random.yaw_deg", "out_of_range"),
        (thing(random={"yaw": [-1, 1]}), "objects.0.random.yaw", "unknown_key"),
        (thing(random={}), "objects.0.random", "missing_key"),
        (thing(random=[-1, 1]), "objects.0.random", "wrong_type"),
        ({"objects": [{"name": "f", "shape": "plane", "random": {"x": [0, 1]}}]}, "objects.0", "conflict"),
        (
            {"objects": [{"file": "cube", "attached": {"robot": "arm", "link": "hand"}, "random": {"x": [0, 1]}}]}
            | robot(),
            "objects.0",
            "conflict",
        ),
        # Pads.
        ({"gamepads": {"p": {"driver": "playback"}}}, "gamepads.p.file", "missing_key"),
        ({"gamepads": {"p": {"driver": "playback", "file": "no.jsonl"}}}, "gamepads.p.file", "missing_file"),
        ({"gamepads": {"p": {"driver": "keyboard"}}}, "gamepads.p.driver", "unknown_driver"),
        ({"gamepads": {"p": {"file": "a.jsonl"}}}, "gamepads.p.file", "conflict"),
        # Names of devices.
        ({"robots": {"a": ROBOT}, "cameras": {"a": CAMERA}}, "cameras.a", "duplicate_name"),
    ],
)
def test_one_mistake_is_one_problem_with_its_key(config: dict[str, Any], key: str, code: str) -> None:
    problem = only(config)
    assert (problem.key, problem.code) == (key, code)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (robot(sped=0.2), "did you mean 'speed'"),
        ({"robots": {"arm": {"model": "pnada"}}}, "did you mean 'panda'"),
        (robot(drivers={"sim": "pybulet"}), "did you mean 'pybullet'"),
        (robot(drivers={"sim": "evdev"}), "it has: gamepad"),
        (camera(capture={"width": 640, "height": 480, "rate_hz": 31}), "640x480 at 6, 15, 30, 60 Hz"),
        (robot(tcp_speed=250), "250 mm/s would be 0.25"),
        (thing(half_extents=[1, 10, 1]), "item 2 is 10; 10 mm would be 0.01"),
        (robot(initial=[0, -45, 0, -135, 0, 90, 45]), "'panda_joint2' is at -45"),
    ],
)
def test_messages_name_the_nearest_choice_the_unit_and_the_place(config: dict[str, Any], words: str) -> None:
    assert words in only(config).message


@pytest.mark.parametrize(
    "model",
    [RigFile, RobotModel, CameraModel, ObjectConfig, TeleopMapping, BoardConfig],
    ids=lambda model: str(model.__name__),
)
def test_every_number_of_a_file_has_a_range(model: type[BaseModel]) -> None:
    def unlimited(schema: Any, place: str) -> Iterator[str]:
        if isinstance(schema, dict):
            most = {"maximum", "exclusiveMaximum"} & schema.keys()
            least = {"minimum", "exclusiveMinimum"} & schema.keys()
            if schema.get("type") in ("number", "integer") and not (most and least):
                yield place
        inner = schema.items() if isinstance(schema, dict) else enumerate(schema) if isinstance(schema, list) else ()
        for key, value in inner:
            yield from unlimited(value, f"{place}.{key}")

    assert list(unlimited(model.model_json_schema(), model.__name__)) == []


REAL = {"model": "panda", "sim": False, "drivers": {"real": "mock"}}


@pytest.mark.parametrize(
    ("keys", "place", "code"),
    [
        ({"tcp_speed": 3.0}, "robots.arm.tcp_speed", "out_of_range"),
        ({"limits": {"velocity": 20, "allow_looser_limits": True}}, "robots.arm.limits.velocity", "out_of_range"),
        ({"limits": {"jerk": 30000, "allow_looser_limits": True}}, "robots.arm.limits.jerk", "out_of_range"),
    ],
)
def test_what_a_simulation_may_do_a_real_arm_may_not(keys: dict[str, Any], place: str, code: str) -> None:
    config = {"robots": {"arm": {**REAL, **keys}}}
    load(config, sim=True)
    assert (place, code) in {(problem.key, problem.code) for problem in problems(config)}


# Files.


def test_missing_file_and_unknown_rig(tmp_path: Path) -> None:
    (tmp_path / "panda_bench.yaml").write_text("{}")
    problem = only(tmp_path / "panda_bnech.yaml")
    assert (problem.file, problem.code) == (str(tmp_path / "panda_bnech.yaml"), "missing_file")
    assert "'panda_bench.yaml'" in problem.message
    assert only("panda_tabel").code == "unknown_rig"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("robots: {arm: [", "bad_yaml"),
        ("- a\n- b\n", "wrong_type"),
        ("", "wrong_type"),
        ("robots: !!python/object/apply:os.system ['true']", "bad_yaml"),
        ("a: 1\n---\nb: 2\n", "bad_yaml"),
        ("objects: &all [*all]", "too_large"),
    ],
)
def test_files_that_are_no_rig(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    assert only(tmp_path / "rig.yaml").code == code


def test_keys_that_are_given_twice(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("robots:\n  arm: {model: panda}\n  arm: {model: fr3, speed: 0.1, speed: 0.2}\n")
    found = problems(tmp_path / "rig.yaml")
    assert {(problem.key, problem.code) for problem in found} == {
        ("robots.arm", "duplicate_key"),
        ("robots.arm.speed", "duplicate_key"),
    }
    assert "lines 2 and 3" in found[0].message


def test_a_folder_in_place_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").mkdir()
    assert only(tmp_path / "rig.yaml").code == "unreadable"


# Overrides and arguments.


@pytest.mark.parametrize(
    ("override", "key", "code"),
    [
        ("cameras.wrist.output.widht=320", "cameras.wrist.output.widht", "unknown_key"),
        ("cameras.wrsit.output.width=320", "cameras.wrsit.output.width", "unknown_device"),
        ("cameras.wrist.output.width=wide", "cameras.wrist.output.width", "wrong_type"),
        ("cameras.wrist.output.width=[", "cameras.wrist.output.width", "bad_yaml"),
        ("simulaton.physics_hz=1000", "simulaton", "unknown_key"),
        ("sim", "", "bad_override"),
        ("sim.deep=1", "sim.deep", "unknown_key"),
        ("objects.9=cube", "objects.9", "unknown_key"),
        ("robots..speed=1", "robots..speed", "bad_override"),
    ],
)
def test_overrides_are_to_blame_for_their_own_mistakes(override: str, key: str, code: str) -> None:
    problem = only("panda_table", overrides=[override])
    assert (problem.file, problem.key, problem.code) == ("--set", key, code)


NONSENSE = [None, -1, 2.5, "x", [], {}, [1, 2], True, float("nan"), float("inf"), 10**400, {1: 2}, [None] * 7]


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every key and item in nested data."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [deeper for key, item in items for deeper in places(item, (*path, key))]


def test_nonsense_anywhere_is_a_config_error_or_nothing_worse() -> None:
    """Nonsense in every place of a rig is a ConfigError, never another exception."""
    rig = yaml.safe_load(find_data("config", "panda_table.yaml").read_text())
    refused: list[Problem] = []
    for k, place in enumerate(places(rig)):
        broken = copy.deepcopy(rig)
        target = broken
        for part in place[:-1]:
            target = target[part]
        target[place[-1]] = NONSENSE[k % len(NONSENSE)]
        try:
            load(broken)
        except ConfigError as error:
            refused.extend(error.problems)
    assert len(refused) > 50
    assert all(problem.key and problem.message for problem in refused)


def test_arguments() -> None:
    found = problems("panda_table", clock="lockstep", driver="mok")
    assert {(problem.key, problem.code) for problem in found} == {
        ("clock", "invalid_choice"),
        ("driver", "wrong_driver"),
    }


def test_a_real_arm_without_a_driver_for_it() -> None:
    pytest.importorskip("pybullet_data")
    problem = only({"robots": {"arm": {"model": "iiwa"}}}, sim=False)
    assert (problem.key, problem.code) == ("robots.arm", "no_driver")
    assert "robots.arm.drivers.real" in problem.message


# Models and URDFs.


class Bench:
    """A valid rig with its models, in files to be broken."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rig = yaml.safe_load(find_data("config", "panda_table.yaml").read_text())
        self.arm = yaml.safe_load(find_data("robots", "panda.yaml").read_text()) | {"urdf": "arm.urdf"}
        self.camera = yaml.safe_load(find_data("sensors", "cameras", "realsense_d435.yaml").read_text())
        self.cup = {"name": "cup", "urdf": "cup.urdf"}
        self.urdf = Path(load("panda_table").resolve().robots[0].urdf).read_text()
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
            (self.folder / f"{name}.yaml").write_text(yaml.safe_dump(getattr(self, name)))
        (self.folder / "arm.urdf").write_text(self.urdf)
        (self.folder / "cup.urdf").write_text("<robot name='cup'><link name='cup'/></robot>")
        try:
            load(self.folder / "rig.yaml", overrides=self.overrides, **options)
        except ConfigError as error:
            return error.problems
        return ()

    def only(self) -> tuple[str, str, str]:
        """File, key and code of the only problem."""
        (problem,) = self.load()
        return Path(problem.file).name, problem.key, problem.code

    def found(self) -> set[tuple[str, str]]:
        """File and key of each problem; every one is reported once."""
        found = self.load()
        places = [(Path(problem.file).name, problem.key) for problem in found]
        assert len(places) == len(set(places)), "\n".join(map(str, found))
        return set(places)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.mark.parametrize(
    ("change", "key", "code"),
    [
        (lambda m: m["joints"].__setitem__(2, "panda_jiont3"), "joints.2", "unknown_joint"),
        (lambda m: m["joints"].__setitem__(6, "panda_joint8"), "joints.6", "wrong_joint"),
        (lambda m: m["joints"].__setitem__(6, "panda_joint1"), "joints.6", "duplicate_name"),
        (lambda m: m["joints"].__setitem__(6, "panda_finger_joint1"), "joints.6", "wrong_joint"),
        (lambda m: m["gripper"]["joints"].__setitem__(0, "finger"), "gripper.joints.0", "unknown_joint"),
        (lambda m: m["gripper"]["joints"].__setitem__(0, "panda_joint7"), "gripper.joints", "wrong_joint"),
        (lambda m: m["tcp"].update(link="panda_hnad"), "tcp.link", "unknown_link"),
        (lambda m: m.update(base_link="base"), "base_link", "unknown_link"),
        (lambda m: m["limits"].pop("acceleration"), "limits.acceleration", "missing_key"),
        (lambda m: m["limits"].pop("jerk"), "limits.jerk", "missing_key"),
        (lambda m: m["limits"].update(jerk=0), "limits.jerk", "out_of_range"),
        (lambda m: m["limits"]["upper"].pop(), "limits.upper", "wrong_count"),
        (lambda m: m["limits"]["lower"].__setitem__(0, 3.0), "limits", "empty_range"),
        (lambda m: m["home"].pop(), "home", "wrong_count"),
        (lambda m: m["home"].__setitem__(3, 0.5), "home", "out_of_range"),
        (lambda m: m.update(urdf={"package": "no_such_robots", "path": "a.urdf"}), "urdf.package", "missing_package"),
        (lambda m: m.update(urdf="amr.urdf"), "urdf", "missing_file"),
        (lambda m: m.update(urdf={"package": "yaml", "path": "a.urdf"}), "urdf", "missing_file"),
        (lambda m: m.pop("tcp"), "tcp", "missing_key"),
        (lambda m: m.update(joints=[]), "joints", "wrong_count"),
        (lambda m: m["gripper"].update(width=0.08), "gripper.width", "unknown_key"),
        (lambda m: m.update(driver="franka"), "driver", "unknown_key"),
    ],
)
def test_mistakes_in_a_robot_model(
    bench: Bench, change: Callable[[dict[str, Any]], object], key: str, code: str
) -> None:
    change(bench.arm)
    assert bench.only() == ("arm.yaml", key, code)


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
    assert bench.only() == ("arm.yaml", "gripper.joints.1", "wrong_joint")


def test_a_model_and_a_urdf_without_speed_limits(bench: Bench) -> None:
    del bench.arm["limits"]["velocity"]
    assert bench.found() == set(), "the URDF has them"
    bench.urdf = bench.urdf.replace('velocity="2.175"', 'velocity="0"')
    assert bench.only() == ("arm.yaml", "limits.velocity", "missing_key")


def test_an_object_whose_urdf_is_broken(tmp_path: Path) -> None:
    (tmp_path / "cup.urdf").write_text("<robot>")
    (tmp_path / "rig.yaml").write_text("objects: [{name: cup, urdf: cup.urdf}, {name: mug, urdf: mug.urdf}]")
    found = problems(tmp_path / "rig.yaml")
    assert [(Path(problem.file).name, problem.key) for problem in found] == [
        ("cup.urdf", ""),
        ("rig.yaml", "objects.1.urdf"),
    ]


def test_a_driver_whose_package_does_not_import() -> None:
    problem = only(robot(drivers={"sim": "no_such_lab.arm:DRIVER"}))
    assert (problem.key, problem.code) == ("robots.arm", "unknown_driver")


# Many mistakes at once: each is reported as it is alone, and nothing else is.


def _hide_speed_limit(bench: Bench) -> None:
    del bench.arm["limits"]["velocity"]
    bench.urdf = bench.urdf.replace('velocity="2.175"', 'velocity="0"')


MISTAKES: dict[tuple[str, str], Callable[[Bench], object]] = {
    # The arm's entry in the rig: a key, a type, a unit, and what only its model or its URDF can tell.
    ("rig.yaml", "robots.panda.colour"): lambda b: b.panda.update(colour="red"),
    ("rig.yaml", "robots.panda.move_sped"): lambda b: b.panda.update(move_sped=0.2),
    ("rig.yaml", "robots.panda.speed"): lambda b: b.panda.update(speed="fast"),
    ("rig.yaml", "robots.panda.base"): lambda b: b.panda.update(base=[0, 0, 1]),
    ("rig.yaml", "robots.panda.initial"): lambda b: b.panda.update(initial=[0, -45, 0, -135, 0, 90, 45]),
    ("rig.yaml", "robots.panda.limits.torque"): lambda b: b.panda.update(limits={"torque": 1000}),
    ("rig.yaml", "robots.panda.gripper.speed"): lambda b: b.panda.update(gripper={"speed": 9.0}),
    ("rig.yaml", "robots.panda.drivers.rael"): lambda b: b.panda.update(drivers={"rael": "franka"}),
    ("rig.yaml", "robots.panda.workspace"): lambda b: b.panda.update(workspace={"upper": [1, 1, 0], "table_height": 1}),
    ("rig.yaml", "robots.other.model"): lambda b: b.rig["robots"]["other"].update(model="iwia"),
    # Its model.
    ("arm.yaml", "driver"): lambda b: b.arm.update(driver=b.arm.pop("drivers")),
    ("arm.yaml", "description"): lambda b: b.arm.update(description=7),
    ("arm.yaml", "joints.2"): lambda b: b.arm["joints"].__setitem__(2, "panda_jiont3"),
    ("arm.yaml", "tcp.lnk"): lambda b: b.arm["tcp"].update(lnk=b.arm["tcp"].pop("link")),
    ("arm.yaml", "base_link"): lambda b: b.arm.update(base_link="panda_lnik0"),
    ("arm.yaml", "home"): lambda b: b.arm["home"].__setitem__(3, 0.5),
    ("arm.yaml", "limits.jerk"): lambda b: b.arm["limits"].pop("jerk"),
    ("arm.yaml", "limits.acceleration"): lambda b: b.arm["limits"].update(acceleration=0),
    ("arm.yaml", "limits.velocity"): _hide_speed_limit,
    ("arm.yaml", "limits"): lambda b: b.arm["limits"]["lower"].__setitem__(0, 3.0),
    ("arm.yaml", "limits.effort"): lambda b: b.arm["limits"].update(effort=9),
    ("arm.yaml", "gripper.joints.0"): lambda b: b.arm["gripper"]["joints"].__setitem__(0, "finger"),
    # Cameras and their model.
    ("rig.yaml", "cameras.wrist.attached.lnk"): lambda b: b.wrist["attached"].update(
        lnk=b.wrist["attached"].pop("link")
    ),
    ("rig.yaml", "cameras.wrist.output.width"): lambda b: b.wrist["output"].update(width="wide"),
    ("rig.yaml", "cameras.wrist.capture"): lambda b: b.wrist.update(capture={"width": 9, "height": 9, "rate_hz": 9}),
    ("rig.yaml", "cameras.wrist.drivers.sim"): lambda b: b.wrist.update(drivers={"sim": 3}),
    ("rig.yaml", "cameras.scene.model"): lambda b: b.rig["cameras"]["scene"].update(model="realsense_d453"),
    ("rig.yaml", "cameras.scene.look_at.yaw"): lambda b: b.rig["cameras"]["scene"]["look_at"].update(yaw=3),
    ("rig.yaml", "cameras.ear.attached.robot"): lambda b: b.attach("ear", robot="pnada"),
    ("rig.yaml", "cameras.nose.attached.link"): lambda b: b.attach("nose", link="panda_hadn"),
    ("rig.yaml", "cameras.eye"): lambda b: b.rig["cameras"].update(eye={"model": "realsense_d435"}),
    ("camera.yaml", "mode"): lambda b: b.camera.update(mode=[]),
    ("camera.yaml", "distortion"): lambda b: b.camera.update(distortion=[0, 0]),
    # Objects: in files, in the rig, changed.
    ("cup.yaml", "colour"): lambda b: b.cup.update(colour="red"),
    ("cup.yaml", "urdf"): lambda b: b.cup.update(urdf="cpu.urdf"),
    ("cup.yaml", "random.z"): lambda b: b.cup.setdefault("random", {}).update(z=[2, 1]),
    ("cup.yaml", "random.yaw"): lambda b: b.cup.setdefault("random", {}).update(yaw=[0, 1]),
    ("rig.yaml", "objects.5.mas"): lambda b: b.objects[5].update(mas=1),
    ("rig.yaml", "objects.6"): lambda b: b.objects.append({"file": "cube", "name": "ball", "radius": 0.1}),
    # The pad, the simulation, the caller.
    ("rig.yaml", "gamepads.pad.driver"): lambda b: b.pad.update(driver="evdve"),
    ("rig.yaml", "gamepads.pad.model"): lambda b: b.pad.update(model="dualshok4"),
    ("rig.yaml", "gamepads.pad.dead_zone"): lambda b: b.pad.update(dead_zone=2),
    ("rig.yaml", "simulation.physics_rate"): lambda b: b.rig["simulation"].update(physics_rate=1000),
    ("rig.yaml", "simulation.clock"): lambda b: b.rig["simulation"].update(clock="lockstep"),
    ("--set", "cameras.wrsit.output.width"): lambda b: b.overrides.append("cameras.wrsit.output.width=3"),
    ("--set", "robots.panda.tcp_speed"): lambda b: b.overrides.append("robots.panda.tcp_speed=-1"),
}


def test_the_bench_is_valid(bench: Bench) -> None:
    assert bench.found() == set()
    assert len(load(bench.folder / "rig.yaml").resolve().robots) == 2


@pytest.mark.parametrize("place", MISTAKES, ids=" ".join)
def test_each_mistake_alone_is_one_problem(bench: Bench, place: tuple[str, str]) -> None:
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
        ("arm.yaml", "limts"),
        ("arm.yaml", "limts.jerk"),
        ("arm.yaml", "limts.velocity"),
        ("--set", "robots.other.wrokspace"),
        ("--set", "robots.other.wrokspace.table_height"),
    }


def test_a_key_that_only_looks_like_another_is_one_problem(bench: Bench) -> None:
    bench.wrist["depth_min"] = 0.1  # nearest: depth, which holds min and max
    assert bench.found() == {("rig.yaml", "cameras.wrist.depth_min")}


@pytest.mark.parametrize("name", ["arm", "camera", "cup"])
def test_nonsense_in_a_model_or_an_object_is_a_config_error_or_nothing_worse(bench: Bench, name: str) -> None:
    refused = 0
    good = getattr(bench, name)
    for k, place in enumerate(places(good)[::4]):
        setattr(bench, name, copy.deepcopy(good))
        target = getattr(bench, name)
        for part in place[:-1]:
            target = target[part]
        target[place[-1]] = NONSENSE[k % len(NONSENSE)]
        refused += bool(bench.found())
    assert refused > len(places(good)) / 8


def test_a_joint_that_does_not_move_lacks_no_limits(bench: Bench) -> None:
    bench.arm["limits"] = {"acceleration": 10, "jerk": 500}  # the rest is the URDF's, which has none for this joint
    bench.arm["real_limits"] = {}
    assert bench.found() == set()
    bench.arm["joints"][6] = "panda_joint8"
    assert bench.found() == {("arm.yaml", "joints.6")}


def test_a_mistake_in_an_objects_file_is_reported_once(bench: Bench) -> None:
    bench.cup["rgba"] = [255, 0, 0, 1]
    bench.objects.append({"file": "cup.yaml", "name": "mug", "fixd": True})
    assert bench.found() == {("cup.yaml", "rgba"), ("rig.yaml", "objects.6.fixd")}
