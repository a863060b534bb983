"""Read every URDF file of installed packages, and check a rig with each arm among them by ``hal teleop --dry-run``.

    python benchmarks/urdfs.py [PACKAGE ...] [--no-rigs]

A file that cannot be read is loaded by pinocchio and by PyBullet as well, each in a process of its own, as one may
crash. One that both load should be read. The packages are by default those of ``pip install 'robot-hal[robots]'``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from hal.apps import teleop
from hal.kinematics.mesh_files import package_folder
from hal.kinematics.urdf import UrdfModel, read_urdf

PACKAGES = ("airo_models", "rtbdata", "example_robot_data")
LEAST_JOINTS = 4
"""Least number of joints from the root to a link that counts as an arm."""


def load_pinocchio(path: str) -> None:
    """Load a URDF with pinocchio."""
    import pinocchio

    pinocchio.buildModelFromUrdf(path)


def load_pybullet(path: str) -> None:
    """Load a URDF with PyBullet."""
    import pybullet

    pybullet.connect(pybullet.DIRECT)
    pybullet.loadURDF(path)


def loads(load: Callable[[str], None], path: Path) -> bool:
    """Return whether a library loads a file in a process of its own within a minute."""
    process = multiprocessing.Process(target=load, args=(str(path),))
    process.start()
    process.join(60.0)
    if process.is_alive():
        process.kill()
    return process.exitcode == 0


def longest_arm(urdf: UrdfModel) -> tuple[list[str], str]:
    """Return the joints from the root to the link that most of them move, and that link."""
    chains = {link: [joint.name for joint in urdf.above(link) if joint.movable][::-1] for link in urdf.links}
    tip = max(chains, key=lambda link: len(chains[link]))
    return chains[tip], tip


def dry_run(path: Path, urdf: UrdfModel) -> str:
    """Return the outcome of ``hal teleop --dry-run`` for a rig with the longest arm of a URDF."""
    joints, tip = longest_arm(urdf)
    home = []
    for name in joints:
        lower, upper = urdf.joints[name].lower, urdf.joints[name].upper
        home.append(0.0 if lower is None or upper is None or lower <= 0.0 <= upper else 0.5 * (lower + upper))
    limits: dict[str, Any] = {"acceleration": 5, "jerk": 100, "velocity": 1}
    model = {"urdf": str(path), "drivers": {"sim": "simulation"}, "joints": joints, "tcp": {"link": tip}}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.yaml").write_text(yaml.safe_dump({**model, "home": home, "limits": limits}))
        rig = Path(folder) / "rig.yaml"
        rig.write_text("robots: {arm: {model: arm.yaml}}\n")
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            status = teleop.main(["--config", str(rig), "--dry-run"])
    text = printed.getvalue()
    if "Traceback" in text:
        return "TRACEBACK"
    return "" if status == 0 else " ".join(text.split())[:200]


def main() -> int:
    """Print what is refused; return 1 if another reader takes it, or if anything ended with a traceback."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", default=PACKAGES)
    parser.add_argument("--no-rigs", action="store_true", help="read the files only")
    args = parser.parse_args()
    read = arms = valid = wrong = 0
    files = []
    for package in args.packages:
        folder = package_folder(package)
        if folder is None:
            print(f"{package} is not installed")
            continue
        files += sorted(folder.rglob("*.urdf"))
    for path in files:
        try:
            urdf = read_urdf(path)
        except ValueError as error:
            others = [loads(load, path) for load in (load_pinocchio, load_pybullet)]
            wrong += all(others)
            print(f"{path.name}: {error}; pinocchio {others[0]}, PyBullet {others[1]}", flush=True)
            continue
        read += 1
        if args.no_rigs or len(longest_arm(urdf)[0]) < LEAST_JOINTS:
            continue
        arms += 1
        try:
            outcome = dry_run(path, urdf)
        except Exception:
            outcome = f"TRACEBACK {traceback.format_exc()}"
        wrong += outcome.startswith("TRACEBACK")
        valid += not outcome
        if outcome:
            print(f"{path.name}: {outcome}", flush=True)
    print(f"{read} of {len(files)} read; {valid} rigs of {arms} arms are valid; {wrong} wrong")
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main())
