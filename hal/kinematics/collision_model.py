"""Collision shapes of arms and boxes, and the distances between them, by pinocchio and coal.

The shapes are those of the URDF: primitives as they are, meshes as their convex hulls. Fingers fill the whole way on
which they can move, so that a verdict does not depend on how far the gripper is open. Poses are in the world.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import NotSupported
from ..geometry import Pose
from .arm import reduced_model
from .mesh_files import hull_points
from .urdf import UrdfJoint, UrdfModel, UrdfVisual, read_urdf

if TYPE_CHECKING:
    from ..specs import CollisionSpec, KinematicsSpec, RobotSpec

Array = NDArray[np.float64]
Floats = Sequence[float]

_SAMPLES = 300
"""Random positions in which pairs are tried that may always touch."""
_MOSTLY = 0.25
"""Two links that touch in this share of them are left out: their shapes are too coarse to tell more."""
_RESERVE = 0.05
"""Pairs that may get too near on thrice the way, and after each joint has turned so far, rad, count as close;"""
_FRESH = 0.8
"""the distances of those are computed again when less than this share of their room is left."""
_RING = 16
"""Points on the outline of a circle."""
_SHARE_AT_HOME = 0.5
"""Two links that are near each other at home keep this share of that distance, if it is less than the margin."""


@dataclass(frozen=True)
class PairDistance:
    """Two links, or a link and a box, and the distance between them."""

    first: str
    """Name of the link; ``ROBOT/LINK`` where there are several arms."""
    second: str
    """Name of the other link, or of the box."""
    distance: float
    """m; negative if they overlap."""

    def __str__(self) -> str:
        apart = f"{1e3 * self.distance:.0f} mm apart" if self.distance > 0.0 else "overlap"
        return f"{self.first} and {self.second} ({apart})"


class CollisionModel:
    """Distances of an arm's links from each other, from the boxes of a rig, and from the links of other arms.

    The arm is the first of ``robots``; pairs of the others among themselves are not checked. Joint positions are those
    of all arms in their order, (n,) with n the sum of their numbers of joints. An object has scratch memory, so every
    thread needs its own.

    Raises:
        NotSupported: An arm has no collision shapes, or a mesh that cannot be read.
    """

    def __init__(self, robots: Sequence[RobotSpec], spec: CollisionSpec) -> None:
        import pinocchio as pin

        self._pin: Any = pin
        arms = ((r.name, r.same or r.name, r.kinematics, r.base_position, r.base_orientation) for r in robots)
        scene = _scene(tuple(arms), spec)
        self._scene = scene
        self._data: Any = scene.model.createData()
        self._geometry: Any = scene.geometry
        self._geometry_data: Any = pin.GeometryData(scene.geometry)
        self._compute_distance: Any = pin.computeDistance
        self._q: Array = np.zeros(scene.model.nq)
        self.n = len(scene.columns)
        """Number of joints of all arms."""
        self.slices = scene.slices
        """Where each arm's joints are in the joint positions."""
        self.count = len(scene.names)
        """Number of pairs."""
        self.levers = scene.levers
        """(pairs, n): the distance of pair k changes by at most ``levers[k, j]`` m for each rad of joint j."""
        self.margins = scene.margins
        """Smallest permitted distance of each pair, m."""
        self.indices = scene.indices
        """Of each pair, the numbers of its two shapes (see :meth:`shapes`)."""
        self.notes = scene.notes
        """Pairs that are not checked, or less strictly, and why."""

    def place(self, q: Floats | Array) -> None:
        """Move the arms to the joint positions ``q`` (n,), rad."""
        self._q[self._scene.columns] = q
        self._pin.updateGeometryPlacements(
            self._scene.model, self._data, self._scene.geometry, self._geometry_data, self._q
        )

    def distance(self, pair: int) -> float:
        """Return the distance (m) of a pair where the arms were placed last; negative if the shapes overlap."""
        distance: float = self._compute_distance(self._geometry, self._geometry_data, pair).min_distance
        return distance

    def distances(self) -> Array:
        """Return the distances (pairs,) of all pairs where the arms were placed last, m."""
        self._pin.computeDistances(self._scene.geometry, self._geometry_data)
        return np.array([found.min_distance for found in self._geometry_data.distanceResults])

    def touching(self) -> list[int]:
        """Return the pairs whose shapes overlap where the arms were placed last; much faster than distances."""
        self._pin.computeCollisions(self._scene.geometry, self._geometry_data, False)
        return [k for k, found in enumerate(self._geometry_data.collisionResults) if found.isCollision()]

    def pair(self, k: int, distance: float) -> PairDistance:
        """Return the names of pair ``k``, with this distance (m)."""
        return PairDistance(*self._scene.names[k], distance)

    def shapes(self) -> Iterator[tuple[str, Any, Array]]:
        """Yield the owner, coal's shape and the pose (4, 4) in the world of each shape, where they were placed last."""
        for name, shape, placed in zip(
            self._scene.owners, self._scene.geometry.geometryObjects, self._geometry_data.oMg, strict=True
        ):
            yield name, shape.geometry, placed.homogeneous


class PairBounds:
    """Distances of all pairs of a model, computed only where a bound from an earlier position does not suffice.

    No distance changes by more than the levers times the way of the joints. So a distance that was computed once is a
    bound for every position around, and only pairs that may be too near are computed again.
    """

    def __init__(self, model: CollisionModel) -> None:
        self.model = model
        self.distances: Array = np.full(model.count, -np.inf)
        """Distances (pairs,), m, at the positions where each was computed last: of the pairs that :meth:`near` returns,
        those at its ``q``."""
        self.shares: Array = np.full((model.n, model.count), np.inf)
        """(n, pairs), 1/rad: no pair gets under the ``least`` of the last call of :meth:`near` as long as the turns of
        the joints since the positions of that call, times its column, make less than 1 together."""
        self.weights: Array = np.full(model.n, np.inf)
        """The greatest share of each joint (n,), 1/rad: as good as the column of any pair."""
        # Pairs are along the last axis, where numpy is fast.
        self._at: Array = np.zeros((model.n, model.count))
        """Joint positions (n, pairs) at which each distance was computed, rad."""
        self._levers: Array = np.ascontiguousarray(model.levers.T)
        self._reserve: Array = _RESERVE * model.levers.sum(axis=1)

    def near(self, q: Array, way: Array, least: Array) -> list[int]:
        """Return the pairs that may get under ``least`` (pairs,), m, on a way that begins at ``q`` (n,), rad.

        Args:
            q: Joint positions (n,), rad.
            way: How far each joint may move from there at most (n,), rad.
            least: Distance of each pair, m.
        """
        levers, distances = self._levers, self.distances
        bounds = distances - (levers * np.abs(self._at - q[:, np.newaxis])).sum(axis=0)
        reach = way.dot(levers)
        needed = reach + least
        # Pairs within thrice the way are computed before they are needed, or the shares would soon be of no use.
        fresh = least + _FRESH * (distances - least)
        low = (bounds < np.maximum(needed, np.minimum(needed + 2.0 * reach + self._reserve, fresh))).nonzero()[0]
        if len(low):
            self._compute(q, low, bounds)
        rooms = bounds - least
        if rooms.min(initial=np.inf) > 0.0:
            self.shares = levers / rooms
            self.weights = self.shares.max(axis=1, initial=0.0)
        else:
            self.shares = np.full(levers.shape, np.inf)
            self.weights = np.full(len(levers), np.inf)
        near: list[int] = (bounds < needed).nonzero()[0].tolist()
        return near

    def _compute(self, q: Array, pairs: NDArray[np.intp], bounds: Array) -> None:
        """Compute the distances of ``pairs`` at ``q`` (n,), rad, and put them into ``bounds`` (all pairs,), m."""
        model = self.model
        model.place(q)
        if 2 * len(pairs) > model.count:
            self.distances = model.distances()
            self._at[:] = q[:, np.newaxis]
            bounds[:] = self.distances
            return
        self.distances[pairs] = bounds[pairs] = [model.distance(k) for k in pairs.tolist()]
        self._at[:, pairs] = q[:, np.newaxis]

    def nearest(self, q: Array) -> tuple[int, float]:
        """Return the nearest pair at ``q`` (n,), rad, and its distance, m."""
        if not self.model.count:
            raise NotSupported("no collisions are checked for this arm", code="nothing_checked")
        self.model.place(q)
        self.distances = self.model.distances()
        self._at[:] = q[:, np.newaxis]
        k = int(np.argmin(self.distances))
        return k, float(self.distances[k])


# The scene: built once for each set of arms and boxes.

_Arm = tuple[str, str, "KinematicsSpec", tuple[float, float, float], tuple[float, float, float, float]]
"""Names of an arm and of its robot, kinematics, and pose of the base."""


@dataclass(frozen=True)
class _Scene:
    """What never changes: pinocchio's models and the pairs."""

    model: Any
    geometry: Any
    columns: NDArray[np.intp]
    slices: tuple[slice, ...]
    owners: tuple[str, ...]
    names: tuple[tuple[str, str], ...]
    indices: tuple[tuple[int, int], ...]
    levers: Array
    margins: Array
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Shape:
    """A shape on a joint of an arm; joint 0 is its base."""

    link: str
    joint: int
    placement: Any
    geometry: Any


@dataclass(frozen=True)
class _ArmShapes:
    """The shapes of one arm, and what was found about its own pairs."""

    model: Any
    shapes: tuple[_Shape, ...]
    pairs: dict[tuple[str, str], float]
    """Two links -> their distance at home, m; pairs that are not checked are absent."""
    notes: tuple[str, ...]


@lru_cache(maxsize=16)
def _scene(arms: tuple[_Arm, ...], spec: CollisionSpec) -> _Scene:
    import coal
    import pinocchio as pin

    loaded = [_arm_shapes(kinematics, _changed(kinematics.urdf)) for _, _, kinematics, _, _ in arms]
    model, geometry = pin.Model(), pin.GeometryModel()
    several = len(arms) > 1
    owners: list[str] = []
    place: list[tuple[int, int, str]] = []  # arm (-1 for a box), joint of the whole model, link
    columns: list[int] = []
    slices: list[slice] = []
    for a, ((name, _, kinematics, position, orientation), shapes) in enumerate(zip(arms, loaded, strict=True)):
        base = pin.XYZQUATToSE3(np.array([*position, *Pose((0, 0, 0), orientation).orientation]))
        first = model.njoints - 1
        model = pin.appendModel(model, _rename(shapes.model, f"{a}/"), 0, base)
        slices.append(slice(len(columns), len(columns) + len(kinematics.joints)))
        columns += [int(model.joints[model.getJointId(f"{a}/{joint}")].idx_q) for joint in kinematics.joints]
        for shape in shapes.shapes:
            joint = shape.joint + first if shape.joint else 0
            placement = shape.placement if shape.joint else base * shape.placement
            _add(pin, geometry, joint, placement, shape.geometry)
            owners.append(f"{name}/{shape.link}" if several else shape.link)
            place.append((a, joint, shape.link))
    for box in spec.boxes:
        at = pin.XYZQUATToSE3(np.array([*box.position, *Pose((0, 0, 0), box.orientation).orientation]))
        _add(pin, geometry, 0, at, coal.Box(*box.size))
        owners.append(box.name)
        place.append((-1, 0, box.name))

    reach = _reach(model, geometry, columns, pin)
    moved_by = reach > 0.0
    names, indices, levers, margins = [], [], [], []
    for i, j in combinations(range(len(place)), 2):
        (a, joint_a, link_a), (b, joint_b, link_b) = place[i], place[j]
        margin = spec.margin
        if a != 0 and b != 0:  # not of the first arm
            continue
        if a == b:
            apart = loaded[a].pairs.get((link_a, link_b)) if spec.own else None
            if apart is None:
                continue
            margin = min(margin, _SHARE_AT_HOME * apart)
        elif a >= 0 and b >= 0 and not spec.arms:
            continue
        elif 0 in (joint_a, joint_b) and a >= 0 and b >= 0 and arms[a][1] == arms[b][1]:
            continue  # each arm's own pairs have the robot's body
        alone = moved_by[i] != moved_by[j]
        if not alone.any():  # neither moves the other: two bases, or a base and a box
            continue
        geometry.addCollisionPair(pin.CollisionPair(i, j))
        names.append((owners[i], owners[j]))
        indices.append((i, j))
        levers.append(np.where(alone, reach[i] + reach[j], 0.0))
        margins.append(margin)
    n = len(columns)
    return _Scene(
        model=model,
        geometry=geometry,
        columns=np.array(columns, np.intp),
        slices=tuple(slices),
        owners=tuple(owners),
        names=tuple(names),
        indices=tuple(indices),
        levers=np.array(levers, float).reshape(-1, n),
        margins=np.array(margins, float),
        notes=tuple(f"{arms[0][0]}: {note}" for note in loaded[0].notes) if spec.own else (),
    )


def _changed(urdf: str) -> int:
    return Path(urdf).stat().st_mtime_ns


def _rename(model: Any, prefix: str) -> Any:
    """Return a copy of a model whose joints and frames have names of their own."""
    copy = model.copy()
    for k in range(1, copy.njoints):
        copy.names[k] = prefix + copy.names[k]
    for frame in copy.frames:
        frame.name = prefix + frame.name
    return copy


def _add(pin: Any, geometry: Any, joint: int, placement: Any, shape: Any) -> None:
    geometry.addGeometryObject(pin.GeometryObject(f"shape{geometry.ngeoms}", joint, placement, shape))


def _reach(model: Any, geometry: Any, columns: Sequence[int], pin: Any) -> Array:
    """Return the levers (shapes, n): how far a shape moves at most, in m, for each rad of a joint.

    They are 0 for joints that do not move it. The joint that carries a shape moves it around its axis; to a joint
    before that, no point is farther than along the links between them.
    """
    reach = np.zeros((geometry.ngeoms, len(columns)))
    of_joint = {column: k for k, column in enumerate(columns)}
    axes = _axes(model, pin)
    for i, item in enumerate(geometry.geometryObjects):
        joint = int(item.parentJoint)
        points = np.array([item.placement.act(point) for point in outline_of(item.geometry)])
        distance = float(np.linalg.norm(points, axis=1).max())
        lever = float(np.linalg.norm(np.cross(points, axes[joint]), axis=1).max()) if joint else 0.0
        while joint > 0:
            slides = "JointModelP" in model.joints[joint].shortname()
            column = int(model.joints[joint].idx_q)
            if slides:
                span = abs(model.lowerPositionLimit[column]), abs(model.upperPositionLimit[column])
                distance += max(x if isfinite(x) else 0.0 for x in span)
            reach[i, of_joint[column]] = 1.0 if slides else lever
            distance += float(np.linalg.norm(model.jointPlacements[joint].translation))
            lever = distance
            joint = int(model.parents[joint])
    return reach


def _axes(model: Any, pin: Any) -> Array:
    """Return the axis (3,) of each joint in its own frame; zeros for the first, which is the world."""
    data = model.createData()
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model)).reshape(6, -1)  # (6,) for one joint
    axes = np.zeros((model.njoints, 3))
    for k in range(1, model.njoints):
        column = jacobian[:, int(model.joints[k].idx_v)]
        axes[k] = data.oMi[k].rotation.T @ column[3:]
    return axes


def outline_of(shape: Any) -> Array:
    """Return points (k, 3) whose hull contains a shape of coal."""
    kind = type(shape).__name__
    if kind == "Box":
        return _corners(np.array(shape.halfSide).ravel())
    if kind == "Sphere":
        return _corners(np.full(3, shape.radius))
    if kind in ("Cylinder", "Capsule"):
        angles = np.linspace(0.0, 2.0 * np.pi, _RING, endpoint=False)
        ring = shape.radius / np.cos(np.pi / _RING) * np.column_stack([np.cos(angles), np.sin(angles)])
        half = shape.halfLength + (shape.radius if kind == "Capsule" else 0.0)
        return np.vstack([np.column_stack([ring, np.full(_RING, z)]) for z in (-half, half)])
    points: Array = np.array(shape.points())
    return points


def _corners(half: Array) -> Array:
    """Return the corners (8, 3) of a box with these half sides (3,)."""
    corners: Array = half * np.array(list(product((-1.0, 1.0), repeat=3)))
    return corners


# One arm.


@lru_cache(maxsize=16)
def _arm_shapes(spec: KinematicsSpec, changed_ns: int) -> _ArmShapes:
    """Return the shapes of an arm; ``changed_ns`` is the time of its URDF's last change."""
    import pinocchio as pin

    urdf = read_urdf(Path(spec.urdf), meshes=False)
    model = reduced_model(spec, pin)
    shapes: list[_Shape] = []
    for link in urdf.links.values():
        if link.collisions:
            shapes += _of_link(spec, urdf, link.name, link.collisions, model, pin)
    if not any(shape.joint for shape in shapes):
        raise NotSupported(f"{Path(spec.urdf).name} has no collision shapes on its moving links", code="no_shapes")
    return _ArmShapes(model, tuple(shapes), *_own_pairs(spec, model, shapes, pin))


def _of_link(
    spec: KinematicsSpec, urdf: UrdfModel, link: str, collisions: Sequence[UrdfVisual], model: Any, pin: Any
) -> list[_Shape]:
    """Return the shapes of a link. One behind joints that are not the arm's (a finger) fills their whole range."""
    chain: list[UrdfJoint] = []
    anchor = link
    for joint in urdf.above(link):
        if joint.name in spec.joints:
            break
        chain.append(joint)
        anchor = joint.parent
    loose = [joint for joint in chain if joint.movable and joint.mimic is None]
    loose += [
        urdf.joints[joint.mimic.of] for joint in chain if joint.mimic is not None and joint.mimic.of in urdf.joints
    ]
    frame = model.frames[model.getFrameId(anchor, pin.FrameType.BODY)]  # a joint may have the same name
    carried = int(frame.parentJoint) > 0
    if any(joint.movable for joint in chain) and not carried:
        return []  # of something else on the same base, such as a second arm
    relative = [_pose_along(chain, values) for values in _ranges(loose)]
    placements = [frame.placement * pin.XYZQUATToSE3(np.array([*p.position, *p.orientation])) for p in relative]
    found = []
    for shape in collisions:
        own = pin.XYZQUATToSE3(np.array([*shape.pose.position, *shape.pose.orientation]))
        if len(placements) == 1:
            found.append(_Shape(link, int(frame.parentJoint), placements[0] * own, _geometry(shape, link)))
        else:
            corners = _points(shape, link)
            swept = np.vstack([[(at * own).act(corner) for corner in corners] for at in placements])
            found.append(_Shape(link, int(frame.parentJoint), pin.SE3.Identity(), _hull(swept, link)))
    return found


def _ranges(joints: Sequence[UrdfJoint]) -> list[dict[str, float]]:
    """Return positions of some joints over their whole ranges, all joints at the same share of them."""
    if not joints:
        return [{}]
    ends = {}
    for joint in joints:
        low = joint.lower if joint.lower is not None and isfinite(joint.lower) else -np.pi
        high = joint.upper if joint.upper is not None and isfinite(joint.upper) else np.pi
        ends[joint.name] = (low, high)
    shares = (0.0, 1.0) if all(joint.kind == "prismatic" for joint in joints) else (0.0, 0.25, 0.5, 0.75, 1.0)
    return [{name: low + share * (high - low) for name, (low, high) in ends.items()} for share in shares]


def _pose_along(chain: Sequence[UrdfJoint], values: dict[str, float]) -> Pose:
    """Return the pose of the last link of a chain, whose joints are given from there inwards, in the first one."""
    pose = Pose()
    for joint in chain:
        pose = Pose(*joint.placement(values)) @ pose
    return pose


def _geometry(shape: UrdfVisual, link: str) -> Any:
    """Return coal's shape."""
    import coal

    if shape.shape == "mesh":
        return _hull(_points(shape, link), link)
    kinds = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder, "capsule": coal.Capsule}
    return kinds[shape.shape](*shape.size)


def _points(shape: UrdfVisual, link: str) -> Array:
    """Return points (k, 3) whose hull is the shape (of a mesh), or contains it."""
    if shape.shape == "mesh":
        try:
            points: Array = hull_points(Path(shape.file)) * np.array(shape.size)
            return points
        except (ValueError, RuntimeError, OSError) as error:
            what = f"collision mesh {Path(shape.file).name} of link {link}"
            raise NotSupported(f"{what} cannot be read: {error}", code="bad_mesh") from None
    if shape.shape == "box":
        half = 0.5 * np.array(shape.size)
    elif shape.shape == "sphere":
        half = np.full(3, shape.size[0])
    else:  # along z
        radius, length = shape.size
        caps = radius if shape.shape == "capsule" else 0.0
        half = np.array([radius, radius, 0.5 * length + caps])
    return _corners(half)


def _hull(points: Array, link: str) -> Any:
    """Return the convex hull of points (k, 3)."""
    import coal

    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(0, len(points))
    mesh.addVertices(points)
    mesh.endModel()
    try:
        mesh.buildConvexHull(True, "Qt")
    except (RuntimeError, ValueError):
        raise NotSupported(f"the shape of link {link} has no volume", code="flat_shape") from None
    return mesh.convex


def _own_pairs(
    spec: KinematicsSpec, model: Any, shapes: Sequence[_Shape], pin: Any
) -> tuple[dict[tuple[str, str], float], tuple[str, ...]]:
    """Return the pairs of links to check with their distances at home, and notes about the others.

    Not checked are neighbours, which a joint's limits keep apart, and pairs that touch in most positions or at home:
    their shapes overlap.
    """
    geometry = pin.GeometryModel()
    for shape in shapes:
        _add(pin, geometry, shape.joint, shape.placement, shape.geometry)
    links: list[tuple[str, str]] = []
    for i, j in combinations(range(len(shapes)), 2):
        a, b = shapes[i].joint, shapes[j].joint
        if a == b or int(model.parents[max(a, b)]) == min(a, b):
            continue
        geometry.addCollisionPair(pin.CollisionPair(i, j))
        links.append((shapes[i].link, shapes[j].link))
    data, geometry_data = model.createData(), pin.GeometryData(geometry)
    columns = [int(model.joints[model.getJointId(name)].idx_q) for name in spec.joints]
    q = np.zeros(model.nq)
    lower, upper = np.maximum(spec.lower, -np.pi), np.minimum(spec.upper, np.pi)
    count: dict[tuple[str, str], int] = dict.fromkeys(links, 0)
    for sample in np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, len(columns))):
        q[columns] = sample
        pin.updateGeometryPlacements(model, data, geometry, geometry_data, q)
        pin.computeCollisions(geometry, geometry_data, False)
        results = zip(links, geometry_data.collisionResults, strict=True)
        for link_pair in {pair for pair, result in results if result.isCollision()}:
            count[link_pair] += 1
    q[columns] = spec.home
    pin.updateGeometryPlacements(model, data, geometry, geometry_data, q)
    pin.computeDistances(geometry, geometry_data)
    home: dict[tuple[str, str], float] = {}
    for pair, result in zip(links, geometry_data.distanceResults, strict=True):
        home[pair] = min(home.get(pair, np.inf), float(result.min_distance))
    notes = []
    for pair in list(home):
        share = count[pair] / _SAMPLES
        if home[pair] <= 0.0 or share >= _MOSTLY:
            where = "at home" if home[pair] <= 0.0 else f"in {100.0 * share:.0f} % of all positions"
            notes.append(f"{pair[0]} and {pair[1]} are not checked against each other: their shapes touch {where}")
            del home[pair]
    return home, tuple(notes)
