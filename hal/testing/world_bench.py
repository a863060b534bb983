"""The bench of simulated worlds: it makes worlds of simple shapes, a small arm, and a cabinet with a drawer and doors.

The URDFs of the arm and of the cabinet are written into a folder of the test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..specs import BodySpec, GripperSpec, LimitsSpec, RobotSpec, WorldSpec
from ..world import WorldDriver
from .benches import Bench, robot_spec

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
GRAVITY = 9.81
_ARM = """<robot name="arm">
  <link name="base"><inertial><mass value="3"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="upper"><inertial><origin xyz="0 0 0.15"/><mass value="1"/><inertia ixx="0.008" iyy="0.008" izz="0.001"
    ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0 0 0.17"/><geometry><box size="0.04 0.04 0.2"/>
    </geometry></collision></link>
  <link name="hand"><inertial><mass value="0.3"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><origin xyz="0 0 0.06"/><geometry><box size="0.03 0.1 0.02"/></geometry></collision></link>
  <link name="left"><inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><geometry><box size="0.02 0.01 0.04"/></geometry></collision></link>
  <link name="right"><inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><geometry><box size="0.02 0.01 0.04"/></geometry></collision></link>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.05"/><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="2" effort="50"/></joint>
  <joint name="bend" type="revolute"><origin xyz="0 0 0.3"/><parent link="upper"/><child link="hand"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="2" effort="50"/></joint>
  <joint name="slide_left" type="prismatic"><origin xyz="0 0 0.1"/><parent link="hand"/><child link="left"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="0.2" effort="20"/></joint>
  <joint name="slide_right" type="prismatic"><origin xyz="0 0 0.1"/><parent link="hand"/><child link="right"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.04" velocity="0.2" effort="20"/></joint>
</robot>
"""
_CABINET = """<robot name="cabinet">
  <link name="frame"/>
  <link name="drawer"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial></link>
  <link name="left"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial></link>
  <link name="right"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial></link>
  <joint name="slide" type="prismatic"><parent link="frame"/><child link="drawer"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" velocity="1" effort="1"/><dynamics damping="5" friction="2"/></joint>
  <joint name="hinge" type="revolute"><parent link="frame"/><child link="left"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="other" type="revolute"><parent link="frame"/><child link="right"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/><mimic joint="hinge" multiplier="-1"/></joint>
</robot>
"""
_START = (0.3, -0.4)
JOINTS = ("turn", "bend")
FINGERS = ("slide_left", "slide_right")


@dataclass(kw_only=True)
class WorldBench(Bench):
    """A simulation engine: makes the worlds of the checks, and closes them."""

    driver: Any = None
    """Unused: each check makes a world of its own."""
    name: str
    """Name of the driver, as in ``WorldSpec.driver``."""
    make: Callable[[WorldSpec], WorldDriver]
    """The driver's class."""
    made: list[WorldDriver] = field(default_factory=list)
    """The worlds so far."""

    def has(self, ability: str) -> bool:
        return ability == "physics" or super().has(ability)

    def world(self, *things: BodySpec | RobotSpec, **changes: Any) -> WorldDriver:
        """Return a world of these objects and arms at 240 Hz; ``changes`` are fields of its record."""
        bodies = tuple(thing for thing in things if isinstance(thing, BodySpec))
        robots = tuple(thing for thing in things if isinstance(thing, RobotSpec))
        spec = WorldSpec(self.name, 240.0, (0.0, 0.0, -GRAVITY), bodies, robots)
        self.made.append(self.make(replace(spec, **changes)))
        return self.made[-1]

    def arm(self, folder: Path, name: str = "arm", **changes: Any) -> RobotSpec:
        """Return a small simulated arm with a gripper, whose URDF is written into ``folder``."""
        path = folder / "arm.urdf"
        path.write_text(_ARM)
        base = robot_spec(2)
        limits = LimitsSpec((-2.0, -2.0), (2.0, 2.0), (2.0, 2.0), (10.0, 10.0), (100.0, 100.0), (50.0, 50.0))
        changes = {"driver": self.name, **changes}
        return replace(
            base,
            **{
                "name": name,
                "rate_hz": 240.0,
                "urdf": str(path),
                "joints": JOINTS,
                "initial": _START,
                "limits": limits,
                "kinematics": replace(base.kinematics, urdf=str(path), joints=JOINTS, tcp_link="hand"),
                "gripper": GripperSpec(name, changes["driver"], 0.08, 0.1, 20.0, FINGERS),
                **changes,
            },
        )


def body(name: str, shape: str, at: tuple[float, float, float], **changes: Any) -> BodySpec:
    """Return an object of 1 kg; ``changes`` are fields of its record."""
    return BodySpec(**{"name": name, "position": at, "orientation": UPRIGHT, "shape": shape, "mass": 1.0, **changes})


def floor() -> BodySpec:
    """Return an infinite plane at the height 0."""
    return body("floor", "plane", (0.0, 0.0, 0.0), mass=0.0)


def cube(at: tuple[float, float, float], **changes: Any) -> BodySpec:
    """Return a cube of 0.1 m and 1 kg; ``changes`` are fields of its record."""
    return body(changes.pop("name", "cube"), "box", at, half_extents=(0.05, 0.05, 0.05), **changes)


def cabinet(folder: Path) -> BodySpec:
    """Return a cabinet with a drawer and two doors of which one follows the other; its file is in ``folder``."""
    path = folder / "cabinet.urdf"
    path.write_text(_CABINET)
    return body("cabinet", "urdf", (0.0, 0.0, 1.0), urdf=str(path), fixed=True, mass=0.0)
