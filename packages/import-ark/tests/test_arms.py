"""Robots: known arms with 7, 9, 10 or 12 numbers, real addresses, and models made of other URDFs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ark_kit import CAMERA, PANDA, PANDA_URDF, changed, imported, raises_problems, row
from hal_import_ark import ArkOptions
from hal_import_ark.arm_model import ArkUrdf

import hal
from hal.config import load
from hal.config.files import parse_yaml
from hal.geometry import Pose

p = pytest.importorskip("pybullet")
pybullet_data = pytest.importorskip("pybullet_data")
BulletClient = pytest.importorskip("pybullet_utils.bullet_client").BulletClient

HOME = [0, -0.785, 0, -2.356, 0, 1.571, 0.785]
OTHER = [0.1, -0.5, 0, -2.0, 0, 1.5, 0.7]
XARM = Path(pybullet_data.getDataPath(), "xarm")


@pytest.mark.parametrize("more", [0, 2, 3, 5])
def test_the_arms_joints_are_the_first_of_7_9_10_or_12(tmp_path: Path, more: int) -> None:
    key = "robots.0.config.initial_configuration"
    data, result = imported(tmp_path, robots={"Franka": changed(PANDA, initial_configuration=HOME + [0] * more)})
    assert "initial" not in data["robots"]["Franka"], "it is the model's home"
    outcome, here = row(result, key)
    assert (outcome, "the first 7 of" in here) == ("kept", more > 0)

    data, result = imported(tmp_path, robots={"Franka": changed(PANDA, initial_configuration=OTHER + [0.04] * more)})
    assert (data["robots"]["Franka"]["initial"], row(result, key)[0]) == (OTHER, "changed")
    assert load(tmp_path / "rig.yaml").resolve().robots[0].initial == tuple(OTHER)


@pytest.mark.parametrize(
    ("keys", "model"),
    [
        ({}, "panda"),
        ({"joint_groups__arm__joints": [f"fr3_joint{k}" for k in range(1, 8)]}, "fr3"),
        ({"joint_groups": None}, "panda"),  # the URDF's name
    ],
)
def test_frankas_are_known_by_their_joints(tmp_path: Path, keys: dict[str, Any], model: str) -> None:
    data, _ = imported(tmp_path, robots={"arm": changed(PANDA, **keys)})
    assert data["robots"]["arm"]["model"] == model


def test_an_option_names_the_arm(tmp_path: Path) -> None:
    data, result = imported(tmp_path, ArkOptions(arms={"arm": "fr3"}), robots={"arm": PANDA})
    assert data["robots"]["arm"]["model"] == "fr3"
    assert "from --arm" in row(result, "robots.0.config.urdf_path")[1]
    with raises_problems("unknown_model"):
        imported(tmp_path, ArkOptions(arms={"arm": "fr4"}), robots={"arm": PANDA})


def test_base(tmp_path: Path) -> None:
    keys = {"base_position": [1, 2, 3], "base_orientation": [0, 0, np.pi / 2]}
    data, result = imported(tmp_path, robots={"arm": changed(PANDA, **keys)})
    base = data["robots"]["arm"]["base"]
    turned = Pose(base["position"], base["orientation"])
    assert turned.distance(Pose.from_rpy([1, 2, 3], [0, 0, np.pi / 2])) == pytest.approx((0, 0), abs=1e-5)
    assert row(result, "robots.0.config.base_orientation")[0] == "changed"

    keys["base_orientation"] = [0, 0, 2, 2]
    data, result = imported(tmp_path, robots={"arm": changed(PANDA, **keys)})
    assert data["robots"]["arm"]["base"]["orientation"] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5], abs=1e-6)
    assert "of length 2.83" in row(result, "robots.0.config.base_orientation")[1]


def test_a_real_arms_address_is_kept_and_nothing_becomes_real_or_faster_by_it(tmp_path: Path) -> None:
    real = {"robot_ip": "172.16.0.2", "gripper_ip": "172.16.0.2"}
    real |= {"relative_dynamics_factor": 0.9, "gripper_speed": 0.5}
    data, result = imported(tmp_path, robots={"arm": changed(PANDA, real_config=real)})
    assert data["sim"] is True
    real_arm = {"model": "panda", "base": {"position": [0, 0, 0]}, "real": {"host": "172.16.0.2"}}
    assert data["robots"]["arm"] == real_arm
    assert row(result, "robots.0.config.real_config.relative_dynamics_factor") == (
        "changed",
        "robots.arm.speed stays 0.3 of the joint speeds; increase it by hand",
    )
    assert row(result, "robots.0.config.real_config.gripper_speed")[0] == "changed"
    spec = load(tmp_path / "rig.yaml", sim=False).resolve().robots[0]
    assert (spec.options["host"], spec.speed) == ("172.16.0.2", 0.3)

    real |= {"gripper_ip": "172.16.0.3", "relative_dynamics_factor": 0.1, "gripper_speed": 0.05}
    data, _ = imported(tmp_path, robots={"arm": changed(PANDA, real_config=real)})
    assert data["robots"]["arm"]["speed"] == 0.1
    assert data["robots"]["arm"]["gripper"] == {"real": {"host": "172.16.0.3"}, "speed": 0.05}
    load(tmp_path / "rig.yaml", sim=False)


def test_the_tcp_of_ark_is_reported(tmp_path: Path) -> None:
    robot = changed(PANDA, ee_index=11)
    for options in (ArkOptions(), ArkOptions(urdfs={"arm": PANDA_URDF})):
        _, result = imported(tmp_path, options, robots={"arm": robot})
        assert "Ark's tcp_link: 3.4 mm before it" in row(result, "robots.0.config.ee_index")[1]
    _, result = imported(tmp_path, ArkOptions(urdfs={"arm": PANDA_URDF}), robots={"arm": changed(robot, ee_index=6)})
    assert "not Ark's panda_link7" in row(result, "robots.0.config.ee_index")[1]


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("file", ["panda", "xarm6_robot.urdf", "xarm6_with_gripper.urdf"])
def test_joints_are_numbered_as_pybullet_does(file: str, merged: bool) -> None:
    path = PANDA_URDF if file == "panda" else XARM / file
    client = BulletClient(p.DIRECT)
    body = client.loadURDF(str(path), flags=p.URDF_MERGE_FIXED_LINKS if merged else 0)
    names = [client.getJointInfo(body, k)[1].decode() for k in range(client.getNumJoints(body))]
    client.disconnect()
    ours = [joint.name for joint in ArkUrdf(path).order(merged)]
    assert ours == names[: len(ours)]
    assert len(ours) >= 6, "to the end of the arm at least"
    assert merged or len(ours) == len(names)


def xarm(**keys: Any) -> dict[str, Any]:
    arm = {"urdf_path": "xarm6_robot.urdf", "class_dir": str(XARM), "base_position": [0, 0, 0], "ee_index": 5}
    return changed(arm | {"initial_configuration": [0, -0.3, -1.2, 0, 1.5, 0]}, **keys)


def test_a_model_is_made_of_another_urdf_and_the_arm_runs(tmp_path: Path) -> None:
    data, result = imported(tmp_path, robots={"my arm": xarm()}, sensors={"eye": CAMERA})
    assert data["robots"]["my_arm"]["model"] == "rig_my_arm.yaml"
    text = (tmp_path / "rig_my_arm.yaml").read_text()
    model = parse_yaml(text)
    assert model["joints"] == [f"joint{k}" for k in range(1, 7)]
    assert (model["home"], model["tcp"]["link"]) == ([0, -0.3, -1.2, 0, 1.5, 0], "link6")
    assert model["drivers"] == {"sim": "simulation"}, "no arm moves by guessed limits"
    speed, acceleration, jerk = (np.array(model["limits"][key]) for key in ("velocity", "acceleration", "jerk"))
    assert acceleration == pytest.approx(speed / 0.3, rel=1e-3)
    assert jerk == pytest.approx(acceleration / 0.02, rel=1e-3)
    for key in ("acceleration", "jerk", "velocity", "tcp"):
        (line,) = [line for line in text.splitlines() if line.strip().startswith(f"{key}:")]
        assert "# CHECK" in line
    assert any("acceleration" in note for note in result.models["my_arm"].to_fill_in)
    with hal.open(str(tmp_path / "rig.yaml"), sim=True, clock="lock_step", pad="none") as rig:
        arm = rig.robots["my_arm"]
        arm.move_to(arm.home + np.array([0.2, 0, 0, 0, 0, 0]), speed=0.5)
        arm.move_to(arm.home, speed=0.5)
        assert arm.state().q == pytest.approx(arm.home, abs=0.01)
    with pytest.raises(hal.ConfigError) as caught:
        load(tmp_path / "rig.yaml", sim=False).resolve()
    assert {problem.code for problem in caught.value.problems} == {"no_driver"}


def test_fingers_are_no_joints_of_the_arm(tmp_path: Path) -> None:
    groups = {
        "gripper": {"control_mode": "position", "joints": ["drive_joint", "left_finger_joint"]},
        "all": {"control_mode": "position", "joints": [*(f"joint{k}" for k in range(1, 7)), "drive_joint"]},
    }
    robot = xarm(urdf_path="xarm6_with_gripper.urdf", joint_groups=groups)
    _, result = imported(tmp_path, robots={"arm": robot})
    model = parse_yaml((tmp_path / "rig_arm.yaml").read_text())
    assert model["joints"] == [f"joint{k}" for k in range(1, 7)]
    assert "gripper" not in model
    assert row(result, "robots.0.config.joint_groups.gripper.joints")[0] == "ignored"


def test_fixed_joints_of_a_group_are_no_joints_of_the_arm(tmp_path: Path) -> None:
    group = {"control_mode": "position", "joints": ["world_joint", *(f"joint{k}" for k in range(1, 7))]}
    _, result = imported(tmp_path, robots={"arm": xarm(joint_groups={"all": group})})
    assert parse_yaml((tmp_path / "rig_arm.yaml").read_text())["joints"] == [f"joint{k}" for k in range(1, 7)]
    assert "without those that are fixed" in row(result, "robots.0.config.joint_groups.all.joints")[1]


def test_numbers_are_those_of_the_arms_joints_also_with_other_joints_between(tmp_path: Path) -> None:
    """Without merging, PyBullet counts the fixed joint to the world too."""
    robot = xarm(merge_fixed_links=False, initial_configuration=[9, 0, -0.3, -1.2, 0, 1.5, 0], ee_index=6)
    imported(tmp_path, robots={"arm": robot})
    model = parse_yaml((tmp_path / "rig_arm.yaml").read_text())
    assert (model["home"], model["tcp"]["link"]) == ([0, -0.3, -1.2, 0, 1.5, 0], "link6")


def test_missing_and_placeholder_speeds_of_a_urdf_are_reported(tmp_path: Path) -> None:
    urdf = tmp_path / "arm.urdf"
    text = (XARM / "xarm6_robot.urdf").read_text()
    assert text.count('velocity="3.14"') >= 2
    urdf.write_text(text.replace('velocity="3.14"', 'velocity="100"', 1).replace('velocity="3.14"', "", 1))
    _, result = imported(tmp_path, ArkOptions(urdfs={"arm": urdf}), robots={"arm": xarm(class_dir=None)})
    notes = " ".join(result.models["arm"].to_fill_in)
    assert "joint1" in notes
    assert "joint2" in notes
    assert "joint3" not in notes
    assert parse_yaml((tmp_path / "rig_arm.yaml").read_text())["limits"]["velocity"][:2] == [3.2, 0.5]


def test_problems_of_a_generated_model_are_reported_at_arks_line(tmp_path: Path) -> None:
    with pytest.raises(hal.ConfigError) as caught:
        imported(tmp_path, robots={"arm": xarm(initial_configuration=[0, 3, 0, 0, 0, 0])})
    (problem,) = caught.value.problems
    assert problem.file.startswith(str(tmp_path / "global_config.yaml:"))
    assert problem.code == "out_of_range"
    assert problem.message.endswith("(as home of the model made for it)")


def test_a_broken_urdf_is_reported(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text("<robot")
    with raises_problems("bad_urdf"):
        imported(tmp_path, robots={"arm": xarm(urdf_path="arm.urdf", class_dir=None)})
