"""Where URDFs come from: a file of the user's, or one inside an installed Python package."""

from __future__ import annotations

from pathlib import Path

from ..packages import package_folder
from .files import Problems, nearest
from .models import UrdfSource

__all__ = ["locate_urdf"]

INSTALL = {
    "pybullet_data": "pip install pybullet",
    "example_robot_data": "pip install example-robot-data",
    "airo_models": "pip install airo-models",
}
"""The command that brings a package, where it is not simply its name."""


def locate_urdf(source: UrdfSource, base: Path, file: Path | str, key: str, problems: Problems) -> Path | None:
    """Absolute path of a URDF; None, and a problem noted, where it is not there. Imports nothing."""
    if source.package is None:
        path = (base / Path(source.path).expanduser()).resolve()
    else:
        folder = package_folder(source.package)
        if folder is None:
            command = INSTALL.get(source.package, f"pip install {source.package.replace('_', '-')}")
            problems.add(file, f"{key}.package", f"package {source.package!r} is not installed; {command}")
            return None
        path = (folder / source.path).resolve()
    if not path.is_file():
        there = [p.name for p in path.parent.glob("*.urdf")] if path.parent.is_dir() else []
        problems.add(file, key, f"there is no file {path}{nearest(path.name, there) if there else ''}")
        return None
    return path
