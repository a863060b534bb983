"""Gravity, inertia and inverse dynamics against closed forms, and the inertials that are refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code
from specs import data, panda

from hal.config import load
from hal.config.data_files import data_folder
from hal.dynamics import STANDARD_GRAVITY, Dynamics
from hal.errors import CommandError, NotSupported
from hal.geometry import Pose
from hal.kinematics import Kinematics
from hal.kinematics.inertials import find_wrong_inertials
from hal.kinematics.urdf import parse_xml
from hal.specs import KinematicsSpec, LimitsSpec, PayloadSpec
from hal.testing import robot_spec

G = STANDARD_GRAVITY
LENGTHS, MASSES = (0.4, 0.3), (2.0, 1.5)
TURNED = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
"""A base that is turned by 90 degrees about x: gravity points along its -y."""

LINK = """<link name="{name}">
  <inertial><origin xyz="{com} 0 0"/><mass value="{mass}"/>
  <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="{com} 0 0"/><geometry><box size="{length} 0.05 0.05"/></geometry></collision></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{x} 0 0"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="2" effort="50"/></joint>"""


def rod(name: str, mass: float, length: float, **other: float) -> str:
    across = mass * length**2 / 12.0
    values = {"com": length / 2, "ixx": 1e-4, "iyy": across, "izz": across} | other
    return LINK.format(name=name, mass=mass, length=length, **values)


def arm(folder: Path, upper: str | None = None, lower: str | None = None, tip: str = '<link name="tip"/>') -> Any:
    """Two thin rods that hang in the x-z plane and turn about y, with a tool flange at the end."""
    parts = [
        '<robot name="rods"><link name="base"/>',
        rod("upper", MASSES[0], LENGTHS[0]) if upper is None else upper,
        rod("lower", MASSES[1], LENGTHS[1]) if lower is None else lower,
        tip,
        JOINT.format(name="j1", kind="revolute", parent="base", child="upper", x=0),
        JOINT.format(name="j2", kind="revolute", parent="upper", child="lower", x=LENGTHS[0]),
        JOINT.format(name="flange", kind="fixed", parent="lower", child="tip", x=LENGTHS[1]),
        "</robot>",
    ]
    file = folder / "rods.urdf"
    file.write_text("".join(parts), encoding="utf-8")
    spec = KinematicsSpec(
        str(file), ("j1", "j2"), (-2, -2), (2, 2), (0, 0), None, "tip", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    )
    return replace(robot_spec(2), urdf=str(file), joints=("j1", "j2"), kinematics=spec)


def weight(q: tuple[float, float], mass: float = 0.0) -> list[float]:
    """The torques that hold the rods and a mass at their tip, Nm: positive angles turn the rods downwards."""
    (l1, l2), (m1, m2) = LENGTHS, MASSES
    second = (m2 / 2 + mass) * l2 * math.cos(q[0] + q[1])
    first = (m1 / 2 + m2 + mass) * l1 * math.cos(q[0]) + second
    return [-G * first, -G * second]


@pytest.mark.parametrize("q", [(0.0, 0.0), (0.7, -0.4), (-1.2, 1.9)])
def test_gravity_of_two_rods_is_their_weight_times_the_lever(q: tuple[float, float], tmp_path: Path) -> None:
    dynamics = Dynamics.of(arm(tmp_path))
    assert dynamics.gravity(q) == pytest.approx(weight(q))
    assert dynamics.inverse(q, (0.0, 0.0), (0.0, 0.0)) == pytest.approx(weight(q))


def test_a_payload_hangs_at_its_place_in_the_frame_of_the_tcp(tmp_path: Path) -> None:
    q = (0.3, 0.5)
    spec = arm(tmp_path)
    at_tcp = Dynamics.of(replace(spec, payload=PayloadSpec(0.8)))
    assert at_tcp.gravity(q) == pytest.approx(weight(q, 0.8))
    tcp = replace(spec.kinematics, tcp_position=(0.1, 0.0, 0.0))
    behind = replace(spec, kinematics=tcp, payload=PayloadSpec(0.8, (-0.1, 0.0, 0.0)))
    assert Dynamics.of(behind).gravity(q) == pytest.approx(weight(q, 0.8))


def test_gravity_points_down_however_the_base_is_mounted(tmp_path: Path) -> None:
    lying = replace(arm(tmp_path), base_orientation=TURNED)
    assert Dynamics.of(lying).gravity((0.3, 0.5)) == pytest.approx([0.0, 0.0], abs=1e-12)
    hanging = replace(lying, base_orientation=(0.0, TURNED[0], 0.0, TURNED[3]))  # its x axis points down
    expected = Dynamics(hanging.kinematics, gravity=(G, 0.0, 0.0)).gravity((0.3, 0.5))
    assert Dynamics.of(hanging).gravity((0.3, 0.5)) == pytest.approx(expected)
    assert np.abs(expected).min() > 1.0


def test_inverse_dynamics_are_inertia_times_acceleration_plus_gravity(tmp_path: Path) -> None:
    dynamics = Dynamics.of(arm(tmp_path))
    q, ddq = (0.3, 0.5), (1.5, -2.0)
    mass = np.array(dynamics.mass_matrix(q))
    (_, l2), (_, m2) = LENGTHS, MASSES
    assert mass[1, 1] == pytest.approx(m2 * l2**2 / 3)
    assert np.array(dynamics.inverse(q, (0.0, 0.0), ddq)) == pytest.approx(mass @ ddq + dynamics.gravity(q))
    with raises_code(CommandError, "bad_command"):
        dynamics.gravity((0.0,) * 3)


def test_coriolis_torques_are_in_inverse_dynamics(tmp_path: Path) -> None:
    dynamics = Dynamics.of(arm(tmp_path))
    q, dq = (0.0, math.pi / 2), (0.0, 1.0)
    moving = dynamics.inverse(q, dq, (0.0, 0.0))
    h = -MASSES[1] * LENGTHS[0] * LENGTHS[1] / 2
    assert moving[0] - dynamics.gravity(q)[0] == pytest.approx(h)


def configurations(limits: LimitsSpec, count: int) -> list[list[float]]:
    positions: list[list[float]] = np.random.default_rng(4).uniform(limits.lower, limits.upper, (count, 7)).tolist()
    return positions


def differences(function: Any, q: Any, h: float = 1e-3) -> list[Any]:
    """Fourth-order central differences along each joint."""

    def at(k: int, steps: int) -> Any:
        return np.array(function([x + steps * h * (j == k) for j, x in enumerate(q)]))

    return [(8.0 * (at(k, 1) - at(k, -1)) - (at(k, 2) - at(k, -2))) / (12.0 * h) for k in range(len(q))]


def potential(kinematics: Kinematics, q: list[float]) -> float:
    """Potential energy of all links, J, from the centres of mass in the URDF."""
    energy = 0.0
    for link in parse_xml(kinematics.spec.urdf).findall("link"):
        mass, origin = link.find("inertial/mass"), link.find("inertial/origin")
        if mass is not None:
            place = [float(word) for word in ("0 0 0" if origin is None else origin.get("xyz", "0 0 0")).split()]
            pose = kinematics.link_pose(link.get("name", ""), q)
            energy += G * float(mass.get("value", "0")) * (pose @ Pose(place)).position[2]
    return energy


@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_dynamics_are_derivatives_of_the_energies_and_agree_with_the_recursive_form(model: str) -> None:
    spec = load("franka", overrides=[f"robots.arm.model={model}"]).resolve().robots[0]
    dynamics, kinematics = Dynamics(spec.kinematics), Kinematics(spec.kinematics)
    random, still = np.random.default_rng(5), [0.0] * 7
    for q in configurations(spec.limits, 5):
        gravity = np.array(dynamics.gravity(q))
        assert gravity == pytest.approx(differences(lambda q: potential(kinematics, q), q), abs=1e-9)
        mass = np.array(dynamics.mass_matrix(q))
        columns = [dynamics.inverse(q, still, unit) - gravity for unit in np.eye(7)]
        assert mass == pytest.approx(np.array(columns).T, abs=1e-9)
        dq, ddq = random.normal(size=7), random.normal(size=7)
        slope = np.array(differences(dynamics.mass_matrix, q))
        by_energy = np.einsum("kij,k,j->i", slope, dq, dq) - 0.5 * np.einsum("kij,i,j->k", slope, dq, dq)
        coriolis = np.array(dynamics.coriolis(q, dq))
        assert coriolis == pytest.approx(by_energy, abs=1e-9)
        tau = dynamics.inverse(q, dq, ddq)
        assert tau == pytest.approx(mass @ ddq + coriolis + gravity, abs=1e-9)
        assert dynamics.forward(q, dq, tau) == pytest.approx(ddq, abs=1e-9)


def test_the_task_inertia_is_how_hard_the_tcp_is_to_accelerate() -> None:
    spec = load("franka").resolve().robots[0]
    dynamics, kinematics = Dynamics.of(spec), Kinematics(spec.kinematics)
    q, still, wrench = spec.home, [0.0] * 7, np.array([3.0, -2.0, 5.0, 0.1, 0.3, -0.2])
    jacobian = kinematics.jacobian(q)
    tau = np.array(dynamics.gravity(q)) + jacobian.T @ wrench
    acceleration = jacobian @ dynamics.forward(q, still, tau)
    assert dynamics.task_inertia(q) @ acceleration == pytest.approx(wrench)
    stretched = dynamics.task_inertia(still)  # along z nothing can move
    assert np.isfinite(stretched).all()


def test_open_fingers_are_part_of_the_inertia() -> None:
    spec = load("franka").resolve().robots[0]
    wide, shut = Dynamics.of(spec), Dynamics.of(spec, width=0.0)
    more = np.array(wide.mass_matrix(spec.home)) - shut.mass_matrix(spec.home)
    finger = 0.0291  # kg, each 40 mm off the axis of joint 7, and a little farther with its own centre of mass
    assert more[6, 6] == pytest.approx(2.0 * finger * (0.0553**2 - 0.0153**2), rel=0.01)
    assert wide.gravity(spec.home) == pytest.approx(shut.gravity(spec.home), abs=1e-9)


def test_joints_may_be_in_another_order_than_in_the_file(tmp_path: Path) -> None:
    spec = arm(tmp_path).kinematics
    plain, turned = Dynamics(spec), Dynamics(replace(spec, joints=("j2", "j1")))
    q, dq, ddq = (0.3, 0.5), (0.2, -1.0), (1.5, -2.0)
    assert turned.inverse(q[::-1], dq[::-1], ddq[::-1]) == pytest.approx(plain.inverse(q, dq, ddq)[::-1])
    assert turned.gravity(q[::-1]) == pytest.approx(plain.gravity(q)[::-1])
    assert turned.coriolis(q[::-1], dq[::-1]) == pytest.approx(plain.coriolis(q, dq)[::-1])
    assert turned.forward(q[::-1], dq[::-1], ddq[::-1]) == pytest.approx(plain.forward(q, dq, ddq)[::-1])
    np.testing.assert_allclose(turned.task_inertia(q[::-1]), plain.task_inertia(q), atol=1e-9)
    np.testing.assert_allclose(turned.mass_matrix(q[::-1]), np.array(plain.mass_matrix(q))[::-1, ::-1], atol=1e-12)


@pytest.mark.parametrize(
    ("links", "wrong"),
    [
        ({}, set()),
        ({"lower": '<link name="lower"/>'}, {"lower", "tip"}),  # nothing that the second joint moves has a mass
        ({"tip": '<link name="tip"><visual/></link>'}, {"tip"}),
        ({"lower": rod("lower", 1.5, 0.3, iyy=1.0, izz=1.0)}, {"lower"}),
        ({"lower": rod("lower", 1.5, 0.3, izz=0.05)}, {"lower"}),
        ({"upper": rod("upper", 2.0, 0.4, ixx=0.0), "lower": rod("lower", 0.0, 0.3)}, {"lower", "tip"}),
    ],
)
def test_missing_and_impossible_inertials_are_refused_by_link(
    links: dict[str, str], wrong: set[str], tmp_path: Path
) -> None:
    spec = arm(tmp_path, **links)
    assert set(find_wrong_inertials(spec.urdf, spec.joints)) == wrong
    if wrong:
        with pytest.raises(NotSupported) as caught:
            Dynamics.of(spec)
        assert caught.value.code == "wrong_inertials"
        assert all(link in str(caught.value) for link in wrong)


def test_links_that_the_arm_does_not_move_need_no_mass(tmp_path: Path) -> None:
    spec = arm(tmp_path, upper='<link name="upper"><visual/></link>')
    assert set(find_wrong_inertials(spec.urdf, ("j1",))) == {"upper"}
    assert not find_wrong_inertials(spec.urdf, ("j2",))


def test_invented_inertias_are_found() -> None:
    spec = panda(urdf=data("franka_panda/panda.urdf"))
    assert {"panda_link6", "panda_link7", "panda_hand"} <= set(find_wrong_inertials(spec.urdf, spec.joints))


@pytest.mark.parametrize("file", sorted(data_folder("robots").glob("*.urdf")), ids=lambda file: file.stem)
def test_urdfs_that_ship_have_sound_inertials(file: Path) -> None:
    from hal.kinematics.urdf import read_urdf

    model = read_urdf(file, meshes=False)
    assert not find_wrong_inertials(file, [name for name, joint in model.joints.items() if joint.movable])
