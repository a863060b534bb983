"""Mistakes in configuration files: all of them at once, each with file, key, what is right and the nearest spelling."""

from __future__ import annotations

import copy
import random
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
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
    """What is wrong; fails where nothing is."""
    with pytest.raises(ConfigError) as caught:
        load(config, **arguments)
    return list(caught.value.problems)


def only(config: Any, **arguments: Any) -> Problem:
    """The one thing that is wrong."""
    found = problems(config, **arguments)
    assert len(found) == 1, "\n".join(map(str, found))
    return found[0]


def robot(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": {**ROBOT, **keys}}}


def camera(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": ROBOT}, "cameras": {"eye": {**CAMERA, **keys}}}


def thing(**keys: Any) -> dict[str, Any]:
    return {"objects": [{"name": "brick", "shape": "box", "half_extents": [1, 1, 1], **keys}]}


@pytest.mark.parametrize(
    ("config", "key", "words"),
    [
        # Unknown keys, with the nearest right one.
        ({"robtos": {}}, "robtos", ["did you mean 'robots'"]),
        (robot(sped=0.2), "robots.arm.sped", ["did you mean 'speed'", "tcp_speed"]),
        (robot(base={"positon": [0, 0, 0]}), "robots.arm.base.positon", ["did you mean 'position'"]),
        (robot(gripper={"sped": 0.05}), "robots.arm.gripper.sped", ["did you mean 'speed'"]),
        (camera(look_at={**LOOK, "yaw": 3}), "cameras.eye.look_at.yaw", ["did you mean 'yaw_deg'"]),
        (camera(streams={"colour": {}}), "cameras.eye.streams.colour", ["did you mean 'color'"]),
        (camera(streams={"color": {"fromat": "bgr8"}}), "cameras.eye.streams.color.fromat", ["'format'"]),
        ({"simulation": {"physics_rate": 1}}, "simulation.physics_rate", ["physics_hz"]),
        (thing(half_extent=[1, 1, 1]), "objects.0.half_extent", ["did you mean 'half_extents'"]),
        # Unknown names, with the nearest right one.
        ({"robots": {"arm": {"model": "pnada"}}}, "robots.arm.model", ["did you mean 'panda'", "iiwa"]),
        (
            {"cameras": {"e": {**CAMERA, "model": "realsens_d435"}}},
            "cameras.e.model",
            ["mean 'realsense_d435'", "pinhole"],
        ),
        ({"gamepads": {"p": {"model": "dualshok4"}}}, "gamepads.p.model", ["did you mean 'dualshock4'", "auto"]),
        ({"gamepads": {"p": {"driver": "evdve"}}}, "gamepads.p.driver", ["did you mean 'evdev'"]),
        ({"objects": ["cub"]}, "objects.0", ["did you mean 'cube'", "table"]),
        (robot(drivers={"sim": "pybulet"}), "robots.arm", ["did you mean 'pybullet'"]),
        (robot(drivers={"sim": "evdev"}), "robots.arm", ["'evdev' has no robot", "gamepad"]),
        ({"simulation": {"clock": "lockstep"}}, "simulation.clock", ["did you mean 'lock_step'"]),
        ({"simulation": {"renderer": "opengl"}}, "simulation.renderer", ["auto", "gl", "tiny"]),
        # A camera on a robot or a link that is not there.
        (
            camera(look_at=None, attached={"robot": "arn", "link": "panda_hand"}),
            "cameras.eye.attached.robot",
            ["no robot 'arn'", "did you mean 'arm'"],
        ),
        (
            camera(look_at=None, attached={"robot": "arm", "link": "panda_hnad"}),
            "cameras.eye.attached.link",
            ["did you mean 'panda_hand'"],
        ),
        # A mode or a stream that the model lacks.
        (
            camera(capture={"width": 640, "height": 480, "rate_hz": 31}),
            "cameras.eye.capture",
            ["no mode 640x480 at 31 Hz", "640x480 at 6, 15, 30, 60 Hz", "1280x720"],
        ),
        (
            camera(capture={"width": 641, "height": 480, "rate_hz": 30}),
            "cameras.eye.capture",
            ["641x480", "848x480"],
        ),
        (camera(depth={"min": 0.1, "max": 1.0}), "cameras.eye.depth", ["realsense_d435", "adjustable"]),
        (camera(streams=[]), "cameras.eye.streams", ["at least one"]),
        # Wrong types and wrong counts.
        ({"sim": "yes"}, "sim", ["true or false", "'yes'"]),
        ({"robots": ["panda"]}, "robots", ["keys and values"]),
        ({"robots": {"arm": "panda"}}, "robots.arm", ["keys and values", "'panda'"]),
        ({"objects": {"cube": 1}}, "objects", ["a list"]),
        ({"objects": [7]}, "objects.0", ["a file, a name"]),
        (robot(speed="fast"), "robots.arm.speed", ["a number", "'fast'"]),
        (robot(speed=1.5), "robots.arm.speed", ["at most 1", "1.5"]),
        (robot(speed=True), "robots.arm.speed", ["a number"]),
        (robot(model=5), "robots.arm.model", ["text"]),
        ({"robots": {"arm": {}}}, "robots.arm.model", ["is missing"]),
        ({"robots": {"my arm": ROBOT}}, "robots.my arm", ["match pattern"]),
        (camera(output={"width": 256.5, "height": 256}), "cameras.eye.output.width", ["whole number"]),
        (camera(output={"width": "256", "height": 256}), "cameras.eye.output.width", ["whole number"]),
        (camera(output={"width": 0, "height": 256}), "cameras.eye.output.width", ["greater than 0"]),
        ({"simulation": {"physics_hz": float("nan")}}, "simulation.physics_hz", ["number"]),
        ({"simulation": {"gravity": -9.81}}, "simulation.gravity", ["3 numbers"]),
        ({"simulation": {"gravity": [0, 0, "down"]}}, "simulation.gravity", ["item 3 is 'down'"]),
        # Wrong units: a pose of 3 numbers where 7 are due, degrees, a quaternion that is none.
        (camera(look_at=None, pose=[0, 0, 1]), "cameras.eye.pose", ["7 numbers", "not 3", "quaternion"]),
        (robot(base=[0, 0, 0]), "robots.arm.base", ["7 numbers", "not 3"]),
        (robot(base={"position": [0, 0]}), "robots.arm.base.position", ["3 numbers", "in m", "not 2"]),
        (robot(base={"orientation": [0, 0, 90]}), "robots.arm.base.orientation", ["4 numbers", "not 3"]),
        (robot(base={"orientation": [0, 0, 90, 1]}), "robots.arm.base.orientation", ["unit quaternion", "90"]),
        (robot(initial=[0, -45, 0, -135, 0, 90, 45]), "robots.arm.initial", ["panda_joint2", "-45", "rad"]),
        (robot(initial=[0, 0, 0]), "robots.arm.initial", ["7 numbers", "panda_joint7", "not 3"]),
        (
            camera(look_at=None, attached={"robot": "arm", "link": "panda_hand", "rotation": [1, 2]}),
            "cameras.eye.attached.rotation",
            ["roll, pitch, yaw in rad", "quaternion"],
        ),
        (
            camera(look_at=None, attached={"robot": "arm", "link": "panda_hand", "target": [0, 0, 0]}),
            "cameras.eye.attached.target",
            ["direction"],
        ),
        # A simulated camera must stand somewhere, and in one place.
        (camera(look_at=None), "cameras.eye", ["look_at, pose or attached"]),
        (camera(pose={}), "cameras.eye", ["one place", "look_at", "pose"]),
        # Numbers that are out of every plausible range are mostly in another unit.
        (robot(tcp_speed=250), "robots.arm.tcp_speed", ["at most 10 m/s", "250 mm/s would be 0.25"]),
        (camera(look_at={**LOOK, "distance": 1200}), "cameras.eye.look_at.distance", ["50 m", "1200 mm would be 1.2"]),
        (camera(look_at={**LOOK, "target": [0, 500, 0]}), "cameras.eye.look_at.target", ["50 m", "item 2 is 500"]),
        (camera(look_at={**LOOK, "pitch_deg": 1e9}), "cameras.eye.look_at.pitch_deg", ["-360 to 360 deg"]),
        (thing(half_extents=[1, 10, 1]), "objects.0.half_extents", ["at most 5 m", "item 2 is 10", "10 mm would be"]),
        (thing(half_extents=[1, 0, 1]), "objects.0.half_extents", ["above 0"]),
        (thing(mass=100), "objects.0.mass", ["0 to 50 kg", "100 g would be 0.1"]),
        (thing(position=[0, 0, 600]), "objects.0.position", ["-50 to 50 m", "item 3 is 600", "0.6"]),
        (robot(base={"position": [-550, 0, 0]}), "robots.arm.base.position", ["-550 mm would be -0.55"]),
        (robot(limits={"velocity": 150}), "robots.arm.limits.velocity", ["50 rad/s", "150 deg/s would be 2.618"]),
        (robot(limits={"upper": 170, "allow_looser_limits": True}), "robots.arm.limits.upper", ["30 rad", "2.967"]),
        (robot(workspace={"table_height": 200}), "robots.arm.workspace.table_height", ["50 m"]),
        (robot(gripper={"speed": 50}), "robots.arm.gripper.speed", ["50 mm/s would be 0.05"]),
        (robot(rate_hz=1e6), "robots.arm.rate_hz", ["10 to 10000 Hz"]),
        ({"simulation": {"gravity": [0, 0, -981]}}, "simulation.gravity", ["-100 to 100 m/s2"]),
        (
            camera(look_at=None, attached={"robot": "arm", "link": "panda_hand", "rotation": [0, 90, 0]}),
            "cameras.eye.attached.rotation",
            ["rad", "item 2 is 90", "90 deg would be 1.571"],
        ),
        (
            camera(look_at=None, attached={"robot": "arm", "link": "panda_hand", "translation": [90, 0, 0]}),
            "cameras.eye.attached.translation",
            ["5 m", "90 mm would be 0.09"],
        ),
        # Limits.
        (robot(limits={"velocity": [1, 1]}), "robots.arm.limits.velocity", ["7 numbers", "rad/s", "not 2"]),
        (robot(limits={"velocity": 3.0}), "robots.arm.limits.velocity", ["looser", "allow_looser_limits", "2.175"]),
        (robot(limits={"lower": -3.0}), "robots.arm.limits.lower", ["looser"]),
        (robot(limits={"velocity": -1.0}), "robots.arm.limits.velocity", ["above 0"]),
        (robot(gripper={"speed": 0.9}), "robots.arm.gripper.speed", ["at most 0.1"]),
        ({"robots": {"a": {"model": "iiwa", "gripper": {"speed": 0.1}}}}, "robots.a.gripper", ["no gripper"]),
        (
            robot(workspace={"upper": [1, 1, 0.1], "table_height": 0.2}),
            "robots.arm.workspace",
            ["empty"],
        ),
        # Objects.
        (thing(half_extents=None), "objects.0", ["a box has half_extents", "missing"]),
        (thing(radius=1), "objects.0", ["radius has no meaning"]),
        (thing(shape="cone"), "objects.0.shape", ["'cone'", "cylinder"]),
        (thing(mass=-1), "objects.0.mass", ["0 to 50 kg"]),
        (thing(rgba=[255, 0, 0, 1]), "objects.0.rgba", ["0 to 1"]),
        ({"objects": ["cube", "cube"]}, "name", ["'cube' is also the name of objects.0", "differ"]),
        ({"robots": {"cube": ROBOT}, "objects": ["cube"]}, "name", ["robots.cube"]),
        ({"objects": ["cubes/brick.yaml"]}, "objects.0", ["there is no file"]),
        (thing(random={"x": [0.1, -0.1]}), "objects.0.random.x", ["the least and the greatest", "0.1 is above -0.1"]),
        (thing(random={"y": 0.3}), "objects.0.random.y", ["2 numbers", "0.3"]),
        (thing(random={"z": [1, 2, 3]}), "objects.0.random.z", ["2 numbers", "not 3"]),
        (thing(random={"x": [0, float("nan")]}), "objects.0.random.x", ["2 numbers", "nan"]),
        (thing(random={"x": [0, "far"]}), "objects.0.random.x", ["2 numbers", "'far'"]),
        (thing(random={"yaw_deg": [-400, 0]}), "objects.0.random.yaw_deg", ["-360 to 360 deg"]),
        (thing(random={"yaw": [-1, 1]}), "objects.0.random.yaw", ["did you mean 'yaw_deg'"]),
        (thing(random={}), "objects.0.random", ["no range", "yaw_deg"]),
        (thing(random=[-1, 1]), "objects.0.random", ["keys and values"]),
        ({"objects": [{"name": "f", "shape": "plane", "random": {"x": [0, 1]}}]}, "objects.0", ["plane", "random"]),
        (
            {"objects": [{"file": "cube", "attached": {"robot": "arm", "link": "hand"}, "random": {"x": [0, 1]}}]}
            | robot(),
            "objects.0",
            ["attached and random"],
        ),
        # Pads.
        ({"gamepads": {"p": {"driver": "playback"}}}, "gamepads.p.file", ["is missing", "recording"]),
        ({"gamepads": {"p": {"driver": "playback", "file": "no.jsonl"}}}, "gamepads.p.file", ["there is no file"]),
        ({"gamepads": {"p": {"driver": "keyboard"}}}, "gamepads.p.driver", ["web", "terminal"]),
        ({"gamepads": {"p": {"file": "a.jsonl"}}}, "gamepads.p.file", ["playback"]),
        # Names of devices.
        ({"robots": {"a": ROBOT}, "cameras": {"a": CAMERA}}, "cameras.a", ["robots.a has the same name"]),
    ],
)
def test_one_mistake_is_one_problem_with_its_key(config: dict[str, Any], key: str, words: list[str]) -> None:
    problem = only(config)
    assert problem.key == key
    for word in words:
        assert word in problem.message


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
    ("keys", "place", "words"),
    [
        ({"tcp_speed": 3.0}, "robots.arm.tcp_speed", ["at most 1.5 m/s on a real arm", "3"]),
        (
            {"limits": {"velocity": 20, "allow_looser_limits": True}},
            "robots.arm.limits.velocity",
            ["at most 15 rad/s for every joint of a real arm", "20"],
        ),
        (
            {"limits": {"jerk": 30000, "allow_looser_limits": True}},
            "robots.arm.limits.jerk",
            ["at most 20000 rad/s3"],
        ),
    ],
)
def test_what_a_simulation_may_do_a_real_arm_may_not(keys: dict[str, Any], place: str, words: list[str]) -> None:
    config = {"robots": {"arm": {**REAL, **keys}}}
    load(config, sim=True)
    found = {problem.key: problem.message for problem in problems(config)}
    for word in words:
        assert word in found[place]


def test_the_hard_limits_of_a_real_arm_hold_for_its_model_too(own_model: Callable[..., Path]) -> None:
    rig = own_model(lambda m: m.update(real_limits={}, limits=m["limits"] | {"acceleration": 150}))
    load(rig, sim=True)
    found = problems(rig, sim=False, overrides=["robots.arm.drivers.real=mock"])
    assert ("arm.yaml", "limits.acceleration") in {(Path(problem.file).name, problem.key) for problem in found}


def test_every_mistake_in_every_file_is_listed(tmp_path: Path) -> None:
    (tmp_path / "bad_arm.yaml").write_text("urdf: arm.urdf\njoints: [j1]\ntcp: {lnk: hand}\nhome: [0]\n")
    (tmp_path / "bad_brick.yaml").write_text("name: brick\nshape: box\n")
    (tmp_path / "rig.yaml").write_text(
        """
sim: maybe
robots:
  good: {model: panda, initial: [1]}
  bad: {model: panda, sped: 1}
  ugly: {model: bad_arm.yaml}
cameras:
  eye: {model: realsense_d435, attached: {robot: bad, link: anything}}
  ear: {model: realsense_d435, attached: {robot: god, link: panda_hand}}
  nose: {model: realsense_d435, attached: {robot: good, link: panda_hadn}}
objects: [bad_brick.yaml, missing.yaml, cub]
"""
    )
    found = problems(tmp_path / "rig.yaml", overrides=["cameras.wrsit.output.width=3", "robots.good.colour=red"])
    rig, arm, brick = (str(tmp_path / name) for name in ("rig.yaml", "bad_arm.yaml", "bad_brick.yaml"))
    assert {(problem.file, problem.key) for problem in found} == {
        (rig, "sim"),
        (rig, "robots.bad.sped"),
        ("--set", "robots.good.colour"),
        ("--set", "cameras.wrsit.output.width"),
        (rig, "robots.good.initial"),
        (arm, "tcp.lnk"),
        (arm, "urdf"),
        (arm, "limits.acceleration"),
        (arm, "limits.jerk"),
        (brick, ""),
        (rig, "objects.1"),
        (rig, "objects.2"),
        (rig, "cameras.eye.attached.link"),
        (rig, "cameras.ear.attached.robot"),
        (rig, "cameras.nose.attached.link"),
    }
    text = str(ConfigError(found))
    assert text.startswith("15 problems")
    assert f"{rig}: robots.bad.sped: " in text


# Files.


def test_missing_file_and_unknown_rig(tmp_path: Path) -> None:
    (tmp_path / "panda_bench.yaml").write_text("{}")
    problem = only(tmp_path / "panda_bnech.yaml")
    assert problem.file == str(tmp_path / "panda_bnech.yaml")
    assert "there is no such file" in problem.message
    assert "'panda_bench.yaml'" in problem.message
    assert "did you mean 'panda_table'" in only("panda_tabel").message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("robots: {arm: [", ["not valid YAML", "line"]),
        ("- a\n- b\n", ["keys and values", "a list of 2"]),
        ("", ["is empty"]),
        ("robots: !!python/object/apply:os.system ['true']", ["not valid YAML"]),
        ("a: 1\n---\nb: 2\n", ["not valid YAML"]),
        ("objects: &all [*all]", ["alias *all"]),
    ],
)
def test_files_that_are_no_rig(tmp_path: Path, text: str, words: list[str]) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    problem = only(tmp_path / "rig.yaml")
    for word in words:
        assert word in problem.message


def test_keys_that_are_given_twice(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("robots:\n  arm: {model: panda}\n  arm: {model: iiwa, speed: 0.1, speed: 0.2}\n")
    found = {problem.key: problem.message for problem in problems(tmp_path / "rig.yaml")}
    assert set(found) == {"robots.arm", "robots.arm.speed"}
    assert "given twice, in lines 2 and 3" in found["robots.arm"]


def test_a_folder_in_place_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").mkdir()
    assert "cannot be read" in only(tmp_path / "rig.yaml").message


# Overrides and arguments.


@pytest.mark.parametrize(
    ("override", "key", "words"),
    [
        ("cameras.wrist.output.widht=320", "cameras.wrist.output.widht", ["did you mean 'width'"]),
        ("cameras.wrsit.output.width=320", "cameras.wrsit.output.width", ["no camera 'wrsit'", "did you mean 'wrist'"]),
        ("cameras.wrist.output.width=wide", "cameras.wrist.output.width", ["whole number", "'wide'"]),
        ("cameras.wrist.output.width=[", "cameras.wrist.output.width", ["not valid YAML"]),
        ("simulaton.physics_hz=1000", "simulaton", ["did you mean 'simulation'"]),
        ("sim", "", ["KEY=VALUE"]),
        ("sim.deep=1", "sim.deep", ["sim holds no keys"]),
        ("objects.9=cube", "objects.9", ["list of 4"]),
        ("robots..speed=1", "robots..speed", ["empty part"]),
    ],
)
def test_overrides_are_to_blame_for_their_own_mistakes(override: str, key: str, words: list[str]) -> None:
    problem = only("panda_table", overrides=[override])
    assert (problem.file, problem.key) == ("--set", key)
    for word in words:
        assert word in problem.message


NONSENSE = [None, -1, 2.5, "x", [], {}, [1, 2], True, float("nan"), float("inf"), 10**400, {1: 2}, [None] * 7]


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every key and item in nested data."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [deeper for key, item in items for deeper in places(item, (*path, key))]


def test_nonsense_anywhere_is_a_config_error_or_nothing_worse() -> None:
    """Never a traceback for a person's mistake: nonsense in every place of a rig."""
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
    assert {problem.key for problem in found} == {"clock", "driver"}
    assert any("did you mean 'lock_step'" in problem.message for problem in found)


def test_a_real_arm_without_a_driver_for_it() -> None:
    found = problems({"robots": {"arm": {"model": "iiwa"}}}, sim=False)
    assert [problem.key for problem in found] == ["robots.arm"]
    assert "no driver for a real robot" in found[0].message
    assert "robots.arm.drivers.real" in found[0].message


# Models and URDFs.


@pytest.fixture
def own_model(tmp_path: Path) -> Callable[..., Path]:
    """Writes a rig with a changed copy of the Panda's model, and a changed copy of its URDF."""
    original = yaml.safe_load(find_data("robots", "panda.yaml").read_text())
    text = Path(load("panda_table").resolve().robots[0].urdf).read_text()

    def write(change: Callable[[dict[str, Any]], object] = lambda model: None, urdf: str | None = None) -> Path:
        model = copy.deepcopy(original) | {"urdf": "arm.urdf"}
        change(model)
        (tmp_path / "arm.urdf").write_text(text if urdf is None else urdf)
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(model))
        (tmp_path / "rig.yaml").write_text("robots: {arm: {model: arm.yaml}}")
        return tmp_path / "rig.yaml"

    return write


def test_the_copied_model_is_in_order(own_model: Callable[..., Path]) -> None:
    load(own_model())


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        (lambda m: m["joints"].__setitem__(2, "panda_jiont3"), "joints.2", ["did you mean 'panda_joint"]),
        (lambda m: m["joints"].__setitem__(6, "panda_joint8"), "joints.6", ["is fixed", "panda_joint7"]),
        (lambda m: m["joints"].__setitem__(6, "panda_joint1"), "joints.6", ["given twice"]),
        (lambda m: m["joints"].__setitem__(6, "panda_finger_joint1"), "joints.6", ["does not move the tcp's link"]),
        (lambda m: m["gripper"]["joints"].__setitem__(0, "finger"), "gripper.joints.0", ["panda_finger_joint1"]),
        (lambda m: m["tcp"].update(link="panda_hnad"), "tcp.link", ["did you mean 'panda_hand'"]),
        (lambda m: m.update(base_link="base"), "base_link", ["no link 'base'", "panda_link0"]),
        (lambda m: m["limits"].pop("acceleration"), "limits.acceleration", ["is missing", "rad/s2"]),
        (lambda m: m["limits"].pop("jerk"), "limits.jerk", ["is missing", "rad/s3"]),
        (lambda m: m["limits"].update(jerk=0), "limits.jerk", ["above 0"]),
        (lambda m: m["limits"]["upper"].pop(), "limits.upper", ["7 numbers", "not 6"]),
        (lambda m: m["limits"]["lower"].__setitem__(0, 3.0), "limits", ["lower must be below upper", "panda_joint1"]),
        (lambda m: m["home"].pop(), "home", ["7 numbers", "not 6"]),
        (lambda m: m["home"].__setitem__(3, 0.5), "home", ["panda_joint4", "outside its limits", "rad"]),
        (lambda m: m.update(urdf={"package": "no_such_robots", "path": "a.urdf"}), "urdf.package", ["pip install"]),
        (lambda m: m.update(urdf="amr.urdf"), "urdf", ["there is no file", "did you mean 'arm.urdf'"]),
        (lambda m: m.update(urdf={"package": "yaml", "path": "a.urdf"}), "urdf", ["there is no file"]),
        (lambda m: m.pop("tcp"), "tcp", ["is missing"]),
        (lambda m: m.update(joints=[]), "joints", ["at least 1"]),
        (lambda m: m["gripper"].update(width=0.08), "gripper.width", ["did you mean 'width_max'"]),
        (lambda m: m.update(driver="franka"), "driver", ["did you mean 'drivers'"]),
    ],
)
def test_mistakes_in_a_robot_model(
    own_model: Callable[..., Path], change: Callable[[dict[str, Any]], object], key: str, words: list[str]
) -> None:
    rig = own_model(change)
    problem = only(rig)
    assert (problem.file, problem.key) == (str(rig.parent / "arm.yaml"), key)
    for word in words:
        assert word in problem.message


@pytest.mark.parametrize(
    ("urdf", "words"),
    [
        ("<robot name='x'><link name='a'></robot>", ["not valid XML"]),
        ("<sdf/>", ["not a URDF", "<sdf>"]),
        ("<robot/>", ["no links"]),
        ("<robot><link name='a'/><joint name='j' type='fixed'><parent link='a'/></joint></robot>", ["'j' lacks"]),
        (
            "<robot><link name='a'/><joint name='j' type='fixed'><parent link='a'/><child link='b'/></joint></robot>",
            ["'j' names link 'b'"],
        ),
        (
            "<robot><link name='a'/><link name='b'/><joint name='j' type='revolute'><parent link='a'/><child link='b'/>"
            "<limit lower='low'/></joint></robot>",
            ["lower='low' is no number"],
        ),
    ],
)
def test_a_urdf_that_does_not_parse(own_model: Callable[..., Path], urdf: str, words: list[str]) -> None:
    rig = own_model(urdf=urdf)
    problem = only(rig)
    assert problem.file == str(rig.parent / "arm.urdf")
    for word in words:
        assert word in problem.message


def test_one_of_the_arms_own_joints_is_no_finger(own_model: Callable[..., Path]) -> None:
    problem = only(own_model(lambda model: model["gripper"]["joints"].__setitem__(0, "panda_joint7")))
    assert problem.key == "gripper.joints"
    assert "one of the arm's joints" in problem.message


def test_a_finger_that_turns_is_refused(own_model: Callable[..., Path], tmp_path: Path) -> None:
    own_model()
    urdf = ElementTree.parse(tmp_path / "arm.urdf")
    (finger,) = (joint for joint in urdf.iter("joint") if joint.get("name") == "panda_finger_joint2")
    finger.set("type", "revolute")
    problem = only(own_model(urdf=ElementTree.tostring(urdf.getroot(), "unicode")))
    assert (problem.file, problem.key) == (str(tmp_path / "arm.yaml"), "gripper.joints.1")
    for word in ("panda_finger_joint2", "revolute", "prismatic"):
        assert word in problem.message


def test_a_model_and_a_urdf_without_speed_limits(own_model: Callable[..., Path], tmp_path: Path) -> None:
    rig = own_model(lambda model: model["limits"].pop("velocity"))
    load(rig)  # the URDF has them
    text = (tmp_path / "arm.urdf").read_text().replace('velocity="2.1750"', 'velocity="0"')
    problem = only(own_model(lambda model: model["limits"].pop("velocity"), text))
    assert problem.key == "limits.velocity"
    assert "panda_joint1" in problem.message


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
    assert problem.key == "robots.arm"
    assert "no_such_lab" in problem.message


# Many mistakes at once: what each one alone is told, all together are told, and nothing else.


class Bench:
    """A rig in order, in files that mistakes can be made in."""

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
        self.rig["robots"]["other"] = {"model": "iiwa", "base": [2, 0, 0, 0, 0, 0, 1]}
        self.objects: list[Any] = self.rig["objects"]
        self.objects += ["cup.yaml", {"file": "cube", "name": "brick"}]

    def found(self) -> set[tuple[str, str]]:
        """File and key of each problem; every one is told once."""
        for name in ("rig", "arm", "camera", "cup"):
            (self.folder / f"{name}.yaml").write_text(yaml.safe_dump(getattr(self, name)))
        (self.folder / "arm.urdf").write_text(self.urdf)
        (self.folder / "cup.urdf").write_text("<robot name='cup'><link name='cup'/></robot>")
        try:
            load(self.folder / "rig.yaml", overrides=self.overrides)
            found: tuple[Problem, ...] = ()
        except ConfigError as error:
            found = error.problems
        places = [(Path(problem.file).name, problem.key) for problem in found]
        assert len(places) == len(set(places)), "\n".join(map(str, found))
        return set(places)


def _hide_speed_limit(bench: Bench) -> None:
    del bench.arm["limits"]["velocity"]
    bench.urdf = bench.urdf.replace('velocity="2.1750"', 'velocity="0"')


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


def test_the_bench_is_in_order(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.found() == set()
    assert len(load(tmp_path / "rig.yaml").resolve().robots) == 2


@pytest.mark.parametrize("place", MISTAKES, ids=" ".join)
def test_each_mistake_alone_is_one_problem(tmp_path: Path, place: tuple[str, str]) -> None:
    bench = Bench(tmp_path)
    MISTAKES[place](bench)
    assert bench.found() == {place}


def test_all_mistakes_on_all_levels_are_told_at_once(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    for make in MISTAKES.values():
        make(bench)
    assert bench.found() == set(MISTAKES)


@pytest.mark.parametrize("seed", range(15))
def test_no_mistake_hides_another_and_none_invents_one(tmp_path: Path, seed: int) -> None:
    bench = Bench(tmp_path)
    some = random.Random(seed).sample(list(MISTAKES), 2 + seed % 6)
    for place in some:
        MISTAKES[place](bench)
    assert bench.found() == set(some)


def test_what_stands_under_a_misspelt_key_is_checked_too_and_told_under_that_key(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.arm["limts"] = bench.arm.pop("limits") | {"jerk": 0, "velocity": "fast"}
    bench.overrides = ["robots.other.wrokspace.table_height=high"]
    assert bench.found() == {
        ("arm.yaml", "limts"),
        ("arm.yaml", "limts.jerk"),
        ("arm.yaml", "limts.velocity"),
        ("--set", "robots.other.wrokspace"),
        ("--set", "robots.other.wrokspace.table_height"),
    }


def test_a_key_that_only_looks_like_another_is_one_problem(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.wrist["depth_min"] = 0.1  # nearest: depth, which holds min and max
    assert bench.found() == {("rig.yaml", "cameras.wrist.depth_min")}


@pytest.mark.parametrize("name", ["arm", "camera", "cup"])
def test_nonsense_in_a_model_or_an_object_is_a_config_error_or_nothing_worse(tmp_path: Path, name: str) -> None:
    bench, refused = Bench(tmp_path), 0
    good = getattr(bench, name)
    for k, place in enumerate(places(good)[::4]):
        setattr(bench, name, copy.deepcopy(good))
        target = getattr(bench, name)
        for part in place[:-1]:
            target = target[part]
        target[place[-1]] = NONSENSE[k % len(NONSENSE)]
        refused += bool(bench.found())
    assert refused > len(places(good)) / 8


def test_a_joint_that_does_not_move_lacks_no_limits(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.arm["limits"] = {"acceleration": 10, "jerk": 500}  # the rest is the URDF's, which has none for this joint
    bench.arm["real_limits"] = {}
    assert bench.found() == set()
    bench.arm["joints"][6] = "panda_joint8"
    assert bench.found() == {("arm.yaml", "joints.6")}


def test_a_mistake_in_an_objects_file_is_not_told_again_of_who_changes_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.cup["rgba"] = [255, 0, 0, 1]
    bench.objects.append({"file": "cup.yaml", "name": "mug", "fixd": True})
    assert bench.found() == {("cup.yaml", "rgba"), ("rig.yaml", "objects.6.fixd")}
