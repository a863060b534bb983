"""What a rig's file comes to: drivers by flag, clocks, limits, camera matrices and places."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from engines_kit import AUTO
from jsonschema import Draft202012Validator

from hal.config import load
from hal.config.data_files import find_data, list_data
from hal.config.rigfile import rig_schema
from hal.errors import ConfigError
from hal.geometry import Pose
from hal.images import centre_crop
from hal.kinematics.mesh_files import package_folder
from hal.specs import BodySpec, Plan, WorldSpec, from_json, to_json

MIXED: dict[str, Any] = {
    "robots": {"one": {"model": "panda"}, "two": {"model": "panda", "sim": True, "base": {"position": [0, 1, 0]}}},
    "cameras": {"eye": {"model": "pinhole", "look_at": {"target": [0, 0, 0], "distance": 1.0}}},
}
MINE = {"sim": "mock", "real": "mock"}
"""A stand-in for a real driver that is always there."""


def plan(config: Any, **arguments: Any) -> Plan:
    return load(config, **arguments).resolve()


def with_real_drivers(config: dict[str, Any]) -> dict[str, Any]:
    copy: dict[str, Any] = json.loads(json.dumps(config))
    for section in ("robots", "cameras"):
        for device in copy[section].values():
            device["drivers"] = {"real": "mock"}
            if section == "robots":
                device["gripper"] = {"drivers": {"real": "mock"}}
    return copy


@pytest.mark.parametrize("name", list_data("config"))
def test_every_built_in_rig_is_valid(name: str) -> None:
    if name in ("baxter_table", "xarm7") and package_folder("example_robot_data") is None:
        pytest.skip("needs the package example_robot_data")
    rig = plan(name)
    assert rig.robots
    assert rig.world is not None
    assert rig.warnings == ()
    # What the hosts are given travels as JSON.
    assert from_json(WorldSpec, json.loads(json.dumps(to_json(rig.world)))) == rig.world


def test_the_pandas_limits_are_the_published_ones() -> None:
    limits = plan("panda_table").robots[0].limits
    assert limits.lower[3] == -3.0718
    assert limits.upper[1] == 1.7628
    assert limits.velocity == (2.175,) * 4 + (2.61,) * 3
    assert limits.acceleration == (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
    assert limits.jerk == tuple(500 * a for a in limits.acceleration)
    assert limits.torque == (87.0,) * 4 + (12.0,) * 3


def test_a_rig_in_one_line_has_good_defaults() -> None:
    rig = plan({"robots": {"arm": {"model": "panda"}}})
    assert rig.sim
    assert (rig.clock, rig.source) == ("real_time", "<dict>")
    arm = rig.robots[0]
    assert (arm.driver, arm.speed, arm.move_speed, arm.tcp_speed) == (AUTO, 0.3, 0.1, 0.25)
    assert (arm.rate_hz, arm.attended, arm.deadline_max) == (240.0, False, 1.0)
    assert rig.world is not None
    assert rig.world.robots == rig.robots
    assert rig.world.bodies == ()


def test_missing_flag_means_simulation_and_sim_true_overrules_all() -> None:
    config = with_real_drivers(MIXED) | {"sim": False}
    rig = plan(config)
    assert [(r.name, r.attended) for r in rig.robots] == [("one", True), ("two", False)]
    assert not rig.sim
    everything = plan(config, sim=True)
    assert everything.sim
    assert [r.attended for r in everything.robots] == [False, False]
    assert {r.driver for r in everything.robots} | {c.driver for c in everything.cameras} == {AUTO}
    config["robots"]["one"]["sim"] = False
    assert not plan(config, sim=True).robots[0].attended


def test_sim_false_sets_the_rigs_flag_and_leaves_each_device_its_own() -> None:
    rig = plan(with_real_drivers(MIXED), sim=False)
    assert not rig.sim
    one, two = rig.robots
    assert (one.driver, one.attended, one.rate_hz, one.deadline_max) == ("mock", True, 1000.0, 0.3)
    assert (two.driver, two.attended, two.rate_hz, two.deadline_max) == (AUTO, False, 240.0, 1.0)
    assert one.gripper is not None
    assert two.gripper is not None
    assert (one.gripper.driver, two.gripper.driver) == ("mock", AUTO)
    assert rig.cameras[0].driver == "mock"
    # The real arm stands in the world too, as a copy that simulated cameras see.
    assert rig.world is not None
    assert [r.name for r in rig.world.robots] == ["one", "two"]


def test_without_simulated_devices_there_is_no_world() -> None:
    config = with_real_drivers({**MIXED, "robots": {"one": {"model": "panda"}}})
    assert plan(config, sim=False).world is None
    assert plan(config).world is not None


def test_objects_alone_are_in_a_world_of_a_simulated_rig() -> None:
    objects = {"objects": ["floor", "cube"]}
    for engine in ("pybullet", "mujoco"):
        world = plan(objects, engine=engine).world
        assert world is not None
        assert (world.driver, [body.name for body in world.bodies]) == (engine, ["floor", "cube"])
    assert plan(objects, sim=False).world is None
    assert plan(objects, driver="mock").world is None
    assert plan({"gamepads": {"pad": {}}}).world is None


def test_only_the_chosen_kind_of_options_reaches_the_driver() -> None:
    robot = {"model": "panda", "real": {"host": "1.2.3.4"}, "simulated": {"lag": 0.01}, "drivers": MINE}
    robot["gripper"] = {"drivers": MINE}
    assert plan({"robots": {"arm": robot}}).robots[0].options == {"lag": 0.01}
    assert plan({"robots": {"arm": robot}}, sim=False).robots[0].options == {"host": "1.2.3.4"}


def test_mock_stands_in_for_every_device_and_steps() -> None:
    rig = plan("panda_table", driver="mock", sim=False)
    robot = rig.robots[0]
    assert robot.gripper is not None
    drivers = {robot.driver, robot.gripper.driver, *(c.driver for c in rig.cameras), *(p.driver for p in rig.pads)}
    assert drivers == {"mock"}
    assert not robot.attended
    assert rig.world is None
    assert rig.clock == "lock_step"
    assert plan("panda_table", driver="mock", clock="real_time").clock == "real_time"


def test_clock_of_the_file_and_of_the_caller() -> None:
    config = {**MIXED, "simulation": {"clock": "lock_step"}}
    assert plan(config).clock == "lock_step"
    assert plan(config, clock="real_time").clock == "real_time"
    with pytest.raises(ConfigError) as caught:
        load(with_real_drivers(config), sim=False)
    assert ("robots.one", "real_in_lock_step") in {(problem.key, problem.code) for problem in caught.value.problems}


def test_physics_rate_is_the_rate_of_simulated_arms() -> None:
    rig = plan(MIXED, overrides=["simulation.physics_hz=1000"])
    assert {r.rate_hz for r in rig.robots} == {1000.0}
    assert rig.world is not None
    assert rig.world.physics_hz == 1000.0


def test_overrides_set_any_key() -> None:
    rig = load(
        "panda_table",
        overrides=[
            "cameras.wrist.output.width=320",
            "robots.panda.limits.acceleration=2",
            "objects=[table]",
            "sim=true",
        ],
    )
    assert rig.resolve().cameras[1].width == 320
    assert rig.resolve().robots[0].limits.acceleration == (2.0,) * 7
    assert rig.cameras["wrist"].output is not None  # the file as written, with the override
    assert rig.cameras["wrist"].output.width == 320
    by_mapping = plan("panda_table", overrides={"cameras": {}, "simulation.renderer": "tiny"})
    assert by_mapping.cameras == ()
    assert by_mapping.renderer == "tiny"
    assert (
        plan("panda_table", overrides=["robots.panda.limits.acceleration=1e-1"]).robots[0].limits.acceleration[0] == 0.1
    )


def test_overrides_do_not_change_the_callers_dict() -> None:
    before = json.dumps(MIXED)
    plan(MIXED, overrides={"robots.one.base.position": [1, 2, 3], "robots.one.speed": 0.5})
    assert json.dumps(MIXED) == before


def test_a_rig_of_the_users_own_names_files_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = yaml.safe_load(find_data("robots", "panda.yaml").read_text())
    source = Path(plan("panda_table").robots[0].urdf)
    (tmp_path / "my").mkdir()
    (tmp_path / "my" / "arm.urdf").write_text(source.read_text())
    model["urdf"] = "arm.urdf"
    (tmp_path / "my" / "arm.yaml").write_text(yaml.safe_dump(model))
    (tmp_path / "my" / "brick.yaml").write_text(
        "{name: brick, shape: box, half_extents: [1, 1, 1], position: [3, 0, 0]}"
    )
    (tmp_path / "rig.yaml").write_text(
        "robots: {arm: {model: my/arm.yaml}}\nobjects: [my/brick.yaml, {file: my/brick.yaml, name: other, mass: 2}]\n"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    rig = plan(tmp_path / "rig.yaml")
    assert rig.robots[0].urdf == str(tmp_path / "my" / "arm.urdf")
    assert rig.source == str(tmp_path / "rig.yaml")
    assert rig.world is not None
    assert [(b.name, b.mass, b.position) for b in rig.world.bodies] == [
        ("brick", 0.0, (3.0, 0.0, 0.0)),
        ("other", 2.0, (3.0, 0.0, 0.0)),
    ]


def test_random_ranges_of_objects() -> None:
    brick = {"name": "brick", "shape": "box", "half_extents": [1, 1, 1], "position": [1, 2, 3]}
    ranges = {"x": [-1, 2], "roll_deg": [-90, 90], "yaw_deg": [0, 180]}
    rig = plan({"robots": {"arm": {"model": "panda"}}, "objects": ["table", {**brick, "random": ranges}]})
    assert rig.world is not None
    table, body = rig.world.bodies
    assert table.random is None
    assert body.random is not None
    assert body.random.lower == pytest.approx((-1, 2, 3, -math.pi / 2, 0, 0)), "what is left out stays"
    assert body.random.upper == pytest.approx((2, 2, 3, math.pi / 2, 0, math.pi))
    assert from_json(BodySpec, json.loads(json.dumps(to_json(body)))) == body


@pytest.mark.parametrize(
    ("changes", "ranges"),
    [
        ({"mass": 1.0}, True),
        ({"random": None}, False),
        ({"position": [0, 0, 1]}, False),
        ({"pose": [0, 0, 1, 0, 0, 0, 1]}, False),
        ({"attached": {"robot": "arm", "link": "hand"}}, False),
        ({"position": [0, 0, 1], "random": {"x": [0, 1]}}, True),
    ],
)
def test_ranges_of_a_file_are_for_the_place_that_it_gives(changes: dict[str, Any], ranges: bool) -> None:
    rig = plan({"robots": {"arm": {"model": "panda"}}, "objects": [{"file": "cube", **changes}]})
    assert rig.world is not None
    assert (rig.world.bodies[0].random is not None) == ranges


def test_a_pose_in_the_rig_takes_the_place_of_the_files_position() -> None:
    turned = [0.1, 0.2, 0.9, 0, 0, 1, 0]
    rig = plan({"robots": {"arm": {"model": "panda"}}, "objects": [{"file": "duck", "pose": turned}]})
    assert rig.world is not None
    body = rig.world.bodies[0]
    assert (*body.position, *body.orientation) == pytest.approx(turned)


def test_limits_may_be_tightened_by_the_rig() -> None:
    limits = {"velocity": 1.0, "upper": [2.0, 1.0, 2.0, -1.0, 2.0, 3.0, 2.0]}
    arm = plan({"robots": {"arm": {"model": "panda", "limits": limits}}}).robots[0]
    assert arm.limits.velocity == (1.0,) * 7
    assert arm.limits.upper == arm.kinematics.upper == (2.0, 1.0, 2.0, -1.0, 2.0, 3.0, 2.0)
    looser = {"jerk": 20000, "allow_looser_limits": True}
    assert plan({"robots": {"arm": {"model": "panda", "limits": looser}}}).robots[0].limits.jerk == (20000.0,) * 7


def test_position_and_speed_limits_may_come_from_the_urdf() -> None:
    limits = plan("iiwa_table").robots[0].limits
    assert limits.lower[0] == pytest.approx(-math.radians(170))
    assert limits.upper[6] == pytest.approx(math.radians(175))


def test_workspace_and_table() -> None:
    robot = {"model": "panda", "workspace": {"upper": [0.8, 0.5, 1.0], "table_height": 0.02}}
    workspace = plan({"robots": {"arm": robot}}).robots[0].workspace
    assert workspace is not None
    assert workspace.upper == (0.8, 0.5, 1.0)
    assert workspace.lower[2] == 0.02
    assert workspace.lower[0] < -1.0


def test_initial_positions_with_fingers_are_taken_with_a_warning() -> None:
    q = [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.5]
    assert plan({"robots": {"arm": {"model": "panda", "initial": q}}}).robots[0].initial == tuple(q)
    rig = plan({"robots": {"arm": {"model": "panda", "initial": [*q, 0.04, 0.04]}}})
    assert rig.robots[0].initial == tuple(q)
    assert len(rig.warnings) == 1
    assert "fingers" in rig.warnings[0]


def test_gripper_can_be_left_out_and_slowed() -> None:
    assert plan({"robots": {"arm": {"model": "panda", "gripper": {"enabled": False}}}}).robots[0].gripper is None
    slow = plan({"robots": {"arm": {"model": "panda", "gripper": {"speed": 0.05}}}}).robots[0].gripper
    assert slow is not None
    assert slow.speed == 0.05


@pytest.mark.parametrize("chosen", ["driver: playback", "sim: true", "sim: true, driver: playback"])
def test_a_recording_is_relative_to_the_rig(tmp_path: Path, chosen: str) -> None:
    shutil.copy(find_data("config", "teleop/tour.jsonl"), tmp_path)
    (tmp_path / "rig.yaml").write_text(f"gamepads: {{pad: {{{chosen}, file: tour.jsonl}}}}")
    (pad,) = plan(tmp_path / "rig.yaml").pads
    assert (pad.driver, pad.options) == ("playback", {"file": str(tmp_path / "tour.jsonl")})


@pytest.mark.parametrize("sim", [None, True, False])
def test_only_its_own_flag_makes_a_pad_simulated_or_real(sim: bool | None) -> None:
    def pad(**keys: Any) -> tuple[str, bool]:
        (found,) = plan({"gamepads": {"pad": keys}}, sim=sim).pads
        return found.driver, found.real

    assert pad() == ("auto", False)
    assert pad(sim=True) == pad(sim=True, driver="mock") == ("mock", False)
    assert pad(sim=False) == ("auto", True)
    assert pad(sim=False, driver="evdev") == ("evdev", True)


# Cameras.


def camera(**keys: Any) -> Any:
    keys = {"model": "pinhole", "look_at": {"target": [0, 0, 0], "distance": 1.0}} | keys
    return plan({"robots": {"arm": {"model": "panda"}}, "cameras": {"eye": keys}}).cameras[0]


def project(K: Any, direction: tuple[float, float, float]) -> tuple[float, float]:
    u, v, w = np.array(K) @ np.array(direction)
    return u / w, v / w


def test_the_edges_of_the_picture_are_at_the_angles_of_view() -> None:
    eye = camera(
        capture={"width": 200, "height": 100, "rate_hz": 10}, field_of_view={"horizontal_deg": 90, "vertical_deg": 60}
    )
    assert project(eye.K, (1.0, 0.0, 1.0))[0] == pytest.approx(199.5)  # pixel centres are whole numbers
    assert project(eye.K, (-1.0, 0.0, 1.0))[0] == pytest.approx(-0.5)
    assert project(eye.K, (0.0, math.tan(math.radians(30)), 1.0))[1] == pytest.approx(99.5)
    assert project(eye.K, (0.0, 0.0, 1.0)) == pytest.approx((99.5, 49.5))
    square = camera(field_of_view={"vertical_deg": 60})
    assert square.K[0][0] == square.K[1][1]


def test_output_is_the_captures_centre_scaled() -> None:
    capture = {"width": 640, "height": 480, "rate_hz": 30}
    whole = camera(model="realsense_d435", capture=capture)
    cut = camera(model="realsense_d435", capture=capture, output={"width": 256, "height": 256})
    assert (cut.width, cut.height, cut.capture_width) == (256, 256, 640)
    # A direction lands at the same place of the picture, measured in shares of the crop.
    for direction in ((0.2, -0.1, 1.0), (-0.3, 0.3, 1.0), (0.0, 0.0, 1.0)):
        u, v = project(whole.K, direction)
        x, y = project(cut.K, direction)
        assert (x + 0.5) / 256 == pytest.approx((u + 0.5 - 80) / 480)
        assert (y + 0.5) / 256 == pytest.approx((v + 0.5) / 480)


@pytest.mark.parametrize(
    ("size", "out", "crop"),
    [
        ((640, 480), (256, 256), (80, 0, 480, 480)),
        ((480, 640), (256, 256), (0, 80, 480, 480)),
        ((640, 480), (320, 240), (0, 0, 640, 480)),
        ((640, 480), (160, 90), (0, 60, 640, 360)),
    ],
)
def test_centre_crop(size: tuple[int, int], out: tuple[int, int], crop: tuple[int, ...]) -> None:
    assert centre_crop(*size, *out) == crop


@pytest.mark.parametrize("up_axis", ["y", "z"])
@pytest.mark.parametrize("angles", [(0, 0, 0), (30, -40, 20), (-90, 215, 0), (170, -89, -75), (90, -25, 0)])
def test_look_at_is_pybullets(up_axis: str, angles: tuple[float, float, float]) -> None:
    pybullet = pytest.importorskip("pybullet", reason="needs pybullet (pip install pybullet)")
    target, distance = [0.1, -0.2, 0.3], 1.5
    yaw, pitch, roll = angles
    look_at = {"target": target, "distance": distance, "yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
    view = camera(look_at=look_at | {"up_axis": up_axis}).view
    axis = {"y": 1, "z": 2}[up_axis]
    gl = np.array(pybullet.computeViewMatrixFromYawPitchRoll(target, distance, yaw, pitch, roll, axis)).reshape(4, 4).T
    expected = np.linalg.inv(gl) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along -z, y up
    np.testing.assert_allclose(Pose(view.position, view.orientation).matrix(), expected, atol=1e-6)


def test_pose_is_given_either_way() -> None:
    half = math.sqrt(0.5)
    long = camera(look_at=None, pose={"position": [1, 2, 3], "orientation": [half, 0, 0, half]}).view
    assert camera(look_at=None, pose=[1, 2, 3, half, 0, 0, half]).view == long
    assert long.position == (1.0, 2.0, 3.0)


def axes(view: Any) -> np.ndarray:
    return Pose(view.position, view.orientation).matrix()[:3, :3]


def test_attached_looks_along_its_target_the_right_way_up() -> None:
    place = {"robot": "arm", "link": "panda_hand", "translation": [0.1, 0, 0.2]}
    forward = camera(look_at=None, attached=place | {"target": [0, 2, 0]}).view
    assert (forward.robot, forward.link, forward.position) == ("arm", "panda_hand", (0.1, 0.0, 0.2))
    x, y, z = axes(forward).T
    np.testing.assert_allclose(z, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(y, [0, 0, -1], atol=1e-12)  # the picture's down is the link's -z
    np.testing.assert_allclose(x, [1, 0, 0], atol=1e-12)
    along_z = axes(camera(look_at=None, attached=place).view).T
    np.testing.assert_allclose(along_z[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(along_z[1], [-1, 0, 0], atol=1e-12)  # x is up
    tilted = axes(camera(look_at=None, attached=place | {"target": [0, 1, 0], "up": [1, 0, 0]}).view).T
    np.testing.assert_allclose(tilted[1], [-1, 0, 0], atol=1e-12)


def test_attached_rotation_turns_the_target_by_angles_or_quaternion() -> None:
    place = {"robot": "arm", "link": "panda_hand", "target": [0, 1, 0]}
    turned = camera(look_at=None, attached=place | {"rotation": [0, 0, math.pi / 2]}).view
    np.testing.assert_allclose(axes(turned)[:, 2], [-1, 0, 0], atol=1e-12)
    half = math.sqrt(0.5)
    same = camera(look_at=None, attached=place | {"rotation": [0, 0, half, half]}).view
    np.testing.assert_allclose(axes(same), axes(turned), atol=1e-12)


def test_missing_inertials_are_a_warning(tmp_path: Path) -> None:
    text = Path(plan("panda_table").robots[0].urdf).read_text()
    start = text.index("<inertial>", text.index('name="panda_link3"'))
    (tmp_path / "arm.urdf").write_text(text[:start] + text[text.index("</inertial>", start) + len("</inertial>") :])
    model = yaml.safe_load(find_data("robots", "panda.yaml").read_text()) | {"urdf": "arm.urdf"}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(model))
    (tmp_path / "rig.yaml").write_text("robots: {arm: {model: ./arm.yaml}}")
    (warning,) = plan(tmp_path / "rig.yaml").warnings
    assert "panda_link3" in warning
    assert "inertial" in warning


def test_the_json_schema_for_editors_is_up_to_date() -> None:
    shipped = find_data("config", "rig.schema.json").read_text()
    assert json.loads(shipped) == rig_schema(), "run: hal schema > config/rig.schema.json"


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    return Draft202012Validator(rig_schema())


@pytest.mark.parametrize("name", list_data("config"))
def test_shipped_rigs_name_the_schema_and_fit_it(name: str, validator: Draft202012Validator) -> None:
    file = find_data("config", f"{name}.yaml")
    first, _, text = file.read_text().partition("\n")
    assert first == "# yaml-language-server: $schema=rig.schema.json"
    validator.validate(yaml.safe_load(text))
    assert not validator.is_valid(yaml.safe_load(text) | {"robots": {"arm": {"modle": "panda"}}})


@pytest.mark.parametrize(("boxes", "count"), [([], 1), (["table"], 0)])
def test_a_fixed_object_without_a_box_is_a_warning(boxes: list[str], count: int) -> None:
    rig = {"robots": {"arm": {"model": "panda"}}, "objects": ["floor", "table", "cube"], "collisions": {"boxes": boxes}}
    found = plan(rig).warnings
    assert len(found) == count
    assert all("table is fixed" in text for text in found)
