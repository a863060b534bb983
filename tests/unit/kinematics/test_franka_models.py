"""The FR3's and the Panda's URDFs have the published values and load everywhere; the FR3's limits hold in its range."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from engines_kit import Engine
from specs import cube, data, panda, world_spec

from hal.config import load
from hal.config.data_files import find_data
from hal.drivers.franka.arm import FrankaArm
from hal.drivers.franka.limits import FR3, LIMITS
from hal.drivers.franka.settings import check_arm
from hal.dynamics import Dynamics
from hal.kinematics.arm import Kinematics
from hal.specs import RobotSpec
from hal_emulators.franka.plant import RigidBody

URDF = find_data("robots", "fr3.urdf")
PANDA = find_data("robots", "panda.urdf")
JOINTS = [f"fr3_joint{k}" for k in range(1, 8)]
# a, d, alpha of the modified Denavit-Hartenberg parameters in Franka's documents; the last row is the flange.
DH = [
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
    (0.0, 0.107, 0.0),
]

ADDRESS = "robots.arm.real.host=172.16.0.2"
"""No built-in rig has one."""


def fr3(**arguments: bool) -> RobotSpec:
    return load("franka", overrides=[ADDRESS], **arguments).resolve().robots[0]


def turn_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def flange(q: np.ndarray) -> np.ndarray:
    """(4, 4) by the table."""
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(DH, [*q, 0.0], strict=True):
        c, s = math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]]) @ turn_z(theta)
        pose = pose @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, d], [0, 0, 0, 1.0]])
    return pose


def random_positions(count: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(FR3.lower, FR3.upper, (count, 7))


@pytest.mark.parametrize(("model", "end"), [("fr3", "fr3_hand_tcp"), ("panda", "panda_hand")])
def test_the_kinematics_are_those_of_the_table(model: str, end: str) -> None:
    kinematics = Kinematics(load("franka", overrides=[f"robots.arm.model={model}"]).resolve().robots[0].kinematics)
    to_tcp = turn_z(-math.pi / 4)
    to_tcp[2, 3] = 0.1034
    to_end = to_tcp if end.endswith("tcp") else turn_z(-math.pi / 4)
    for q in random_positions(50):
        assert kinematics.pose(q).matrix() == pytest.approx(flange(q) @ to_tcp, abs=1e-9)
        assert kinematics.link_pose(end, q).matrix() == pytest.approx(flange(q) @ to_end, abs=1e-9)


def test_every_link_stands_where_that_of_pybullets_panda_does() -> None:
    theirs = data("franka_panda/panda.urdf")
    from hal.drivers.pybullet.world import PyBulletWorld

    apart = np.array([0.0, 2.0, 0.0])
    arms = [
        replace(fr3(), name="fr3", base_position=(0.0, 0.0, 0.0)),
        panda("panda", base_position=(0.0, 2.0, 0.0)),
        panda("reference", base_position=(0.0, 4.0, 0.0), urdf=theirs),
    ]
    world = PyBulletWorld(world_spec(*arms))
    assert all(warning.startswith("reference") for warning in world.warnings)
    links = [*(f"link{k}" for k in range(9)), "hand", "leftfinger", "rightfinger"]
    for q in random_positions(20):
        for arm in arms:
            world.reset(arm.name, q=[*q, 0.01, 0.01])
        for link in links:
            right = world.pose("reference", f"panda_{link}")
            for name, prefix, steps in (("panda", "panda", 1), ("fr3", "fr3", 2)):
                ours = world.pose(name, f"{prefix}_{link}")
                assert ours["position"] == pytest.approx(right["position"] - steps * apart, abs=1e-6), (name, link)
                if (name, link) != ("fr3", "rightfinger"):  # turned about z, so that both fingers are alike
                    same = abs(np.dot(ours["orientation"], right["orientation"]))
                    assert same == pytest.approx(1.0, abs=1e-6), (name, link)
    world.close()


@pytest.mark.parametrize("urdf", [URDF, PANDA])
def test_pybullet_loads_it_without_messages(urdf: Path) -> None:
    from hal.drivers.pybullet.engine import PyBulletClient, silence_output
    from hal.drivers.pybullet.loading import loadable_urdf

    data("")
    client = PyBulletClient()
    with loadable_urdf(str(urdf)) as file, silence_output() as chatter:
        body = client.loadURDF(file, useFixedBase=True, flags=client.URDF_USE_INERTIA_FROM_FILE)
    assert chatter.text == ""
    drawn = [Path(shape[4].decode()) for shape in client.getVisualShapeData(body)]
    assert len(drawn) == 11
    assert all(file.is_file() for file in drawn)
    client.close()


@pytest.mark.parametrize("urdf", [URDF, PANDA])
def test_the_other_views_find_its_meshes(urdf: Path) -> None:
    from hal.kinematics.urdf import read_urdf

    data("")
    visuals = [visual for link in read_urdf(urdf).links.values() for visual in link.visuals]
    assert len(visuals) == 11
    assert all(Path(visual.file).is_file() for visual in visuals)


def test_the_urdf_holds_the_official_limits() -> None:
    root = ElementTree.parse(URDF).getroot()
    joints = {joint.get("name"): joint for joint in root.iter("joint")}
    for k, name in enumerate(JOINTS):
        limit, slower = joints[name].find("limit"), joints[name].find("position_based_velocity_limits")
        assert limit is not None
        assert slower is not None
        said = [float(limit.get(key, "nan")) for key in ("lower", "upper", "velocity", "effort")]
        assert said == [FR3.lower[k], FR3.upper[k], FR3.velocity[k], FR3.torque[k]]
        assert FR3.velocity_offset is not None
        assert FR3.deceleration is not None
        assert float(slower.get("velocity_offset", "nan")) == FR3.velocity_offset[k]
        assert float(slower.get("deceleration_limit", "nan")) == FR3.deceleration[k]


def test_no_other_joint_can_be_taken_for_one_of_the_arms() -> None:
    """The vendor's client looks for joints whose names contain joint1 to joint7."""
    names = [joint.get("name", "") for joint in ElementTree.parse(URDF).getroot().iter("joint")]
    for k in range(1, 8):
        assert [name for name in names if f"joint{k}" in name] == [f"fr3_joint{k}"]


@pytest.mark.parametrize("urdf", [URDF, PANDA])
def test_it_weighs_what_an_arm_with_a_hand_does(urdf: Path) -> None:
    masses = [float(mass.get("value", "nan")) for mass in ElementTree.parse(urdf).getroot().iter("mass")]
    assert 17.0 < sum(masses) < 20.0


# Gaz et al. 2019, links 1 to 7: mass, kg; centre of mass, m; xx, xy, xz, yy, yz, zz of the inertia about it, kg m2.
GAZ = """
4.970684  0.003875  0.002081 -0.04762   0.70337  -0.000139  0.006772 0.70661   0.019169 0.009117
0.646926 -0.003141 -0.02872   0.003495  0.007962 -0.003925  0.010254 0.02811   0.000704 0.025995
3.228604  0.027518  0.039252 -0.066502  0.037242 -0.004761 -0.011396 0.036155 -0.012805 0.01083
3.587895 -0.05317   0.104419  0.027454  0.025853  0.007796 -0.001332 0.019552  0.008641 0.028323
1.225946 -0.011953  0.041065 -0.038437  0.035549 -0.002117 -0.004037 0.029474  0.000229 0.008627
1.666555  0.060149 -0.014117 -0.010517  0.001964  0.000109 -0.001158 0.004354  0.000341 0.005433
0.735522  0.010517 -0.004252  0.061597  0.012516 -0.000428 -0.001196 0.010027 -0.000741 0.004815
"""


def inertials(urdf: Path, link: str) -> list[float]:
    """The numbers of a link in the order of GAZ."""
    found = ElementTree.parse(urdf).getroot().find(f"link[@name='{link}']/inertial")
    assert found is not None
    mass, origin, inertia = found.find("mass"), found.find("origin"), found.find("inertia")
    assert mass is not None
    assert origin is not None
    assert inertia is not None
    numbers = [mass.get("value", ""), *origin.get("xyz", "").split()]
    return [float(n) for n in (*numbers, *(inertia.get(f"i{k}", "") for k in ("xx", "xy", "xz", "yy", "yz", "zz")))]


def test_the_pandas_torques_are_those_of_the_published_identification() -> None:
    """The arm's own: without the hand."""
    import pinocchio as pin

    whole = pin.buildModelFromUrdf(str(PANDA))
    models = []
    for table in (
        [inertials(PANDA, f"panda_link{k}") for k in range(1, 8)],
        np.array(GAZ.split(), float).reshape(7, 10),
    ):
        arm = pin.buildReducedModel(whole, [8, 9], pin.neutral(whole))
        for k, (mass, x, y, z, xx, xy, xz, yy, yz, zz) in enumerate(table, start=1):
            about_com = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            arm.inertias[k] = pin.Inertia(mass, np.array([x, y, z]), about_com)
        models.append((arm, arm.createData()))
    random = np.random.default_rng(2)
    for q in random_positions(50):
        dq, ddq = random.normal(0.0, 1.0, 7), random.normal(0.0, 5.0, 7)
        ours, published = (pin.rnea(arm, data, q, dq, ddq) for arm, data in models)
        assert ours == pytest.approx(published, abs=1e-3)


@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_driver_and_emulator_have_the_inertia_of_the_urdf(model: str) -> None:
    spec = load("franka", overrides=[f"robots.arm.model={model}", ADDRESS], sim=False).resolve().robots[0]
    dynamics, driver, body = Dynamics.of(spec), FrankaArm(spec), RigidBody(Path(spec.urdf))
    assert np.array(driver.mass_matrix(spec.home)) == pytest.approx(np.array(dynamics.mass_matrix(spec.home)))
    still = [0.0] * 7
    assert body.torques(spec.home, still, still) == pytest.approx(dynamics.gravity(spec.home))
    if model == "panda":  # a URDF with invented inertias
        kinematics = replace(spec.kinematics, urdf=data("franka_panda/panda.urdf"))
        other = FrankaArm(replace(spec, urdf=kinematics.urdf, kinematics=kinematics)).mass_matrix(spec.home)
        assert np.array(other) == pytest.approx(np.array(dynamics.mass_matrix(spec.home)), abs=0.15)


def test_the_driver_reads_the_inertia_before_its_first_cycle(tmp_path: Path) -> None:
    spec = fr3(sim=False)
    urdf = tmp_path / "arm.urdf"
    urdf.write_bytes(Path(spec.urdf).read_bytes())
    spec = replace(spec, urdf=str(urdf), kinematics=replace(spec.kinematics, urdf=str(urdf)))
    driver = FrankaArm(spec)
    urdf.unlink()
    assert np.shape(driver.mass_matrix(spec.home)) == (7, 7)


def test_every_speed_holds_everywhere_in_the_range() -> None:
    limits = fr3(sim=False).limits
    # Of Franka's control-parameters-joint-fr3-rectangular.csv, whose speeds exceed the formula in the corners.
    suggested = (2.0, 1.0, 1.5, 1.25, 3.0, 1.5, 3.0)
    assert limits.lower == (-2.3476, -1.5454, -2.4937, -2.7714, -2.5100, 0.7773, -2.7045)
    assert limits.upper == (2.3476, 1.5454, 2.4937, -0.4226, 2.5100, 4.2841, 2.7045)
    for q in np.linspace(limits.lower, limits.upper, 101):
        down, up = FR3.velocity_range(q)
        for k, speed in enumerate(limits.velocity):
            assert -down[k] >= speed <= up[k]
    # And they are not slower than they must be: less than 1 % below.
    edge = FR3.velocity_range(limits.upper)[1]
    assert all(
        min(most, official) < 1.01 * speed
        for most, official, speed in zip(edge, suggested, limits.velocity, strict=True)
    )
    assert list(check_arm(fr3(sim=False))) == []


@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_where_the_arm_is_real_one_lost_setpoint_keeps_the_jerk_below_the_arms_own(model: str) -> None:
    overrides = [f"robots.arm.model={model}"]
    simulated = load("franka", overrides=overrides).resolve().robots[0].limits
    real = load("franka", overrides=[*overrides, ADDRESS], sim=False).resolve().robots[0].limits
    assert set(real.acceleration) == {4.0}
    assert all(4.0 * ours <= official for ours, official in zip(real.jerk, simulated.jerk, strict=True))
    assert max(real.jerk) <= 1250.0


def test_a_panda_that_extrapolates_for_19_cycles_stays_below_its_own_speed_limit() -> None:
    real = load("franka", overrides=["robots.arm.model=panda", ADDRESS], sim=False).resolve().robots[0].limits
    for speed, acceleration, official in zip(real.velocity, real.acceleration, LIMITS["fer"].velocity, strict=True):
        assert speed + 0.019 * acceleration <= official


@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_the_simulated_hand_presses_with_the_commanded_force(model: str, engine: Engine) -> None:
    spec = load("franka", overrides=[f"robots.arm.model={model}"]).resolve().robots[0]
    arm = replace(spec, base_position=(0.0, 0.0, 0.0))
    here = tuple(Kinematics(arm.kinematics).fk(arm.home)[:3])
    world = engine.world(cube(here), arm)
    hand = engine.gripper(world)
    hand.open()
    hand.move(0.031, 0.1, 60.0)
    for _ in range(150):
        world.step()
        world.set_pose("cube", {"position": here})
    hand.move(0.0, 0.1, 60.0)
    for _ in range(240):
        world.step()
    reading = hand.read(1.0)
    assert reading.grasped
    assert reading.force == pytest.approx(60.0, rel=0.05)
    assert world.pose("cube")["position"][2] == pytest.approx(here[2], abs=0.008)  # it sinks until they press
    world.close()
