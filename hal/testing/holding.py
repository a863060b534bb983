"""Whether a simulated gripper holds what it grasps: for authors of models, and for this project's own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from ..commands import Twist
from ..errors import NotSupported
from ..geometry import Pose
from ..gripper import Gripper
from ..rig import Rig, open_rig
from ..robot import Robot
from ..specs import BodySpec

Thing: TypeAlias = Literal["cube", "cylinder", "plate"]

WIDTH = 0.03
"""Width of the cube and the cylinder, and height of all three, m."""
THIN, MORE = 0.006, 0.004
"""Thickness of the plate, m, and how much wider than the closed gripper it is at least."""
MASS = 0.1
"""kg"""
SETTLE = 0.3
"""Time after a motion, s."""
LIFT = 0.05
"""m, in 1 s."""
SHAKE, SHAKE_HZ, SHAKE_TIME = 1.0, 1.5, 2.0
"""Greatest acceleration along each axis, m/s2, its frequency, and for how long, s."""
RATE_HZ = 100
"""Rate of the commands."""
LEAST, MOST, RAMP = 0.8, 1.2, 0.1
"""Where a pull begins and ends, as shares of the expected force, and how much of it is added in a second."""
SLIDING = 0.005
"""Speed from which on a pulled object counts as sliding, m/s."""
WEAK = 20.0
"""Greatest force of the fingers while the object is pulled, N: not every arm withstands more."""
_AXES = np.eye(3)


class HoldResult(NamedTuple):
    """What became of an object in a gripper."""

    wrong: int
    """Number of wrong verdicts of 6: ``grasp`` and ``grasped`` with nothing between the fingers; with the object, at
    first and after it was shaken; and after it was taken away."""
    error: float
    """The width that the gripper reports, less that of the object, m."""
    slip: float
    """How far the object moved in the gripper before it was pulled, m."""
    turn: float
    """How far it turned there, rad."""
    strength: float
    """The force that pulls it out sideways, grasped anew, as a share of twice the friction times the commanded force;
    infinite if a fifth more does not."""
    shaken: float
    """Greatest acceleration of the tcp while it was shaken, m/s2."""

    @property
    def good(self) -> bool:
        """Whether all is right.

        No verdict was wrong, the width is true within 1 mm, the object moved by at most 0.5 mm and 0.02 rad although it
        was shaken, and the force of the pull is within 5 % of theory.
        """
        held = abs(self.error) <= 1e-3 and self.slip <= 5e-4 and self.turn <= 0.02 and self.shaken >= 0.9 * SHAKE
        return held and not self.wrong and abs(self.strength - 1.0) <= 0.05


def hold_object(
    robot: str | Mapping[str, Any], thing: Thing = "cube", *, engine: str | None = None, seconds: float = 10.0
) -> HoldResult:
    """Grasp an object of 100 g in the air, hold it, lift it by 5 cm, shake it and pull it out, in lock-step.

    Its middle is at the tcp, and the fingers have to close along the tcp's y axis, as :mod:`hal.skills` expects. It
    weighs nothing until it is grasped.

    Args:
        robot: The arm as in a rig file: the name or the path of its model, or a mapping with ``model``.
        thing: A cube or an upright cylinder 30 mm wide, or a plate 6 mm thick; if the closed fingers are farther apart
            than 2 mm, the plate is 4 mm thicker than that. All are 30 mm high.
        engine: The physics engine; None for the usual one.
        seconds: How long it is held at rest, s.

    Raises:
        ConfigError: The model cannot be loaded.
        NotSupported: It has no gripper.
        CommandError: The object is wider than its gripper.
    """
    entry = {"model": robot} if isinstance(robot, str) else dict(robot)
    config = {"robots": {"arm": entry}, "collisions": {"self": False, "arms": False}}
    with open_rig(config, sim=True, engine=engine, clock="lock_step") as rig:
        arm = rig.robots["arm"]
        if arm.gripper is None:
            raise NotSupported(f"model {entry.get('model')!r} has no gripper", code="no_gripper")
        return _Hand(rig, arm, arm.gripper, thing).test(seconds)


class _Hand:
    """A gripper, and the object in it."""

    def __init__(self, rig: Rig, arm: Robot, gripper: Gripper, thing: Thing) -> None:
        self.rig, self.arm, self.gripper, self.thing = rig, arm, gripper, thing
        self.base = Pose(arm.spec.base_position, arm.spec.base_orientation)
        self.width = max(THIN, gripper.spec.width_min + MORE) if thing == "plate" else WIDTH

    def test(self, seconds: float) -> HoldResult:
        """Grasp, hold, lift, shake, pull and take away the object."""
        rig, world, gripper = self.rig, self.rig.world, self.gripper
        world.set_gravity((0.0, 0.0, 0.0))
        gripper.open()
        verdicts = [not gripper.grasp(self.width), not gripper.state().grasped]
        gripper.open()
        self._add()
        verdicts.append(gripper.grasp(self.width))
        rig.clock.sleep(SETTLE)
        error = gripper.state().width - self.width
        verdicts.append(gripper.state().grasped is True)
        seen = [self._in_hand()]
        world.set_gravity((0.0, 0.0, -9.81))
        rig.clock.sleep(seconds)
        seen.append(self._in_hand())
        shaken = self._shake(seen)
        verdicts.append(gripper.state().grasped is True)
        slip, turn = np.array([seen[0].distance(pose) for pose in seen]).max(axis=0).tolist()
        world.set_gravity((0.0, 0.0, 0.0))
        gripper.open()
        world.remove(self.thing)
        self._add()
        strength = self._pull()
        world.remove(self.thing)
        rig.clock.sleep(2.0 * self.width / gripper.spec.speed + SETTLE)
        verdicts.append(not gripper.state().grasped)
        return HoldResult(verdicts.count(False), error, slip, turn, strength, shaken)

    def _add(self) -> None:
        middle, half = self.base @ self.arm.state().tcp, self.width / 2.0
        place = (tuple(middle.position.tolist()), tuple(middle.orientation.tolist()))
        if self.thing == "cylinder":
            body = BodySpec("cylinder", *place, "cylinder", radius=half, length=WIDTH, mass=MASS)
        else:
            body = BodySpec(self.thing, *place, "box", half_extents=(WIDTH / 2.0, half, WIDTH / 2.0), mass=MASS)
        self.rig.world.add(body)

    def _in_hand(self) -> Pose:
        return (self.base @ self.arm.state().tcp).inverse() @ self.rig.world.pose(self.thing)

    def _shake(self, seen: list[Pose]) -> float:
        """Lift the object and shake it along each axis; add where it is in the hand, and return the acceleration."""
        swing, peak, before = 2.0 * math.pi * SHAKE_HZ, 0.0, None
        with self.arm.control(rate_hz=RATE_HZ) as control:
            for tick in self.rig.clock.rate(RATE_HZ):
                axis, t = divmod(tick.elapsed - 1.0, SHAKE_TIME)
                if axis >= 3:
                    break
                speed = SHAKE / swing * math.sin(swing * t)
                control.send(Twist((0.0, 0.0, LIFT) if axis < 0 else speed * _AXES[int(axis)]))
                seen.append(self._in_hand())
                now = self.arm.state().tcp_twist[:3]
                if before is not None and axis >= 0:
                    peak = max(peak, float(np.linalg.norm(now - before)) * RATE_HZ)
                before = now
        self.rig.clock.sleep(SETTLE)
        seen.append(self._in_hand())
        return peak

    def _pull(self) -> float:
        """Grasp the object and pull it along the tcp's x axis with a growing force; return its strength.

        It is grasped anew: what a shake leaves, such as pads that press at different heights and shear the object, is
        no part of the theory of two pads.
        """
        world, clock, thing = self.rig.world, self.rig.clock, self.thing
        force = min(WEAK, self.gripper.spec.force)
        self.gripper.grasp(self.width, force)
        clock.sleep(SETTLE)
        contacts = [contact for contact in world.contacts(thing, "arm") if contact.force > 0.0]
        if not contacts:
            return 0.0
        pads = [world.dynamics("arm", contact.link_b)["lateral_friction"] for contact in contacts]
        expected = 2.0 * world.dynamics(thing)["lateral_friction"] * min(pads) * force
        weights = np.array([contact.force for contact in contacts])
        point = weights @ np.array([contact.position for contact in contacts]) / weights.sum()
        place = world.pose(thing).inverse().transform(point)  # so that the pull does not turn it
        share, dt, ways = 0.0, 2.0 / RATE_HZ, [math.inf] * 5
        while share < MOST:
            share += dt * (RAMP if share >= LEAST else 2.0)
            forwards = (self.base @ self.arm.state().tcp).matrix()[:3, 0]
            world.apply_force(thing, share * expected * forwards, world.pose(thing).transform(place), duration=dt)
            clock.sleep(dt)
            ways.append(float(self._in_hand().position[0]))
            if share >= LEAST and ways[-1] - ways[-6] > SLIDING * 5.0 * dt:
                return share
        return math.inf
