"""Microseconds per kinematics call, each beside the bare pinocchio calls that it needs.

python benchmarks/kinematics.py [--calls 20000]
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

import hal.config
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics


def microseconds(call: Callable[[], object], calls: int, repeats: int = 7) -> float:
    """Return the median over ``repeats`` runs of the mean time of one call, us."""
    count = max(1, calls // repeats)
    call()
    means = []
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(count):
            call()
        means.append((time.perf_counter() - start) / count * 1e6)
    return statistics.median(means)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=20000)
    calls = parser.parse_args().calls

    spec = hal.config.load("panda_table").resolve().robots[0].kinematics
    kinematics = Kinematics(spec)
    full = pin.buildModelFromUrdf(spec.urdf)
    locked = [full.getJointId(name) for name in full.names[1:] if name not in spec.joints]
    model = pin.buildReducedModel(full, locked, pin.neutral(full))
    data, frame, axes = model.createData(), model.getFrameId(spec.tcp_link), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    array = np.array(spec.home)
    q, twist, identity = list(spec.home), [0.1, 0.0, 0.05, 0.1, 0.0, 0.2], 1e-4 * np.eye(6)
    here = kinematics.fk(q)
    near_q = np.array(q) + 0.05
    near, far = kinematics.pose(near_q), Pose([2.0, 0.0, 0.4])

    def bare_fk() -> None:
        pin.forwardKinematics(model, data, array)
        pin.updateFramePlacement(model, data, frame)

    def bare_dls() -> None:
        jacobian = pin.computeFrameJacobian(model, data, array, frame, axes)
        jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + identity, twist)

    def unreachable() -> None:
        try:
            kinematics.solve(far)
        except ValueError:
            return
        raise AssertionError("2 m away and reached")

    fk_us = microseconds(bare_fk, calls)
    jacobian_us = microseconds(lambda: pin.computeFrameJacobian(model, data, array, frame, axes), calls)
    dls_us = microseconds(bare_dls, calls)
    rows = [
        ("fk", microseconds(lambda: kinematics.fk(q), calls), "forwardKinematics + updateFramePlacement", fk_us),
        ("jacobian", microseconds(lambda: kinematics.jacobian(q), calls), "computeFrameJacobian", jacobian_us),
        ("pose_error", microseconds(lambda: kinematics.pose_error(q, here), calls), "the same as fk", fk_us),
        (
            "velocity",
            microseconds(lambda: kinematics.velocity(q, twist), calls),
            "Jacobian + DLS by numpy.solve",
            dls_us,
        ),
        ("velocity, singular", microseconds(lambda: kinematics.velocity([0.0] * 7, twist), calls), "", dls_us),
        ("solve, 0.05 rad away", microseconds(lambda: kinematics.solve(near), calls // 50), "one step of it", dls_us),
        ("solve, unreachable", microseconds(unreachable, 14), "", dls_us),
    ]
    print(f"{'call':22s}{'us':>10s}   {'reference':44s}{'us':>8s}{'ratio':>9s}")
    for name, ours, reference, theirs in rows:
        print(f"{name:22s}{ours:10.1f}   {reference:44s}{theirs:8.1f}{ours / theirs:9.1f}")


if __name__ == "__main__":
    main()
