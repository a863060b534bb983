"""Kinematics of one arm: forward, differential and inverse, by pinocchio. Poses are in the arm's base frame.

The model is reduced to the arm's joints, in the order of the spec; every other joint (fingers, a second arm) is at
zero. Continuous joints are treated as revolute joints without an end, so that a configuration is always n angles.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from math import cos, dist, hypot, inf, sin, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import vector
from ..errors import CommandError, DeviceNotFound, suggest
from ..geometry import Pose, difference
from . import ik
from .urdf import parse_xml

if TYPE_CHECKING:
    from ..specs import KinematicsSpec

Array = NDArray[np.float64]
Frame = Literal["base", "tcp", "space"]
"""In which frame a Jacobian is: see :meth:`Kinematics.jacobian`."""
Pose7 = tuple[float, float, float, float, float, float, float]
"""x, y, z in m, then a unit quaternion x, y, z, w."""

NEAR_SINGULAR = 0.05
"""Smallest singular value of the Jacobian (m and rad mixed) down to which twists are tracked exactly."""
POSTURE_SPEED = 0.5
"""Bound of the fastest joint in the pull towards the home posture, rad/s."""


class Kinematics:
    """Forward, differential and inverse kinematics of one arm with ``n`` joints.

    Joint positions are n numbers in rad, in the order of ``spec.joints``; angles of continuous joints may take any
    value. An object has scratch memory, so every thread needs its own.

    Raises:
        ValueError: The URDF lacks a joint or a link of the spec.
    """

    def __init__(self, spec: KinematicsSpec) -> None:
        import eigenpy
        import pinocchio as pin

        self.spec = spec
        self.n = len(spec.joints)
        self._shape = (self.n,)
        self.lower: Array = np.array(spec.lower, float)
        self.upper: Array = np.array(spec.upper, float)
        self.home: Array = np.array(spec.home, float)
        for name, values in (("lower", self.lower), ("upper", self.upper), ("home", self.home)):
            if values.shape != (self.n,):
                raise ValueError(f"{name} has {values.size} numbers for {self.n} joints")
        self._pin: Any = pin
        self._model: Any = reduced_model(spec, pin)
        self._tcp: int = add_tcp(self._model, spec, pin)
        self._data: Any = self._model.createData()
        # These are views of what was computed last.
        self._tcp_placement: Any = self._data.oMf[self._tcp]
        self._axes: Any = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        self._eigen: Any = eigenpy.SelfAdjointEigenSolver(np.eye(6))
        self._llt: Any = eigenpy.LLT(np.eye(6))
        self._gram: Array = np.empty((6, 6))
        self._regular_at: Sequence[float] = (inf,) * self.n
        self._regular_room = 0.0
        # Column of pinocchio's model for each joint of the spec; None if the orders agree, as they usually do.
        columns = [int(self._model.joints[self._model.getJointId(name)].idx_q) for name in spec.joints]
        self._columns: NDArray[np.intp] | None = None
        self._inverse_columns: NDArray[np.intp] | None = None
        if columns != list(range(self.n)):
            self._columns, self._inverse_columns = np.array(columns), np.argsort(columns)
        ranks = np.array([self._model.getJointId(name) for name in spec.joints])
        self._ranks: list[int] = ranks.tolist()
        """Places of the joints from the base outwards."""
        self._inner = (ranks[:, None] <= ranks)[:, :, None]
        """(n, n, 1): whether joint i is joint j or nearer to the base."""
        # Greatest change of the Jacobian (Frobenius norm) for a turn of the joints of length 1.
        self._change = sqrt(self.n) * hypot(*self.reach(), sqrt(self.n))

    def fk(self, q: Sequence[float] | Array) -> Pose7:
        """Return the pose of the tcp as seven plain floats."""
        self._forward(q)
        self._pin.updateFramePlacement(self._model, self._data, self._tcp)
        pose: Pose7 = self._pin.SE3ToXYZQUATtuple(self._tcp_placement)
        return pose

    def pose(self, q: Sequence[float] | Array) -> Pose:
        """Return the pose of the tcp."""
        values = self.fk(q)
        return Pose(values[:3], values[3:])

    def link_pose(self, link: str, q: Sequence[float] | Array) -> Pose:
        """Return the pose of a link's frame (not its centre of mass). Raises DeviceNotFound (``unknown_link``)."""
        frame = self._body_frame(link)
        self._forward(q)
        self._pin.updateFramePlacement(self._model, self._data, frame)
        values = self._pin.SE3ToXYZQUATtuple(self._data.oMf[frame])
        return Pose(values[:3], values[3:])

    def jacobian(self, q: Sequence[float] | Array, frame: Frame = "base", link: str | None = None) -> Array:
        """Return the Jacobian (6, n) from joint speeds to a velocity: three rows linear, m/s, three angular, rad/s.

        Args:
            q: Joint positions (n,), rad.
            frame: ``"base"``: velocity of the tcp's origin, along the base's axes (as :class:`hal.Twist` has it).
                ``"tcp"``: the same velocity along the tcp's own axes, the body Jacobian. ``"space"``: velocity of that
                point of the moving body, extended if need be, which passes through the base's origin, along the base's
                axes: the spatial Jacobian, whose columns are the present screw axes.
            link: A link whose frame replaces the tcp's; its columns of joints farther out are 0. None: the tcp.

        Raises:
            DeviceNotFound: No such link (``code`` is ``unknown_link``).
            CommandError: No such frame, or another number of joints.
        """
        if frame == "base":
            axes = self._axes
        else:
            reference = self._pin.ReferenceFrame
            if frame not in ("tcp", "space"):
                raise CommandError(f"frame must be 'base', 'tcp' or 'space', not {frame!r}", code="unknown_frame")
            axes = reference.LOCAL if frame == "tcp" else reference.WORLD
        return self._frame_jacobian(q, self._tcp if link is None else self._body_frame(link), axes)

    def _frame_jacobian(self, q: Sequence[float] | Array, number: int, axes: Any) -> Array:
        """Return the Jacobian (6, n) of a frame of pinocchio's along these axes."""
        jacobian: Array = self._pin.computeFrameJacobian(self._model, self._data, self._reorder(q), number, axes)
        if self.n == 1:
            jacobian = jacobian.reshape(6, 1)  # pinocchio returns a vector
        return jacobian if self._columns is None else jacobian[:, self._columns]

    def screw_axes(self, link: str | None = None) -> Array:
        """Return the screw axes (6, n) of the joints in the base frame where all joints are at 0: v, then omega.

        Of a joint that turns, omega is its unit axis and v = -omega x p for a point p on it, m; of one that slides, v
        is the unit axis and omega 0. (Lynch and Park, "Modern Robotics", 2017, section 4.1; they write omega first.)

        Args:
            link: Joints beyond this link have columns of 0. None: the tcp.
        """
        return self.jacobian([0.0] * self.n, "space", link)

    def exponential(self, q: ArrayLike, link: str | None = None) -> Pose:
        """Return the pose of the tcp, or of a link, by the product of exponentials of :meth:`screw_axes`.

        ``exp([S1] q1) ... exp([Sn] qn) M`` with the pose M where all joints are at 0 (Brockett, 1984; Lynch and Park,
        "Modern Robotics", 2017, section 4.1). It equals :meth:`pose`, computed in another way.

        Args:
            q: Joint positions (n,), rad.
            link: A link; None: the tcp.
        """
        zero, axes = [0.0] * self.n, self.screw_axes(link)
        angles = vector("q", q, self.n)
        matrix: Array = (self.pose(zero) if link is None else self.link_pose(link, zero)).matrix()
        for k in sorted(range(self.n), key=self._ranks.__getitem__, reverse=True):
            matrix = _exponential(axes[:, k], float(angles[k])) @ matrix
        return Pose.from_matrix(matrix)

    def manipulability(self, q: Sequence[float] | Array, link: str | None = None) -> float:
        """Return the product of the singular values of :meth:`jacobian` at ``q`` (n,), rad: 0 at a singularity.

        With six joints or more that is sqrt(det(J J^T)) (Yoshikawa, Int. J. Robotics Research 4(2), 1985). It mixes m
        and rad, so it compares postures of one arm, not different arms.
        """
        return float(np.prod(np.linalg.svd(self.jacobian(q, "base", link), compute_uv=False)))

    def fk_and_jacobian(self, q: Sequence[float] | Array) -> tuple[Pose7, Array]:
        """Return :meth:`fk` and :meth:`jacobian`; together they take little longer than one of them."""
        jacobian = self._frame_jacobian(q, self._tcp, self._axes)  # has done the forward kinematics of the joints
        self._pin.updateFramePlacement(self._model, self._data, self._tcp)
        pose: Pose7 = self._pin.SE3ToXYZQUATtuple(self._tcp_placement)
        return pose, jacobian

    def curvature(self, jacobian: Array) -> Array:
        """Return (n, n, 3), m/rad: change of column j of the linear Jacobian for each rad that joint i turns.

        ``jacobian`` (6, n) is that of the present position. Turning joint i turns the levers of all joints from i to
        the tip; the rest follows, since second derivatives of the tcp's position are symmetric.
        """
        turned = np.cross(jacobian[3:].T[:, None], jacobian[:3].T)
        return np.where(self._inner, turned, turned.transpose(1, 0, 2))

    def velocity(
        self,
        q: Sequence[float] | Array,
        twist: Sequence[float] | Array,
        posture_gain: float = 0.5,
        jacobian: Array | None = None,
    ) -> tuple[list[float], bool]:
        """Return the joint speeds (n,) in rad/s for a twist (6,) of the tcp, and whether the arm is near a singularity.

        The null space of the twist moves towards home at ``posture_gain`` (1/s) times the distance, at most at
        :data:`POSTURE_SPEED`; that does not move the tcp. Callers that have the Jacobian at ``q`` can pass it.

        Far from singularities a twist is tracked exactly. Near one, the component along each direction whose singular
        value s is below :data:`NEAR_SINGULAR` (e) is tracked to the share (s/e)^2, so that joint speeds stay below
        |twist| / e: damped least squares with numerical filtering (Maciejewski and Klein, J. Robotic Systems 5(6),
        1988) with the damping s^2 + l^2 = max(s, e)^2. All other directions stay exact.
        """
        if jacobian is None:
            jacobian = self.jacobian(q)
        gram = np.dot(jacobian, jacobian.T, self._gram)
        near = not self._is_surely_regular(q) and self._is_near_singular(q, gram)
        home = self._pull(q, posture_gain) if self.n > 6 and posture_gain else None  # else there is no null space
        wanted = np.array(twist, float)
        if not near:
            self._llt.compute(gram)
            if home is None:
                speeds = self._llt.solve(wanted).dot(jacobian)
            else:  # the motion home, without the part that would move the tcp
                speeds = self._llt.solve(wanted - jacobian.dot(home)).dot(jacobian) + home
        else:
            squares = self._eigen.eigenvalues()  # of the singular values, in ascending order
            vectors = self._eigen.eigenvectors()
            along = vectors.T.dot(jacobian)
            speeds = (vectors.T.dot(wanted) / np.maximum(squares, NEAR_SINGULAR**2)).dot(along)
            if home is not None:
                # The null space is undamped, or the posture would creep along the singular direction.
                regular = squares > 1e-12
                speeds += home - (along[regular].dot(home) / squares[regular]).dot(along[regular])
        result: list[float] = speeds.tolist()
        return result, near

    def _pull(self, q: Sequence[float] | Array, gain: float) -> Array | None:
        """Return the speeds (n,) towards home, rad/s; None if they are all 0."""
        way: Array = self.home - q
        square = float(way.dot(way))
        if square == 0.0:
            return None
        if gain * gain * square > POSTURE_SPEED * POSTURE_SPEED:  # else none is too fast: all of them together are not
            gain = min(gain, POSTURE_SPEED / max(map(abs, way.tolist())))
        way *= gain
        return way

    def _is_near_singular(self, q: Sequence[float] | Array, gram: Array) -> bool:
        """Return whether the Jacobian at ``q`` has a singular value below :data:`NEAR_SINGULAR`; ``gram`` is J J^T."""
        self._eigen.compute(gram)
        square = float(self._eigen.eigenvalues()[0])
        self._regular_at, self._regular_room = tuple(q), sqrt(max(0.0, square)) - NEAR_SINGULAR
        return square < NEAR_SINGULAR**2

    def _is_surely_regular(self, q: Sequence[float] | Array) -> bool:
        """Return whether the arm cannot be near a singularity, by its distance from the last position that was checked.

        No singular value of J changes by more than the Frobenius norm of the change of J (Weyl). A turn of the joints
        by d changes the linear part of each of its n columns by at most |reach| |d| (see :meth:`reach`), the angular
        part by at most sum |d_i| <= sqrt(n) |d|.
        """
        return dist(q, self._regular_at) * self._change <= self._regular_room

    def pose_error(self, q: Sequence[float] | Array, pose: Sequence[float] | Array) -> Array:
        """Return the constant twist (6,) along the base's axes that moves the tcp from ``fk(q)`` to ``pose`` in 1 s.

        Linear part: the difference of the positions, m. Angular part: the rotation vector (the logarithm) of the
        rotation between them, rad, never longer than pi.
        """
        return np.array(difference(self.fk(q), [float(value) for value in pose]))

    def solve(
        self,
        pose: Pose,
        q_seed: ArrayLike | None = None,
        *,
        position_tolerance: float = 1e-5,
        rotation_tolerance: float = 1e-5,
        starts: int = 24,
    ) -> Array:
        """Return joint positions (n,) inside the limits that bring the tcp to ``pose``.

        Args:
            pose: In the base frame.
            q_seed: (n,) rad; the search starts there, then at points ever farther from it. None: home.
            position_tolerance: m.
            rotation_tolerance: rad.
            starts: Most points to search from; they are the same in every call.

        Raises:
            Unreachable: No position was found; it has the distance of the closest one, from its forward kinematics.
            CommandError: A seed of the wrong shape.
        """
        if not isinstance(pose, Pose):
            raise CommandError(f"pose must be a hal.Pose, not a {type(pose).__name__}")
        seed = self.home if q_seed is None else vector("q_seed", q_seed, self.n)
        return ik.solve(self, pose, seed, position_tolerance, rotation_tolerance, starts)

    def reach(self) -> tuple[float, ...]:
        """Return for each joint the greatest speed of the tcp, m/s, at 1 rad/s (or 1 m/s) of it, for all positions.

        The distance from a joint's axis to the tcp along the links is at least as long as any lever arm. The numbers do
        not grow from base to tip, and bound the change of the Jacobian, too: turning joint j by x rad turns or shifts
        every column of the linear part by at most ``reach[j] * x``.
        """
        return self._levers()[0]

    def farthest(self) -> float:
        """Return a bound on the distance of the tcp from the base frame's origin, m."""
        return self._levers()[1]

    def _levers(self) -> tuple[tuple[float, ...], float]:
        """Return bounds on the distances along the links from each joint, and from the base, to the tcp, m."""
        model = self._model
        frame = model.frames[self._tcp]
        joint, distance, least = int(frame.parentJoint), float(np.linalg.norm(frame.placement.translation)), 0.0
        reach = dict.fromkeys(self.spec.joints, 0.0)
        while joint > 0:
            name = str(model.names[joint])
            if "JointModelP" in model.joints[joint].shortname():  # it slides: 1 m/m, and it makes the distance longer
                least = 1.0
                k = self.spec.joints.index(name)
                distance += max(abs(self.spec.lower[k]), abs(self.spec.upper[k]))
            reach[name] = max(distance, least)
            distance += float(np.linalg.norm(model.jointPlacements[joint].translation))
            joint = int(model.parents[joint])
        return tuple(reach[name] for name in self.spec.joints), distance

    def _body_frame(self, link: str) -> int:
        frame = int(self._model.getFrameId(link, self._pin.FrameType.BODY))  # a joint may have the same name
        if frame >= self._model.nframes:
            links = [f.name for f in self._model.frames if f.type == self._pin.FrameType.BODY]
            text = f"no link {link!r} in {Path(self.spec.urdf).name}{suggest(link, links)}"
            raise DeviceNotFound(text, code="unknown_link")
        return frame

    def _reorder(self, q: Sequence[float] | Array) -> Array:
        values = np.asarray(q, float)
        if values.shape != self._shape:
            raise CommandError(f"q must have shape {self._shape}, not {values.shape}")
        return values if self._inverse_columns is None else values[self._inverse_columns]

    def _forward(self, q: Sequence[float] | Array) -> None:
        self._pin.forwardKinematics(self._model, self._data, self._reorder(q))


def _exponential(axis: Array, angle: float) -> Array:
    """Return the matrix exponential (4, 4) of a screw axis (6,), v then omega, by Rodrigues' formula."""
    matrix = np.eye(4)
    v, (x, y, z) = axis[:3], axis[3:]
    if not axis[3:].any():
        matrix[:3, 3] = angle * v
        return matrix
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    square, one = skew @ skew, np.eye(3)
    matrix[:3, :3] = one + sin(angle) * skew + (1.0 - cos(angle)) * square
    matrix[:3, 3] = (angle * one + (1.0 - cos(angle)) * skew + (angle - sin(angle)) * square) @ v
    return matrix


def reduced_model(spec: KinematicsSpec, pin: Any, others: Mapping[str, float] | None = None) -> Any:
    """Return pinocchio's model of the arm's joints alone, with the base link as its world frame.

    Args:
        spec: The arm.
        pin: The module.
        others: Positions of joints that are not the arm's, such as those of fingers, rad or m; absent ones are at 0.
    """
    full = pin.buildModelFromXML(bounded_urdf(spec.urdf))
    missing = [name for name in spec.joints if not full.existJointName(name)]
    if missing:
        raise ValueError(f"{spec.urdf} has no movable joint {', '.join(missing)}")
    locked = [k for k in range(1, full.njoints) if full.names[k] not in spec.joints]
    reference = pin.neutral(full)
    for name, value in (others or {}).items():
        if full.existJointName(name):
            reference[full.joints[full.getJointId(name)].idx_q] = value
    model = pin.buildReducedModel(full, locked, reference)
    if model.nq != len(spec.joints) or model.nv != len(spec.joints):
        raise ValueError(f"an arm's joints must turn or slide about one axis each: {', '.join(spec.joints)}")
    if spec.base_link is not None:
        base = model.frames[_frame(model, spec.base_link, spec)]
        if base.parentJoint != 0:
            raise ValueError(f"base link {spec.base_link} moves with the arm's joints")
        to_base = base.placement.inverse()
        for k in range(1, model.njoints):
            if model.parents[k] == 0:
                model.jointPlacements[k] = to_base * model.jointPlacements[k]
        for frame in model.frames:
            if frame.parentJoint == 0:
                frame.placement = to_base * frame.placement
    return model


def bounded_urdf(urdf: str) -> str:
    """Return the URDF's text with continuous joints made revolute: pinocchio has two numbers for a continuous one."""
    robot = parse_xml(urdf)
    for joint in robot.iter("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            for old in joint.findall("limit"):
                joint.remove(old)
            ElementTree.SubElement(joint, "limit", lower="-1e9", upper="1e9", effort="1e9", velocity="1e9")
    return ElementTree.tostring(robot, encoding="unicode")


def _frame(model: Any, link: str, spec: KinematicsSpec) -> int:
    import pinocchio as pin

    frame = int(model.getFrameId(link, pin.FrameType.BODY))  # a joint may have the same name
    if frame >= model.nframes:
        raise ValueError(f"{spec.urdf} has no link {link}")
    return frame


def add_tcp(model: Any, spec: KinematicsSpec, pin: Any) -> int:
    """Add the tool centre point to the model as a frame, and return its index."""
    link = model.frames[_frame(model, spec.tcp_link, spec)]
    offset = pin.XYZQUATToSE3(np.array([*spec.tcp_position, *Pose((0, 0, 0), spec.tcp_orientation).orientation]))
    frame = pin.Frame("hal_tcp", link.parentJoint, 0, link.placement * offset, pin.FrameType.OP_FRAME)
    return int(model.addFrame(frame))
