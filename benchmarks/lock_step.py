"""Policy steps per second in lock-step, beside the physics engine as a user writes it by hand.

On PyBullet the reference is a short script with its own functions: the same bodies in a client of its own with default
settings, one setJointMotorControlArray, twelve stepSimulation and one getJointStates per policy step. It moves the
joints directly, so it computes no inverse kinematics for the rows with twists and poses either. "Motors written at
every physics step" is the same script with motors written and joints read at every physics step, as any servo must.
With two 256x256 RGB-D cameras the script draws with PyBullet's own renderer (TinyRenderer, no shadows). On MuJoCo the
reference is the rig's own model, with torques written and joints read at every physics step.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import numpy as np

import hal
from hal.drivers.pybullet.loading import loadable_urdf
from hal.specs import BodySpec, RobotSpec, WorldSpec

from .kit import ENGINES, Table, median, median_ratio, per_second, run_in_turns

PATHS = (
    "hal/servo",
    "hal/host",
    "hal/control.py",
    "hal/kinematics",
    "drivers/pybullet",
    "drivers/mujoco",
    "drivers/scene",
)
POLICY_HZ = 20.0
CONFIG = "panda_table"
TURN = 0.2
"""s that one of the two runs before the other one does."""
HOVER = [0.42, 0.0, 0.35]
"""Around here the tcp moves in Cartesian commands, m in the arm's base frame: well inside the workspace."""

Step = Callable[[], None]


def ours(engine: str, kind: str, cameras: bool) -> tuple[Step, hal.Rig]:
    """Return one policy step through the public interface with commands of this kind, and the rig to close."""
    bare = () if cameras else ("cameras={}",)
    rig = hal.open(CONFIG, sim=True, engine=engine, clock="lock_step", overrides=bare, pad="none")
    arm = rig.robots["panda"]
    if kind != "joints":
        arm.move_to(hal.Pose(HOVER, [1, 0, 0, 0]), speed=0.5)
    control = arm.control(rate_hz=POLICY_HZ, controller=hal.OperationalSpace() if kind == "torques" else None)
    control.__enter__()
    start, ticks = arm.state().q, rig.clock.rate(POLICY_HZ)
    phases = np.arange(arm.n)
    middle = np.array(HOVER)

    def command(t: float) -> hal.Command:
        if kind == "joints":
            return hal.JointTarget(start + 0.05 * np.sin(t + phases) - 0.05 * np.sin(phases))
        if kind in ("twists", "torques"):
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


@contextlib.contextmanager
def by_hand(spec: WorldSpec, cameras: bool, every_tick: bool = False) -> Iterator[Step]:
    """Yield one policy step written with PyBullet's own functions."""
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

    yield step
    p.disconnect(c)


def mujoco_by_hand(rig: hal.Rig) -> Step:
    """Return one policy step written with MuJoCo's own functions."""
    import mujoco

    arm = rig.robots["panda"]
    model = arm._host.cycle.world.model
    data, substeps = mujoco.MjData(model), round(1.0 / model.opt.timestep / POLICY_HZ)
    data.qpos[: arm.n] = arm.state().q

    def step() -> None:
        for _ in range(substeps):
            data.qfrc_applied[: arm.n] = data.qfrc_bias[: arm.n]
            mujoco.mj_step(model, data)
            data.qpos[: arm.n].tolist()

    return step


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


ROWS = {
    "joint targets": ("pybullet", "joints", False, False),
    "twists": ("pybullet", "twists", False, False),
    "poses": ("pybullet", "poses", False, False),
    "joint targets; motors written at every physics step": ("pybullet", "joints", False, True),
    "two 256x256 RGB-D cameras": ("pybullet", "joints", True, False),
    "MuJoCo, joint targets": ("mujoco", "joints", False, True),
    "MuJoCo, twists": ("mujoco", "twists", False, True),
    "MuJoCo, poses": ("mujoco", "poses", False, True),
    "MuJoCo, twists with OperationalSpace": ("mujoco", "torques", False, True),
}


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    rounds = 1 if quick else 20
    table = Table(
        f"policy steps/s at 20 Hz over 240 Hz, medians of {rounds} turns", ("", "robot-hal", "by hand", "ratio")
    )
    for name, (engine, kind, cameras, every_tick) in ROWS.items():
        if engine not in ENGINES:
            continue
        step, rig = ours(engine, kind, cameras)
        assert rig.plan.world is not None
        with rig, contextlib.ExitStack() as stack:
            if engine == "mujoco":
                reference = mujoco_by_hand(rig)
            else:
                reference = stack.enter_context(by_hand(rig.plan.world, cameras, every_tick))
            pair = {"ours": step, "theirs": reference}
            measures = {key: lambda call=call: per_second(call, TURN) for key, call in pair.items()}
            run_in_turns(measures, 1)
            mine, theirs = run_in_turns(measures, rounds).values()
        table.add(name, median(mine), median(theirs), median_ratio(mine, theirs))
    yield table
