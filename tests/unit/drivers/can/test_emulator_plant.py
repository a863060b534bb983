"""The mechanics of the emulated CAN arms: gravity, stiff drives, friction, stops, the gripper."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from hal.config.loader import load
from hal_emulators.can.damiao import shorted_damping
from hal_emulators.can.plant import OFF, ArmPlant, Drive, JointMechanics

KINEMATICS = load("yam", overrides=["cameras={}"]).resolve().robots[0].kinematics
HOME = (0.0, 1.5, 1.35, -1.42, 0.0, 0.0)
BIG, SMALL = JointMechanics(0.03, 0.3, 0.15, 28.0), JointMechanics(0.0018, 0.06, 0.02, 10.0)
SMOOTH = [joint._replace(coulomb=0.0, viscous=0.0) for joint in (BIG,) * 3 + (SMALL,) * 3]
DT = 1e-3


def yam(mechanics=(BIG,) * 3 + (SMALL,) * 3, base=(0.0, 0.0, 0.0, 1.0)) -> ArmPlant:
    plant = ArmPlant(KINEMATICS, mechanics, HOME, base)
    plant.held = False
    return plant


def holding(plant: ArmPlant, kp: float, kd: float) -> list[Drive]:
    return [Drive(q, 0.0, kp, kd, float(g)) for q, g in zip(HOME, plant.gravity(), strict=True)]


def test_stiff_drives_on_light_wrists_are_stable() -> None:
    plant = yam(SMOOTH)
    drives = holding(plant, 240.0, 5.0)
    plant.q += 0.05
    for _ in range(1500):
        plant.step(DT, drives)
    assert plant.q == pytest.approx(HOME, abs=1e-4)
    assert np.abs(plant.dq).max() < 1e-3


def test_an_arm_that_is_heavier_than_its_model_sags_by_torque_over_stiffness() -> None:
    plant = yam(SMOOTH)
    drives = holding(plant, 80.0, 5.0)
    before = plant.gravity()
    plant.load(mass_factor=1.2)
    assert plant.gravity() == pytest.approx(1.2 * before)
    for _ in range(4000):
        plant.step(DT, drives)
    assert plant.q - HOME == pytest.approx((before - plant.gravity()) / 80.0, abs=1e-5)
    assert np.abs(plant.q - HOME).max() > 0.01


def test_a_payload_adds_its_weight() -> None:
    plant = yam()
    before = plant.gravity()
    plant.load(payload=(0.5, (0.0, 0.0, -0.05)))
    lever = (plant.gravity() - before)[1] / (0.5 * 9.81)
    assert abs(lever) == pytest.approx(0.253 - 0.02, abs=0.01)  # from the shoulder to the tool, horizontally
    plant.load(payload=(0.0, (0.0, 0.0, 0.0)))
    assert plant.gravity() == pytest.approx(before)


def test_gravity_points_down_in_the_world() -> None:
    """On its side the arm needs torque at its first joint, which an upright one does not."""
    assert abs(yam().gravity()[0]) < 1e-6
    assert abs(yam(base=(0.7071068, 0.0, 0.0, 0.7071068)).gravity()[0]) > 3.0


def test_energy_is_kept_without_friction() -> None:
    plant = yam(SMOOTH)
    model, data = plant._model, plant._data

    def energy() -> float:
        kinetic = pin.computeKineticEnergy(model, data, plant.q, plant.dq)
        rotors = 0.5 * float(np.sum(plant._rotor * plant.dq**2))
        return kinetic + rotors + pin.computePotentialEnergy(model, data, plant.q)

    start = energy()
    for _ in range(1000):
        plant.step(1e-4, [OFF] * 6)
    moved = pin.computeKineticEnergy(model, data, plant.q, plant.dq)
    assert moved > 0.1
    assert energy() == pytest.approx(start, abs=0.03 * moved)


def test_friction_holds_a_small_torque_and_brakes_a_motion() -> None:
    plant = yam()
    drives = [Drive(tau=float(g)) for g in plant.gravity()]
    plant.push[0] = 0.25  # below the 0.3 Nm of Coulomb friction
    for _ in range(500):
        plant.step(DT, drives)
    assert abs(plant.q[0]) < 1e-6
    plant.push[0] = 0.5
    for _ in range(500):
        plant.step(DT, drives)
    assert plant.q[0] > 1e-3


def test_a_motor_gives_no_more_than_its_torque() -> None:
    plant = yam()
    for _ in range(20):
        plant.step(DT, [Drive(q=2.0, kp=500.0)] + [OFF] * 5)
    assert plant.tau[0] == pytest.approx(28.0)


def test_shorted_windings_damp() -> None:
    """DM4340: 1.5 (24 V / sqrt 3 / 5.445 rad/s)^2 / 0.65 ohm."""
    assert shorted_damping("DM4340") == pytest.approx(14.9, abs=0.1)
    assert shorted_damping("DM4310") == pytest.approx(1.0, abs=0.1)
