"""Records of arms and objects for tests of the simulation, made from files that come with PyBullet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hal.config.data_files import find_data
from hal.drivers.pybullet.engine import load_pybullet
from hal.errors import DriverMissing
from hal.specs import BodySpec, GripperSpec, KinematicsSpec, LimitsSpec, RobotSpec, WorldSpec


def data(path: str) -> str:
    """A file of pybullet_data; skips the test where PyBullet is not installed."""
    try:
        load_pybullet()
    except DriverMissing:
        pytest.skip("pybullet is not installed")
    import pybullet_data

    return str(Path(pybullet_data.getDataPath()) / path)


PANDA_HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)


def _arm(name: str, urdf: str, limits: LimitsSpec, tcp_link: str, tcp_z: float, values: dict[str, Any]) -> RobotSpec:
    """Return an arm at the origin; ``values`` has at least its model, joints and home."""
    kinematics = KinematicsSpec(
        urdf=urdf,
        joints=values["joints"],
        lower=limits.lower,
        upper=limits.upper,
        home=values["home"],
        base_link=None,
        tcp_link=tcp_link,
        tcp_position=(0.0, 0.0, tcp_z),
        tcp_orientation=(0.0, 0.0, 0.0, 1.0),
    )
    rest = {"driver": "pybullet", "rate_hz": 240.0, "urdf": urdf, "initial": values["home"], "limits": limits}
    base = {"base_position": (0.0, 0.0, 0.0), "base_orientation": (0.0, 0.0, 0.0, 1.0)}
    return RobotSpec(**({"name": name, "kinematics": kinematics, **rest, **base} | values))


def panda(name: str = "panda", **changes: Any) -> RobotSpec:
    """A Franka Emika Panda with its hand. Limits: Franka's control parameters of the FER."""
    limits = LimitsSpec(
        lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
        upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
        velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
        acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
        jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
        torque=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
    )
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    gripper = GripperSpec(name, "pybullet", width_max=0.08, speed=0.1, force=40.0, joints=fingers)
    joints = tuple(f"panda_joint{k}" for k in range(1, 8))
    values: dict[str, Any] = {"model": "panda", "joints": joints, "home": PANDA_HOME, "gripper": gripper}
    arm = _arm(name, str(find_data("robots", "panda.urdf")), limits, "panda_hand", 0.1034, values)
    return replace(arm, **changes)


IIWA_HOME = (0.0, 0.5, 0.0, -1.4, 0.0, 1.0, 0.0)


def iiwa(name: str = "iiwa", **changes: Any) -> RobotSpec:
    """A KUKA LBR iiwa 7 R800 without a hand. Limits: its data sheet; acceleration and jerk are this test's choice."""
    reach = (2.967, 2.094, 2.967, 2.094, 2.967, 2.094, 3.054)
    limits = LimitsSpec(
        lower=tuple(-value for value in reach),
        upper=reach,
        velocity=(1.71, 1.71, 1.745, 2.27, 2.44, 3.14, 3.14),
        acceleration=(10.0,) * 7,
        jerk=(1000.0,) * 7,
        torque=(176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0),
    )
    joints = tuple(f"lbr_iiwa_joint_{k}" for k in range(1, 8))
    values: dict[str, Any] = {"model": "iiwa", "joints": joints, "home": IIWA_HOME}
    arm = _arm(name, data("kuka_iiwa/model.urdf"), limits, "lbr_iiwa_link_7", 0.0, values)
    return replace(arm, **changes)


def box(name: str, position: tuple[float, float, float], half: tuple[float, float, float], **changes: Any) -> BodySpec:
    """A box; it stands still unless a mass is given."""
    values: dict[str, Any] = {
        "name": name,
        "position": position,
        "orientation": (0.0, 0.0, 0.0, 1.0),
        "shape": "box",
        "half_extents": half,
    }
    return BodySpec(**(values | changes))


def floor() -> BodySpec:
    """The ground at z = 0."""
    return BodySpec("floor", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "plane")


def cube(position: tuple[float, float, float] = (0.5, -0.2, 0.3)) -> BodySpec:
    """The pink cube of the tutorial's scene: 2 kg."""
    return box("cube", position, (0.03, 0.015, 0.03), mass=2.0, rgba=(1.0, 0.4, 0.7, 1.0))


def world_spec(*things: BodySpec | RobotSpec, physics_hz: float = 240.0) -> WorldSpec:
    """A world of these objects and arms under the earth's gravity."""
    return WorldSpec(
        driver="pybullet",
        physics_hz=physics_hz,
        gravity=(0.0, 0.0, -9.81),
        bodies=tuple(thing for thing in things if isinstance(thing, BodySpec)),
        robots=tuple(thing for thing in things if isinstance(thing, RobotSpec)),
    )
