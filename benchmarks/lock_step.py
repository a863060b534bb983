"""Policy steps per second in lock-step, through the public interface, beside PyBullet as a user writes it by hand.

    python benchmarks/lock_step.py [--seconds 5] [--only NAME]

The reference is a short script with PyBullet's own functions: the same bodies in a client of its own with PyBullet's
default settings, one setJointMotorControlArray, twelve stepSimulation and one getJointStates per policy step. It moves
the joints directly, so it computes no inverse kinematics for the rows with twists and poses either. The row "motors
written every tick" is the same script with motors written and joints read at every physics step, as any servo must.
With two 256x256 RGB-D cameras the script draws with PyBullet's own renderer (TinyRenderer, no shadows).

Both take turns of 0.2 s; the medians over all turns and the median of their ratios are printed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np

import hal
from hal.drivers.pybullet.loading import loadable_urdf
from hal.specs import BodySpec, RobotSpec, WorldSpec

POLICY_HZ = 20.0
CONFIG = "panda_table"
TURN = 0.2
"""s that one of the two runs before the other one does."""
HOVER = [0.42, 0.0, 0.35]
"""Around here the tcp moves in Cartesian commands, m in the arm's base frame: well inside the workspace."""

Step = Callable[[], None]


def ours(kind: str, cameras: bool) -> tuple[Step, hal.Rig]:
    """Return one policy step through the public interface with commands of this kind, and the rig to close."""
    rig = hal.open(CONFIG, sim=True, clock="lock_step", overrides=() if cameras else ["cameras={}"], pad="none")
    arm = rig.robots["panda"]
    if kind != "joints":
        arm.move_to(hal.Pose(HOVER, [1, 0, 0, 0]), speed=0.5)
    control = arm.control(rate_hz=POLICY_HZ)
    control.__enter__()
    start, ticks = arm.state().q, rig.clock.rate(POLICY_HZ)
    phases = np.arange(arm.n)
    middle = np.array(HOVER)

    def command(t: float) -> hal.Command:
        if kind == "joints":
            return hal.JointTarget(start + 0.05 * np.sin(t + phases) - 0.05 * np.sin(phases))
        if kind == "twists":
            return hal.Twist([0.05 * np.cos(t), 0.05 * np.sin(t), 0.05 * np.cos(2 * t)])
        circle = np.array([np.sin(t), 1.0 - np.cos(t), np.sin(2 * t) / 2])
        return hal.CartesianTarget(hal.Pose(middle + 0.05 * circle, [1, 0, 0, 0]))

    def step() -> None:
        tick = next(ticks)
        control.send(command(tick.elapsed))
        arm.state()
        if cameras:
            for camera in rig.cameras.values():
                camera.read()

    return step, rig


def by_hand(spec: WorldSpec, cameras: bool, every_tick: bool) -> tuple[Step, Callable[[], None]]:
    """Return one policy step written with PyBullet's own functions, and what ends the client."""
    import pybullet as p

    c = p.connect(p.DIRECT)
    p.setTimeStep(1.0 / spec.physics_hz, physicsClientId=c)
    p.setGravity(*spec.gravity, physicsClientId=c)
    for body in spec.bodies:
        place_by_hand(p, c, body)
    arm = spec.robots[0]
    robot, joints, fingers = load_by_hand(p, c, arm)
    p.setJointMotorControlArray(
        robot, fingers, p.POSITION_CONTROL, targetPositions=[0.04] * len(fingers), forces=[20.0] * len(fingers),
        physicsClientId=c,
    )  # fmt: skip
    start, forces = np.array(arm.initial), list(arm.limits.torque or [87.0] * len(joints))
    phases, turns, substeps = np.arange(len(joints)), count(1), round(spec.physics_hz / POLICY_HZ)
    projection = p.computeProjectionMatrixFOV(60, 1, 0.05, 5)
    views = [
        p.computeViewMatrix([0.6, 0, 1.4], [0, 0, 0.6], [0, 0, 1]),
        p.computeViewMatrix([0, 0, 1.2], [0, 0, 0.6], [1, 0, 0]),
    ]

    def write(target: list[float]) -> None:
        p.setJointMotorControlArray(
            robot, joints, p.POSITION_CONTROL, targetPositions=target, forces=forces, physicsClientId=c
        )

    def step() -> None:
        target = (start + 0.05 * np.sin(next(turns) / POLICY_HZ + phases) - 0.05 * np.sin(phases)).tolist()
        if every_tick:
            for _ in range(substeps):
                write(target)
                p.stepSimulation(physicsClientId=c)
                p.getJointStates(robot, joints, physicsClientId=c)
        else:
            write(target)
            for _ in range(substeps):
                p.stepSimulation(physicsClientId=c)
            p.getJointStates(robot, joints, physicsClientId=c)
        for view in views if cameras else ():
            p.getCameraImage(
                256, 256, view, projection, shadow=0, flags=p.ER_NO_SEGMENTATION_MASK,
                renderer=p.ER_TINY_RENDERER, physicsClientId=c,
            )  # fmt: skip

    return step, lambda: p.disconnect(c)


def place_by_hand(p: Any, c: int, body: BodySpec) -> None:
    """Put an object of the rig into a client."""
    if body.shape == "urdf":
        p.loadURDF(
            body.urdf, body.position, body.orientation, useFixedBase=body.fixed, globalScaling=body.scale,
            physicsClientId=c,
        )  # fmt: skip
        return
    shape = (
        p.createCollisionShape(p.GEOM_PLANE, physicsClientId=c)
        if body.shape == "plane"
        else p.createCollisionShape(p.GEOM_BOX, halfExtents=body.half_extents, physicsClientId=c)
    )
    mass = 0.0 if body.fixed else body.mass
    p.createMultiBody(mass, shape, -1, body.position, body.orientation, physicsClientId=c)


def load_by_hand(p: Any, c: int, arm: RobotSpec) -> tuple[int, list[int], list[int]]:
    """Load an arm at its start; return its number, its joints and its fingers."""
    with loadable_urdf(arm.urdf) as urdf:
        robot = p.loadURDF(urdf, arm.base_position, arm.base_orientation, useFixedBase=True, physicsClientId=c)
    numbers = {
        p.getJointInfo(robot, k, physicsClientId=c)[1].decode(): k
        for k in range(p.getNumJoints(robot, physicsClientId=c))
    }
    joints = [numbers[name] for name in arm.joints]
    fingers = [numbers[name] for name in arm.gripper.joints] if arm.gripper else []
    for joint, q in zip([*joints, *fingers], [*arm.initial, *[0.04] * len(fingers)], strict=True):
        p.resetJointState(robot, joint, q, physicsClientId=c)
    return robot, joints, fingers


def rate(step: Step, seconds: float) -> float:
    """Return steps per second."""
    done, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < seconds:
        step()
        done += 1
    return done / spent


ROWS = {
    "joint targets": ("joints", False, False),
    "twists": ("twists", False, False),
    "poses": ("poses", False, False),
    "motors written every tick": ("joints", False, True),
    "two 256x256 RGB-D cameras": ("joints", True, False),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=5.0, help="that each row takes (%(default)s)")
    parser.add_argument("--only", choices=ROWS, action="append", help="this row alone; may be repeated")
    args = parser.parse_args()
    asked = []
    with hal.open(CONFIG, sim=True, clock="lock_step", overrides=["cameras={}"], pad="none") as rig:
        for _ in range(500):
            start = time.perf_counter()
            rig.world.pose("cube")
            asked.append(time.perf_counter() - start)
    print(f"rig.world.pose: {1e6 * statistics.median(asked):.1f} us")
    print(f"{'':34s}{'hal':>12s}{'by hand':>14s}{'ratio':>8s}   policy steps/s, medians")
    for name in args.only or ROWS:
        kind, cameras, every_tick = ROWS[name]
        step, rig = ours(kind, cameras)
        assert rig.plan.world is not None
        reference, disconnect = by_hand(rig.plan.world, cameras, every_tick)
        for each in (step, reference):
            rate(each, TURN)
        turns = [(rate(step, TURN), rate(reference, TURN)) for _ in range(max(1, round(args.seconds / (2 * TURN))))]
        mine, theirs = (statistics.median(values) for values in zip(*turns, strict=True))
        ratio = statistics.median(a / b for a, b in turns)
        print(f"{name:34s}{mine:12.1f}{theirs:14.1f}{ratio:8.2f}")
        rig.close()
        disconnect()


if __name__ == "__main__":
    main()
