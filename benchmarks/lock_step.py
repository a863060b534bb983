"""Policy steps per second in lock-step, through the public API, beside raw PyBullet stepping the same scene.

    python benchmarks/lock_step.py [--seconds 5] [--rounds 3]

Without cameras the reference is PyBullet alone: the same bodies, the same number of physics steps, one motor command
and one reading a policy step. With two 256x256 RGB-D cameras it is the same with PyBullet's own renderer
(TinyRenderer, no shadows). The row between them is for PyBullet whose motors are written and whose joints are read
at every physics step, as any servo must. Rounds of both alternate; the medians are printed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import hal

POLICY_HZ = 20.0
CONFIG = "panda_table"


def ours(cameras: bool) -> tuple[Callable[[], None], hal.Rig]:
    """One policy step through the public API."""
    rig = hal.open(CONFIG, sim=True, clock="lock_step", overrides=() if cameras else ["cameras={}"], pad="none")
    arm = rig.robots["panda"]
    control = arm.control(rate_hz=POLICY_HZ)
    control.__enter__()
    start, ticks = arm.state().q, rig.clock.rate(POLICY_HZ)
    phases = np.arange(arm.n)

    def step() -> None:
        tick = next(ticks)
        control.send(hal.JointTarget(start + 0.05 * np.sin(tick.t + phases) - 0.05 * np.sin(phases)))
        arm.state()
        if cameras:
            for camera in rig.cameras.values():
                camera.read()

    return step, rig


def raw(rig: hal.Rig, cameras: bool, every_tick: bool = False) -> tuple[Callable[[], None], Any]:
    """The same with bare PyBullet calls; with ``every_tick``, motors written and joints read at each physics step."""
    import pybullet

    from hal.drivers.pybullet.world import World

    plan = rig.plan
    assert plan.world is not None
    world = World(plan.world)
    client = world.client_id
    spec = plan.robots[0]
    body = world.bodies[spec.name]
    joints = [body.joints[name] for name in spec.joints]
    substeps = round(plan.world.physics_hz / POLICY_HZ)
    start, forces = np.array(spec.home), list(spec.limits.torque or [87.0] * len(joints))
    phases, turn = np.arange(len(joints)), 0
    projection = pybullet.computeProjectionMatrixFOV(60, 1, 0.05, 5)
    views = [
        pybullet.computeViewMatrix([0.6, 0, 1.4], [0, 0, 0.6], [0, 0, 1]),
        pybullet.computeViewMatrix([0, 0, 1.2], [0, 0, 0.6], [1, 0, 0]),
    ]

    def step() -> None:
        nonlocal turn
        turn += 1
        target = (start + 0.05 * np.sin(turn / POLICY_HZ + phases)).tolist()
        for k in range(substeps):
            if k == 0 or every_tick:
                pybullet.setJointMotorControlArray(
                    body.id,
                    joints,
                    pybullet.POSITION_CONTROL,
                    targetPositions=target,
                    forces=forces,
                    physicsClientId=client,
                )
            pybullet.stepSimulation(physicsClientId=client)
            if k == substeps - 1 or every_tick:
                pybullet.getJointStates(body.id, joints, physicsClientId=client)
        if cameras:
            for view in views:
                pybullet.getCameraImage(
                    256,
                    256,
                    view,
                    projection,
                    shadow=0,
                    flags=pybullet.ER_NO_SEGMENTATION_MASK,
                    renderer=pybullet.ER_TINY_RENDERER,
                    physicsClientId=client,
                )

    return step, world


def rate(step: Callable[[], None], seconds: float) -> float:
    """Steps per second."""
    for _ in range(3):
        step()
    count, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < seconds:
        step()
        count += 1
    return count / spent


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=5.0, help="length of one round (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of each (%(default)s)")
    args = parser.parse_args()
    print(f"{'':34s}{'hal':>12s}{'raw PyBullet':>14s}{'ratio':>8s}   policy steps/s, medians of {args.rounds}")
    for cameras, every_tick, name in (
        (False, False, "no camera"),
        (False, True, "... motors written every tick"),
        (True, False, "two 256x256 RGB-D cameras"),
    ):
        step, rig = ours(cameras)
        reference, world = raw(rig, cameras, every_tick)
        rounds = [(rate(step, args.seconds), rate(reference, args.seconds)) for _ in range(args.rounds)]
        mine, theirs = (statistics.median(values) for values in zip(*rounds, strict=True))
        ratio = statistics.median(a / b for a, b in rounds)
        print(f"{name:34s}{mine:12.1f}{theirs:14.1f}{ratio:8.2f}")
        rig.close()
        world.close()


if __name__ == "__main__":
    main()
