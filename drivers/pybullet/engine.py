"""PyBullet for one world: the library, the bodies that it holds, and how values from outside are checked.

PyBullet is imported when it is first used, and what its C code prints is kept off the terminal.
"""

from __future__ import annotations

import ctypes
import difflib
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import CommandError, DriverMissing
from hal.geometry import Transform, compose, inverse
from hal.specs import BodySpec, RobotSpec, from_json

from .scene import Visual

__all__ = [
    "Body",
    "CapturedOutput",
    "Gear",
    "PyBulletClient",
    "body_spec",
    "joint_positions",
    "link_frames",
    "listed",
    "load_pybullet",
    "nearest",
    "numbers",
    "pose_json",
    "silenced",
    "transform",
    "visuals_of",
]

GEAR_SHARE = 0.8
"""Share of the error between coupled joints that one physics step takes away."""
GEAR_FORCE = 10.0
"""Strength of a coupling, as a multiple of the effort of the joints that it couples."""
CONSTRAINT_ERP = 0.2
"""PyBullet's own share, by which it multiplies a gear's."""


# --- the library -----------------------------------------------------------------------------------------------------


class CapturedOutput:
    """What a silenced block printed; complete once the block has ended."""

    text: str = ""


@contextmanager
def silenced() -> Iterator[CapturedOutput]:
    """Capture what C code prints, for example PyBullet's import line and its URDF warnings.

    The file descriptors of the whole process are redirected: keep the block short.
    """
    captured = CapturedOutput()
    with tempfile.TemporaryFile() as file:
        _flush()
        kept = {}
        for descriptor in (1, 2):
            with suppress(OSError):  # a process may have closed them
                kept[descriptor] = os.dup(descriptor)
                os.dup2(file.fileno(), descriptor)
        try:
            yield captured
        finally:
            _flush()
            for descriptor, original in kept.items():
                os.dup2(original, descriptor)
                os.close(original)
            file.seek(0)
            captured.text = file.read().decode(errors="replace")


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # they may be replaced, or closed
            stream.flush()
    ctypes.CDLL(None).fflush(None)


def load_pybullet() -> Any:
    """Import and return the ``pybullet`` module.

    Raises:
        DriverMissing: It is not installed.
    """
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    try:
        with silenced():
            import pybullet
    except ImportError as error:
        raise DriverMissing(
            f"the simulation needs PyBullet ({error}); install it with: pip install 'robot-hal[sim]'"
        ) from error
    return pybullet


class PyBulletClient:
    """PyBullet's functions with the id of one world filled in; ``client.stepSimulation()`` steps that world.

    Each function is bound once, so a call costs no look-up (``pybullet_utils``' client binds it at every call).

    Args:
        gui: Open PyBullet's window.

    Raises:
        DriverMissing: PyBullet is not installed, or its window cannot open.
    """

    def __init__(self, *, gui: bool = False) -> None:
        self._module = load_pybullet()
        with silenced():
            self.id: int = self._module.connect(self._module.GUI if gui else self._module.DIRECT)
        if self.id < 0:
            raise DriverMissing("PyBullet could not open its window; is there a display (see the DISPLAY variable)?")

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._module, name)
        if isinstance(attribute, Callable) and not isinstance(attribute, type):  # type: ignore[arg-type]  # its error
            attribute = partial(attribute, physicsClientId=self.id)
        setattr(self, name, attribute)
        return attribute

    def close(self) -> None:
        """Delete the world and free its memory. Idempotent."""
        number, self.id = self.id, -1
        if number >= 0:
            with suppress(self._module.error):
                self._module.disconnect(physicsClientId=number)

    def __del__(self) -> None:
        if "id" in self.__dict__:  # __init__ completed
            self.close()


# --- bodies ----------------------------------------------------------------------------------------------------------


class Gear:
    """A coupling that makes one joint of a body follow another one.

    ``q[follower] = multiplier * q[leader]``, plus their difference when it is engaged. It acts between the two joints,
    so a finger that is blocked holds back the other one too.

    Args:
        body: PyBullet's number of the body.
        leader: Index of the joint that is followed.
        follower: Index of the joint that follows.
        multiplier: Ratio of their motions.
        effort: Greatest torque or force of the two joints, Nm or N.
    """

    def __init__(
        self, client: PyBulletClient, body: int, leader: int, follower: int, multiplier: float, effort: float
    ) -> None:
        self.joints = frozenset((leader, follower))
        self._client = client
        self._make = (body, leader, body, follower, client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0))
        self._set = {
            "gearRatio": -1.0 / multiplier,
            "erp": GEAR_SHARE / CONSTRAINT_ERP,
            "maxForce": GEAR_FORCE * effort,
        }
        self._number: int | None = None
        self.engage()

    def engage(self) -> None:
        """Couple the joints. Idempotent."""
        if self._number is None:
            self._number = self._client.createConstraint(*self._make)
            self._client.changeConstraint(self._number, **self._set)

    def release(self) -> None:
        """Uncouple the joints, which makes a physics step shorter. Idempotent."""
        if self._number is not None:
            self._client.removeConstraint(self._number)
            self._number = None


@dataclass
class Body:
    """A robot or an object: its PyBullet number, its names, and the frame in which its pose is given.

    PyBullet keeps a body's pose in the frame of its base link's *centre of mass* (its "inertial frame"); everything
    else uses the base link's own frame. ``inertial`` is the constant transform between the two.
    """

    name: str
    id: int
    """PyBullet's number."""
    spec: BodySpec | RobotSpec
    links: dict[str, int]
    """Link indices by name; the base link is -1."""
    joints: dict[str, int]
    """Indices of all joints by name, including fixed ones."""
    movable: tuple[int, ...]
    """Indices of the joints that move."""
    floating: bool
    """Whether physics can move its base."""
    inertial: Transform
    """The centre of mass's frame in the frame of the base link."""
    index: int = -1
    """Its place among the world's bodies: its value in segmentation images."""
    home: dict[int, float] = field(default_factory=dict)
    """Initial position of each movable joint: rad, or m."""
    efforts: dict[int, float] = field(default_factory=dict)
    """Greatest torque or force of each driven joint: Nm, or N."""
    speeds: dict[int, float] = field(default_factory=dict)
    """Greatest speed of each driven joint: rad/s, or m/s."""
    base: Transform = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    """Initial pose of the base link in the world."""
    damping: tuple[float, float] = (0.04, 0.04)
    """Linear and angular damping. PyBullet does not report them; 0.04 is its default."""
    gears: list[Gear] = field(default_factory=list)
    """Couplings between joints that move together (fingers)."""
    hardened: set[int] = field(default_factory=set)
    """Links whose contacts were made soft and then hard again (see :mod:`.dynamics`)."""

    def __post_init__(self) -> None:
        self.link_names = {index: name for name, index in self.links.items()}

    @property
    def is_robot(self) -> bool:
        """Whether this is an arm."""
        return isinstance(self.spec, RobotSpec)

    @property
    def carried(self) -> bool:
        """Whether it is attached to a link of an arm."""
        return isinstance(self.spec, BodySpec) and self.spec.robot is not None

    @property
    def roams(self) -> bool:
        """Whether its base may be elsewhere after the next step."""
        return self.floating or self.carried

    @property
    def moves(self) -> bool:
        """Whether its base or any joint may move."""
        return self.roams or bool(self.movable)

    def base_pose(self, client: PyBulletClient) -> Transform:
        """Return the pose of the base link in the world."""
        return compose(client.getBasePositionAndOrientation(self.id), inverse(self.inertial))

    def set_base_pose(self, client: PyBulletClient, pose: Transform) -> None:
        """Place the base link at ``pose`` in the world. Velocities stay."""
        client.resetBasePositionAndOrientation(self.id, *compose(pose, self.inertial))


# --- what there is to draw -------------------------------------------------------------------------------------------


def visuals_of(client: PyBulletClient, body: int) -> tuple[Visual, ...]:
    """Return the visual shapes of the body with PyBullet's number ``body``."""
    kinds = {
        client.GEOM_MESH: "mesh",
        client.GEOM_BOX: "box",
        client.GEOM_SPHERE: "sphere",
        client.GEOM_CYLINDER: "cylinder",
        client.GEOM_CAPSULE: "capsule",
        client.GEOM_PLANE: "plane",
    }
    found = []
    for _, link, number, size, file, position, orientation, rgba, *_ in client.getVisualShapeData(body):
        kind = kinds.get(number)
        if kind == "sphere":
            size = size[:1]
        elif kind in ("cylinder", "capsule"):
            size = (size[1], size[0])  # PyBullet gives the length first
        if kind is not None:
            found.append(Visual(link, kind, tuple(size), file.decode(), position, orientation, rgba))
    return tuple(found)


def link_frames(client: PyBulletClient, links: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Return the poses (N, 4, 4) in the world of the frames of links.

    Args:
        links: (body, link) by PyBullet's numbers, -1 for a base; those of one body together.
    """
    wanted: dict[int, list[int]] = {}
    for body, link in links:
        wanted.setdefault(body, []).append(link)
    frames: list[tuple[float, ...]] = []
    for body, indices in wanted.items():
        moving = [link for link in indices if link >= 0]
        states = iter(client.getLinkStates(body, moving, computeForwardKinematics=1) if moving else ())
        for link in indices:
            if link >= 0:
                state = next(states)
                frames.append((*state[4], *state[5]))
            else:  # PyBullet gives the base by its centre of mass
                inertial = client.getDynamicsInfo(body, -1)[3:5]
                centre = client.getBasePositionAndOrientation(body)
                position, orientation = client.multiplyTransforms(*centre, *client.invertTransform(*inertial))
                frames.append((*position, *orientation))
    return _matrices(np.array(frames).reshape(-1, 7))


def _matrices(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (N, 7), position and quaternion, as matrices (N, 4, 4)."""
    x, y, z, w = poses[:, 3:].T
    matrices = np.zeros((len(poses), 4, 4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    for k, row in enumerate(rows):
        for column, values in enumerate(row):
            matrices[:, k, column] = values
    matrices[:, :3, 3] = poses[:, :3]
    matrices[:, 3, 3] = 1
    return matrices


# --- values from outside ---------------------------------------------------------------------------------------------


def numbers(name: str, values: Any, size: int | None = None) -> list[float]:
    """Return ``values`` as ``size`` finite floats; raises CommandError for anything else."""
    try:
        floats = [float(value) for value in values]
    except (TypeError, ValueError):
        raise CommandError(f"{name} must be {size or 'some'} numbers, not {values!r}") from None
    if size is not None and len(floats) != size:
        raise CommandError(f"{name} must be {size} numbers, not {len(floats)}", code="wrong_size")
    if not all(map(math.isfinite, floats)):
        raise CommandError(f"{name} holds a number that is not finite: {floats}", code="not_finite")
    return floats


def transform(pose: object) -> Transform:
    """Return the transform of a pose ``{"position": (3,), "orientation": (4,) xyzw}``; the orientation is optional.

    Raises:
        CommandError: It is no such pose, or its orientation is zero.
    """
    if not isinstance(pose, Mapping) or not set(pose) <= {"position", "orientation"} or "position" not in pose:
        raise CommandError(f"a pose is {{'position': [x, y, z], 'orientation': [x, y, z, w]}}, not {pose!r}")
    position = numbers("position", pose["position"], 3)
    orientation = numbers("orientation", pose.get("orientation", (0.0, 0.0, 0.0, 1.0)), 4)
    norm = math.hypot(*orientation)
    if norm < 1e-9:
        raise CommandError("orientation must not be zero")
    return tuple(position), tuple(value / norm for value in orientation)


def pose_json(pose: Transform) -> dict[str, list[float]]:
    """Return a pose as JSON."""
    return {"position": list(pose[0]), "orientation": list(pose[1])}


def body_spec(data: Mapping[str, Any]) -> BodySpec:
    """Return the record of an object from its JSON; raises CommandError."""
    try:
        return from_json(BodySpec, dict(data))
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise CommandError(f"not the record of a body: {error}") from None


def joint_positions(body: Body, q: Sequence[float]) -> dict[int, float]:
    """Return joint index -> position for the ``q`` of a reset.

    ``q`` has an arm's joints, optionally its fingers after them; for an object, all its movable joints. Raises
    CommandError.
    """
    values = numbers("q", q)
    joints, fingers = list(body.movable), []
    if isinstance(body.spec, RobotSpec):
        joints = [body.joints[name] for name in body.spec.joints]
        fingers = [body.joints[name] for name in body.spec.gripper.joints] if body.spec.gripper else []
    if len(values) == len(joints) + len(fingers):
        joints += fingers
    if len(values) != len(joints):
        raise CommandError(f"q of {body.name!r} must be {len(joints)} numbers, not {len(values)}", code="wrong_size")
    return dict(zip(joints, values, strict=True))


def nearest(name: str, names: Iterable[str]) -> str:
    """Return the end of an error message: the closest known name, and all known names."""
    known = list(names)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"{hint} There are: {', '.join(known)}" if known else "; there is none"


def listed(names: Sequence[str], most: int = 3) -> str:
    """Return names for a message: the first ones, and how many more there are."""
    more = len(names) - most
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:most])} and {more} more"
