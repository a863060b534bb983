"""Where URDFs come from: a file of the user's, or one inside an installed Python package."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

from ..packages import package_folder
from .data_files import user_path
from .files import Problems, nearest
from .models import UrdfSource

__all__ = ["locate_urdf"]

_HAS_WHEEL = sys.version_info < (3, 12) and (sys.platform, platform.machine()) == ("linux", "x86_64")
_NO_WHEEL = (
    f"PyBullet has no wheel for Python {platform.python_version()} on {platform.machine()}: use Python 3.11 on x86-64 "
    "Linux (uv venv --seed --python 3.11 .venv, then install again), or build it (C++ compiler): pip install pybullet"
)
INSTALL = {
    "pybullet_data": "pip install pybullet" if _HAS_WHEEL else _NO_WHEEL,
    "example_robot_data": "pip install example-robot-data",
    "airo_models": "pip install airo-models",
}
"""The command that brings a package, where it is not simply its name."""


def locate_urdf(source: UrdfSource, base: Path, file: Path | str, key: str, problems: Problems) -> Path | None:
    """Absolute path of a URDF; None, and a problem noted, where it is not there. Imports nothing."""
    if source.package is None:
        path = user_path(source.path, base)
    else:
        folder = package_folder(source.package)
        if folder is None:
            command = INSTALL.get(source.package, f"pip install {source.package.replace('_', '-')}")
            message = f"package {source.package!r} is not installed; {command}"
            if all(problem.message != message for problem in problems.found):  # robot and objects may share a package
                problems.add(file, f"{key}.package", message)
            return None
        path = user_path(source.path, folder)
    if not os.path.isfile(path):
        there = [p.name for p in path.parent.glob("*.urdf")] if path.parent.is_dir() else []
        problems.add(file, key, f"there is no file {path}{nearest(path.name, there) if there else ''}")
        return None
    return path
