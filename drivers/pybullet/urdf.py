"""What a URDF file says that PyBullet ignores, or reports with no more than a failure: read as plain XML."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hal.errors import ConfigError, Problem
from hal.kinematics.urdf import mesh_file, near
from hal.kinematics.urdf import read_urdf as check_urdf

__all__ = ["Mimic", "UrdfFacts", "loadable", "read_urdf"]


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: ``q[joint] = multiplier * q[of] + offset``."""

    joint: str
    of: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class UrdfFacts:
    """What this driver needs to know beside what PyBullet loads."""

    mimics: tuple[Mimic, ...]
    massless: tuple[str, ...]
    """Links that have geometry but no ``<inertial>``: PyBullet gives them a mass of 1 kg."""


def read_urdf(path: str, key: str) -> UrdfFacts:
    """Read and check a URDF.

    Args:
        path: the file.
        key: the configuration key that names it, for the error.

    Raises:
        ConfigError: no such file, no URDF, or meshes that are not there; every one is listed.
    """
    try:
        check_urdf(Path(path))
    except OSError as error:
        raise ConfigError([Problem(path, key, f"cannot be read: {error.strerror}")]) from None
    except ValueError as error:
        raise ConfigError([Problem(path, key, str(error))]) from None
    root = ElementTree.parse(path).getroot()
    folder = Path(path).resolve().parent
    names = dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh"))
    missing = [name for name in names if not mesh_file(name, folder).is_file()]
    if missing:
        raise ConfigError([Problem(path, key, f"names a mesh that is not there: {name}") for name in missing])
    mimics = tuple(
        Mimic(
            joint.get("name", ""),
            mimic.get("joint", ""),
            float(mimic.get("multiplier", 1.0)),
            float(mimic.get("offset", 0.0)),
        )
        for joint in root.iter("joint")
        if (mimic := joint.find("mimic")) is not None
    )
    massless = tuple(
        link.get("name", "")
        for link in root.iter("link")
        if link.find("inertial") is None and (link.find("visual") is not None or link.find("collision") is not None)
    )
    return UrdfFacts(mimics, massless)


@contextmanager
def loadable(path: str) -> Iterator[str]:
    """The path of a URDF as PyBullet can load it: a copy for a while where its meshes are in installed packages."""
    folder = Path(path).resolve().parent
    tree = ElementTree.parse(path)
    files = [element for tag in ("mesh", "texture") for element in tree.iter(tag) if element.get("filename")]
    if all(near(element.get("filename", ""), folder) for element in files):
        yield path
        return
    for element in files:
        element.set("filename", str(mesh_file(element.get("filename", ""), folder)))
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / Path(path).name
        tree.write(copy, encoding="unicode")
        yield str(copy)
