"""Error of hand-eye calibration: simulated cameras against their true pose, and synthetic views with known errors.

python benchmarks/calibration.py [--seeds 3] [--sets 6]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
from calibration_kit import CAMERA, CalibrationBench, K, degrees, poses, views

import hal
from hal.calibration import Calibration, Eye, solve

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


def show(what: str, results: list[tuple[float, float, float]]) -> None:
    """Print the range and the mean of each number."""
    low, high, mean = np.min(results, axis=0), np.max(results, axis=0), np.mean(results, axis=0)
    cells = [f"{a:.3f} to {b:.3f}, mean {m:.3f}" for a, b, m in zip(low, high, mean, strict=True)]
    print(f"{what:48}{cells[0]:>28} mm{cells[1]:>28} deg   reported {cells[2]:>28} mm")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="initial guesses for each simulated camera (%(default)s)")
    parser.add_argument("--sets", type=int, default=6, help="sets of synthetic views for each error (%(default)s)")
    arguments = parser.parse_args()

    for name, eye in RIGS.items():
        show(f"simulated, {eye}, 20 views", [simulated(name, 20, seed) for seed in range(arguments.seeds)])
        show("  PyBullet's own renderer, 8 views", [simulated(name, 8, 0, "simulation.renderer=tiny")])
    seeds = range(arguments.sets)
    for arm in ARM_ERRORS:
        for eye in RIGS.values():
            sets = [views(eye, poses(15, k), noise_px=0.2, arm=arm, seed=k) for k in seeds]
            show(f"synthetic, {eye}, arm {1e3 * arm:g} mm", [error(solve(one, eye)) for one in sets])
    for what, believed in WRONG_K.items():
        sets = [views("in-hand", poses(15, k), noise_px=0.2, arm=2e-4, seed=k, believed=believed) for k in seeds]
        found = [solve(one, "in-hand") for one in sets]
        show(f"synthetic, in-hand, {what}", [error(one) for one in found])
        print(f"{'':48}the board appears {100 * np.mean([one.uncertainty.scale for one in found]):+.1f} % larger")


if __name__ == "__main__":
    main()
