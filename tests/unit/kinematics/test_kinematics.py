"""Kinematics against PyBullet's own of the same URDF, and against their own definitions."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

from hal.errors import CommandError, DeviceNotFound, Unreachable
from hal.geometry import Pose, quaternion_to_matrix
from hal.kinematics.arm import NEAR_SINGULAR, Kinematics
from hal.specs import KinematicsSpec

pybullet = pytest.importorskip("pybullet", reason="needs pybullet (pip install pybullet)")

_DATA = importlib.util.find_spec("pybullet_data")
if _DATA is None or _DATA.origin is None:
    pytest.skip("needs pybullet_data (pip install pybullet)", allow_module_level=True)
FOLDER = Path(_DATA.origin).parent

PANDA = KinematicsSpec(
    urdf=str(FOLDER / "franka_panda/panda.urdf"),
    joints=tuple(f"panda_joint{k}" for k in range(1, 8)),
    lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    home=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    base_link="panda_link0",
    tcp_link="panda_hand",
    tcp_position=(0.0, 0.0, 0.1034),
    tcp_orientation=(0.0, 0.0, 0.0, 1.0),
)
IIWA = KinematicsSpec(
    urdf=str(FOLDER / "kuka_iiwa/model.urdf"),
    joints=tuple(f"lbr_iiwa_joint_{k}" for k in range(1, 8)),
    lower=(-2.96, -2.09, -2.96, -2.09, -2.96, -2.09, -3.05),
    upper=(2.96, 2.09, 2.96, 2.09, 2.96, 2.09, 3.05),
    home=(0.0, 0.5, 0.0, -1.3, 0.0, 1.2, 0.0),
    base_link=None,
    tcp_link="lbr_iiwa_link_7",
    tcp_position=(0.0, 0.03, 0.1),
    tcp_orientation=(0.0, 0.0, 0.6, 0.8),
)


@pytest.fixture(scope="module")
def panda() -> Kinematics:
    return Kinematics(PANDA)


def configurations(spec: KinematicsSpec, count: int, seed: int = 7) -> Iterator[np.ndarray]:
    numbers = np.random.default_rng(seed)
    for _ in range(count):
        yield numbers.uniform(spec.lower, spec.upper)


class Bullet:
    """The same arm in PyBullet."""

    def __init__(self, spec: KinematicsSpec) -> None:
        self.spec = spec
        self.client = pybullet.connect(pybullet.DIRECT)
        self.body = pybullet.loadURDF(spec.urdf, useFixedBase=True, physicsClientId=self.client)
        count = pybullet.getNumJoints(self.body, physicsClientId=self.client)
        infos = [pybullet.getJointInfo(self.body, k, physicsClientId=self.client) for k in range(count)]
        self.link = next(info[0] for info in infos if info[12].decode() == spec.tcp_link)
        self.joints = {info[1].decode(): info[0] for info in infos}
        self.moving = [info[1].decode() for info in infos if info[2] != pybullet.JOINT_FIXED]

    def place(self, q: np.ndarray) -> None:
        for name, value in zip(self.spec.joints, q, strict=True):
            pybullet.resetJointState(self.body, self.joints[name], value, physicsClientId=self.client)

    def link_pose(self) -> Pose:
        state = pybullet.getLinkState(self.body, self.link, computeForwardKinematics=True, physicsClientId=self.client)
        return Pose(state[4], state[5])

    def tcp(self) -> Pose:
        return self.link_pose() @ Pose(self.spec.tcp_position, self.spec.tcp_orientation)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        positions = [0.0] * len(self.moving)
        for name, value in zip(self.spec.joints, q, strict=True):
            positions[self.moving.index(name)] = float(value)
        zeros = [0.0] * len(self.moving)
        linear, angular = pybullet.calculateJacobian(
            self.body, self.link, self.spec.tcp_position, positions, zeros, zeros, physicsClientId=self.client
        )
        columns = [self.moving.index(name) for name in self.spec.joints]
        return np.vstack([linear, angular])[:, columns]


@pytest.mark.parametrize("spec", [PANDA, IIWA], ids=["panda", "iiwa"])
def test_agrees_with_pybullet(spec: KinematicsSpec) -> None:
    kinematics, bullet = Kinematics(spec), Bullet(spec)
    try:
        tcps = []
        for q in configurations(spec, 50):
            bullet.place(q)
            distance, angle = kinematics.pose(q).distance(bullet.tcp())
            assert distance < 1e-6
            assert angle < 1e-5
            distance, angle = kinematics.link_pose(spec.tcp_link, q).distance(bullet.link_pose())
            assert distance < 1e-6
            assert angle < 1e-5
            np.testing.assert_allclose(kinematics.jacobian(q), bullet.jacobian(q), atol=1e-6)
            tcps.append(kinematics.pose(q).position)
        assert np.ptp(tcps, axis=0).min() > 0.5  # it moved
    finally:
        pybullet.disconnect(bullet.client)


def test_fk_gives_seven_plain_floats(panda: Kinematics) -> None:
    pose = panda.fk(PANDA.home)
    assert len(pose) == 7
    assert all(type(value) is float for value in pose)
    assert np.linalg.norm(pose[3:]) == pytest.approx(1.0)
    assert panda.fk(panda.home.tolist()) == pose


def test_results_do_not_change_when_the_next_pose_is_computed(panda: Kinematics) -> None:
    jacobian, pose = panda.jacobian(panda.home), panda.fk(panda.home)
    kept = jacobian.copy()
    panda.jacobian(panda.home + 0.3)
    panda.fk(panda.home + 0.3)
    assert np.array_equal(jacobian, kept)
    assert panda.fk(panda.home) == pose


def test_jacobian_is_the_derivative_of_fk(panda: Kinematics) -> None:
    for q in configurations(PANDA, 10):
        jacobian = panda.jacobian(q)
        for k in range(7):
            step = np.zeros(7)
            step[k] = 1e-6
            derivative = panda.pose_error(q, panda.fk(q + step)) / 1e-6
            np.testing.assert_allclose(jacobian[:, k], derivative, atol=1e-5)


def test_velocity_tracks_exactly_and_the_posture_stays_in_the_null_space(panda: Kinematics) -> None:
    checked = 0
    for q in configurations(PANDA, 200):
        twist = np.array([0.1, -0.05, 0.2, 0.3, -0.2, 0.1])
        jacobian = panda.jacobian(q)
        speeds, near = panda.velocity(q, twist)
        assert near == (np.linalg.svd(jacobian)[1][-1] < NEAR_SINGULAR)
        if near:
            continue
        checked += 1
        np.testing.assert_allclose(jacobian @ speeds, twist, atol=1e-9)
        without, _ = panda.velocity(q, twist, posture_gain=0.0)
        np.testing.assert_allclose(jacobian @ without, twist, atol=1e-9)
        assert np.linalg.norm(without) <= np.linalg.norm(speeds) + 1e-12  # the smallest solution
        self_motion = np.subtract(speeds, without)
        assert self_motion @ (panda.home - q) > -1e-12  # towards home
    assert checked > 100


def test_posture_brings_the_elbow_home_and_leaves_the_tcp(panda: Kinematics) -> None:
    start = panda.fk(panda.home)
    q = panda.solve(panda.pose(panda.home), panda.home + np.array([0.4, 0.0, -0.4, 0.0, 0.0, 0.0, 0.0]))
    assert np.abs(q - panda.home).max() > 0.2  # another elbow, the same tcp
    farthest = 0.0
    for _ in range(2000):
        speeds, _ = panda.velocity(q, panda.pose_error(q, start))
        q = q + 0.01 * np.array(speeds)
        farthest = max(farthest, float(np.linalg.norm(panda.pose_error(q, start))))
    assert np.abs(q - panda.home).max() < 1e-3
    assert farthest < 1e-3


def test_far_from_home_the_posture_is_slow(panda: Kinematics) -> None:
    for q in configurations(PANDA, 100):
        speeds, _ = panda.velocity(q, np.zeros(6), posture_gain=100.0)
        assert np.linalg.norm(speeds) < 0.5 * math.sqrt(7) + 1e-9


def singular_configurations() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    straight = [np.array([0.0, 0.0, 0.0, -0.0698, 0.0, 0.0, 0.0]), np.zeros(7)]
    return [s + scale * rng.normal(size=7) for scale in (0.0, 1e-7, 0.02) for s in straight]


def test_near_singularities_speeds_are_bounded_and_the_flag_is_set(panda: Kinematics) -> None:
    for q in singular_configurations():
        for axis in range(6):
            twist = np.zeros(6)
            twist[axis] = 0.2
            speeds, near = panda.velocity(q, twist, posture_gain=0.0)
            assert near
            assert np.linalg.norm(speeds) <= 0.2 / NEAR_SINGULAR + 1e-9
            # What is met is met along the twist, never against it.
            assert float(panda.jacobian(q)[axis] @ speeds) >= -1e-9
            both, _ = panda.velocity(q, twist)
            assert np.isfinite(both).all()
            assert np.linalg.norm(both) < 0.2 / NEAR_SINGULAR + 0.5 * math.sqrt(7)


def test_near_singularities_the_posture_does_not_move_the_tcp(panda: Kinematics) -> None:
    q = singular_configurations()[4]
    speeds, near = panda.velocity(q, np.zeros(6))
    assert near
    assert np.linalg.norm(speeds) > 1e-3
    np.testing.assert_allclose(panda.jacobian(q) @ speeds, 0.0, atol=1e-9)


def test_velocity_is_continuous_where_the_damping_begins(panda: Kinematics) -> None:
    """Along a line into a singularity neighbouring answers stay close, also where the method changes."""
    start, end = panda.home.copy(), panda.home.copy()
    end[3], end[5] = -0.0698, 0.05
    twist = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
    previous, flags = None, []
    for s in np.linspace(0.0, 1.0, 4000):
        speeds, near = panda.velocity((1 - s) * start + s * end, twist, posture_gain=0.0)
        flags.append(near)
        if previous is not None:
            assert np.abs(np.subtract(speeds, previous)).max() < 0.05
        previous = speeds
    assert any(flags)
    assert not all(flags)


def test_pose_error_reaches_the_pose_in_a_second(panda: Kinematics) -> None:
    for q, other in zip(configurations(PANDA, 30, 1), configurations(PANDA, 30, 2), strict=True):
        twist = panda.pose_error(q, panda.fk(other))
        angle = float(np.linalg.norm(twist[3:]))
        axis = twist[3:] / angle
        turn = quaternion_to_matrix([*(math.sin(angle / 2) * axis), math.cos(angle / 2)])
        start, end = panda.pose(q).matrix(), panda.pose(other).matrix()
        np.testing.assert_allclose(start[:3, 3] + twist[:3], end[:3, 3], atol=1e-9)
        np.testing.assert_allclose(turn @ start[:3, :3], end[:3, :3], atol=1e-9)
        assert angle <= math.pi + 1e-9
    assert np.linalg.norm(panda.pose_error(panda.home, panda.fk(panda.home))) < 1e-12
    pose = panda.fk(panda.home)
    flipped = (*pose[:3], *(-value for value in pose[3:]))
    assert np.linalg.norm(panda.pose_error(panda.home, flipped)) < 1e-12  # the same orientation


@pytest.mark.parametrize("spec", [PANDA, IIWA], ids=["panda", "iiwa"])
def test_solve_round_trip_inside_the_limits(spec: KinematicsSpec) -> None:
    kinematics = Kinematics(spec)
    for q in configurations(spec, 40, 11):
        target = kinematics.pose(q)
        answer = kinematics.solve(target)
        assert (answer >= spec.lower).all()
        assert (answer <= spec.upper).all()
        distance, angle = kinematics.pose(answer).distance(target)
        assert distance < 2e-5
        assert angle < 2e-5


def test_solve_stays_near_its_seed(panda: Kinematics) -> None:
    rng = np.random.default_rng(5)
    inside = [q for q in configurations(PANDA, 60, 13) if np.linalg.svd(panda.jacobian(q))[1][-1] > 0.1]
    assert len(inside) > 20
    for q in inside:
        seed = np.clip(q + 0.05 * rng.normal(size=7), PANDA.lower, PANDA.upper)
        assert np.abs(panda.solve(panda.pose(q), seed) - seed).max() < 0.6


def test_solve_is_deterministic(panda: Kinematics) -> None:
    target = panda.pose(np.array([1.5, 1.2, -1.0, -1.8, 2.0, 3.0, -2.0]))
    assert np.array_equal(panda.solve(target), panda.solve(target))


def test_an_unreachable_pose_has_its_true_distance(panda: Kinematics) -> None:
    target = Pose([2.0, 0.0, 0.4], panda.pose(panda.home).orientation)
    with pytest.raises(Unreachable) as caught:
        panda.solve(target)
    error = caught.value
    assert error.q is not None
    assert (np.array(error.q) >= PANDA.lower).all()
    assert (np.array(error.q) <= PANDA.upper).all()
    distance, angle = panda.pose(error.q).distance(target)
    assert error.position_error == pytest.approx(distance, abs=1e-9)
    assert error.rotation_error == pytest.approx(angle, abs=1e-6)
    # The arm reaches 0.855 m from its shoulder at 0.333 m, the tcp at most 0.107 + 0.1034 + 0.088 m farther.
    assert 0.85 < error.position_error < 1.5


def test_pose_beyond_a_joint_limit_is_refused() -> None:
    narrow = dataclasses.replace(
        PANDA, lower=tuple(h - 0.1 for h in PANDA.home), upper=tuple(h + 0.1 for h in PANDA.home)
    )
    kinematics = Kinematics(narrow)
    q = np.array(PANDA.home) + 0.5
    with pytest.raises(Unreachable):
        kinematics.solve(kinematics.pose(q))
    inside = np.array(PANDA.home) + np.array([0.09, -0.09, 0.05, 0.09, 0.0, -0.09, 0.05])
    assert np.abs(kinematics.solve(kinematics.pose(inside)) - PANDA.home).max() <= 0.1 + 1e-12


def test_singular_targets_are_solved(panda: Kinematics) -> None:
    q = np.array([0.0, 0.0, 0.0, -0.0698, 0.0, 0.5, 0.0])
    answer = panda.solve(panda.pose(q))
    assert panda.pose(answer).distance(panda.pose(q))[0] < 2e-5


def test_bad_seed_and_unknown_link_are_named(panda: Kinematics) -> None:
    pose = panda.pose(panda.home)
    with pytest.raises(CommandError, match="q_seed (must have shape|holds)"):
        panda.solve(pose, [0.0] * 6)
    with pytest.raises(CommandError, match="q_seed (must have shape|holds)"):
        panda.solve(pose, [math.nan] * 7)
    with pytest.raises(DeviceNotFound, match="panda_hand"):
        panda.link_pose("panda_hnad", panda.home)


def arm_urdf(first: str = "continuous") -> str:
    """Three axes in an order that is not the alphabet's, behind a mast, with a sliding finger at the end."""
    limit = "" if first == "continuous" else '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    links = "".join(f'<link name="{name}"/>' for name in ("root", "mast", "z", "m", "a", "finger"))
    return f"""<robot name="arm">{links}
      <joint name="foot" type="fixed"><parent link="root"/><child link="mast"/>
        <origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/></joint>
      <joint name="zeta" type="{first}"><parent link="mast"/><child link="z"/><axis xyz="0 0 1"/>{limit}</joint>
      <joint name="mu" type="revolute"><parent link="z"/><child link="m"/><origin xyz="0.5 0 0"/><axis xyz="0 1 0"/>
        <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
      <joint name="alpha" type="prismatic"><parent link="m"/><child link="a"/><origin xyz="0.25 0 0"/>
        <axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
      <joint name="aa_finger" type="prismatic"><parent link="root"/><child link="finger"/><axis xyz="1 0 0"/>
        <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
    </robot>"""


def small_spec(path: Path, **changes: Any) -> KinematicsSpec:
    values: dict[str, Any] = {
        "urdf": str(path),
        "joints": ("zeta", "mu", "alpha"),
        "lower": (-100.0, -2.0, 0.0),
        "upper": (100.0, 2.0, 1.0),
        "home": (0.0, 0.0, 0.0),
        "base_link": "mast",
        "tcp_link": "a",
        "tcp_position": (0.0, 0.0, 0.0),
        "tcp_orientation": (0.0, 0.0, 0.0, 1.0),
    }
    return KinematicsSpec(**(values | changes))


def expected(zeta: float, mu: float, alpha: float) -> np.ndarray:
    """Position of link ``a`` in the mast's frame, worked out by hand."""
    radius = 0.5 + (0.25 + alpha) * math.cos(mu)
    return np.array([radius * math.cos(zeta), radius * math.sin(zeta), -(0.25 + alpha) * math.sin(mu)])


@pytest.mark.parametrize("first", ["continuous", "revolute"])
def test_continuous_joints_are_plain_angles_and_the_base_is_a_frame(tmp_path: Path, first: str) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf(first))
    kinematics = Kinematics(small_spec(path))
    for q in ([0.0, 0.0, 0.0], [0.7, -0.4, 0.3], [7.0, 0.2, 0.1]):
        np.testing.assert_allclose(kinematics.pose(q).position, expected(*q), atol=1e-12)
    np.testing.assert_allclose(kinematics.link_pose("mast", [0.3, 0.2, 0.1]).position, 0.0, atol=1e-12)
    np.testing.assert_allclose(kinematics.link_pose("root", [0.3, 0.2, 0.1]).position, [-2.0, 1.0, -3.0], atol=1e-12)
    root = Kinematics(small_spec(path, base_link=None))
    np.testing.assert_allclose(root.pose([0.0, 0.0, 0.0]).position, [1.0, 2.75, 3.0], atol=1e-12)


def test_joints_keep_the_order_of_the_spec(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf())
    plain = Kinematics(small_spec(path))
    turned = Kinematics(
        small_spec(path, joints=("alpha", "zeta", "mu"), lower=(0.0, -100.0, -2.0), upper=(1.0, 100.0, 2.0))
    )
    q, other = [0.7, -0.4, 0.3], [0.3, 0.7, -0.4]
    np.testing.assert_allclose(turned.fk(other), plain.fk(q), atol=1e-12)
    np.testing.assert_allclose(turned.jacobian(other), plain.jacobian(q)[:, [2, 0, 1]], atol=1e-12)
    # Three axes cannot follow six numbers: the answer is damped, finite and flagged.
    speeds, near = plain.velocity(q, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert near
    assert np.isfinite(speeds).all()


def derivative_of(matrix: Any, q: np.ndarray, joint: int, h: float = 1e-3) -> np.ndarray:
    """Fourth-order central difference of ``matrix(q)`` along one joint."""
    step = np.eye(len(q))[joint] * h
    near, far = matrix(q + step) - matrix(q - step), matrix(q + 2 * step) - matrix(q - 2 * step)
    return (8.0 * near - far) / (12.0 * h)


@pytest.mark.parametrize("link", [None, "panda_link5"])
def test_jacobians_in_three_frames_are_derivatives_of_the_pose(panda: Kinematics, link: str | None) -> None:
    def pose(q: np.ndarray) -> np.ndarray:
        return (panda.pose(q) if link is None else panda.link_pose(link, q)).matrix()

    for q in configurations(PANDA, 10):
        here = pose(q)
        back, base = np.linalg.inv(here), np.eye(4)
        base[:3, 3] = here[:3, 3]
        at_tcp = np.linalg.inv(base)
        found = {frame: panda.jacobian(q, frame, link) for frame in ("base", "tcp", "space")}
        for k in range(7):
            slope = derivative_of(pose, q, k)
            twists = {"space": slope @ back, "tcp": back @ slope, "base": at_tcp @ slope @ back @ base}
            for frame, m in twists.items():
                column = [*m[:3, 3], m[2, 1], m[0, 2], m[1, 0]]
                np.testing.assert_allclose(found[frame][:, k], column, atol=1e-8)
    if link is not None:
        assert not found["base"][:, 5:].any()


def test_an_unknown_frame_and_an_unknown_link_are_refused(panda: Kinematics) -> None:
    with pytest.raises(CommandError) as caught:
        panda.jacobian(panda.home, "world")  # type: ignore[arg-type]  # the mistake
    assert caught.value.code == "unknown_frame"
    with raises_code(DeviceNotFound, "unknown_link"):
        panda.jacobian(panda.home, link="panda_link55")
    for wrong in ([0.0] * 6, [[0.0] * 7]):
        with raises_code(CommandError, "bad_command"):
            panda.jacobian(wrong)  # type: ignore[arg-type]  # the mistake


@pytest.mark.parametrize("link", [None, "panda_link4"])
def test_the_product_of_exponentials_is_forward_kinematics(panda: Kinematics, link: str | None) -> None:
    axes = panda.screw_axes()
    np.testing.assert_allclose(np.linalg.norm(axes[3:], axis=0), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.einsum("ij,ij->j", axes[:3], axes[3:]), 0.0, atol=1e-12)  # they turn only
    for q in configurations(PANDA, 20):
        pose = panda.pose(q) if link is None else panda.link_pose(link, q)
        np.testing.assert_allclose(panda.exponential(q, link).matrix(), pose.matrix(), atol=1e-12)


def test_the_product_of_exponentials_of_an_arm_with_a_slide_in_another_order(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf())
    arm = Kinematics(
        small_spec(path, joints=("alpha", "zeta", "mu"), lower=(0.0, -100.0, -2.0), upper=(1.0, 100.0, 2.0))
    )
    q = (0.3, 0.7, -0.4)
    np.testing.assert_allclose(arm.exponential(q).matrix(), arm.pose(q).matrix(), atol=1e-12)
    assert sorted(np.linalg.norm(arm.screw_axes()[3:], axis=0).tolist()) == pytest.approx([0.0, 1.0, 1.0])


def test_manipulability_is_yoshikawas(panda: Kinematics) -> None:
    jacobian = panda.jacobian(panda.home)
    assert panda.manipulability(panda.home) == pytest.approx(np.sqrt(np.linalg.det(jacobian @ jacobian.T)))
    assert panda.manipulability(np.zeros(7)) == pytest.approx(0.0, abs=1e-9)  # stretched out


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": ("zeta", "mu", "beta")}, "beta"),
        ({"tcp_link": "hand"}, "hand"),
        ({"base_link": "floor"}, "floor"),
        ({"base_link": "m"}, "moves with"),
        ({"home": (0.0, 0.0)}, "home"),
    ],
)
def test_a_spec_that_does_not_fit_the_urdf_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf())
    with pytest.raises(ValueError, match=message):
        Kinematics(small_spec(path, **changes))


def test_an_arm_of_one_joint_has_a_jacobian_with_one_column(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(arm_urdf())
    one = {"joints": ("zeta",), "lower": (-3.0,), "upper": (3.0,), "home": (0.0,), "tcp_link": "m"}
    kinematics = Kinematics(small_spec(tmp_path / "arm.urdf", **one))
    pose, jacobian = kinematics.fk_and_jacobian([0.0])
    np.testing.assert_allclose(pose[:3], [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(jacobian, np.array([[0.0, 0.5, 0.0, 0.0, 0.0, 1.0]]).T, atol=1e-12)
