"""The simulated world of a rig: one PyBullet client that simulated arms, grippers and cameras are views of.

The same class is the world that is stepped and each of its mirrors (the renderer's, the viewer's). A mirror is made
from the same record and never stepped: it replays the edits of :attr:`PyBulletWorld.MIRRORED` in their order, which
keeps the order of the bodies the same, and :meth:`PyBulletWorld.show` poses it by a :meth:`PyBulletWorld.snapshot` of
that revision.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hal.errors import CommandError, ConfigError, DeviceNotFound, NotSupported, Problem
from hal.geometry import Transform
from hal.specs import BodySpec, RobotSpec, WorldSpec

from .attachments import AttachedObjects, MirroredArm
from .dynamics import bounding_box, deepest_overlap, find_contacts, forget_contacts, read_dynamics, write_dynamics
from .engine import (
    Body,
    PyBulletClient,
    body_spec,
    joint_positions,
    link_frames,
    nearest,
    numbers,
    pose_json,
    transform,
    visuals_of,
)
from .loading import load_object, load_robot
from .motors import hold
from .scene import Visual

__all__ = [
    "PyBulletWorld",
    "SnapshotLayout",
]

ENGINE: dict[str, Any] = {
    "deterministicOverlappingPairs": 1,
    "minimumSolverIslandSize": 1,
    "numSolverIterations": 100,
}
"""Settings of PyBullet's solver.

Each group of bodies that touch is solved by itself: PyBullet solves small groups together, which gives the same numbers
and makes every group wait for the slowest. With PyBullet's own limit of 50 iterations, fingers do not reach a great
force, and fast arms exceed their speed limits a little."""
RESIDUAL = {"fine": 1e-7, "coarse": 3e-6}
"""The solver stops once no speed changes by more than the root of this in an iteration, m/s or rad/s: 0.3 and 1.7 mm/s.

"fine" is PyBullet's own, and needed while fingers move slowly or hold something. With "coarse" a step takes less time,
and an arm follows less exactly: ``benchmarks/world_tick.py`` prints both."""
OVERLAP = 0.005
"""Depth, m, from which on two arms that overlap at the start are refused."""


class PyBulletWorld:
    """One simulation and all bodies in it.

    Public methods whose names are in :attr:`REQUESTS` are the queries and edits of ``rig.world``; they take and return
    plain numbers, lists and dicts, so that they can be sent as JSON (:meth:`request`). Poses are dicts of ``position``
    (3,) m and ``orientation`` (4,) xyzw, of a link's own frame, in the world.

    Args:
        spec: The record of the world.
        mirror: The world is posed by snapshots and never stepped.
        gui: Open PyBullet's window.
        drawn: Load visual meshes, because this very world is drawn. Without them loading takes less time and memory.

    Raises:
        ConfigError: Something in the record cannot be loaded; lists every problem.
        DriverMissing: PyBullet is not installed, or its window cannot open.
    """

    REQUESTS: ClassVar[frozenset[str]] = frozenset(
        {
            *("names", "describe", "pose", "poses", "velocity", "dynamics", "contacts", "aabb"),
            *("add", "remove", "set_color", "set_pose", "set_velocity", "set_dynamics", "reset"),
        }
    )
    MIRRORED: ClassVar[frozenset[str]] = frozenset({"add", "remove", "set_color"})
    """Edits that change what is drawn beyond poses. Each one that succeeds adds one to :attr:`revision`; mirrors
    replay them (``mirror.request(method, params)``) before they show a snapshot of that revision."""

    def __init__(self, spec: WorldSpec, *, mirror: bool = False, gui: bool = False, drawn: bool = True) -> None:
        self.spec = spec
        self.mirror = mirror
        self.drawn = drawn
        self.dt = 1.0 / spec.physics_hz
        """One physics step, s."""
        self.steps = 0
        self.revision = 0
        self._changes = 0
        self.bodies: dict[str, Body] = {}
        self.warnings: list[str] = []
        """Warnings for the user about the files that were loaded."""
        self.client = PyBulletClient(gui=gui)
        self._on_reset: dict[str, list[Callable[[], None]]] = {}
        self._mirrored: dict[str, MirroredArm] = {}
        """Mirrors of arms that other drivers move."""
        self._handling = {robot.name for robot in spec.robots if robot.gripper is not None}
        """Robots whose fingers may move or hold something."""
        try:
            self.client.setTimeStep(self.dt)
            self.client.setGravity(*spec.gravity)
            self.client.setPhysicsEngineParameter(**ENGINE)
            self._set_residual()
            self._load((*spec.bodies, *spec.robots))
            if not mirror:
                self._check_overlaps()
        except BaseException:
            self.close()
            raise
        self._step = self.client.stepSimulation

    def _load(self, specs: Sequence[BodySpec | RobotSpec]) -> None:
        problems: list[Problem] = []
        for spec in specs:
            try:
                self._place(spec)
            except ConfigError as error:
                problems.extend(error.problems)
        if problems:
            raise ConfigError(problems)
        try:
            self._attached = AttachedObjects(self.client, self.bodies)
        except ConfigError:  # something is attached to a missing arm or link
            for spec in specs:
                self.client.removeBody(self.bodies.pop(spec.name).id)
            self._arrange()
            raise
        self._arrange()
        self._attached.leave_physics(self.bodies[spec.name] for spec in specs)
        self._attached.follow()

    def _check_overlaps(self) -> None:
        """Refuse arms that overlap at the start: the solver would throw them apart."""
        robots = [body for body in self.bodies.values() if body.is_robot and body.name not in self._mirrored]
        problems = []
        for a, b in combinations(robots, 2):
            depth, link_a, link_b = deepest_overlap(self.client, a, b)
            if depth > OVERLAP:
                message = f"starts {depth:.3f} m inside robot {a.name!r} (its {link_b} in {link_a})"
                remedy = "change its base or initial; a URDF with two arms is loaded whole for every entry: split it"
                problems.append(Problem("simulation", f"robots.{b.name}", f"{message}; {remedy}", "robots_overlap"))
        if problems:
            raise ConfigError(problems)

    def _place(self, spec: BodySpec | RobotSpec) -> Body:
        if spec.name in self.bodies:
            message = "names two bodies; names must be unique in the world"
            raise ConfigError([Problem("world", spec.name, message, "duplicate_name")])
        if isinstance(spec, RobotSpec):
            body, warnings = load_robot(self.client, spec, self.drawn)
        else:
            body, warnings = load_object(self.client, spec, self.drawn)
        self.bodies[spec.name] = body
        self.warnings += warnings
        self._put_home(body)
        if isinstance(spec, RobotSpec) and spec.driver != self.spec.driver:
            self._mirrored[spec.name] = MirroredArm(self.client, body, self.dt)
        return body

    @property
    def client_id(self) -> int:
        """PyBullet's ``physicsClientId``."""
        return self.client.id

    @property
    def t(self) -> float:
        """Simulated time, s."""
        return self.steps * self.dt

    @property
    def version(self) -> tuple[int, int]:
        """Changes whenever anything may look different: after a step, an edit or a reset."""
        return self.steps, self._changes

    def step(self) -> None:
        """Make one physics step."""
        if self.mirror:
            raise NotSupported("a mirror is posed by show(), never stepped")
        for arm in self._mirrored.values():
            arm.prepare_step()
        self._step()
        self._attached.follow()
        self.steps += 1

    def close(self) -> None:
        """Delete the world. Idempotent."""
        self.bodies = {}
        self._mirrored = {}
        self.client.close()

    # --- requests of rig.world -----------------------------------------------------------------------------------

    def request(self, method: str, params: Mapping[str, Any]) -> Any:
        """Call one of :attr:`REQUESTS` by name.

        Args:
            method: Name of the method.
            params: Its arguments, as JSON.

        Returns:
            Its result, as JSON.

        Raises:
            DeviceNotFound: No body or link of that name; lists the existing ones.
            CommandError: No such method, arguments that it does not take, or impossible numbers.
        """
        if method not in self.REQUESTS:
            raise CommandError(f"the world has no request {method!r}; requests: {', '.join(sorted(self.REQUESTS))}")
        function = getattr(self, method)
        try:
            return function(**params)
        except TypeError:
            try:
                inspect.signature(function).bind(**params)
            except TypeError as error:
                raise CommandError(f"world.{method}: {error}") from None
            raise

    def names(self) -> list[str]:
        """Return the names of all bodies, objects first, in the order in which they were added."""
        return list(self.bodies)

    def describe(self, name: str) -> dict[str, Any]:
        """Return ``index`` (in segmentation images), ``robot`` (a bool), and the names of ``links`` and ``joints``."""
        body = self.body(name)
        return {"index": body.index, "robot": body.is_robot, "links": list(body.links), "joints": list(body.joints)}

    def pose(self, name: str, link: str | None = None) -> dict[str, list[float]]:
        """Return the pose of a link's frame in the world; of the base link when none is named."""
        body = self.body(name)
        index = self.link(body, link)
        if index == -1:
            return pose_json(body.base_pose(self.client))
        state = self.client.getLinkState(body.id, index, computeForwardKinematics=True)
        return pose_json((state[4], state[5]))

    def poses(self, names: Sequence[str] | None = None) -> dict[str, Any]:
        """Return ``poses`` of base links by name, of all bodies for None, and ``t``, the simulated time, s."""
        found = self.bodies.values() if names is None else [self.body(name) for name in names]
        return {"t": self.t, "poses": {body.name: pose_json(body.base_pose(self.client)) for body in found}}

    def set_pose(self, name: str, pose: Mapping[str, Sequence[float]]) -> None:
        """Place an object's base link there, at rest, without a check for overlaps; its joints keep their positions."""
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: its servo moves it, and reset() puts it back", code="is_robot")
        if body.carried:
            raise CommandError(f"{name!r} is attached to an arm: it follows that arm", code="is_attached")
        self._set_base(body, transform(pose))

    def velocity(self, name: str) -> list[list[float]]:
        """Return the velocity in the world: linear (3,) m/s of the base link's centre of mass, angular (3,) rad/s."""
        return [list(part) for part in self.client.getBaseVelocity(self.body(name).id)]

    def set_velocity(
        self, name: str, linear: Sequence[float] = (0.0, 0.0, 0.0), angular: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Set the velocity, as :meth:`velocity` returns it, of a body with a free base."""
        body = self.body(name)
        if not body.floating:
            raise CommandError(f"the base of {name!r} is fixed: it has no velocity to set", code="base_fixed")
        self.client.resetBaseVelocity(body.id, numbers("linear", linear, 3), numbers("angular", angular, 3))

    def dynamics(self, name: str, link: str | None = None) -> dict[str, Any]:
        """Return mass, inertia, friction, restitution, stiffness and damping: :func:`.dynamics.read_dynamics`."""
        body = self.body(name)
        return read_dynamics(self.client, body, self.link(body, link))

    def set_dynamics(self, name: str, link: str | None = None, **values: Any) -> dict[str, Any]:
        """Set some values of :meth:`dynamics` and return the previous ones: :func:`.dynamics.write_dynamics`."""
        body = self.body(name)
        before = write_dynamics(self.client, body, self.link(body, link), values, self.dt)
        forget_contacts(self.client, [body])
        return before

    def contacts(self, a: str | None = None, b: str | None = None) -> list[dict[str, Any]]:
        """Return the contacts of the last step: all, those of ``a``, or those between ``a`` and ``b``.

        Each is a dict of ``a``, ``b``, ``link_a``, ``link_b``, ``position`` (3,) m on ``b``, ``normal`` (3,) from ``b``
        towards ``a``, ``distance`` m, negative where they overlap, and ``force`` N along the normal.
        """
        if a is None:
            a, b = b, None
        first, second = (None if name is None else self.body(name) for name in (a, b))
        return find_contacts(self.client, self.bodies.values(), first, second)

    def aabb(self, name: str) -> dict[str, list[float]]:
        """Return ``lower`` and ``upper`` (3,) m, the corners of the box along the world's axes around the body.

        It may be larger by PyBullet's collision margin (mm).
        """
        lower, upper = bounding_box(self.client, self.body(name))
        return {"lower": lower, "upper": upper}

    def add(self, spec: Mapping[str, Any] | BodySpec) -> int:
        """Add an object and return the new revision."""
        record = spec if isinstance(spec, BodySpec) else body_spec(spec)
        self._load([record])
        return self._edited()

    def remove(self, name: str) -> int:
        """Remove an object, not a robot, and return the new revision."""
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: robots stay in the world", code="is_robot")
        self.client.removeBody(body.id)
        del self.bodies[name]
        self._attached = AttachedObjects(self.client, self.bodies)
        self._arrange()
        return self._edited()

    def set_color(self, name: str, rgba: Sequence[float]) -> int:
        """Set the colour of all links of a body (red, green, blue, alpha in 0..1) and return the new revision."""
        body = self.body(name)
        color = numbers("rgba", rgba, 4)
        if not all(0.0 <= value <= 1.0 for value in color):
            raise CommandError(f"rgba of {name!r} must be numbers in 0..1, not {color}")
        for link in {shape[1] for shape in self.client.getVisualShapeData(body.id)}:
            self.client.changeVisualShape(body.id, link, rgbaColor=color)
        return self._edited()

    def _edited(self) -> int:
        self._changes += 1
        self.revision += 1
        return self.revision

    def reset(
        self,
        name: str | None = None,
        pose: Mapping[str, Sequence[float]] | None = None,
        q: Sequence[float] | None = None,
    ) -> None:
        """Reset one body, or all, at rest, to their initial state in the rig or to these arguments.

        An arm holds its position and its gripper is open. The mirror of a real arm stays where that arm is. Added and
        removed bodies, colours and dynamics are kept, and simulated time continues.

        Args:
            name: The body; None for all.
            pose: Pose of an object's base link in the world; only with a name.
            q: Joint positions, rad or m; only with a name. For an arm, those of its joints, or of its joints and
                fingers; for an object, those of all its movable joints.
        """
        if name is None:
            if pose is not None or q is not None:
                raise CommandError("reset with a pose or with q needs the name of a body", code="name_missing")
            everything = list(self.bodies.values())
            forget_contacts(self.client, everything)
            for body in everything:
                if body.name not in self._mirrored:
                    self._put_home(body)
            self._attached.follow()
            return
        body = self.body(name)
        if name in self._mirrored:
            raise CommandError(f"{name!r} mirrors a real arm; move that", code="is_mirrored")
        if pose is not None and body.is_robot:
            raise CommandError(f"{name!r} is a robot: its base is fixed by the rig", code="is_robot")
        if pose is not None and body.carried:
            raise CommandError(f"{name!r} is attached to an arm: it follows that arm", code="is_attached")
        base = body.base if pose is None else transform(pose)
        joints = body.home if q is None else {**body.home, **joint_positions(body, q)}
        forget_contacts(self.client, [body])
        self._put(body, base, joints)
        self._attached.follow()

    # --- for drivers, the renderer and the viewer ----------------------------------------------------------------

    def follow(self, name: str, q: Sequence[float], dq: Sequence[float], width: float | None = None) -> None:
        """Place the mirror of a real arm where that arm is; to be called for every step, else the mirror stays.

        Args:
            name: An arm that another driver moves.
            q: (n,) rad.
            dq: (n,) rad/s, its speeds during the next step.
            width: Width of its gripper, m; None where it is unknown.

        Raises:
            DeviceNotFound: No such body.
            CommandError: The arm is simulated, or the numbers are not n finite ones. The mirror stays.
        """
        arm = self._mirrored.get(name)
        if arm is None:
            self.body(name)
            raise CommandError(f"{name!r} is not the mirror of a real arm", code="not_mirrored")
        arm.follow(q, dq, width)
        self._changes += 1

    def body(self, name: str) -> Body:
        """Return the body of that name; raises DeviceNotFound, which lists all."""
        if name not in self.bodies:
            raise DeviceNotFound(f"the world has no body {name!r}{nearest(name, self.bodies)}", code="unknown_body")
        return self.bodies[name]

    def link(self, body: Body, name: str | None) -> int:
        """Return the index of a link by name, that of the base link for None; raises DeviceNotFound."""
        if name is None:
            return -1
        if name not in body.links:
            raise DeviceNotFound(f"{body.name!r} has no link {name!r}{nearest(name, body.links)}", code="unknown_link")
        return body.links[name]

    def handle(self, name: str, active: bool) -> None:
        """Report whether a robot's fingers move or hold something, which takes a finer solution.

        Fingers that stand still with nothing between them need no coupling: each motor holds its own finger.
        """
        if active == (name in self._handling):
            return
        (self._handling.add if active else self._handling.discard)(name)
        body = self.bodies[name]
        fingers = {body.joints[joint] for joint in body.spec.gripper.joints}  # type: ignore[union-attr]  # it has some
        for gear in body.gears:
            if gear.joints <= fingers:
                (gear.engage if active else gear.release)()
        self._set_residual()

    def _set_residual(self) -> None:
        self.client.setPhysicsEngineParameter(solverResidualThreshold=RESIDUAL["fine" if self._handling else "coarse"])

    def on_reset(self, name: str, callback: Callable[[], None]) -> None:
        """Call ``callback`` after each reset of the robot of that name."""
        self._on_reset.setdefault(name, []).append(callback)

    def off_reset(self, name: str, callback: Callable[[], None]) -> None:
        """Remove a callback of :meth:`on_reset`."""
        self._on_reset[name].remove(callback)

    def snapshot(self) -> list[float]:
        """Return the state of all bodies, for :meth:`show` of a mirror at the same :attr:`revision`."""
        return self._layout.read()

    def show(self, snapshot: Sequence[float]) -> None:
        """Place every body as in a snapshot of the same revision.

        Raises:
            ValueError: It was taken from a world with other bodies.
        """
        self._layout.apply(snapshot)

    def visuals(self, body: int) -> tuple[Visual, ...]:
        """Return the visual shapes of the body with PyBullet's number ``body``."""
        return visuals_of(self.client, body)

    def link_frames(self, links: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
        """Return the poses (N, 4, 4) of links, each given as (PyBullet's number of the body, link)."""
        return link_frames(self.client, links)

    def _arrange(self) -> None:
        """Number the bodies and read the fixed ones again, after bodies were added, removed or placed."""
        for index, body in enumerate(self.bodies.values()):
            body.index = index
        self._layout = SnapshotLayout(self.client, self.bodies.values())

    def _put_home(self, body: Body) -> None:
        self._put(body, body.base, body.home)

    def _put(self, body: Body, base: Transform, joints: Mapping[int, float]) -> None:
        self._changes += 1
        if not body.carried:
            self._set_base(body, base)
        for joint, position in joints.items():
            self.client.resetJointState(body.id, joint, position, 0.0)
        if body.is_robot:
            hold(self.client, body, joints, self.dt)
        for callback in self._on_reset.get(body.name, ()):
            callback()

    def _set_base(self, body: Body, base: Transform) -> None:
        self._changes += 1
        body.set_base_pose(self.client, base)
        if body.floating:
            self.client.resetBaseVelocity(body.id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        else:
            self._arrange()


class SnapshotLayout:
    """Reads and applies snapshots: the state of a set of bodies as one list of numbers.

    First the poses (7) of all bodies with a fixed base, then of each other body, in order, the pose (7) of its base if
    that is free or attached to an arm, and its joint positions. Poses are PyBullet's own, of the centre of mass.

    Fixed bases are read once, by the constructor: make a new layout when one was moved.
    """

    def __init__(self, client: PyBulletClient, bodies: Iterable[Body]) -> None:
        everything = list(bodies)
        self._client = client
        self._still = [body.id for body in everything if not body.roams]
        self._still_values: list[float] = []
        for number in self._still:
            position, orientation = client.getBasePositionAndOrientation(number)
            self._still_values += [*position, *orientation]
        self._moving = [(body.id, body.roams, body.movable) for body in everything if body.moves]
        self.size = len(self._still_values) + sum(7 * roams + len(joints) for _, roams, joints in self._moving)

    def read(self) -> list[float]:
        """Return the present snapshot."""
        values = self._still_values.copy()
        pose_of, joints_of = self._client.getBasePositionAndOrientation, self._client.getJointStates
        for number, roams, movable in self._moving:
            if roams:
                position, orientation = pose_of(number)
                values += position
                values += orientation
            if movable:
                values += [state[0] for state in joints_of(number, movable)]
        return values

    def apply(self, snapshot: Sequence[float]) -> None:
        """Place all bodies as in a snapshot; raises ValueError when it is one of other bodies."""
        values = list(snapshot)
        if len(values) != self.size:
            raise ValueError(f"a snapshot of {len(values)} numbers does not fit a world of {self.size}")
        put, put_joints = self._client.resetBasePositionAndOrientation, self._client.resetJointStatesMultiDof
        place = len(self._still_values)
        if values[:place] != self._still_values:
            for k, number in enumerate(self._still):
                put(number, values[7 * k : 7 * k + 3], values[7 * k + 3 : 7 * k + 7])
            self._still_values = values[:place]
        for number, roams, movable in self._moving:
            if roams:
                put(number, values[place : place + 3], values[place + 3 : place + 7])
                place += 7
            if movable:
                put_joints(number, movable, [[value] for value in values[place : place + len(movable)]])
                place += len(movable)
