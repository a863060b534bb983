"""The ``real:`` part of a UFACTORY arm, and its model against UFACTORY's own figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.config import load
from hal.drivers.xarm.settings import check_arm
from hal.errors import ConfigError
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.kinematics.urdf import read_urdf
from hal.specs import RobotSpec
from hal.testing import robot_spec
from hal_emulators.xarm.controller import ROBOTS, Controller

MASSES = {
    "xarm7": [2.382, 1.869, 1.638, 1.727, 1.32, 1.325, 0.17],
    "xarm6": [2.382, 2.267, 1.875, 1.319, 1.34, 0.17],
    "xarm5": [2.382, 2.164, 2.121, 1.317, 0.17],
    "lite6": [1.411, 1.34, 0.953, 1.284, 0.784, 0.13],
}
"""Of links 1 to n, kg: "Kinematic and Dynamic Parameters" in xArm-Developer/ufactory_docs, of the xArms "Model 3"; the
Lite 6's fifth of xArm-Developer/xarm_ros2, as 0.084 there is taken for a misprint."""


def problems(rate_hz: float = 250.0, joints: int = 7, tcp_speed: float = 0.25, **options: Any) -> set[str]:
    spec = robot_spec(joints, driver="xarm", rate_hz=rate_hz, options={"host": "192.168.1.200"} | options)
    return {key for key, _, _ in check_arm(replace(spec, tcp_speed=tcp_speed))}


def test_mistakes_are_named_by_their_key() -> None:
    assert problems(load={"mass": 1.5, "com": [0, 0, 0.05]}) == set()
    assert problems(joints=6, rate_hz=100.0) == set()
    assert problems(host=None) == {"real.host"}
    assert problems(load={"mass": -1}) == {"real.load.mass"}
    assert problems(joints=4) == {"model"}
    assert problems(rate_hz=500.0) == {"rate_hz"}
    assert problems(tcp_speed=1.2) == {"tcp_speed"}


def load_model(model: str = "xarm7") -> RobotSpec:
    try:
        return load({"robots": {"arm": {"model": model}}}).resolve().robots[0]
    except ConfigError as error:
        pytest.skip(error.problems[0].message)


@pytest.mark.parametrize("model", ROBOTS)
def test_the_models_flange_is_where_the_dh_parameters_of_ufactory_put_it(model: str) -> None:
    spec = load_model(model)
    n = len(spec.joints)
    kinematics, controller = Kinematics(spec.kinematics), Controller(model, [0.0] * n)
    for q in np.random.default_rng(0).uniform(-1.5, 1.5, (20, n)):
        x = controller.forward(q)
        distance, turn = Pose.from_rpy([1e-3 * value for value in x[:3]], x[3:]).distance(kinematics.pose(q))
        assert distance < 1e-5
        assert turn < 1e-4


@pytest.mark.parametrize("model", MASSES)
def test_the_models_masses_are_those_of_ufactory(model: str) -> None:
    links = read_urdf(Path(load_model(model).urdf), meshes=False).links
    masses = [links[f"link{k + 1}"].mass for k in range(len(MASSES[model]))]
    assert masses == pytest.approx(MASSES[model], abs=5e-4)


def test_narrower_limits_of_a_newer_arm_are_named() -> None:
    pytest.importorskip("xarm", reason="needs xarm-python-sdk: pip install 'robot-hal[xarm]'")
    from hal.drivers.xarm.preflight import check_limits

    spec = load_model()
    assert check_limits(spec, 7, 7, "XI130412345678").level == "ok"
    newer = check_limits(spec, 7, 7, "XI130512345678")
    assert newer.level == "warn"
    assert "joint2 -2.042 to 2.025 rad, joint4 -0.105 to 3.927 rad" in newer.found
    assert check_limits(spec, 7, 99, None).level == "unknown"


@pytest.mark.parametrize("model", ROBOTS)
def test_the_models_limits_are_those_of_the_sdk(model: str) -> None:
    limits = load_model(model).limits
    for low, high, (least, most) in zip(limits.lower, limits.upper, ROBOTS[model].limits, strict=True):
        assert least - 1e-5 <= low
        assert high <= most + 1e-5
