"""Files that URDFs name: where the folder of an installed Python package is, and which file a mesh's name means."""

from __future__ import annotations

import importlib.util
from pathlib import Path

__all__ = ["mesh_file", "near", "package_folder"]

_PACKAGE = "package://"
_SCHEMES = (_PACKAGE, "model://", "file://")


def package_folder(package: str) -> Path | None:
    """Folder of an installed Python package, which is not imported; None where there is none of that name."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(spec.origin).parent if spec.origin else None


def mesh_file(name: str, folder: Path) -> Path:
    """The file that a URDF in ``folder`` calls ``name``; where it should be beside the URDF when it is nowhere.

    It may lie beside the URDF or above it (:func:`near`), or, as ``package://NAME/...``, in an installed package.
    """
    found = near(name, folder)
    if found is not None:
        return found
    plain = _plain(name)
    package, _, rest = plain.partition("/")
    if name.startswith(_PACKAGE) and package.isidentifier():
        root = package_folder(package)
        if root is not None and (root / rest).is_file():
            return root / rest
    return folder / plain


def near(name: str, folder: Path) -> Path | None:
    """The file in ``folder`` or in one above it, whatever package a URI names: where PyBullet looks."""
    plain = _plain(name)
    return next((place / plain for place in (folder, *folder.parents) if (place / plain).is_file()), None)


def _plain(name: str) -> str:
    for scheme in _SCHEMES:
        name = name.removeprefix(scheme)
    return name
