"""Cameras stand and look where Ark's do: compared with the view matrices that PyBullet makes of Ark's numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ark_kit import CAMERA, PANDA, PANDA_URDF, changed, imported, row
from hal_import_ark import ArkOptions

from hal.config import load
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics

p = pytest.importorskip("pybullet")
pybullet_data = pytest.importorskip("pybullet_data")
BulletClient = pytest.importorskip("pybullet_utils.bullet_client").BulletClient

XARM = Path(pybullet_data.getDataPath(), "xarm", "xarm6_robot.urdf")


def optical(view: Any) -> np.ndarray:
    """A view matrix of PyBullet as the pose of an optical frame (x right, y down, z forward)."""
    matrix: np.ndarray = np.linalg.inv(np.array(view).reshape(4, 4).T) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return matrix


def camera(**attach: Any) -> dict[str, Any]:
    return changed(CAMERA, camera_type="attached", sim_config={"attach": attach})


def ark_view(urdf: Path, q: list[float], attach: dict[str, Any], merged: bool = False) -> np.ndarray:
    """What Ark makes of it, by PyBullet."""
    client = BulletClient(p.DIRECT)
    body = client.loadURDF(str(urdf), useFixedBase=True, flags=p.URDF_MERGE_FIXED_LINKS if merged else 0)
    joints = range(client.getNumJoints(body))
    moving = [k for k in joints if client.getJointInfo(body, k)[2] == p.JOINT_REVOLUTE]
    for joint, angle in zip(moving, q, strict=False):
        client.resetJointState(body, joint, angle)
    names = [client.getJointInfo(body, k)[12].decode() for k in joints]
    number = names.index(attach["parent_link"])
    position, turn = client.getLinkState(body, number, computeForwardKinematics=True)[:2]
    offset = attach.get("offset_rotation", [0, 0, 0])
    quaternion = client.getQuaternionFromEuler(offset) if len(offset) == 3 else offset
    eye, turn = client.multiplyTransforms(position, turn, attach.get("offset_translation", [0, 0, 0]), quaternion)
    target = np.add(eye, client.rotateVector(turn, attach.get("rel_camera_target", [1, 0, 0])))
    view = client.computeViewMatrix(eye, target.tolist(), client.rotateVector(turn, [0, 0, 1]))
    client.disconnect()
    return optical(view)


def our_view(rig: Path, q: list[float]) -> np.ndarray:
    plan = load(rig).resolve()
    view = plan.cameras[0].view
    assert view.link is not None
    link = replace(plan.robots[0].kinematics, tcp_link=view.link, tcp_position=(0, 0, 0), tcp_orientation=(0, 0, 0, 1))
    at = Kinematics(link).fk(q)
    return (Pose(at[:3], at[3:]) @ Pose(view.position, view.orientation)).matrix()


ATTACHED: list[dict[str, Any]] = [
    {},
    {"offset_translation": [0.05, -0.02, 0.1], "rel_camera_target": [0, 0.2, 1]},
    {"offset_rotation": [0.3, -0.5, 1.2]},
    {"offset_rotation": [0.1, 0.2, 0.3, 0.9273618495495703], "offset_translation": [0, 0, 0.07]},
    {"rel_camera_target": [0.01, 0, 1]},
]


@pytest.mark.parametrize("attach", ATTACHED)
@pytest.mark.parametrize("link", ["panda_hand", "panda_link7", "camera_link", "tcp_link"])
@pytest.mark.parametrize("with_urdf", [False, True])
def test_attached_to_a_panda(tmp_path: Path, link: str, attach: dict[str, Any], with_urdf: bool) -> None:
    q = [0.2, -0.6, 0.1, -2.1, 0.3, 1.6, 0.5]
    attach = {"parent_name": "arm", "parent_link": link, **attach}
    options = ArkOptions(urdfs={"arm": PANDA_URDF} if with_urdf else {})
    imported(tmp_path, options, robots={"arm": PANDA}, sensors={"eye": camera(**attach)})
    assert our_view(tmp_path / "rig.yaml", q) == pytest.approx(ark_view(PANDA_URDF, q, attach), abs=1e-5)


@pytest.mark.parametrize("attach", ATTACHED)
def test_attached_to_a_link_whose_centre_of_mass_is_elsewhere(tmp_path: Path, attach: dict[str, Any]) -> None:
    q = [0.2, -0.3, -1.0, 0.4, 1.2, 0.3]
    attach = {"parent_name": "arm", "parent_link": "link5", **attach}
    robot = {"urdf_path": str(XARM), "initial_configuration": q}
    imported(tmp_path, robots={"arm": robot}, sensors={"eye": camera(**attach)})
    assert our_view(tmp_path / "rig.yaml", q) == pytest.approx(ark_view(XARM, q, attach, merged=True), abs=1e-5)


def test_a_link_that_ark_merges_is_reported(tmp_path: Path) -> None:
    eye = camera(parent_name="arm", parent_link="camera_link")
    _, result = imported(tmp_path, robots={"arm": changed(PANDA, merge_fixed_links=True)}, sensors={"eye": eye})
    assert (
        "Ark merges camera_link with another link, and then counts from the base"
        in (row(result, "sensors.0.config.sim_config.attach.parent_link")[1])
    )


def test_a_link_that_arks_urdf_lacks_is_reported(tmp_path: Path) -> None:
    """The camera's and the tcp's links left ark_franka's URDF in August 2025."""
    text = PANDA_URDF.read_text()
    start = text.index('  <link name="camera_link">')
    without = (
        text[:start] + text[text.index('  <joint name="panda_joint1"') : text.index('  <joint name="camera_joint"')]
    )
    (tmp_path / "panda.urdf").write_text(without + "</robot>\n")
    eye = camera(parent_name="arm", parent_link="camera_link")
    data, result = imported(
        tmp_path, ArkOptions(urdfs={"arm": tmp_path / "panda.urdf"}), robots={"arm": PANDA}, sensors={"eye": eye}
    )
    assert data["cameras"]["eye"]["attached"]["link"] == "panda_hand"
    assert (
        "Ark's URDF has no camera_link any more, and Ark then counts from the base"
        in (row(result, "sensors.0.config.sim_config.attach.parent_link")[1])
    )


def test_without_a_link_it_is_the_base_and_on_an_fr3_its_own_hand(tmp_path: Path) -> None:
    data, _ = imported(tmp_path, robots={"arm": PANDA}, sensors={"eye": camera(parent_name="arm")})
    assert data["cameras"]["eye"]["attached"]["link"] == "panda_link0"
    eye = camera(parent_name="arm", parent_link="camera_link")
    data, _ = imported(tmp_path, ArkOptions(arms={"arm": "fr3"}), robots={"arm": PANDA}, sensors={"eye": eye})
    assert data["cameras"]["eye"]["attached"]["link"] == "fr3_hand"


def test_probable_degrees_are_reported(tmp_path: Path) -> None:
    eye = camera(parent_name="arm", parent_link="panda_hand", offset_rotation=[0.0, 90.0, 45.0])
    _, result = imported(tmp_path, robots={"arm": PANDA}, sensors={"eye": eye})
    outcome, here = row(result, "sensors.0.config.sim_config.attach.offset_rotation")
    assert outcome == "changed"
    assert "check that these are not degrees" in here


@pytest.mark.parametrize("up", [1, 2])
@pytest.mark.parametrize(
    ("yaw", "pitch", "roll"), [(0, 0, 0), (-90, 215, 0), (30, -40, 0), (200, -100, 25), (15, 89, -10)]
)
def test_fixed(tmp_path: Path, yaw: float, pitch: float, roll: float, up: int) -> None:
    fix = {"camera_target_position": [0.1, 0.2, 0.3], "distance": 0.9, "yaw": yaw, "pitch": pitch}
    fix |= {"roll": roll, "up_axis_index": up}
    _, result = imported(tmp_path, robots={"arm": PANDA}, sensors={"eye": changed(CAMERA, sim_config={"fix": fix})})
    view = load(tmp_path / "rig.yaml").resolve().cameras[0].view
    expected = optical(p.computeViewMatrixFromYawPitchRoll([0.1, 0.2, 0.3], 0.9, yaw, pitch, roll, up))
    assert Pose(view.position, view.orientation).matrix() == pytest.approx(expected, abs=1e-5)
    noted = "upside down" in row(result, "sensors.0.config.sim_config.fix.pitch")[1]
    assert noted == (pitch in (215, -100))


def test_what_arks_file_leaves_out_is_what_ark_takes(tmp_path: Path) -> None:
    imported(tmp_path, robots={"arm": PANDA}, sensors={"eye": CAMERA})
    spec = load(tmp_path / "rig.yaml").resolve().cameras[0]
    assert (spec.width, spec.height, spec.rate_hz) == (640, 480, 30)
    assert (spec.depth_min, spec.depth_max) == (0.1, 100.0)
    assert spec.K[1][1] == pytest.approx(240 / np.tan(np.radians(30)))


def test_streams(tmp_path: Path) -> None:
    streams = {"depth": {"enable": True, "format": "z16"}, "color": {"enable": True, "format": "bgr8"}}
    streams |= {"infrared": {"enable": False, "format": "y8"}, "segmentation": {"enable": True}}
    data, result = imported(tmp_path, robots={"arm": PANDA}, sensors={"eye": changed(CAMERA, streams=streams)})
    assert data["cameras"]["eye"]["streams"] == ["color", "depth", "segmentation"]
    assert row(result, "sensors.0.config.streams.color.format") == (
        "changed",
        "depends on the model; frames are RGB in any case",
    )
    assert row(result, "sensors.0.config.streams.infrared.enable")[1].endswith("left out")


def test_old_files_have_no_camera_type(tmp_path: Path) -> None:
    eye = changed(camera(parent_name="arm", parent_link="panda_hand"), camera_type=None)
    data, _ = imported(
        tmp_path, robots={"arm": PANDA}, sensors={"eye": eye, "other": changed(CAMERA, camera_type=None)}
    )
    assert "attached" in data["cameras"]["eye"]
    assert "look_at" in data["cameras"]["other"]
    both = changed(CAMERA, sim_config__attach={"parent_name": "arm"})
    data, result = imported(tmp_path, robots={"arm": PANDA}, sensors={"eye": both})
    assert "look_at" in data["cameras"]["eye"]
    assert row(result, "sensors.0.config.sim_config.attach")[0] == "ignored"


def test_a_real_cameras_size_is_cut_from_one_that_it_has(tmp_path: Path) -> None:
    eye = changed(CAMERA, width=1280, height=720, frequency=15)
    imported(tmp_path, ArkOptions(camera_model="realsense_d435"), robots={"arm": PANDA}, sensors={"eye": eye})
    spec = load(tmp_path / "rig.yaml").resolve().cameras[0]
    assert (spec.capture_width, spec.width, spec.height, spec.rate_hz) == (1280, 1280, 720, 15)
