"""The forms themselves, read again as the programs read them that train on them."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import make_recording, mock_rig, pictures

import hal
from hal.recording import Dataset, Recorder
from hal.recording.exporters import export

ROBOMIMIC = {
    "robot0_joint_pos": ("observation.state", slice(0, 7)),
    "robot0_joint_vel": ("observation.velocity", slice(0, 7)),
    "robot0_eef_pos": ("observation.tcp", slice(0, 3)),
    "robot0_eef_quat": ("observation.tcp", slice(3, 7)),
    "robot0_eef_vel": ("observation.twist", slice(0, 6)),
    "robot0_gripper_width": ("observation.state", slice(7, 8)),
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_recording(tmp_path_factory.mktemp("forms") / "demo")


@pytest.fixture(scope="module")
def two_arms(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("two") / "demo"
    robots = {
        name: {"model": "panda", "base": {"position": [0.0, y, 0.0]}} for name, y in (("left", 0.4), ("right", -0.4))
    }
    with (
        hal.open({"robots": robots, "cameras": {}}, sim=True, driver="mock", clock="lock_step") as rig,
        Recorder(rig, out=out, fps=20, task="both") as recorder,
    ):
        recorder.start()
        with rig.robots["right"].control(rate_hz=50, unattended=True) as control:
            for tick in rig.clock.rate(50):
                if tick.elapsed > 0.3:
                    break
                control.send(hal.Twist([0.0, 0.0, 0.1]), grip=0.25)
        recorder.save(True, wait=True)
    return Dataset(out)


def column(dataset: Dataset, key: str) -> np.ndarray[Any, Any]:
    """Of all episodes, one after the other."""
    return np.concatenate([episode.columns[key] for episode in dataset.episodes])


# npz


def test_npz_has_the_tutorials_names(dataset: Dataset, tmp_path: Path) -> None:
    made = export(dataset, "npz", tmp_path / "out")
    for episode in dataset.episodes:
        state, tcp = episode.columns["observation.state"], episode.columns["observation.tcp"]
        with np.load(made.path / f"episode_{episode.number:06d}.npz", allow_pickle=False) as file:
            assert np.array_equal(file["joint_states"], state[:, :7])
            assert np.array_equal(file["gripper"], state[:, 7])
            assert np.array_equal(file["eef_position"], tcp[:, :3])
            assert np.array_equal(file["eef_orientation"], tcp[:, 3:])
            assert np.array_equal(file["action"], episode.columns["action"])
            assert np.array_equal(file["stamps"], episode.stamps["grid"])
            assert np.array_equal(file["gripper_camera_stamps"], episode.stamps["camera.wrist"])
            for name, camera in (("camera", "scene"), ("gripper_camera", "wrist")):
                assert np.array_equal(file[f"{name}_rgb"], pictures(dataset, "rgb", camera)[episode.number])
                assert np.array_equal(file[f"{name}_depth"], pictures(dataset, "depth", camera)[episode.number])
                assert file[f"{name}_depth"].dtype == np.float32
            for key, values in episode.columns.items():
                assert np.array_equal(file[key], values, equal_nan=values.dtype.kind == "f"), key
            assert file["action.names"].tolist() == episode.names("action")
            info = json.loads(str(file["info"]))
        assert info["rig"] == episode.info["rig"], "with everything that made it"
        assert info["seed"] == 1


def test_npz_cameras_are_called_as_asked(dataset: Dataset, tmp_path: Path) -> None:
    def names(out: str, **options: Any) -> set[str]:
        made = export(dataset, "npz", tmp_path / out, episodes="2", **options)
        with np.load(made.path / "episode_000002.npz") as file:
            return {name for name in file.files if name.endswith(("_rgb", "_depth"))}

    assert names("a", camera="wrist") == {"camera_rgb", "camera_depth", "scene_rgb", "scene_depth"}
    assert names("b", gripper_camera="scene", depth=False) == {"gripper_camera_rgb", "wrist_rgb"}
    assert names("c", cameras=["wrist"], depth=False) == {"gripper_camera_rgb"}


def test_npz_names_each_of_two_arms(two_arms: Dataset, tmp_path: Path) -> None:
    made = export(two_arms, "npz", tmp_path / "out")
    state = two_arms.episodes[0].columns["observation.state"]
    with np.load(made.path / "episode_000000.npz") as file:
        assert np.array_equal(file["left_joint_states"], state[:, :7])
        assert np.array_equal(file["right_joint_states"], state[:, 8:15])
        assert np.array_equal(file["right_gripper"], state[:, 15])
        assert np.ptp(file["right_eef_position"][:, 2]) > 0.01 > np.ptp(file["left_eef_position"][:, 2]), "one moved"


# robomimic


def test_robomimic(dataset: Dataset, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    made = export(dataset, "robomimic", tmp_path / "out.hdf5", valid=0.34)
    # Opened as its SequenceDataset opens it.
    with h5py.File(made.path, "r", swmr=True, libver="latest") as file:
        data = file["data"]
        demos = sorted(data, key=lambda name: int(name[5:]))
        assert demos == ["demo_0", "demo_1", "demo_2"]
        assert data.attrs["total"] == made.rows
        assert set(json.loads(data.attrs["env_args"])) == {"env_name", "type", "env_kwargs"}
        for demo, episode in zip(demos, dataset.episodes, strict=True):
            group, rows = data[demo], episode.length
            assert group.attrs["num_samples"] == rows
            assert np.array_equal(group["actions"][()], episode.columns["action"])
            assert np.array_equal(group["dones"][()], np.arange(rows) == rows - 1)
            assert group["rewards"][()].sum() == (1.0 if episode.success else 0.0)
            images = {f"{camera}_{kind}" for camera in ("scene", "wrist") for kind in ("image", "depth")}
            assert set(group["obs"]) == set(group["next_obs"]) == set(ROBOMIMIC) | images
            for name, (key, part) in ROBOMIMIC.items():
                values = episode.columns[key][:, part]
                assert np.array_equal(group[f"obs/{name}"][()], values), name
                assert np.array_equal(group[f"next_obs/{name}"][()], np.concatenate([values[1:], values[-1:]])), name
            for camera in ("scene", "wrist"):
                color = pictures(dataset, "rgb", camera)[episode.number]
                depth = pictures(dataset, "depth", camera)[episode.number][..., None]
                assert group[f"obs/{camera}_image"].dtype == np.uint8
                for name, values in ((f"{camera}_image", color), (f"{camera}_depth", depth)):
                    assert np.array_equal(group[f"obs/{name}"][()], values)
                    assert np.array_equal(group[f"next_obs/{name}"][: rows - 1], values[1:])
                    assert np.array_equal(group[f"next_obs/{name}"][rows - 1], values[-1])
        masks = {name: [demo.decode() for demo in np.array(file[f"mask/{name}"])] for name in file["mask"]}
    assert masks["successful"] == ["demo_0"]
    assert len(masks["valid"]) == 1
    assert sorted(masks["train"] + masks["valid"]) == demos


def test_robomimic_without_what_cannot_be_split(dataset: Dataset, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    made = export(dataset, "robomimic", tmp_path / "out.hdf5", cameras=[], episodes="1")
    with h5py.File(made.path) as file:
        assert set(file["mask"]) == {"train"}, "an empty filter would train on nothing"
        assert json.loads(file["data/demo_0"].attrs["info"])["episode"] == 1
    assert "cannot be split" in made.notes[0]


def test_a_second_arm_is_robot1(two_arms: Dataset, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    made = export(two_arms, "robomimic", tmp_path / "out.hdf5")
    state = two_arms.episodes[0].columns["observation.state"]
    with h5py.File(made.path) as file:
        seen = file["data/demo_0/obs"]
        assert np.array_equal(seen["robot0_joint_pos"][()], state[:, :7])
        assert np.array_equal(seen["robot1_joint_pos"][()], state[:, 8:15])
        assert np.array_equal(seen["robot1_gripper_width"][()], state[:, 15:])


# zarr


def test_zarr_is_a_replay_buffer(dataset: Dataset, tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr", reason="pip install zarr")
    made = export(dataset, "zarr", tmp_path / "out.zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        root = zarr.open(str(made.path), mode="r")
        ends = root["meta"]["episode_ends"][:]
        data = {name: array[:] for name, array in root["data"].arrays()}
    lengths = [episode.length for episode in dataset.episodes]
    assert ends.dtype == np.int64
    assert ends.tolist() == np.cumsum(lengths).tolist()
    assert list(root["meta"].array_keys()) == ["episode_ends"]
    for name, values in data.items():
        assert len(values) == ends[-1], f"{name}: a replay buffer wants every array as long as the last episode's end"
    images = {f"{camera}_{kind}" for camera in ("scene", "wrist") for kind in ("image", "depth")}
    assert set(data) == set(ROBOMIMIC) | images | {"action", "action_robot0_gripper_force", "timestamp"}
    assert np.array_equal(data["action"], column(dataset, "action"))
    for name, (key, part) in ROBOMIMIC.items():
        assert np.array_equal(data[name], column(dataset, key)[:, part]), name
    for camera in ("scene", "wrist"):
        assert np.array_equal(data[f"{camera}_image"], np.concatenate(pictures(dataset, "rgb", camera)))
        assert np.array_equal(data[f"{camera}_depth"][..., 0], np.concatenate(pictures(dataset, "depth", camera)))
    assert data["scene_image"].dtype == np.uint8
    assert data["timestamp"][ends[:-1]].tolist() == [0.0, 0.0]
    assert [episode["success"] for episode in root.attrs["episodes"]] == [True, False, None]


@pytest.mark.parametrize("rows", [1, 2, 3, 7])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64, np.int64])
def test_zarr_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int, dtype: type) -> None:
    """Whole chunks, a part of one, and one alone."""
    zarr = pytest.importorskip("zarr", reason="pip install zarr")
    from hal.recording.exporters import diffusion_policy

    values = np.random.default_rng(0).integers(0, 200, (rows, 5, 4, 3)).astype(dtype)
    monkeypatch.setattr(diffusion_policy, "_CHUNK", 3 * values[0].nbytes)
    group = diffusion_policy.make_group(tmp_path / "group", {"unit": "m"})
    array = diffusion_policy.ZarrArray(group / "values", values.shape[1:], values.dtype, rows)
    for value in values:
        array.add(value)
    array.close()
    found = zarr.open(str(group), mode="r")
    assert found.attrs["unit"] == "m"
    assert found["values"].chunks[0] == min(3, rows)
    assert found["values"].dtype == dtype
    assert np.array_equal(found["values"][:], values)


# Forms of actions.

ROTATIONS = ("quaternion", "axis_angle", "rotation_6d")


def turns(values: np.ndarray[Any, Any], form: str) -> Any:
    """Read rotations as scipy does, and those of six numbers as UMI does: two rows, made orthogonal."""
    from scipy.spatial.transform import Rotation

    if form == "quaternion":
        return Rotation.from_quat(values)
    if form == "axis_angle":
        return Rotation.from_rotvec(values)
    first = values[:, :3] / np.linalg.norm(values[:, :3], axis=1, keepdims=True)
    second = values[:, 3:] - (first * values[:, 3:]).sum(axis=1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=1))


def turning(dataset: Dataset) -> Dataset:
    """The same recording with commanded poses that turn by up to 3 rad, beyond half a turn in all, and uneven times."""
    from scipy.spatial.transform import Rotation

    random = np.random.default_rng(4)
    for episode in dataset.episodes:
        rows = episode.length
        steps = Rotation.from_rotvec(random.uniform(-1.0, 1.0, (rows, 3)) * np.linspace(0.0, 1.7, rows)[:, None])
        poses = [Rotation.random(random_state=4)]
        for step in steps[1:]:
            poses.append(step * poses[-1])
        quaternions = np.array([pose.as_quat() for pose in poses])
        positions = np.cumsum(random.normal(0.0, 0.01, (rows, 3)), axis=0)
        episode.columns["rig.tcp_set"] = np.concatenate([positions, quaternions], axis=1).astype(np.float32)
        dropped = np.where(np.arange(rows) < rows // 2, 0.0, 0.05)
        episode.columns["rig.time.grid"] = episode.columns["rig.time.grid"] + dropped
    return dataset


def actions(dataset: Dataset, out: Path, action: str, rotation: str | None = None) -> list[np.ndarray[Any, Any]]:
    made = export(dataset, "npz", out, cameras=[], action=action, rotation=rotation)  # type: ignore[arg-type]
    return [np.load(file)["action"] for file in sorted(made.path.glob("*.npz"))]


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_steps_of_the_tcp_add_up_to_its_poses(dataset: Dataset, tmp_path: Path, rotation: str) -> None:
    source = turning(Dataset(dataset.root))
    targets = actions(source, tmp_path / "poses", "tcp_pose", rotation)
    steps = actions(source, tmp_path / "steps", "tcp_delta", rotation)
    for episode, target, step in zip(source.episodes, targets, steps, strict=True):
        poses = episode.columns["rig.tcp_set"].astype(float)
        expected = turns(poses[:, 3:], "quaternion")
        later = [*range(1, episode.length), episode.length - 1]
        assert np.abs(target[:, :3] - poses[later, :3]).max() < 1e-9
        assert (turns(target[:, 3:-1], rotation) * expected[later].inv()).magnitude().max() < 1e-9
        place, turn = poses[0, :3], expected[0]
        for k, (by, rotated) in enumerate(zip(step[:, :3], turns(step[:, 3:-1], rotation), strict=True)):
            place, turn = place + by, rotated * turn
            assert np.abs(place - poses[later[k], :3]).max() < 1e-9
            assert (turn * expected[later[k]].inv()).magnitude() < 1e-9
        for values in (target, step):
            assert np.array_equal(values[:, -1], episode.columns["action"][:, -1].astype(float)), "the gripper"


def test_velocities_of_the_joints_add_up_to_their_targets(dataset: Dataset, tmp_path: Path) -> None:
    source = turning(Dataset(dataset.root))
    for episode, found in zip(source.episodes, actions(source, tmp_path / "out", "joint_velocity"), strict=True):
        period = np.append(np.diff(episode.stamps["grid"]), 1.0 / episode.fps)[:, None]
        start = episode.columns["rig.setpoint"][0, :7].astype(float)
        reached = start + np.cumsum(found[:, :7] * period, axis=0)
        assert np.abs(reached - episode.columns["action"][:, :7]).max() < 1e-9


def test_names_of_actions_follow_their_form(two_arms: Dataset, tmp_path: Path) -> None:
    made = export(two_arms, "npz", tmp_path / "out", action="tcp_delta", rotation="axis_angle")
    one = ["x", "y", "z", "rx", "ry", "rz", "gripper"]
    names = [f"{arm}.{name}" for arm in ("left", "right") for name in one]
    about = json.loads((made.path / "export.json").read_text())
    assert about["action_names"] == names
    assert about["action"] == {"kind": "tcp_delta", "rotation": "axis_angle"}
    with np.load(made.path / "episode_000000.npz") as file:
        assert file["action.names"].tolist() == names
        moved = np.abs(file["action"]).sum(axis=0)
        assert moved[9] > 0.01 > moved[:6].max(), "the right one went up"
    for wrong in ({"rotation": "quaternion"}, {"action": "twist"}, {"action": "tcp_pose", "rotation": "euler"}):
        with raises_code(hal.CommandError, "bad_export"):
            export(two_arms, "npz", tmp_path / "wrong", **wrong)  # type: ignore[arg-type]


def test_umi_and_robomimic_find_their_names(dataset: Dataset, two_arms: Dataset, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    zarr = pytest.importorskip("zarr", reason="pip install zarr")
    rows, first = (dataset.episodes[0].length, column(dataset, "observation.tcp")[:1])
    made = export(dataset, "zarr", tmp_path / "umi", cameras=[], action="tcp_pose", rotation="axis_angle")
    data = zarr.open(str(made.path), mode="r")["data"]
    assert data["action"].shape[1] == 7
    assert data["robot0_eef_rot_axis_angle"].shape == (made.rows, 3)
    start = data["robot0_demo_start_pose"][:]
    assert np.array_equal(start[0, :3], first[0, :3])
    assert np.array_equal(start[rows - 1], start[0])
    difference = turns(start[:1, 3:], "axis_angle") * turns(first[:, 3:], "quaternion").inv()
    assert difference.magnitude() < 1e-6
    for source, leads in ((dataset, [""]), (two_arms, ["robot0_", "robot1_"])):
        made = export(source, "robomimic", tmp_path / "file.hdf5", cameras=[], force=True)
        with h5py.File(made.path) as file:
            parts = file["data/demo_0/action_dict"]
            names = ["gripper", "gripper_force", "joint_position", "joint_velocity"]
            names += [f"{a}_{b}" for a in ("abs", "rel") for b in ("pos", "rot_6d", "rot_axis_angle")]
            assert set(parts) == {lead + name for lead in leads for name in names}
            assert parts[f"{leads[0]}abs_rot_6d"].shape[1] == 6
            state = file["data/demo_0/actions"][()]
            assert np.array_equal(parts[f"{leads[-1]}joint_position"][()], state[:, -8:-1])


# Forces.


def test_forces_are_exported_where_they_were_recorded(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'robot-hal[export]'")
    zarr = pytest.importorskip("zarr", reason="pip install zarr")
    with mock_rig("lock_step", "cameras={}") as rig:
        arm = rig.robots["panda"]
        arm.inject(tau_ext=[0.5] * 7, wrench_ext=[1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        rig.clock.sleep(0.1)
        with Recorder(rig, tmp_path / "demo", fps=20) as recorder:
            recorder.start()
            assert arm.gripper is not None
            arm.gripper.move(0.02, force=15.0)
            recorder.save(wait=True)
    source = Dataset(tmp_path / "demo")
    force = column(source, "rig.setpoint_force").reshape(-1)
    assert {15.0} < set(force.tolist())
    later = np.append(force[1:], force[-1])[:, None]
    with h5py.File(export(source, "robomimic", tmp_path / "a.hdf5").path) as file:
        demo = file["data/demo_0"]
        assert np.array_equal(demo["action_dict/gripper_force"][()], later)
        assert np.array_equal(demo["obs/robot0_joint_effort_ext"][()], column(source, "rig.tau_ext"))
        assert np.array_equal(demo["obs/robot0_eef_wrench"][()], column(source, "rig.wrench_ext"))
    data = zarr.open(str(export(source, "zarr", tmp_path / "b").path), mode="r")["data"]
    assert np.array_equal(data["action_robot0_gripper_force"][:], later)
    assert np.array_equal(data["robot0_eef_wrench"][:], column(source, "rig.wrench_ext"))
    with np.load(export(source, "npz", tmp_path / "c").path / "episode_000000.npz") as file:
        for key in ("rig.setpoint_force", "rig.tau_ext", "rig.wrench_ext"):
            assert np.array_equal(file[key], source.episodes[0].columns[key])


# What was never known.


def test_unknown_values_are_noted(dataset: Dataset, tmp_path: Path) -> None:
    silent = Dataset(dataset.root)
    columns = silent.episodes[1].columns
    columns["observation.velocity"] = np.where(np.arange(7) == 2, np.nan, columns["observation.velocity"])
    made = export(silent, "zarr", tmp_path / "out", cameras=[])
    assert made.notes == ("robot0_joint_vel of episode 1 has unknown values (NaN)",)
