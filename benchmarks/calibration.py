"""Error of hand-eye calibration: simulated cameras against their true pose, and synthetic views with known errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from calibration_kit import CAMERA, CalibrationBench, K, degrees, poses, views

import hal
from hal.calibration import Calibration, Eye, solve

from .kit import Table

PATHS = ("hal/calibration", "apps/calibrate.py")
RIGS: dict[str, Eye] = {"panda_calibration": "in-hand", "panda_calibration_held": "to-hand"}
ARM_ERRORS = (0.0, 2e-4, 5e-4, 1e-3)
"""m; twice as many rad."""
WRONG_K = {
    "focal length 2 % too long": K * (1.0 + 0.02 * np.diag([1.0, 1.0, 0.0])),
    "principal point 15 px off": K + [[0.0, 0.0, 15.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
}
"""A camera matrix that is not the true one; with an error of the arm of 0.2 mm."""


def simulated(name: str, count: int, seed: int, *overrides: str) -> tuple[float, float, float]:
    """Return the error of a calibration, mm and degrees, and the standard deviation that it reports, mm."""
    with hal.open(name, sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        rig.clock.sleep(0.2)
        bench = CalibrationBench(rig, name)
        found = bench.drive(count, seed)
        return (*bench.off(found), 1e3 * found.uncertainty.position)


def error(found: Calibration) -> tuple[float, float, float]:
    """Return the same of a calibration by synthetic views."""
    distance, angle = found.camera.distance(CAMERA)
    return 1e3 * distance, degrees(angle), 1e3 * found.uncertainty.position


def ranges(results: Sequence[tuple[float, float, float]]) -> Iterator[str]:
    """Yield the range and the mean of each number."""
    for a, b, mean in zip(np.min(results, axis=0), np.max(results, axis=0), np.mean(results, axis=0), strict=True):
        yield f"{a:.3f} to {b:.3f}, mean {mean:.3f}"


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    columns = ("error, mm", "error, degrees", "standard deviation reported, mm")
    table = Table("a simulated camera, against its true pose", ("camera", *columns))
    count, seeds = (8, 1) if quick else (20, 3)
    for name, eye in list(RIGS.items())[: 1 if quick else None]:
        table.add(f"{eye}, {count} views", *ranges([simulated(name, count, seed) for seed in range(seeds)]))
        if not quick:
            table.add(
                f"{eye}, PyBullet's renderer, 8 views", *ranges([simulated(name, 8, 0, "simulation.renderer=tiny")])
            )
    yield table
    sets = range(1 if quick else 6)
    table = Table("15 synthetic views with noise of 0.2 px", ("error of the arm", *columns))
    for arm in ARM_ERRORS[: 1 if quick else None]:
        for eye in RIGS.values():
            seen = [views(eye, poses(15, k), noise_px=0.2, arm=arm, seed=k) for k in sets]
            table.add(f"{1e3 * arm:g} mm, {eye}", *ranges([error(solve(one, eye)) for one in seen]))
    yield table
    table = Table("the same in the hand, arm 0.2 mm off", ("camera matrix", *columns, "the board appears larger by, %"))
    for what, believed in list(WRONG_K.items())[: 1 if quick else None]:
        seen = [views("in-hand", poses(15, k), noise_px=0.2, arm=2e-4, seed=k, believed=believed) for k in sets]
        found = [solve(one, "in-hand") for one in seen]
        table.add(what, *ranges([error(one) for one in found]), 100 * np.mean([one.uncertainty.scale for one in found]))
    yield table
