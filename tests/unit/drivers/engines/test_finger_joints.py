"""Grippers whose fingers are not two equal slides, on each engine: one that opens by a negative joint, and knuckles."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from engines_kit import Engine

import hal
from hal.config import load
from hal.errors import ConfigError

MASS = (
    '<inertial><origin xyz="0 0 {z}"/><mass value="{kg}"/>'
    '<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
)
ARM = """<robot name="arm">
  <link name="base"/><link name="wrist">{mass}</link><link name="palm">{mass}</link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="wrist"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
  <joint name="tilt" type="revolute"><parent link="wrist"/><child link="palm"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
{rest}</robot>"""
LINK = '<link name="{name}">{mass}{shape}</link>\n'
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{xyz}" rpy="0 0 {yaw}"/><axis xyz="{axis}"/>'
    '<limit lower="{lower}" upper="{upper}" effort="100" velocity="5"/>{more}</joint>\n'
)
PAD = '<collision><origin xyz="0 {y} {z}"/><geometry><box size="0.02 0.01 0.03"/></geometry></collision>'
FINGER = MASS.format(z=0.03, kg=0.05, i=2e-5)


def sliding() -> tuple[str, dict[str, Any]]:
    """Fingers that slide to either side of one axis, as Baxter's: the second one opens towards negative values."""
    rest = ""
    for side, lower, upper in ((1, 0.0, 0.03), (-1, -0.03, 0.0)):
        shape = PAD.format(y=0.005 * side, z=0.06)
        rest += LINK.format(name=f"finger{side}", mass=FINGER, shape=shape)
        values = {"parent": "palm", "child": f"finger{side}", "xyz": "0 0 0", "yaw": 0, "axis": "0 1 0"}
        rest += JOINT.format(name=f"slide{side}", kind="prismatic", lower=lower, upper=upper, more="", **values)
    ends = [{"name": "slide1", "open": 0.03, "closed": 0}, {"name": "slide-1", "open": -0.03, "closed": 0}]
    return rest, {"joints": ends, "width_max": 0.06}


SIDE, LENGTH, HALF_PAD = 0.045, 0.05, 0.005


def knuckles() -> tuple[str, dict[str, Any]]:
    """One knuckle with a motor; the other and both fingertips follow it, so that the tips stay parallel."""
    rest, more = "", ""
    for side, yaw in (("left", 0.0), ("right", math.pi)):
        y = SIDE if side == "left" else -SIDE
        rest += LINK.format(name=f"{side}_knuckle", mass=FINGER, shape="")
        values = {"parent": "palm", "child": f"{side}_knuckle", "xyz": f"0 {y} 0", "yaw": yaw, "axis": "1 0 0"}
        rest += JOINT.format(name=side, kind="revolute", lower=0, upper=1, more=more, **values)
        more = '<mimic joint="left"/>'
        rest += LINK.format(name=f"{side}_tip", mass=FINGER, shape=PAD.format(y=0.0, z=0.02))
        values = {"parent": f"{side}_knuckle", "child": f"{side}_tip", "xyz": f"0 0 {LENGTH}", "yaw": 0}
        back = '<mimic joint="left" multiplier="-1"/>'
        values |= {"name": f"{side}_parallel", "kind": "revolute", "axis": "1 0 0"}
        rest += JOINT.format(lower=-1, upper=0, more=back, **values)
    angles = [0.1 * k for k in range(10)]
    widths = [[q, 2.0 * (SIDE - HALF_PAD - LENGTH * math.sin(q))] for q in angles]
    closed = math.asin((SIDE - HALF_PAD) / LENGTH)
    return rest, {
        "joints": [{"name": "left", "open": 0, "closed": closed}],
        "widths": [*widths, [closed, 0.0]],
        "width_max": 0.08,
    }


GRIPPERS = [sliding, knuckles]


def rig(folder: Path, made: tuple[str, dict[str, Any]]) -> dict[str, Any]:
    """Return a rig without gravity: an arm of two joints with this gripper, and a box between its fingers."""
    rest, gripper = made
    (folder / "arm.urdf").write_text(ARM.format(mass=MASS.format(z=0, kg=2, i=0.01), rest=rest))
    model = {
        "urdf": "arm.urdf",
        "drivers": {"sim": "simulation"},
        "joints": ["turn", "tilt"],
        "tcp": {"link": "palm", "position": [0, 0, 0.06]},
        "home": [0, 0],
        "limits": {"acceleration": 5, "jerk": 100},
        "gripper": {"drivers": {"sim": "simulation"}, "speed": 0.1, "force": 20, **gripper},
    }
    (folder / "arm.yaml").write_text(yaml.safe_dump(model))
    box = {"name": "box", "shape": "box", "half_extents": [0.01, 0.015, 0.01], "mass": 0.1, "position": [0, 0, 0.06]}
    return {
        "robots": {"arm": {"model": str(folder / "arm.yaml")}},
        "objects": [box],
        "simulation": {"gravity": [0, 0, 0]},
    }


@pytest.mark.parametrize("make", GRIPPERS)
def test_it_opens_closes_and_holds(engine: Engine, tmp_path: Path, make: Callable[[], Any]) -> None:
    made = make()
    widest = made[1]["width_max"]
    with hal.open(rig(tmp_path, made), engine=engine.name, clock="lock_step") as opened:
        gripper, world = opened.robots["arm"].gripper, opened.world
        assert gripper is not None
        assert world is not None
        assert gripper.state().width == pytest.approx(widest, abs=1e-4)
        tall = 0.5 * world.aabb("box")[1][2] + 0.5 * world.aabb("box")[0][2]  # knuckles lower their tips a little
        assert gripper.grasp(0.03, force=20.0)
        held = gripper.state()
        assert held.width == pytest.approx(0.03, abs=0.002)
        assert held.force == pytest.approx(20.0, rel=0.2)
        presses = sum(contact.force for contact in world.contacts("arm", "box"))
        assert presses == pytest.approx(40.0, rel=0.35), "from both sides"
        assert world.pose("box").position[2] == pytest.approx(tall, abs=0.01)
        world.remove("box")
        assert gripper.move(0.0).width == pytest.approx(0.0, abs=2e-3)
        assert gripper.move(0.5 * widest).width == pytest.approx(0.5 * widest, abs=1e-3)
        assert gripper.open().width == pytest.approx(widest, abs=1e-3)
        world.reset("arm")
        assert gripper.state().width == pytest.approx(widest, abs=1e-4)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"joints": ["left"]}, "wrong_joint"),
        ({"joints": [{"name": "left", "open": 0}]}, "missing_key"),
        ({"joints": [{"name": "left", "open": 0, "closed": 0}]}, "empty_range"),
        ({"widths": [[0, 0.08]]}, "wrong_count"),
        ({"widths": [[0, 0.08], [1, 0.09], [2, 0]]}, "wrong_order"),
        ({"widths": [[0, 0.07], [1, 0]]}, "out_of_range"),
        ({"widths": [[0, 0], [1, 0.08]]}, "wrong_order"),
    ],
)
def test_what_is_wrong_with_it(tmp_path: Path, change: dict[str, Any], code: str) -> None:
    rest, gripper = knuckles()
    without = {} if "widths" in change else {"widths": []}
    with pytest.raises(ConfigError) as refused:
        load(rig(tmp_path, (rest, gripper | without | change)))
    assert [problem.code for problem in refused.value.problems] == [code]
