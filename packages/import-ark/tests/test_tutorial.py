"""The tutorial's configuration becomes a rig that runs, and no key of it is forgotten."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from ark_kit import BALL, CAMERA, DATA, PANDA, PANDA_URDF, TUTORIAL, changed, imported, leaves, row, write
from hal_import_ark import ArkOptions, Imported, import_ark
from hal_import_ark.output import summary, table
from hal_import_ark.reading import ArkReader

import hal
from hal.config import load
from hal.config.data_files import list_data
from hal.geometry import Pose

p = pytest.importorskip("pybullet")
BulletClient = pytest.importorskip("pybullet_utils.bullet_client").BulletClient


def saved(result: Imported, path: Path) -> Path:
    for file, text in result.texts(path).items():
        file.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def tutorial(tmp_path: Path) -> Path:
    """The tutorial's rig."""
    return saved(import_ark(TUTORIAL), tmp_path / "mine.yaml")


def test_every_key_of_the_tutorial_has_its_row() -> None:
    rows = import_ark(TUTORIAL).rows
    noted = {(one.node.file, one.node.key) for one in rows}
    reading = ArkReader()
    files = {one.node.file for one in rows}
    assert len(files) == 9
    for file in files:
        for path in leaves(reading.file(file)):
            covered = [node.key for node in path if (file, node.key) in noted]
            assert covered, f"{file.name}: {path[-1].key}"
    assert len(noted) == len(rows), "no key twice"
    assert not [one.node.key for one in rows if one.outcome == "unknown"]
    assert {one.outcome for one in rows} == {"kept", "changed", "ignored"}


def test_rows_name_the_line_of_their_key() -> None:
    for one in import_ark(TUTORIAL).rows:
        line = one.node.file.read_text().splitlines()[one.node.line - 1]
        assert f"{one.node.key.rpartition('.')[2]}:" in line


def test_the_table_shows_file_line_key_value_and_what_became_of_it() -> None:
    result = import_ark(TUTORIAL)
    lines = table(result.rows, TUTORIAL.parent, width=120)
    assert lines[0] == "global_config.yaml"
    assert max(map(len, lines)) <= 120
    (line,) = [line for line in lines if "near_val" in line][:1]
    assert line.split()[:4] == ["16", "changed", "config.sim_config.near_val:", "0.1"]
    assert summary(result.rows).startswith(f"{len(result.rows)} keys: ")


def test_the_tutorials_rig_opens_and_the_arm_moves_home_among_its_objects(tutorial: Path) -> None:
    with hal.open(str(tutorial), sim=True, clock="lock_step", pad="none") as rig:
        assert rig.world.bodies == ("table", "BluePlate", "Mug", "Cube", "ball", "Franka")
        for file in (TUTORIAL.parent / "objects").glob("*.yaml"):
            data = yaml.safe_load(file.read_text())
            config = data["config"]
            expected = Pose(config["base_position"], config["base_orientation"])
            assert rig.world.pose(data["name"]).distance(expected) == pytest.approx((0.0, 0.0), abs=1e-6)
        assert rig.world.dynamics("Cube")["mass"] == 2.0
        assert rig.world.dynamics("table")["mass"] == 0.0
        lower, upper = rig.world.aabb("Mug")
        assert (upper - lower).max() == pytest.approx(1.5 * 0.08, abs=0.01), "scaled"

        arm = rig.robots["Franka"]
        ark = yaml.safe_load((TUTORIAL.parent / "robots" / "franka.yaml").read_text())["config"]
        assert arm.state().q == pytest.approx(ark["initial_configuration"][:7], abs=1e-6)
        assert rig.world.pose("Franka").position == pytest.approx(ark["base_position"])
        arm.move_to(arm.home + np.array([0.3, 0, 0, 0, 0, 0, 0]), speed=0.5)
        arm.move_to(arm.home, speed=0.5)
        assert arm.state().q == pytest.approx(arm.home, abs=0.005)

        for name in ("camera", "gripper_camera"):
            frame = rig.cameras[name].read()
            assert frame.color.shape == (256, 256, 3)
            assert frame.depth.shape == (256, 256)
            focal = 128.0 / np.tan(np.radians(30.0))
            assert (frame.K[0, 0], frame.K[1, 1]) == (pytest.approx(focal), pytest.approx(focal))
            assert len(np.unique(frame.color.reshape(-1, 3), axis=0)) > 10, "something is in the picture"
        # They were dropped a few centimetres above the table, whose top is at 0.625 m, and lie on it.
        for name, half in (("Cube", 0.03), ("ball", 0.05), ("Mug", 0.06), ("BluePlate", 0.01)):
            assert rig.world.pose(name).position[2] == pytest.approx(0.625 + half, abs=0.004)


@pytest.mark.parametrize("with_urdf", [False, True], ids=["without Ark's URDF", "with it"])
def test_views_are_those_that_ark_computes(tmp_path: Path, with_urdf: bool) -> None:
    """Here Ark's own way is gone: PyBullet, with the URDF of the tutorial's time."""
    urdfs = {"Franka": PANDA_URDF} if with_urdf else {}
    rig_file = saved(import_ark(TUTORIAL, ArkOptions(urdfs=urdfs)), tmp_path / "mine.yaml")
    folder = TUTORIAL.parent
    robot, attached, fixed = (
        yaml.safe_load((folder / name).read_text())["config"]
        for name in ("robots/franka.yaml", "sensors/attached_camera.yaml", "sensors/fixed_camera.yaml")
    )
    attach, fix = attached["sim_config"]["attach"], fixed["sim_config"]["fix"]
    with_joints = BulletClient(p.DIRECT)
    body = with_joints.loadURDF(str(PANDA_URDF), robot["base_position"], robot["base_orientation"], useFixedBase=True)
    names = [with_joints.getJointInfo(body, k)[12].decode() for k in range(with_joints.getNumJoints(body))]
    assert len(names) == len(robot["initial_configuration"])
    for joint, q in enumerate(robot["initial_configuration"]):
        with_joints.resetJointState(body, joint, q)
    link = with_joints.getLinkState(body, names.index(attach["parent_link"]), computeForwardKinematics=True)
    turn = with_joints.getQuaternionFromEuler(attach["offset_rotation"])
    eye, turn = with_joints.multiplyTransforms(link[0], link[1], attach["offset_translation"], turn)
    target = np.add(eye, with_joints.rotateVector(turn, attach["rel_camera_target"]))
    views = {
        "gripper_camera": p.computeViewMatrix(eye, target.tolist(), with_joints.rotateVector(turn, [0, 0, 1])),
        "camera": p.computeViewMatrixFromYawPitchRoll(
            fix["camera_target_position"], fix["distance"], fix["yaw"], fix["pitch"], fix["roll"], fix["up_axis_index"]
        ),
    }
    with_joints.disconnect()
    with hal.open(str(rig_file), sim=True, clock="lock_step", pad="none") as rig:
        for name, view in views.items():
            opengl = np.linalg.inv(np.array(view).reshape(4, 4).T)
            expected = opengl @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes: y down, z forward
            assert rig.cameras[name].read().T_world_camera.matrix() == pytest.approx(expected, abs=2e-6)


def test_the_written_rig_is_readable_and_notes_changes(tutorial: Path) -> None:
    text = tutorial.read_text()
    assert "model: panda    # its joints have that arm's names" in text
    assert "base: {position: [-0.55, 0, 0.6]}" in text
    assert "# over the top: the picture is upside down, as in Ark" in text
    assert "half_extents: [0.03, 0.015, 0.03]" in text
    assert max(map(len, text.splitlines())) < 140
    assert "orientation" not in text, "what is no rotation is left out"
    load(tutorial)


def test_paths_are_relative_to_the_rig_where_they_can_be(tmp_path: Path) -> None:
    (tmp_path / "ark" / "sub").mkdir(parents=True)
    (tmp_path / "rigs").mkdir()
    urdf = DATA / "tutorial" / "config" / "objects" / "mug" / "model.urdf"
    (tmp_path / "ark" / "sub" / "mug.urdf").write_text(urdf.read_text())
    source = write(tmp_path / "ark", objects={"mug": {"source": "urdf", "urdf_path": "sub/mug.urdf"}})
    rig = saved(import_ark(source), tmp_path / "rigs" / "mine.yaml")
    assert "urdf: ../ark/sub/mug.urdf" in rig.read_text()
    load(rig)


def test_names_that_a_rig_cannot_have_are_changed(tmp_path: Path) -> None:
    data, result = imported(tmp_path, objects={"a ball!": BALL, "pad": BALL, "a_ball": BALL})
    assert [thing["name"] for thing in data["objects"]] == ["a_ball", "pad", "a_ball_2"]
    assert list(data["gamepads"]) == ["pad_2"]
    assert row(result, "objects.0.name") == (
        "changed",
        "objects.0.name; a_ball: letters, digits, _ and -, and no name twice in a rig",
    )


def test_a_key_without_a_reader_is_unknown(tmp_path: Path) -> None:
    _, result = imported(tmp_path, objects={"ball": changed(BALL, wobble=3)}, text="Pick it up", ground_plane={"a": 1})
    assert row(result, "objects.0.config.wobble") == ("unknown", "nothing here reads it")
    assert (row(result, "text")[0], row(result, "ground_plane")[0]) == ("unknown", "ignored")


def test_simulator(tmp_path: Path) -> None:
    source = write(tmp_path, objects={"ball": BALL})
    data = yaml.safe_load(source.read_text())
    config = {"connection_mode": "GUI", "sim_frequency": 500, "gravity": [0, 0, -1.6]}
    data["simulator"] = {"name": "lab", "backend_type": "mujoco", "node_frequency": 240, "config": config}
    source.write_text(yaml.safe_dump(data))
    result = import_ark(source)
    rig = load(saved(result, tmp_path / "rig.yaml"))
    assert rig.description == "lab (from Ark, global_config.yaml)"
    assert rig.simulation.physics_hz == 500
    assert rig.simulation.gravity == (0, 0, -1.6)
    assert rig.simulation.engine == "mujoco"
    assert row(result, "simulator.backend_type") == ("kept", "simulation.engine")
    assert row(result, "simulator.config.connection_mode")[0] == "changed"
    assert row(result, "simulator.node_frequency")[0] == "ignored"


def test_items_can_be_left_out(tmp_path: Path) -> None:
    data, result = imported(
        tmp_path,
        ArkOptions(without=frozenset({"imu", "ball"})),
        robots={"Franka": PANDA},
        sensors={"imu": {"type": "IMU"}, "eye": CAMERA},
        objects={"ball": BALL},
    )
    assert list(data["cameras"]) == ["eye"]
    assert "objects" not in data
    assert result.left_out == ("ball", "imu")
    assert row(result, "sensors.0.config") == ("ignored", "left out (--without)")


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (ArkOptions(without=frozenset({"bal"})), "unknown_name"),
        (ArkOptions(urdfs={"mug": Path("x")}), "unknown_name"),
        (ArkOptions(arms={"ball": "panda"}), "unknown_name"),
        (ArkOptions(camera_model="pinole"), "unknown_model"),
        (ArkOptions(start=Path("/nowhere/at/all")), "no_folder"),
    ],
)
def test_options_with_unknown_names_are_refused(tmp_path: Path, options: ArkOptions, code: str) -> None:
    with pytest.raises(hal.CommandError) as caught:
        import_ark(write(tmp_path, objects={"ball": BALL}), options)
    assert caught.value.code == code


@pytest.mark.parametrize("model", [name for name in list_data("sensors", "cameras") if name.startswith("realsense")])
def test_cameras_can_be_real_ones(tmp_path: Path, model: str) -> None:
    path = saved(import_ark(TUTORIAL, ArkOptions(camera_model=model)), tmp_path / "mine.yaml")
    spec = next(camera for camera in load(path).resolve().cameras if camera.name == "camera")
    assert (spec.model, spec.width, spec.height) == (model, 256, 256)
    assert (spec.capture_width, spec.capture_height) == (640, 480)
