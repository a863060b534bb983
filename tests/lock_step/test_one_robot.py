"""Two arms of one robot, given by ``same:``: its body is in the world once, and the arms keep off each other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from engines_kit import Engine

import hal
from hal.config import load
from hal.kinematics.urdf import read_urdf

pytestmark = pytest.mark.filterwarnings("ignore:left was stopped")  # while the session of the right arm ends

Rig = Mapping[str, Any]

BOX = "<{0}><origin xyz='{1}'/><geometry><box size='{2}'/></geometry></{0}>"
MASS = (
    "<inertial><origin xyz='{0}'/><mass value='{1}'/>"
    "<inertia ixx='{2}' iyy='{2}' izz='{2}' ixy='0' ixz='0' iyz='0'/></inertial>"
)
JOINT = (
    "<joint name='{0}' type='{1}'><parent link='{2}'/><child link='{3}'/><origin xyz='{4}'/><axis xyz='{5}'/>"
    "<limit lower='-2.5' upper='2.5' effort='60' velocity='2'/></joint>"
)
SIDES = {"left": 1.0, "right": -1.0}
SHOULDER = 0.25
"""Distance of a shoulder from the middle, m."""


@pytest.fixture
def model(tmp_path: Path) -> str:
    """Return the model of a robot whose torso surrounds the roots of its two arms, with a head that turns."""

    def link(name: str, middle: str, size: str, mass: float) -> str:
        shapes = "".join(BOX.format(kind, middle, size) for kind in ("visual", "collision"))
        return f"<link name='{name}'>{MASS.format(middle, mass, 0.01 * mass)}{shapes}</link>"

    parts = [link("torso", "0 0 0.3", "0.2 0.6 0.6", 30.0), link("head", "0 0 0.1", "0.1 0.1 0.1", 2.0)]
    parts.append(JOINT.format("neck", "revolute", "torso", "head", "0 0 0.6", "0 0 1"))
    arms = {}
    for side, y in SIDES.items():
        parts.append(link(f"{side}_upper", "0.15 0 0", "0.3 0.06 0.06", 1.5))
        parts.append(link(f"{side}_lower", "0.15 0 0", "0.3 0.05 0.05", 1.0))
        parts.append(JOINT.format(f"{side}_1", "revolute", "torso", f"{side}_upper", f"0 {y * SHOULDER} 0.5", "0 0 1"))
        parts.append(JOINT.format(f"{side}_2", "revolute", f"{side}_upper", f"{side}_lower", "0.3 0 0", "0 0 1"))
        arms[side] = {"joints": [f"{side}_1", f"{side}_2"], "tcp": {"link": f"{side}_lower", "position": [0.3, 0, 0]}}
        arms[side]["home"] = [0.0, 0.1 * y]
    (tmp_path / "robot.urdf").write_text(f"<robot name='two_arms'>{''.join(parts)}</robot>")
    text = {"urdf": "robot.urdf", "drivers": {"sim": "simulation"}, "arms": arms}
    text["limits"] = {"acceleration": 5.0, "jerk": 100.0}
    file = tmp_path / "robot.yaml"
    file.write_text(yaml.safe_dump(text))
    return str(file)


@pytest.fixture
def robots(model: str) -> dict[str, Any]:
    """Return the arms of a rig; that which names the other comes first."""
    base = {"position": [0.5, 0.0, 0.1], "orientation": [0, 0, 0.3826834, 0.9238795]}
    right = {"model": model, "arm": "right", "same": "left"}
    return {"right": right, "left": {"model": model, "arm": "left", "base": base}}


def open_rig(robots: Rig, engine: Engine, **rig: Any) -> hal.Rig:
    return hal.open({"robots": robots} | rig, sim=True, engine=engine.name, clock="lock_step", pad="none")


def drive_together(rig: hal.Rig, seconds: float = 2.0) -> tuple[float, hal.Limited]:
    """Turn the shoulders of both arms towards each other.

    Returns:
        The smallest distance of the arms, m, and what held them back.
    """
    nearest, limited = np.inf, hal.Limited.NONE
    with rig.robots["left"].control(rate_hz=50) as left, rig.robots["right"].control(rate_hz=50) as right:
        for k, _ in enumerate(rig.clock.rate(50)):
            left.send(hal.JointVelocity([-0.5, 0.0]))
            right.send(hal.JointVelocity([0.5, 0.0]))
            nearest = min(nearest, rig.world.distance("left", "right"))
            for arm in rig.robots.values():
                limited |= arm.state().limited
            if k >= seconds * 50:
                return nearest, limited
    raise AssertionError("the clock ended")


def test_every_link_is_in_the_world_once_and_where_the_robot_has_it(robots: Rig, engine: Engine) -> None:
    with open_rig(robots, engine) as rig:
        whole = read_urdf(Path(rig.robots["left"].spec.kinematics.urdf))
        shaped = {
            name: [link for link, part in read_urdf(Path(rig.robots[name].spec.urdf)).links.items() if part.visuals]
            for name in robots
        }
        assert sorted(shaped["right"] + shaped["left"]) == sorted(whole.links)
        assert shaped["right"] == ["right_upper", "right_lower"]
        q = {joint: value for arm in rig.robots.values() for joint, value in zip(arm.joints, arm.home, strict=True)}
        base = rig.robots["left"].base
        assert np.allclose(rig.robots["right"].base.matrix(), base.matrix())
        mass = 0.0
        for name, links in shaped.items():
            for link in links:
                expected = base @ whole.poses(q)[link]
                assert np.allclose(rig.world.pose(name, link).matrix(), expected.matrix(), atol=1e-6)
                mass += rig.world.dynamics(name, link)["mass"] if link != "torso" else 0.0  # its base is fixed
        assert mass == pytest.approx(2.0 + 2 * 2.5)
        tips = [arm.fk(arm.home).position for arm in rig.robots.values()]
        assert np.allclose(tips[0] * [1, -1, 1], tips[1])


def test_the_arms_rest_in_their_torso_and_touch_nothing(robots: Rig, engine: Engine) -> None:
    with open_rig(robots, engine) as rig:
        for name, link in (("right", "right_upper"), ("left", "torso")):  # MuJoCo gives such pairs their own friction
            rig.world.set_dynamics(name, link, lateral_friction=0.9)
        rig.clock.sleep(0.5)
        assert not [contact for contact in rig.world.contacts() if contact.force > 0.0]
        for arm in rig.robots.values():
            assert np.abs(arm.state().q - arm.home).max() < 1e-3
        assert rig.world.distance("left", "right") > 0.3
        assert not [note for note in rig.notes if "checked against each other" in note and "left and right" in note]


def test_arms_driven_at_each_other_stop_apart(robots: Rig, engine: Engine) -> None:
    with open_rig(robots, engine) as rig:
        nearest, limited = drive_together(rig)
        assert 0.005 < nearest < 0.03
        assert hal.Limited.COLLISION in limited
        found = rig.robots["left"].collisions.nearest(rig.robots["left"].state().q)
        assert {found.first.partition("/")[0], found.second.partition("/")[0]} == {"left", "right"}


def test_unguarded_arms_of_one_robot_hold_each_other_up(robots: Rig, engine: Engine) -> None:
    with open_rig(robots, engine, collisions={"arms": False, "self": False}) as rig:
        with pytest.raises(hal.RobotFault):  # neither gets where it is sent
            drive_together(rig)
        touching = rig.world.contacts("left", "right")
        assert min(contact.distance for contact in touching) > -0.01


def test_a_saved_state_repeats_the_motion_of_both_arms(robots: Rig, engine: Engine) -> None:
    with open_rig(robots, engine) as rig:
        drive_together(rig, 0.3)
        state = rig.world.save()
        ends = []
        for _ in range(2):
            rig.world.restore(state)
            drive_together(rig, 0.3)
            ends.append(np.concatenate([arm.state().q for arm in rig.robots.values()]))
        assert np.array_equal(*ends)
        rig.world.reset()
        for arm in rig.robots.values():
            assert np.abs(arm.state().q - arm.home).max() < 1e-6


def test_arms_that_overlap_at_the_start_are_refused(robots: Rig, engine: Engine) -> None:
    crossed = {name: entry | {"initial": [-SIDES[name], 0.0]} for name, entry in robots.items()}
    with pytest.raises(hal.ConfigError) as caught:
        open_rig(crossed, engine)
    assert [problem.code for problem in caught.value.problems] == ["robots_overlap"]


@pytest.mark.parametrize(
    ("name", "change", "key", "code"),
    [
        ("right", {"same": None}, "robots.left.same", "robots_overlap"),
        ("right", {"same": "lft"}, "robots.right.same", "unknown_robot"),
        ("right", {"same": "right"}, "robots.right.same", "unknown_robot"),
        ("left", {"same": "right"}, "robots.right.same", "conflict"),
        ("left", {"model": "panda", "arm": None}, "robots.right.same", "conflict"),
        ("right", {"base": {"position": [1, 0, 0]}}, "robots.right.same", "conflict"),
        ("right", {"arm": "left"}, "robots.right.arm", "conflict"),
        ("right", {"arm": "left", "same": None}, "robots.left.same", "robots_overlap"),
    ],
)
def test_arms_that_cannot_be_of_one_robot_are_refused(
    robots: dict[str, Any], name: str, change: Rig, key: str, code: str
) -> None:
    robots["left"].pop("base")
    robots[name] = robots[name] | change
    with pytest.raises(hal.ConfigError) as caught:
        load({"robots": robots}, sim=True, driver="mock")
    assert (key, code) in [(problem.key, problem.code) for problem in caught.value.problems]
    assert all("same" in problem.message or problem.code != "robots_overlap" for problem in caught.value.problems)
