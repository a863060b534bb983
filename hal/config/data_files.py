"""Paths of the built-in data files: robot and sensor models, rigs, objects, mappings.

They are in ``hal/data/``, which in a checkout has links to the top-level folders ``robots/``, ``sensors/`` and
``config/``. No folder of the user is searched, so none can shadow them. This module imports nothing heavy.
"""

from __future__ import annotations

import os
from pathlib import Path

FOLDERS = ("robots", "sensors", "config")


def data_folder(name: str) -> Path:
    """Return the folder ``robots``, ``sensors`` or ``config``. Raises LookupError for another name."""
    if name not in FOLDERS:
        raise LookupError(f"there is no data folder {name!r}; folders: {', '.join(FOLDERS)}")
    return (Path(__file__).parents[1] / "data" / name).resolve()


def find_data(folder: str, *parts: str) -> Path:
    """Return the path of a data file, for example ``find_data("robots", "panda.yaml")``.

    Raises:
        FileNotFoundError: There is no such file; the message lists the available ones.
    """
    path = data_folder(folder).joinpath(*parts)
    if not path.is_file():
        there = ", ".join(list_data(folder, *parts[:-1])) or "none"
        raise FileNotFoundError(f"{'/'.join((folder, *parts))} is not a built-in file; available: {there}")
    return path


def list_data(folder: str, *parts: str) -> tuple[str, ...]:
    """Return the names of the YAML files in a data folder, without ``.yaml``, in alphabetical order."""
    return tuple(sorted(path.stem for path in data_folder(folder).joinpath(*parts).glob("*.yaml")))


def is_path(name: str) -> bool:
    """Return whether ``name`` is the path of a user's file, not the name of a built-in one."""
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml"))


def user_path(name: str | Path, base: Path) -> Path:
    """Return the absolute path of ``name``, relative to ``base``, with ``~`` and links resolved.

    Raises nothing: an invalid path (a loop of links, an unknown user, a NUL) becomes one that does not exist.
    """
    path = os.path.join(base, os.path.expanduser(str(name).replace("\0", "\\0")))
    return Path(os.path.realpath(path))
