"""Poses, joints and shapes of a URDF, compared with the kinematics that move the arm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from specs import iiwa, panda

from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.kinematics.urdf import parse_xml, read_urdf
from hal.specs import KinematicsSpec, RobotSpec

SMALL = """
<robot name="small">
  <joint name="second" type="prismatic">
    <parent link="arm"/><child link="tip"/><origin xyz="0 0 1" rpy="0 1.5707963267948966 0"/><axis xyz="0 0 2"/>
    <mimic joint="first" multiplier="-2" offset="0.5"/>
  </joint>
  <joint name="first" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/></joint>
  <link name="base"/>
  <link name="arm">
    <visual><geometry><box size="1 2 3"/></geometry><material name="red"/></visual>
    <visual><geometry><mesh filename="package://nowhere/a.stl" scale="1 1 -1"/></geometry></visual>
  </link>
  <link name="tip">
    <visual>
      <origin xyz="0 0 0.1"/><geometry><cylinder radius="0.1" length="0.2"/></geometry>
      <material name="red"><color rgba="1 0 0 1"/></material>
    </visual>
  </link>
</robot>
"""


@pytest.mark.parametrize("arm", [panda, iiwa])
def test_links_agree_with_the_kinematics(arm: Callable[[], RobotSpec]) -> None:
    spec = arm().kinematics
    kinematics, tree = Kinematics(spec), read_urdf(Path(spec.urdf))
    tcp = Pose(spec.tcp_position, spec.tcp_orientation)
    random = np.random.default_rng(3)
    for q in [np.array(spec.home), *random.uniform(spec.lower, spec.upper, (20, 7))]:
        poses = tree.poses(dict(zip(spec.joints, q.tolist(), strict=True)))
        base = poses[spec.base_link or tree.root].inverse()
        for found, wanted in (
            (base @ poses[spec.tcp_link] @ tcp, kinematics.pose(q)),
            (base @ poses[tree.outwards[3].child], kinematics.link_pose(tree.outwards[3].child, q)),
        ):
            assert np.abs(found.position - wanted.position).max() < 1e-6
            assert found.distance(wanted)[1] < 1e-6


def test_fingers_move_apart_by_the_width() -> None:
    tree = read_urdf(Path(panda().urdf))
    poses = tree.poses({"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.03})
    assert poses["panda_leftfinger"].distance(poses["panda_rightfinger"])[0] == pytest.approx(0.06)


def test_joints_in_any_order_mimics_and_materials(tmp_path: Path) -> None:
    file = tmp_path / "small.urdf"
    file.write_text(SMALL)
    tree = read_urdf(file)
    assert [joint.name for joint in tree.outwards] == ["first", "second"]
    poses = tree.poses({"first": 0.25})  # the second slides by 0 along its own z, which is the arm's x
    assert poses["tip"].position == pytest.approx([0.0, 0.0, 1.0])
    poses = tree.poses({"first": 0.0})
    assert poses["tip"].position == pytest.approx([0.5, 0.0, 1.0])
    box, mesh = tree.links["arm"].visuals
    assert (box.shape, box.size, box.rgba) == ("box", (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 1.0))
    assert (mesh.size, mesh.rgba) == ((1.0, 1.0, -1.0), None)
    assert mesh.file == str(tmp_path / "nowhere/a.stl")
    (cylinder,) = tree.links["tip"].visuals
    assert cylinder.size == (0.1, 0.2)
    assert cylinder.pose.position == pytest.approx([0.0, 0.0, 0.1])


@pytest.mark.parametrize(
    "change",
    [
        ("</robot>", ""),
        ('<parent link="arm"/>', ""),
        ('<parent link="base"/>', '<parent link="tip"/>'),
        ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>'),
        ('size="1 2 3"', 'size="1 2"'),
    ],
    ids=["xml", "no parent", "circle", "axis", "numbers"],
)
def test_wrong_urdf_is_refused(tmp_path: Path, change: tuple[str, str]) -> None:
    assert change[0] in SMALL
    file = tmp_path / "small.urdf"
    file.write_text(SMALL.replace(*change))
    with pytest.raises(ValueError):  # noqa: PT011
        read_urdf(file)


def test_prefixes_that_the_file_does_not_declare(tmp_path: Path) -> None:
    file = tmp_path / "small.urdf"
    extra = '<drake:ignore_self_collision/><transmission xacro:at="tip"/>'
    limit = '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    file.write_text(SMALL.replace("</robot>", f"{extra}</robot>").replace("</joint>", limit, 1))
    urdf = read_urdf(file)
    assert urdf.root == "base"
    root = parse_xml(file)
    assert root.find("drake:ignore_self_collision") is not None
    assert root.findall("transmission")[0].attrib == {"xacro:at": "tip"}
    spec = KinematicsSpec(str(file), ("first",), (-1.0,), (1.0,), (0.0,), None, "tip", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))
    assert Kinematics(spec).fk([0.0])[:3] == pytest.approx((0.0, 0.0, 1.0))


def test_a_changed_file_and_a_moved_mesh_are_read_again(tmp_path: Path) -> None:
    def read() -> tuple[float | None, str]:
        link = read_urdf(path).links["a"]
        return link.mass, link.visuals[0].file

    text = '<robot name="x"><link name="a"><inertial><mass value="1"/></inertial><visual><geometry>'
    text += '<mesh filename="a.ply"/></geometry></visual></link></robot>'
    path = tmp_path / "arms" / "a.urdf"
    path.parent.mkdir()
    path.write_text(text)
    assert read() == (1.0, str(path.parent / "a.ply"))
    (tmp_path / "a.ply").touch()
    assert read() == (1.0, str(tmp_path / "a.ply"))
    path.write_text(text.replace("1", "2"))
    assert read()[0] == 2.0
    (path.parent / "a.ply").touch()
    assert read() == (2.0, str(path.parent / "a.ply"))
