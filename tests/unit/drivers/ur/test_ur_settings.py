"""The ``real:`` part of a UR arm, and its model against UR's own figures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.config import load
from hal.drivers.ur.settings import check_arm
from hal.errors import ConfigError
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.kinematics.urdf import read_urdf
from hal.specs import RobotSpec
from hal.testing import robot_spec
from hal_emulators.ur.motion import ROBOTS, forward, parameters


def problems(rate_hz: float = 500.0, joints: int = 6, **options: Any) -> set[str]:
    spec = robot_spec(joints, driver="ur", rate_hz=rate_hz, options={"host": "192.168.0.3"} | options)
    return {key for key, _, _ in check_arm(spec)}


def test_mistakes_are_named_by_their_key() -> None:
    assert problems(load={"mass": 1.5, "com": [0, 0, 0.05]}, lookahead_time=0.1, gain=300.0) == set()
    assert problems(host=None) == {"real.host"}
    assert problems(lookahead_time=0.01) == {"real.lookahead_time"}
    assert problems(gain=5000.0) == {"real.gain"}
    assert problems(load={"mass": -1}) == {"real.load.mass"}
    assert problems(joints=7) == {"model"}
    assert problems(rate_hz=1000.0) == {"rate_hz"}


def load_model(model: str) -> RobotSpec:
    arm = {"model": model, "real": {"host": "192.168.0.3"}, "gripper": {"enabled": False}}
    try:
        return load({"sim": False, "robots": {"arm": arm}}).resolve().robots[0]
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise


PAGE = Path(__file__).parents[4] / "docs" / "ur.md"
ROWS = {row[0].strip("` "): row[1:] for line in PAGE.read_text().splitlines() if len(row := line.split("|")[1:-1]) == 6}
"""Model -> the other columns of the page's table of models: UR's figures."""


@pytest.mark.parametrize("model", ROBOTS)
def test_the_models_speeds_torques_and_masses_are_those_of_the_page(model: str) -> None:
    spec = load_model(model)
    rate, speeds, torques, masses = (
        [float(x) for x in re.findall(r"[0-9.]+", cell)] for k, cell in enumerate(ROWS[model]) if k != 1
    )
    assert [spec.rate_hz] == rate
    for given, theirs in ((np.degrees(spec.limits.velocity), speeds), (spec.limits.torque, torques)):
        shoulder, elbow, wrists = theirs if len(theirs) == 3 else theirs * 3
        most = 180.0 if theirs is speeds else np.inf
        assert given == pytest.approx(np.minimum(most, [shoulder, shoulder, elbow, *[wrists] * 3]), abs=0.6)
    links = read_urdf(Path(spec.urdf), meshes=False).links
    arm = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")
    assert sum(links[name].mass or 0.0 for name in arm) == pytest.approx(masses[0], abs=0.051)
    assert masses[0] == pytest.approx(masses[1], rel=0.05)


@pytest.mark.parametrize("model", ROBOTS)
def test_the_models_flange_is_where_the_dh_parameters_of_ur_put_it(model: str) -> None:
    spec = load_model(model)
    assert spec.rate_hz == ROBOTS[model][2]
    kinematics = Kinematics(spec.kinematics)
    tcp = Pose(spec.kinematics.tcp_position, spec.kinematics.tcp_orientation)
    dh = parameters(model)
    half_turn = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))  # from the controller's base to that of the model
    beside = (0.1, 0.05, 0.2)  # of the flange: its turn counts, too
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6)):
        point = half_turn @ kinematics.pose(q) @ tcp.inverse() @ Pose(beside)
        assert point.position == pytest.approx(forward(dh, q, [*beside, 0.0, 0.0, 0.0])[:3], abs=1e-6)
