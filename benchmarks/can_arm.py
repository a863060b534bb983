"""Arms on a CAN bus against the emulator with gravity: at rest, on the recorded tour, after the end of a program.

    python benchmarks/can_arm.py [rest] [tour] [ends] [--rig yam|piper] [--runs 20] [--reach 0.4]

* rest: places the arm at random poses around home, and compares where the plant stands with where it was
  sent; with the plant as the driver's model has it, and with friction and 20 % more mass.
* tour: the recorded drive through ``hal teleop``, simulated and emulated; how far apart the ends are, and the largest
  distance between set-point and plant on the way.
* ends: an arm at 0.4 rad/s under gravity, whose app is killed, whose host is killed, or whose bus is cut; its greatest
  speed afterwards.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "kits"), str(ROOT / "tests" / "wire")]
from calm_tour import write_tour  # noqa: E402
from can_proofs import WAYS, end, rest, tour, tracking  # noqa: E402


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", metavar="PART", help="rest, tour or ends (all)")
    parser.add_argument("--rig", choices=["yam", "piper"], default="yam")
    parser.add_argument("--runs", type=int, default=20, help="poses, and ends of each kind (%(default)s)")
    parser.add_argument("--reach", type=float, default=0.4, help="rest: largest distance from home, rad (%(default)s)")
    options = parser.parse_args()
    options.what = options.what or ["rest", "tour", "ends"]
    if "rest" in options.what:
        plants = {
            "plant as the model": (1.0, 0.0),
            "plant with friction": (1.0, 1.0),
            "20 % heavier, no friction": (1.2, 0.0),
            "20 % heavier, with friction": (1.2, 1.0),
        }
        every = rest(options.rig, options.runs, list(plants.values()), reach=options.reach)
        for name, found in zip(plants, every, strict=True):
            distances = sorted(1e3 * one.distance for one in found)
            print(
                f"  {name:28s} at rest, {len(found)} poses: off by mm median {distances[len(found) // 2]:.2f} "
                f"max {distances[-1]:.2f}; fastest joint {max(one.speed for one in found):.4f} rad/s",
                flush=True,
            )
    if "tour" in options.what:
        with tempfile.TemporaryDirectory() as folder:
            drive = tour(options.rig, write_tour(Path(folder) / "calm.jsonl"), Path(folder))
        print(
            f"  tour of {drive.travel:.2f} m: ends {1e3 * drive.apart:.2f} mm and {drive.turned:.4f} rad apart; "
            f"trips {drive.trips}"
        )
        lags = sorted(1e3 * x for x in tracking(options.rig))
        print(f"  tracking: mm p50 {lags[len(lags) // 2]:.2f} max {lags[-1]:.2f} ({len(lags)} samples)", flush=True)
    if "ends" in options.what:
        for way in WAYS:
            ends = [end(options.rig, way) for _ in range(options.runs)]
            print(
                f"  {way:12s} {len(ends)} x: before {min(e.before for e in ends):.2f} to "
                f"{max(e.before for e in ends):.2f}, afterwards at most {max(e.after for e in ends):.3f} rad/s, "
                f"after 5 s {max(e.last for e in ends):.3f} rad/s; sunk {max(e.sunk for e in ends):.2f} rad",
                flush=True,
            )


if __name__ == "__main__":
    main()
