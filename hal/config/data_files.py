"""Where the data that come with the hal are: robot and sensor models, rigs, objects, mappings.

They are found by path, in ``hal/data/``, which in a checkout holds links to the top-level folders ``robots/``,
``sensors/`` and ``config/``. No folder of the user is searched, so none can shadow these.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["FOLDERS", "data_folder", "find_data", "is_path", "list_data", "user_path"]

FOLDERS = ("robots", "sensors", "config")


def data_folder(name: str) -> Path:
    """The folder ``robots``, ``sensors`` or ``config``. LookupError for another name."""
    if name not in FOLDERS:
        raise LookupError(f"there is no data folder {name!r}; folders: {', '.join(FOLDERS)}")
    return (Path(__file__).parents[1] / "data" / name).resolve()


def find_data(folder: str, *parts: str) -> Path:
    """Path of a data file, for example ``find_data("robots", "panda.yaml")``.

    Raises FileNotFoundError, which lists what there is.
    """
    path = data_folder(folder).joinpath(*parts)
    if not path.is_file():
        there = ", ".join(list_data(folder, *parts[:-1])) or "none"
        raise FileNotFoundError(f"{'/'.join((folder, *parts))} does not come with the hal; there are: {there}")
    return path


def list_data(folder: str, *parts: str) -> tuple[str, ...]:
    """Names of the YAML files in a data folder, without their ending, in alphabetical order."""
    return tuple(sorted(path.stem for path in data_folder(folder).joinpath(*parts).glob("*.yaml")))


def is_path(name: str) -> bool:
    """Does ``name`` mean a file of the user's, rather than the name of something that comes with the hal?"""
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml"))


def user_path(name: str | Path, base: Path) -> Path:
    """Return the absolute path that a person wrote as ``name``, relative to ``base``, with links followed.

    Raises nothing: a path that leads nowhere (a loop of links, an unknown user, a NUL) is one that is not there.
    """
    path = os.path.join(base, os.path.expanduser(str(name).replace("\0", "\\0")))
    return Path(os.path.realpath(path))
