"""One URDF of an arm and its tool, and joints that a file has fixed."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from errors_kit import raises_problems

from hal.config import load
from hal.geometry import Pose
from hal.kinematics.composition import MountedTool, compose_urdf
from hal.kinematics.urdf import read_urdf

LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="10"/>'
MASS = '<inertial><mass value="1"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>'
ARM = f"""<robot name="arm"><link name="base_link"/><link name="flange">{MASS}</link><link name="thumb">{MASS}</link>
  <joint name="turn" type="revolute"><parent link="base_link"/><child link="flange"/><axis xyz="0 0 1"/>{LIMIT}</joint>
  <joint name="bend" type="fixed"><parent link="flange"/><child link="thumb"/><axis xyz="1 0 0"/>{LIMIT}</joint>
</robot>"""
TOOL = f"""<robot name="tool"><link name="base_link"/><link name="left">{MASS}</link><link name="right">
    <collision><geometry><mesh filename="pad.obj"/></geometry></collision></link>
  <joint name="turn" type="prismatic"><parent link="base_link"/><child link="left"/><axis xyz="0 1 0"/>{LIMIT}</joint>
  <joint name="other" type="prismatic"><parent link="base_link"/><child link="right"/><axis xyz="0 1 0"/>{LIMIT}
    <mimic joint="turn" multiplier="-1"/></joint>
</robot>"""
POSES = [Pose((0.1, 0.2, 0.3), turn) for turn in ((0.2, -0.4, 0.6, 0.66), (0.5, 0.5, -0.5, 0.5), (0.5, -0.5, 0.5, 0.5))]
"""In general, and with the y axis turned by 90 degrees to either side."""


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "tool").mkdir()
    (tmp_path / "tool" / "tool.urdf").write_text(TOOL)
    (tmp_path / "tool" / "pad.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    return tmp_path


@pytest.mark.parametrize("pose", POSES)
def test_a_tool_is_mounted_and_renamed_where_the_arm_has_its_names(files: Path, pose: Pose) -> None:
    tool = MountedTool(files / "tool" / "tool.urdf", "flange", pose)
    made = compose_urdf(files / "arm.urdf", tool)
    assert made == compose_urdf(files / "arm.urdf", tool), "the same contents have the same name"
    model = read_urdf(made)
    assert set(model.links) == {"base_link", "flange", "thumb", "tool_base_link", "left", "right"}
    assert set(model.joints) == {"turn", "bend", "tool_turn", "other", "tool_mount"}
    assert [mimic.of for mimic in model.mimics] == ["tool_turn"]
    distance, angle = model.poses({})["tool_base_link"].distance(pose)
    assert distance == pytest.approx(0.0, abs=1e-9)
    assert angle == pytest.approx(0.0, abs=1e-6)
    assert model.links["right"].mass == 0.01
    assert model.links["right"].collisions[0].file == str((files / "tool" / "pad.obj").resolve())


def test_a_freed_joint_turns(files: Path) -> None:
    model = read_urdf(compose_urdf(files / "arm.urdf", freed=["bend"]))
    assert (model.joints["bend"].kind, model.joints["bend"].upper) == ("revolute", 1.0)


def test_what_cannot_be_composed_is_refused(files: Path) -> None:
    with pytest.raises(ValueError, match="'turn'"):
        compose_urdf(files / "arm.urdf", freed=["turn"])
    with pytest.raises(ValueError, match="'hand'"):
        compose_urdf(files / "arm.urdf", MountedTool(files / "tool" / "tool.urdf", "hand", Pose()))


MODEL = {
    "urdf": "arm.urdf",
    "drivers": {"sim": "simulation"},
    "tcp": {"link": "flange"},
    "joints": ["turn"],
    "home": [0],
    "limits": {"acceleration": 1, "jerk": 1},
}


def test_the_model_of_a_rig_has_a_tool(files: Path) -> None:
    tool = {"urdf": "tool/tool.urdf", "link": "flange", "position": [0, 0, 0.1]}
    for link, codes in (("flange", ()), ("hand", ("bad_urdf",))):
        (files / "arm.yaml").write_text(yaml.safe_dump(MODEL | {"tool": tool | {"link": link}}))
        rig = {"robots": {"arm": {"model": str(files / "arm.yaml")}}}
        if codes:
            with raises_problems(*codes):
                load(rig)
        else:
            load(rig)


def test_a_rig_chooses_one_of_a_models_arms(files: Path) -> None:
    arms = {"left": {"home": [0.5]}, "right": {"home": [-0.5]}}
    (files / "arm.yaml").write_text(yaml.safe_dump({**MODEL, "arms": arms}))
    model = {"model": str(files / "arm.yaml")}
    load({"robots": {"arm": model | {"arm": "right"}}})
    for wrong in (model, model | {"arm": "upper"}):
        with raises_problems("unknown_arm"):
            load({"robots": {"arm": wrong}})
    (files / "arm.yaml").write_text(yaml.safe_dump(MODEL))
    with raises_problems("unknown_arm"):
        load({"robots": {"arm": model | {"arm": "left"}}})
