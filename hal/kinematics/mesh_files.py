"""Find the mesh files that a URDF names, and check them before a library reads them.

Some libraries crash on a mesh whose indices point past the end of its lists.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import io
import os
import re
import struct
import sys
import xml.etree.ElementTree as ElementTree
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PACKAGE = "package://"
"""Begins the name of a file in an installed package."""
_SCHEMES = (PACKAGE, "model://", "file://")


def package_folder(package: str) -> Path | None:
    """Return the folder of an installed Python package, without importing it; None if there is no such package.

    Wheels of cmeel, such as ``example_robot_data``, hold no module, only files: the folder is then that of their data.
    """
    try:
        return _find_package(package, tuple(sys.path))
    except (ImportError, ValueError):
        return None


@lru_cache(maxsize=64)  # each mesh of an arm asks for it; a package that is not found may be installed later
def _find_package(package: str, path: tuple[str, ...]) -> Path:
    """Return the folder of a package; ``path`` is where Python looks for it. Raises ImportError if there is none."""
    spec = importlib.util.find_spec(package)
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    if spec is not None and spec.origin:
        return Path(spec.origin).parent
    name = package.replace("_", "-")
    from importlib.metadata import distribution  # slow to import, so only when it is needed

    folder = Path(str(distribution(name).locate_file(f"cmeel.prefix/share/{name}")))
    if not folder.is_dir():
        raise ImportError(f"{package} has no folder")
    return folder


def mesh_file(name: str, folder: Path) -> Path:
    """Return the file that a URDF in ``folder`` calls ``name``.

    It is beside the URDF or above it (:func:`mesh_near`), or, as ``package://NAME/...``, in an installed package.
    A file that is in none of these places is returned as if it were beside the URDF.
    """
    found = mesh_near(name, folder)
    if found is not None:
        return found
    plain = _plain(name)
    package, _, rest = plain.partition("/")
    if name.startswith(PACKAGE) and package.isidentifier():
        root = package_folder(package)
        if root is not None and (root / rest).is_file():
            return root / rest
    return folder / plain


def mesh_near(name: str, folder: Path) -> Path | None:
    """Return the file in ``folder`` or in a folder above it, where PyBullet looks, whatever package a URI names."""
    plain = _plain(name)
    places = (folder, *folder.parents)
    return next((place / plain for place in places if os.path.isfile(os.path.join(place, plain))), None)


def _plain(name: str) -> str:
    for scheme in _SCHEMES:
        name = name.removeprefix(scheme)
    return name


def is_installed(file: Path) -> bool:
    """Return whether a file belongs to an installed Python package."""
    return any(part in ("site-packages", "dist-packages") for part in file.parts)


FARTHEST = 1e6
"""Largest coordinate of a vertex, in the unit of the file."""
_VERTEX = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t]+([^\r\n]*)", re.MULTILINE)
# The numbers of a corner, POSITION/TEXTURE/NORMAL, each with the lines that it counts.
_CORNERS = (
    ("vertex", re.compile(rb"(?:^|\s)(-?\d+)"), re.compile(rb"^[ \t]*v[ \t]", re.MULTILINE)),
    ("texture", re.compile(rb"\d/(-?\d+)"), re.compile(rb"^[ \t]*vt[ \t]", re.MULTILINE)),
    ("normal", re.compile(rb"\d/-?\d*/(-?\d+)"), re.compile(rb"^[ \t]*vn[ \t]", re.MULTILINE)),
)


def check_mesh(path: Path) -> None:
    """Check an OBJ, STL or Collada file; files of other kinds are left to the libraries.

    Raises:
        ValueError: It is wrong; the message does not name the file.
        OSError: It cannot be read.
    """
    state = path.stat()
    _check(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=512)
def _check(path: Path, changed_ns: int, size: int) -> None:
    check = {".obj": _check_obj, ".stl": _check_stl, ".dae": _check_collada}.get(path.suffix.lower())
    if check is not None:
        check(path.read_bytes())


def _check_obj(data: bytes) -> None:
    _check_coordinates(np.array(_VERTEX.findall(data)))
    faces = b"\n".join(_FACE.findall(data))
    for kind, corner, line in _CORNERS:
        found = corner.findall(faces)
        _check_indices(found, len(line.findall(data)), kind, first=1)


def _check_stl(data: bytes) -> None:
    if len(data) >= 84:
        (count,) = struct.unpack_from("<I", data, 80)
        if len(data) == 84 + 50 * count:
            rows = np.frombuffer(data, np.dtype([("at", "<f4", 12), ("rest", "<u2")]), count, 84)
            _check_coordinates(rows["at"][:, 3:])
            return
    if not data.lstrip().startswith(b"solid"):
        raise ValueError("is truncated, or not an STL: its size does not fit its number of triangles")
    _check_coordinates(np.array(re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)))


def _check_collada(data: bytes) -> None:
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"is not valid XML: {error}") from None
    for element in root.iter():
        element.tag = str(element.tag).rpartition("}")[2]  # without its namespace
    counts: dict[str, int] = {}  # entries of each source, by its id; of <vertices>, those of the positions
    for source in root.iter("source"):
        accessor = source.find("technique_common/accessor")
        array = source.find("float_array")
        if accessor is None or array is None:
            continue
        values = np.array((array.text or "").split() or ["0"])
        _check_coordinates(values)
        stride = max(1, int(accessor.get("stride", "1")))
        counts[source.get("id", "")] = min(int(accessor.get("count", "0")), len(values) // stride)
    for vertices in root.iter("vertices"):
        positions = [one.get("source", "")[1:] for one in vertices.findall("input")]
        counts[vertices.get("id", "")] = min((counts.get(name, 0) for name in positions), default=0)
    for kind in ("triangles", "polylist", "polygons", "tristrips", "trifans", "lines"):
        for primitive in root.iter(kind):
            inputs = [(int(one.get("offset", "0")), one.get("source", "")[1:]) for one in primitive.findall("input")]
            width = 1 + max((offset for offset, _ in inputs), default=0)
            for part in primitive.findall("p"):
                indices = (part.text or "").split()
                for offset, name in inputs:
                    _check_indices([i.encode() for i in indices[offset::width]], counts.get(name, 0), name, first=0)


def _check_coordinates(values: NDArray[np.generic]) -> None:
    try:
        numbers = values.astype(float)
    except ValueError as error:
        raise ValueError(f"has a coordinate that is not a number: {error}") from None
    if not (np.abs(numbers) <= FARTHEST).all():
        raise ValueError(f"has a coordinate that is not finite, or beyond {FARTHEST:g}")


def _check_indices(found: list[bytes], count: int, kind: str, *, first: int) -> None:
    """Check indices that count from ``first``. Negative ones, if allowed (first=1), count back from the last entry."""
    if not found:
        return
    if max(map(len, found)) > 12:
        raise ValueError(f"has a {kind} index of {max(map(len, found))} digits")
    indices = np.array(found).astype(np.int64)
    least, most = -count if first else 0, count - 1 + first
    wrong = indices[(indices < least) | (indices > most) | ((indices == 0) & (first == 1))]
    if len(wrong):
        raise ValueError(f"has {kind} index {wrong[0]}, but only {count} of that kind")


def hull_points(path: Path) -> NDArray[np.float64]:
    """Return the corners (k, 3) of the convex hull of a mesh file, from the user's cache if it has them.

    Reading a large mesh takes up to a second. A cache that is missing or cannot be written only costs that time.

    Raises:
        ValueError: The file is wrong; the message does not name it.
        RuntimeError: coal cannot read it, or it has no volume.
        OSError: It cannot be read.
    """
    cached = cache_file("hulls", path, 1, suffix=".npy")
    with contextlib.suppress(OSError, ValueError, EOFError):
        known: NDArray[np.float64] = np.load(cached)
        if known.ndim == 2 and known.shape[1] == 3 and np.isfinite(known).all():
            return known
    import coal

    check_mesh(path)
    mesh = coal.MeshLoader().load(str(path))
    mesh.buildConvexHull(True, "Qt")
    points: NDArray[np.float64] = np.array(mesh.convex.points(), float).reshape(-1, 3)
    data = io.BytesIO()
    np.save(data, points)
    with contextlib.suppress(OSError):
        write_whole(cached, data.getvalue())
    return points


def cache_folder(name: str) -> Path:
    """Return ``$XDG_CACHE_HOME/robot-hal/NAME``, by default under ``~/.cache``."""
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(root, "robot-hal", name)


def cache_file(folder: str, file: Path, *what: object, suffix: str) -> Path:
    """Return where to keep what was computed from a file and from ``what``; another place once the file changes.

    Raises OSError if there is no such file.
    """
    state = file.stat()
    text = " ".join(map(str, (file.resolve(), state.st_mtime_ns, state.st_size, *what)))
    return cache_folder(folder) / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}{suffix}"


def write_whole(path: Path, data: bytes) -> None:
    """Write a file, and its folder if there is none, so that nobody reads half of it. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.{os.getpid()}")
    unfinished.write_bytes(data)
    unfinished.replace(path)
