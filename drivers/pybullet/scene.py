"""What there is to draw in a world: the visual shapes of its bodies as meshes, and where their links are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose

from .meshes import MeshLibrary
from .shapes import Mesh, box, capsule, cylinder, joined, plane, sphere

__all__ = ["Part", "Scene", "link_frames", "parts_of"]

Array = NDArray[np.float64]


class SceneBody(Protocol):
    """A body of a world, as far as drawing goes (:class:`.body.Body`)."""

    @property
    def id(self) -> int: ...
    @property
    def index(self) -> int: ...


class Scene(Protocol):
    """A world, as far as drawing goes (:class:`.world.World`)."""

    @property
    def client(self) -> Any: ...
    @property
    def bodies(self) -> Mapping[str, SceneBody]: ...
    @property
    def revision(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Part:
    """What one draw call draws: the meshes of one link that share a texture, in the frame of the link.

    A link has parts for large pictures, and others for small ones if any of its meshes is heavy.
    """

    body: int
    """PyBullet's number of the body."""
    link: int
    """-1 is the base."""
    mesh: Mesh
    coarse: bool
    """For pictures in which ``mesh.cell`` is small."""
    centre: Array
    """(3,) of a ball around the mesh, m."""
    radius: float


def parts_of(client: Any, shapes: Sequence[Any], library: MeshLibrary) -> list[Part]:
    """The parts of one body; ``shapes`` is what ``getVisualShapeData`` says of it."""
    groups: dict[Any, list[Mesh]] = {}
    found: list[tuple[int, int, tuple[float, ...], Array, Mesh]] = []
    for shape in shapes:
        body, link, kind, size, file, position, orientation, rgba = shape[:8]
        if rgba[3] == 0:
            continue
        frame = Pose(position, orientation).matrix()  # in the link's frame, not in that of its centre of mass
        for mesh in _meshes(client, kind, size, file.decode(), library):
            found.append((body, link, rgba, frame, mesh))
    heavy = {(body, link) for body, link, _, _, mesh in found if mesh.coarse is not None}
    for body, link, rgba, frame, mesh in found:
        for coarse in (False, True) if (body, link) in heavy else (False,):
            drawn = mesh.coarse if coarse and mesh.coarse is not None else mesh
            texture = None if drawn.texture is None else id(drawn.texture)
            key = (body, link, coarse, texture, drawn.closed)
            groups.setdefault(key, []).append(drawn.tinted(rgba).moved(frame))
    return [_part(body, link, coarse, joined(meshes)) for (body, link, coarse, *_), meshes in groups.items()]


def _meshes(client: Any, kind: int, size: Sequence[float], file: str, library: MeshLibrary) -> list[Mesh]:
    if kind == client.GEOM_MESH:
        return [_scaled(mesh, np.asarray(size)) for mesh in library.load(file)]
    if kind == client.GEOM_BOX:
        return [box((size[0] / 2, size[1] / 2, size[2] / 2))]
    if kind == client.GEOM_SPHERE:
        return [sphere(size[0])]
    if kind == client.GEOM_CYLINDER:
        return [cylinder(size[1], size[0])]
    if kind == client.GEOM_CAPSULE:
        return [capsule(size[1], size[0])]
    return [plane()] if kind == client.GEOM_PLANE else []


def _scaled(mesh: Mesh, size: Array) -> Mesh:
    coarse = None if mesh.coarse is None else mesh.coarse.scaled(size)
    return replace(mesh.scaled(size), coarse=coarse)


def _part(body: int, link: int, coarse: bool, mesh: Mesh) -> Part:
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    centre = (low + high).astype(float) / 2
    return Part(body, link, mesh, coarse, centre, float(np.linalg.norm(mesh.positions - centre, axis=1).max()))


def link_frames(client: Any, links: Sequence[tuple[int, int]]) -> Array:
    """Poses (N, 4, 4) in the world of the frames of links, each given as (body, link); those of one body together."""
    wanted: dict[int, list[int]] = {}
    for body, link in links:
        wanted.setdefault(body, []).append(link)
    frames: list[tuple[float, ...]] = []
    for body, numbers in wanted.items():
        moving = [link for link in numbers if link >= 0]
        states = iter(client.getLinkStates(body, moving, computeForwardKinematics=1) if moving else ())
        for link in numbers:
            if link >= 0:
                state = next(states)
                frames.append((*state[4], *state[5]))
            else:  # PyBullet gives the base by its centre of mass
                inertial = client.getDynamicsInfo(body, -1)[3:5]
                centre = client.getBasePositionAndOrientation(body)
                position, orientation = client.multiplyTransforms(*centre, *client.invertTransform(*inertial))
                frames.append((*position, *orientation))
    return _matrices(np.array(frames).reshape(-1, 7))


def _matrices(poses: Array) -> Array:
    x, y, z, w = poses[:, 3:].T
    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    matrices[:, 1, 0], matrices[:, 1, 1], matrices[:, 1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    matrices[:, 2, 0], matrices[:, 2, 1], matrices[:, 2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    matrices[:, :3, 3] = poses[:, :3]
    matrices[:, 3, 3] = 1
    return matrices
