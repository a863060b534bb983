"""The simulated world of a rig: bodies, poses, dynamics and contacts. Simulation only.

:class:`World` is what research code holds as ``rig.world``; :class:`WorldDriver` is what a physics engine implements.
"""

from __future__ import annotations

import copy
import json
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import freeze
from .errors import CommandError, NotSupported
from .geometry import Pose
from .randomization import Randomizer
from .specs import BodySpec, WorldSpec, from_json, to_json

Array = NDArray[np.float64]


class Contact(NamedTuple):
    """Contact of two bodies."""

    a: str
    b: str
    link_a: str | None
    link_b: str | None
    position: Array
    """Point on ``b``, in the world, m."""
    normal: Array
    """Unit vector from ``b`` to ``a``."""
    distance: float
    """Distance, m; negative if they overlap."""
    force: float
    """Force along the normal, N."""


class Contacts(tuple[Contact, ...]):
    """The contacts of one step."""

    t: float | None
    """Time of that step, s on ``rig.clock``; None if the world was edited or reset since: there are none then, as no
    step has computed them."""

    def __new__(cls, contacts: Iterable[Contact], t: float | None) -> Contacts:
        """Return contacts (``contacts``) of the step at ``t``, s."""
        made = super().__new__(cls, contacts)
        made.t = t
        return made


class WorldState(dict[str, Any]):
    """State of a world, from :meth:`World.save`: plain numbers, texts, lists and dicts, so that it can be JSON."""

    def to_bytes(self) -> bytes:
        """Return the state as compressed JSON, for :meth:`from_bytes`; every number is exact."""
        return zlib.compress(json.dumps(self, separators=(",", ":"), allow_nan=False).encode(), 1)

    @classmethod
    def from_bytes(cls, data: bytes) -> WorldState:
        """Return the state that ``data`` of :meth:`to_bytes` holds; CommandError (``wrong_state``) if it is none."""
        try:
            found = json.loads(zlib.decompress(data))
        except (zlib.error, ValueError, TypeError) as error:
            raise CommandError(f"not the bytes of a state of a world: {error}", code="wrong_state") from None
        if not isinstance(found, dict):
            raise CommandError("not the bytes of a state of a world", code="wrong_state")
        return cls(found)


class Poses(NamedTuple):
    """Poses of bodies at one moment."""

    t: float
    """Time of the world, s on ``rig.clock``."""
    poses: Mapping[str, Pose]
    """Pose of each body's base in the world, by the body's name."""


class BodyJoint(NamedTuple):
    """A joint of a body that moves."""

    kind: str
    """``revolute``, ``continuous`` or ``prismatic``."""
    lower: float | None
    """Least position, rad or m; None without a limit."""
    upper: float | None
    damping: float
    """Force or torque against a speed, Nm s/rad or Ns/m: the URDF's. An arm's motors compensate it."""
    friction: float
    """Force or torque of dry friction, Nm or N: the URDF's."""
    follows: str | None = None
    """The joint that it follows (a URDF's ``<mimic>``)."""


class RayHit(NamedTuple):
    """What a ray meets first."""

    name: str
    """The body."""
    link: str
    position: Array
    """Point on the body, (3,) m in the world."""
    normal: Array
    """Unit vector (3,) out of the body."""
    distance: float
    """Distance from the start of the ray, m."""


class World:
    """The simulated world, ``rig.world``. Every call runs between two physics steps.

    An unknown body or link raises DeviceNotFound, which lists the known ones. Poses are in the world's frame.

    Args:
        request: Sends a request to the process of the simulation.
        edited: Called after every edit that changes what is drawn, with the method, its parameters and the new
            revision.
        spec: Record of the world; None for one that varies nothing.
    """

    def __init__(
        self,
        request: Callable[[str, dict[str, Any]], Any],
        edited: Callable[[str, Any, int], None],
        spec: WorldSpec | None = None,
    ) -> None:
        self._request = request
        self._edited = edited
        self._randomizer = Randomizer(spec)

    def _call(self, method: str, **params: Any) -> Any:
        return self._request(f"world.{method}", params)

    def _edit(self, method: str, **params: Any) -> None:
        self._edited(method, params, int(self._call(method, **params)))

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies; the index here is the number in ``Frame.segmentation``."""
        return tuple(self._call("names"))

    def add(self, body: BodySpec) -> None:
        """Add a body; if it overlaps another one there, ``rig.notes`` says so.

        Raises:
            ConfigError: It cannot be loaded; lists every problem.
            CommandError: Not a :class:`hal.BodySpec` (``code`` is ``not_a_body``).
        """
        given: object = body
        if not isinstance(given, BodySpec):
            text = "add takes a hal.BodySpec(name, position, orientation, shape, ...), not"
            raise CommandError(f"{text} {type(given).__name__}", code="not_a_body")
        self._edit("add", spec=to_json(given))

    def remove(self, name: str) -> None:
        """Remove a body. Robots cannot be removed."""
        self._edit("remove", name=name)

    def set_color(self, name: str, rgba: Sequence[float]) -> None:
        """Change the colour of a body.

        Args:
            name: Name of the body.
            rgba: Red, green, blue and opacity, 0..1.
        """
        self._edit("set_color", name=name, rgba=[float(value) for value in rgba])

    def randomize(self, seed: int | Mapping[str, Any] | None = None) -> dict[str, Any] | None:
        """Vary the scene as ``simulation.randomize`` of the rig file says: looks, cameras, physics, delays and noise.

        Poses stay; distractors that are drawn are added where they are configured. A reset of a scene, for example by
        ``hal generate`` or :class:`hal.gym.RigEnv`, does this with the seed of the episode.

        Args:
            seed: Seed of what is drawn, the same for every engine; or :attr:`randomization` of another time, as an
                episode has it, for the same values again; or None for those of the rig file.

        Returns:
            :attr:`randomization`.

        Raises:
            CommandError: The rig file has no ranges (``code`` is ``no_randomize``), or the record is of another one
                (``bad_record``).
        """
        randomizer = self._randomizer
        record = None if seed is None else randomizer.make_record(seed)
        if record is not None or not randomizer.clean:
            self._edit("randomize", **randomizer.apply(self, record))
            randomizer.record, randomizer.clean = record, record is None
        return self.randomization

    @property
    def randomization(self) -> dict[str, Any] | None:
        """``seed`` and drawn ``values`` by key of what :meth:`randomize` applied last, as JSON; None without it."""
        return copy.deepcopy(self._randomizer.record)

    def pose(self, name: str, link: str | None = None) -> Pose:
        """Return the true pose of a body in the world.

        Args:
            name: Name of the body.
            link: Name of a link; None for the base.
        """
        return _decode_pose(self._call("pose", name=name, link=link))

    def poses(self, names: Collection[str] | None = None) -> Poses:
        """Return the poses of several bodies' bases at one moment, in one request; of all bodies by default."""
        found = self._call("poses", names=None if names is None else list(names))
        return Poses(float(found["t"]), {name: _decode_pose(pose) for name, pose in found["poses"].items()})

    def set_pose(self, name: str, pose: Pose) -> None:
        """Place a body, at rest. Robots are moved by their servo, or by :meth:`reset`."""
        self._call("set_pose", name=name, pose=_encode_pose(pose))

    def spec(self, name: str) -> BodySpec:
        """Return the record of an object: its shape, size and mass as it was loaded or added.

        Raises:
            CommandError: It is a robot, whose record is ``rig.robots[name].spec`` (``code`` is ``is_robot``).
        """
        found = self._call("describe", name=name)
        if found["robot"]:
            raise CommandError(f"{name!r} is a robot: its record is rig.robots[{name!r}].spec", code="is_robot")
        return from_json(BodySpec, found["spec"])

    def links(self, name: str) -> tuple[str, ...]:
        """Return the names of a body's links; the first one is the base."""
        return tuple(self._call("describe", name=name)["links"])

    def joints(self, name: str) -> dict[str, BodyJoint]:
        """Return the joints of a body that move, by name, in the order of the URDF."""
        movable = self._call("describe", name=name)["movable"]
        return {joint: BodyJoint(**facts) for joint, facts in movable.items()}

    def joint_positions(self, name: str) -> dict[str, float]:
        """Return the position of each joint of :meth:`joints`, rad or m."""
        return dict(self._call("joint_positions", name=name))

    def set_joint_positions(self, name: str, positions: Mapping[str, float]) -> None:
        """Place joints of an object, such as a drawer or a door, at rest; joints that follow one of them, too.

        Args:
            name: Name of the object. Robots are moved by their servo, or by :meth:`reset`.
            positions: Position by the name of the joint, rad or m; other joints stay.

        Raises:
            DeviceNotFound: No such joint; lists the existing ones.
            CommandError: A position is outside of the joint's range (``code`` is ``out_of_range``), or the joint
                follows another one (``joint_follows``).
        """
        self._call("set_joint_positions", name=name, positions={key: float(value) for key, value in positions.items()})

    def velocity(self, name: str) -> tuple[Array, Array]:
        """Return the linear (3,) m/s and the angular (3,) rad/s velocity of a body's base, in the world."""
        linear, angular = self._call("velocity", name=name)
        return freeze(linear), freeze(angular)

    def set_velocity(self, name: str, linear: ArrayLike = (0, 0, 0), angular: ArrayLike = (0, 0, 0)) -> None:
        """Set the linear (3,) m/s and the angular (3,) rad/s velocity of a body's base, in the world."""
        self._call(
            "set_velocity",
            name=name,
            linear=np.asarray(linear, float).tolist(),
            angular=np.asarray(angular, float).tolist(),
        )

    def apply_force(
        self,
        name: str,
        force: ArrayLike,
        point: ArrayLike | None = None,
        *,
        link: str | None = None,
        duration: float | None = None,
    ) -> None:
        """Push a body with a constant force; forces on one body add up, and a reset of the body ends them.

        Args:
            name: An object or an arm.
            force: Force (3,) in the world, N.
            point: Point (3,) in the world where it acts now, m; the point moves with the link. None for the link's
                centre of mass.
            link: Name of the link; None for the base, which must be free.
            duration: Time for which it acts, s of simulated time; None for the next physics step only.

        Raises:
            CommandError: The link's base is fixed, or attached to an arm, or a number is impossible.
        """
        self._call(
            "apply_force",
            name=name,
            force=np.asarray(force, float).tolist(),
            point=None if point is None else np.asarray(point, float).tolist(),
            link=link,
            duration=duration,
        )

    def set_gravity(self, gravity: ArrayLike) -> Array:
        """Set the acceleration (3,) that gravity causes, m/s2 in the world; a reset keeps it.

        Returns:
            The gravity before, for a later call.
        """
        return freeze(self._call("set_gravity", gravity=np.asarray(gravity, float).tolist()))

    def ray(self, start: ArrayLike, end: ArrayLike) -> RayHit | None:
        """Return what a straight ray meets first; None if nothing with a collision shape is in its way.

        Args:
            start: Point (3,) in the world, m, outside of all bodies: whether a body around it counts depends on the
                engine.
            end: Point (3,) in the world where the ray ends, m.
        """
        found = self._call("ray", start=np.asarray(start, float).tolist(), end=np.asarray(end, float).tolist())
        if found is None:
            return None
        return RayHit(**(found | {"position": freeze(found["position"]), "normal": freeze(found["normal"])}))

    def distance(self, a: str, b: str, link_a: str | None = None, link_b: str | None = None) -> float:
        """Return the smallest distance between the collision shapes of two bodies, m; negative if they overlap.

        Args:
            a: Name of a body.
            b: Name of another body.
            link_a: Only this link of ``a``; None for all of it.
            link_b: Only this link of ``b``.

        Raises:
            CommandError: One of them has no collision shape (``code`` is ``no_shape``).
        """
        return float(self._call("distance", a=a, b=b, link_a=link_a, link_b=link_b))

    def dynamics(self, name: str, link: str | None = None) -> dict[str, Any]:
        """Return mass (kg), frictions, restitution, dampings, and contact stiffness and damping of a body or link."""
        return dict(self._call("dynamics", name=name, link=link))

    def set_dynamics(self, name: str, link: str | None = None, **values: float) -> dict[str, Any]:
        """Change properties of a body or link.

        Args:
            name: Name of the body.
            link: Name of a link; None for the base.
            **values: Properties by the names of :meth:`dynamics`.

        Returns:
            These properties as they were before, for a later call.
        """
        return dict(self._call("set_dynamics", name=name, link=link, **values))

    @contextmanager
    def change_dynamics(self, name: str, link: str | None = None, **values: float) -> Iterator[None]:
        """Change some of the values of :meth:`dynamics` for the duration of a ``with`` block."""
        before = self.set_dynamics(name, link, **values)
        try:
            yield
        finally:
            self.set_dynamics(name, link, **before)

    def contacts(self, a: str | None = None, b: str | None = None) -> Contacts:
        """Return the contacts of the last step; none, with ``t`` None, directly after an edit or a reset.

        Args:
            a: Only those of this body.
            b: Only those between ``a`` and this body.
        """
        found = self._call("contacts", a=a, b=b, stamped=True)
        contacts = (
            Contact(**(contact | {"position": freeze(contact["position"]), "normal": freeze(contact["normal"])}))
            for contact in found["contacts"]
        )
        return Contacts(contacts, found["t"])

    def aabb(self, name: str) -> tuple[Array, Array]:
        """Return the lower and the upper corner (3,) of a body's axis-aligned bounding box in the world, m."""
        found = self._call("aabb", name=name)
        return freeze(found["lower"]), freeze(found["upper"])

    def reset(self, name: str | None = None, *, pose: Pose | None = None, q: ArrayLike | None = None) -> None:
        """Reset one body, or everything, to its configured pose and joint positions, at rest.

        Args:
            name: Body or robot; None for all.
            pose: Pose of the body in the world, instead of the configured one.
            q: Joint positions (n,) of an arm, rad, instead of the configured ones.
        """
        params: dict[str, Any] = {"name": name}
        if pose is not None:
            params["pose"] = _encode_pose(pose)
        if q is not None:
            params["q"] = np.asarray(q, float).tolist()
        self._request("world.reset", params)

    def save(self) -> WorldState:
        """Return the state of the world: positions, velocities, forces, what the solver keeps, the arms' set-points.

        Colours, dynamics, gravity and added or removed bodies are no part of it, nor is the time.

        Returns:
            A record for :meth:`restore`, which can be written as JSON, or as bytes. What is inside depends on the
            engine.
        """
        return WorldState(self._call("save"))

    def restore(self, state: Mapping[str, Any]) -> None:
        """Put the world into a state of :meth:`save`, also one of another world with the same bodies.

        Simulated time continues. Arms hold, with the set-point that they had; an open control session waits there for
        a new command, as after :meth:`reset`. Mirrors of real arms stay where these arms are.

        Args:
            state: The record.

        Raises:
            CommandError: It is no such record, or one of another engine or of other bodies, which the message names
                (``code`` is ``wrong_state``); nothing changes.
        """
        self._call("restore", state=state)


class NoWorld:
    """Stands for ``rig.world`` if nothing is simulated: every use of it raises NotSupported."""

    def __getattr__(self, name: str) -> Any:
        raise NotSupported("rig.world exists in simulation only: this rig has no simulated world")


class WorldDriver(ABC):
    """Driver of a simulated world, in the process that steps it; the devices of the same driver are views of it.

    All methods are called from one thread, between two steps. The requests of ``rig.world`` take and return plain
    numbers, lists and dicts, so that they can be sent as JSON:

    =================  ======================================  ========================================================
    request            parameters                              result
    =================  ======================================  ========================================================
    ``names``          none                                    names of the bodies, objects first, as they were added
    ``describe``       ``name``                                ``index`` in segmentation images, ``robot`` (a bool),
                                                               names of ``links`` and ``joints``, ``movable``: the
                                                               fields of each :class:`BodyJoint` by name, and ``spec``:
                                                               those of an object's :class:`.BodySpec`, None for a robot
    ``joint_positions``  ``name``                              position by joint that moves, rad or m
    ``pose``           ``name``, ``link``                      ``position`` (3,) m and ``orientation`` (4,) xyzw of a
                                                               link's own frame in the world; of the base for None
    ``poses``          ``names``                               ``poses`` of bases by name and ``t``, s
    ``velocity``       ``name``                                linear (3,) m/s, angular (3,) rad/s
    ``dynamics``       ``name``, ``link``                      properties by name
    ``contacts``       ``a``, ``b``, ``stamped``               the fields of each :class:`Contact`; with ``stamped``
                                                               these as ``contacts``, and ``t`` of the step, s, or None
    ``aabb``           ``name``                                ``lower`` and ``upper`` (3,) m
    ``ray``            ``start``, ``end``                      the fields of a :class:`RayHit`, or None
    ``distance``       ``a``, ``b``, ``link_a``, ``link_b``    m
    ``add``            ``spec``, of a :class:`.BodySpec`       the new revision
    ``remove``         ``name``                                the new revision
    ``set_color``      ``name``, ``rgba``                      the new revision
    ``randomize``      ``values``, ``seed``                    the new revision
    ``set_pose``       ``name``, ``pose``                      none
    ``set_velocity``   ``name``, ``linear``, ``angular``       none
    ``set_joint_positions``  ``name``, ``positions``           none
    ``set_dynamics``   ``name``, ``link``, properties          these properties as they were before
    ``apply_force``    those of :meth:`World.apply_force`      none
    ``set_gravity``    ``gravity``                             the gravity before, (3,) m/s2
    ``reset``          ``name``, ``pose``, ``q``               none
    ``save``           none                                    the state, for ``restore``
    ``restore``        ``state``                               none
    =================  ======================================  ========================================================

    Raises:
        ConfigError: Something in the record cannot be loaded; lists every problem.
        DriverMissing: The physics engine is not installed.
    """

    REQUESTS: ClassVar[frozenset[str]] = frozenset(
        {
            *("names", "describe", "pose", "poses", "velocity", "dynamics", "contacts", "aabb", "ray", "distance"),
            *("joint_positions", "set_joint_positions"),
            *("add", "remove", "set_color", "set_pose", "set_velocity", "set_dynamics", "apply_force", "set_gravity"),
            *("randomize", "reset", "save", "restore"),
        }
    )
    """Names of the requests."""
    MIRRORED: ClassVar[frozenset[str]] = frozenset({"add", "remove", "set_color", "randomize"})
    """Requests that change what is drawn beyond poses. Each one that succeeds adds one to :attr:`revision`; what draws
    the world repeats them, in their order, before it displays a snapshot of that revision."""

    def __init__(self, spec: WorldSpec) -> None:
        self.spec = spec
        self.dt = 1.0 / spec.physics_hz
        """One step, s."""
        self.steps = 0
        """Number of steps so far."""
        self.revision = 0
        """Number of edits of :attr:`MIRRORED` so far."""
        self.warnings: list[str] = []
        """Messages for the user about the files that were loaded."""

    @property
    def t(self) -> float:
        """Simulated time, s."""
        return self.steps * self.dt

    @property
    @abstractmethod
    def version(self) -> tuple[int, int]:
        """Changes whenever anything may look different: after a step, an edit or a reset."""

    def stamp(self, now: float) -> float:
        """Return the time of the present state on the group's clock, s; ``now`` is that of the cycle that ends."""
        return now

    @abstractmethod
    def step(self) -> None:
        """Advance the world by :attr:`dt`."""

    @abstractmethod
    def request(self, method: str, params: Mapping[str, Any]) -> Any:
        """Serve one of :attr:`REQUESTS`.

        Returns:
            Its result, as JSON.

        Raises:
            DeviceNotFound: No body or link of that name; lists the existing ones.
            CommandError: No such request, parameters that it does not take, or impossible numbers; nothing changes.
            ConfigError: A body cannot be loaded; nothing changes.
            NotSupported: The engine has no such quantity; the message has what to use instead.
        """

    @abstractmethod
    def follow(self, name: str, q: Sequence[float], dq: Sequence[float], width: float | None = None) -> None:
        """Place the mirror of a real arm where that arm is; to be called for every step, else the mirror stays.

        Args:
            name: An arm of the world that another driver moves.
            q: Joint positions (n,), rad.
            dq: Joint speeds (n,) during the next step, rad/s.
            width: Width of its gripper, m; None if it is unknown.

        Raises:
            DeviceNotFound: No such body.
            CommandError: The arm is simulated, or the numbers are not n finite ones. The mirror stays.
        """

    @abstractmethod
    def snapshot(self) -> list[float]:
        """Return the poses of all bodies, in a layout that does not depend on the engine.

        First the base poses of all bodies with a fixed base, then, for each other body or body with joints, in the
        order of ``names``: the pose of its base unless that is fixed, and the positions of its movable joints (rad or
        m) in the order of its URDF. A pose has 7 numbers, position (3,) m and orientation (4,) xyzw of the base link's
        own frame in the world.
        """

    @abstractmethod
    def on_reset(self, name: str, callback: Callable[[], None]) -> None:
        """Call ``callback`` after each reset of the robot of that name."""

    @abstractmethod
    def off_reset(self, name: str, callback: Callable[[], None]) -> None:
        """Remove a callback of :meth:`on_reset`."""

    @abstractmethod
    def keep(self, name: str, save: Callable[[], Any], restore: Callable[[Any], None]) -> None:
        """Save and restore the state of a driver with the world's.

        Args:
            name: Name of the driver's device, unique in the world; a later call replaces the functions.
            save: Returns the state, as JSON.
            restore: Takes that state, after the world has been restored.
        """

    @abstractmethod
    def on_edit(self, callback: Callable[[str, dict[str, Any], int], None]) -> None:
        """Call ``callback`` with the method, the parameters and the new revision after each edit that is mirrored."""

    @abstractmethod
    def close(self) -> None:
        """Delete the world and free its memory. Idempotent."""


def _decode_pose(data: Mapping[str, Any] | Sequence[Any]) -> Pose:
    if isinstance(data, Mapping):
        return Pose(data["position"], data["orientation"])
    return Pose(*data)


def _encode_pose(pose: Pose) -> dict[str, list[float]]:
    if not isinstance(pose, Pose):
        raise CommandError(f"pose must be a hal.Pose, not {type(pose).__name__}", code="not_a_pose")
    return {"position": pose.position.tolist(), "orientation": pose.orientation.tolist()}
