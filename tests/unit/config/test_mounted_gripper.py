"""A rig, or an arm's model, chooses a gripper that has a file of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import hal
from hal.config.loader import load
from hal.kinematics import Kinematics
from hal.kinematics.urdf import read_urdf
from hal.specs import RobotSpec

pytest.importorskip("airo_models", reason="needs airo-models: pip install 'robot-hal[robots]'")

OWN = """
urdf: own.urdf
tcp: {position: [0, 0, 0.2]}
joints: [slide]
drivers: {sim: simulation, real: robotiq}
real: {model: 2f85, counts: [1, 2]}
width_max: 0.1
speed: 0.1
force: 20
"""
URDF = """
<robot name="own"><link name="fr3_hand"/><link name="finger"/>
<joint name="slide" type="prismatic"><parent link="fr3_hand"/><child link="finger"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.05" velocity="1" effort="10"/></joint></robot>
"""


def arm_of(entry: dict[str, Any], sim: bool = True, source: Path | None = None) -> RobotSpec:
    """Return the record of a rig's only arm."""
    rig = {"robots": {"arm": entry}}
    if source is not None:
        source.write_text(yaml.safe_dump(rig))
    (arm,) = load(source or rig, sim=sim).resolve().robots
    return arm


def codes(entry: dict[str, Any], **more: Any) -> dict[str, str]:
    """Return the problems of a rig, key -> code."""
    with pytest.raises(hal.ConfigError) as found:
        arm_of(entry, **more)
    return {problem.key: problem.code for problem in found.value.problems}


@pytest.mark.parametrize(("model", "hand"), [("fr3", "fr3_hand"), ("panda", "panda_hand")])
def test_a_gripper_takes_the_place_of_the_hand(model: str, hand: str) -> None:
    before, after = arm_of({"model": model}), arm_of({"model": model, "gripper": "robotiq_2f85"})
    links = read_urdf(Path(after.urdf)).links
    assert not any("finger" in link and model in link for link in links)
    assert hand not in links
    assert {"tool_flange", "left_inner_finger_pad"} <= set(links)
    assert after.gripper is not None
    assert (after.gripper.joints, after.gripper.width_max) == (("finger_joint",), 0.085)
    hands, grippers = (Kinematics(spec.kinematics).pose(spec.home) for spec in (before, after))
    assert hands.distance(grippers)[1] < 1e-6, "x of the tcp points where that of the hand does"
    assert hands.distance(grippers)[0] == pytest.approx(0.14 - 0.1034, abs=1e-6)


def test_a_mount_is_where_it_says() -> None:
    mount = {"link": "fr3_link8", "position": [0.0, 0.0, 0.011], "orientation": [0, 0, -0.3826834, 0.9238795]}
    before = arm_of({"model": "fr3", "gripper": "robotiq_2f85"})
    after = arm_of({"model": "fr3", "gripper": {"model": "robotiq_2f85", "mount": mount}})
    poses = [Kinematics(spec.kinematics).pose(spec.home) for spec in (before, after)]
    assert poses[1].position - poses[0].position == pytest.approx(np.array([0.0, 0.0, -0.011]), abs=1e-6)


def test_a_file_of_your_own_is_relative_to_the_rig(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(OWN.replace(", counts: [1, 2]", ""))
    (tmp_path / "own.urdf").write_text(URDF)
    arm = arm_of({"model": "fr3", "gripper": "own.yaml"}, source=tmp_path / "rig.yaml")
    assert arm.gripper is not None
    assert arm.gripper.width_max == 0.1
    assert "fr3_hand" in read_urdf(Path(arm.urdf)).links, "its own, not that of the arm"


def test_problems_are_named_where_they_are(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(OWN)
    (tmp_path / "own.urdf").write_text(URDF)
    source = tmp_path / "rig.yaml"
    assert codes({"model": "fr3", "gripper": "robotik_2f85"}) == {"robots.arm.gripper.model": "unknown_model"}
    assert codes({"model": "jaco", "gripper": "robotiq_2f85"}) == {"robots.arm.gripper.mount": "missing_key"}
    assert codes({"model": "fr3", "gripper": {"mount": {"link": "fr3_link8"}}}) == {
        "robots.arm.gripper.mount": "missing_key"
    }
    assert "real.counts" in codes(
        {"model": "fr3", "gripper": {"model": "own.yaml", "real": {"port": "a"}}, "real": {"host": "127.0.0.2"}},
        sim=False,
        source=source,
    )
    (tmp_path / "own.yaml").write_text(OWN.replace("speed: 0.1", "speed: fast"))
    assert set(codes({"model": "fr3", "gripper": "own.yaml"}, source=source)) == {"speed"}
