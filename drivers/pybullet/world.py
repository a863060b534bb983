"""The simulated world of a rig: one PyBullet client that simulated arms, grippers and cameras are views of.

The same class is the world that is stepped and each of its mirrors (the renderer's, the viewer's). A mirror is made
from the same record and never stepped: it replays the edits of :data:`World.MIRRORED` in their order, which keeps the
order of the bodies the same, and :meth:`World.show` poses it by a :meth:`World.snapshot` of that revision.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any, ClassVar

from hal.errors import CommandError, ConfigError, DeviceNotFound, NotSupported, Problem
from hal.specs import BodySpec, RobotSpec, WorldSpec

from .arm_copy import ArmCopy
from .body import Body
from .carrying import Carried
from .contacts import bounding_box, deepest_overlap, find_contacts, forget_contacts
from .dynamics import read_dynamics, write_dynamics
from .library import Client
from .loading import load_object, load_robot
from .motors import hold
from .picture import Picture
from .transforms import Transform
from .values import body_spec, joint_positions, nearest, numbers, pose_json, transform

__all__ = ["World"]

ENGINE: dict[str, Any] = {
    "deterministicOverlappingPairs": 1,
    "minimumSolverIslandSize": 1,
    "numSolverIterations": 100,
}
"""Settings of PyBullet's solver.

Each group of things that touch is solved by itself: PyBullet solves small groups together, which gives the same numbers
and makes every group wait for the slowest. The solver iterates at most 100 times: with PyBullet's 50, fingers that
grasp with 70 N reach half of it, and fast arms are 0.2 % over their speed limits."""
RESIDUAL = {"fine": 1e-7, "coarse": 3e-6}
"""The solver stops once no speed changes by more than the root of this in an iteration, m/s or rad/s: 0.3 and 1.7 mm/s.

"fine" is PyBullet's own, and needed while fingers move slowly or hold something. With "coarse" a step takes a tenth
less time, and a Panda follows a swing within 0.056 mrad instead of 0.041."""
OVERLAP = 0.005
"""m: two arms that start deeper in each other are refused."""


class World:
    """Everything that stands in one simulation.

    Public methods whose names are in :attr:`REQUESTS` are the questions and edits of ``rig.world``; they take and give
    plain numbers, lists and dicts, so that they can travel (:meth:`request`). Poses are dicts of ``position`` (3,) m
    and ``orientation`` (4,) xyzw, of a link's own frame, in the world.

    Raises:
        ConfigError: something in the record cannot be loaded; lists every such thing.
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
        """Load everything in ``spec``.

        Args:
            mirror: The world is posed by snapshots and never stepped.
            gui: Open PyBullet's window.
            drawn: Something draws this very world. Without it visual meshes are not loaded: for a Panda that takes
                0.2 s and 75 MB less.
        """
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
        """What a person should know about the files that were loaded."""
        self.client = Client(gui=gui)
        self._on_reset: dict[str, list[Callable[[], None]]] = {}
        self._copies: dict[str, ArmCopy] = {}
        """Of arms that other drivers move."""
        self._handling = {robot.name for robot in spec.robots if robot.gripper is not None}
        """Robots whose fingers move or hold something, as far as is known."""
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
            self._carried = Carried(self.client, self.bodies)
        except ConfigError:  # something is attached to what is not there
            for spec in specs:
                self.client.removeBody(self.bodies.pop(spec.name).id)
            self._arrange()
            raise
        self._arrange()
        self._carried.leave_physics(self.bodies[spec.name] for spec in specs)
        self._carried.follow()

    def _check_overlaps(self) -> None:
        """Refuse arms that start inside each other: the solver would throw them apart."""
        robots = [body for body in self.bodies.values() if body.is_robot and body.name not in self._copies]
        problems = []
        for a, b in combinations(robots, 2):
            depth, link_a, link_b = deepest_overlap(self.client, a, b)
            if depth > OVERLAP:
                message = f"starts {depth:.3f} m inside robot {a.name!r} (its {link_b} in {link_a})"
                remedy = "change its base or initial; a URDF with two arms is loaded whole for every entry: split it"
                problems.append(Problem("simulation", f"robots.{b.name}", f"{message}; {remedy}"))
        if problems:
            raise ConfigError(problems)

    def _place(self, spec: BodySpec | RobotSpec) -> Body:
        if spec.name in self.bodies:
            raise ConfigError([Problem("world", spec.name, "is the name of two things; names are unique in the world")])
        if isinstance(spec, RobotSpec):
            body, warnings = load_robot(self.client, spec, self.drawn)
        else:
            body, warnings = load_object(self.client, spec, self.drawn)
        self.bodies[spec.name] = body
        self.warnings += warnings
        self._put_home(body)
        if isinstance(spec, RobotSpec) and spec.driver != self.spec.driver:
            self._copies[spec.name] = ArmCopy(self.client, body, self.dt)
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
        """Differs from an earlier one if anything may look different since: after a step, an edit or a reset."""
        return self.steps, self._changes

    def step(self) -> None:
        """One physics step."""
        if self.mirror:
            raise NotSupported("a mirror is posed by show(), never stepped")
        for copy in self._copies.values():
            copy.prepare_step()
        self._step()
        self._carried.follow()
        self.steps += 1

    def close(self) -> None:
        """Let go of PyBullet. Idempotent."""
        self.bodies = {}
        self._copies = {}
        self.client.close()

    # --- requests: rig.world -------------------------------------------------------------------------------------

    def request(self, method: str, params: Mapping[str, Any]) -> Any:
        """Call one of :attr:`REQUESTS` by name: JSON in, JSON out.

        Raises:
            DeviceNotFound: no body or link of that name; lists those that are there.
            CommandError: no such method, arguments that it does not take, or impossible numbers.
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
        """Names of everything, objects first, in the order in which they came."""
        return list(self.bodies)

    def describe(self, name: str) -> dict[str, Any]:
        """``index`` (its number in segmentation images), ``robot`` (is it one?), ``links`` and ``joints`` by name."""
        body = self.body(name)
        return {"index": body.index, "robot": body.is_robot, "links": list(body.links), "joints": list(body.joints)}

    def pose(self, name: str, link: str | None = None) -> dict[str, list[float]]:
        """The pose of a link's frame in the world; of the base link when none is named."""
        body = self.body(name)
        index = self.link(body, link)
        if index == -1:
            return pose_json(body.base_pose(self.client))
        state = self.client.getLinkState(body.id, index, computeForwardKinematics=True)
        return pose_json((state[4], state[5]))

    def poses(self, names: Sequence[str] | None = None) -> dict[str, Any]:
        """``poses`` by name of the base links of many bodies, None: of all; and ``t``, the simulated time, s."""
        found = self.bodies.values() if names is None else [self.body(name) for name in names]
        return {"t": self.t, "poses": {body.name: pose_json(body.base_pose(self.client)) for body in found}}

    def set_pose(self, name: str, pose: Mapping[str, Sequence[float]]) -> None:
        """Put an object's base link there, at rest, whatever is in the way; its joints keep their positions."""
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: its servo moves it, and reset() puts it back")
        if body.carried:
            raise CommandError(f"{name!r} is attached to an arm: it goes where that goes")
        self._set_base(body, transform(pose))

    def velocity(self, name: str) -> list[list[float]]:
        """Linear (3,) m/s of the base link's centre of mass and angular (3,) rad/s, along the world's axes."""
        return [list(part) for part in self.client.getBaseVelocity(self.body(name).id)]

    def set_velocity(
        self, name: str, linear: Sequence[float] = (0.0, 0.0, 0.0), angular: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Give a body that moves freely a velocity, as :meth:`velocity` means it."""
        body = self.body(name)
        if not body.floating:
            raise CommandError(f"the base of {name!r} is fixed: it has no velocity to set")
        self.client.resetBaseVelocity(body.id, numbers("linear", linear, 3), numbers("angular", angular, 3))

    def dynamics(self, name: str, link: str | None = None) -> dict[str, Any]:
        """Mass, inertia, frictions, restitution, contact stiffness and damping, damping (:func:`read_dynamics`)."""
        body = self.body(name)
        return read_dynamics(self.client, body, self.link(body, link))

    def set_dynamics(self, name: str, link: str | None = None, **values: Any) -> dict[str, Any]:
        """Set some of :meth:`dynamics`; returns what to pass here to put it all back (:func:`write_dynamics`)."""
        body = self.body(name)
        before = write_dynamics(self.client, body, self.link(body, link), values, self.dt)
        forget_contacts(self.client, [body])
        return before

    def contacts(self, a: str | None = None, b: str | None = None) -> list[dict[str, Any]]:
        """Where bodies touched in the last step: all, those of ``a``, or those between ``a`` and ``b``.

        Each a dict of ``a``, ``b``, ``link_a``, ``link_b``, ``position`` (3,) m on ``b``, ``normal`` (3,) from ``b``
        towards ``a``, ``distance`` m, negative where they overlap, and ``force`` N along the normal.
        """
        if a is None:
            a, b = b, None
        first, second = (None if name is None else self.body(name) for name in (a, b))
        return find_contacts(self.client, self.bodies.values(), first, second)

    def aabb(self, name: str) -> dict[str, list[float]]:
        """``lower`` and ``upper`` (3,) m: the box along the world's axes that holds the whole body.

        It is PyBullet's, so it may be larger by a collision margin (mm).
        """
        lower, upper = bounding_box(self.client, self.body(name))
        return {"lower": lower, "upper": upper}

    def add(self, spec: Mapping[str, Any] | BodySpec) -> int:
        """Put an object into the world; returns the new revision."""
        record = spec if isinstance(spec, BodySpec) else body_spec(spec)
        self._load([record])
        return self._edited()

    def remove(self, name: str) -> int:
        """Take an object out of the world; returns the new revision. Robots stay."""
        body = self.body(name)
        if body.is_robot:
            raise CommandError(f"{name!r} is a robot: robots stay in the world")
        self.client.removeBody(body.id)
        del self.bodies[name]
        self._carried = Carried(self.client, self.bodies)
        self._arrange()
        return self._edited()

    def set_color(self, name: str, rgba: Sequence[float]) -> int:
        """Paint all links of a body (red, green, blue, alpha in 0..1); returns the new revision."""
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
        """Put one thing, or everything, back: at rest, where the rig says it starts, or where these arguments say.

        An arm holds there and its gripper is open. The copy of a real arm stays where that arm is. What was added or
        removed, painted or given other dynamics stays so, and simulated time goes on.

        Args:
            name: of the body; None means all.
            pose: an object's base link in the world; only with a name.
            q: joint positions in rad or m; only with a name. Of an arm: those of its joints, or of its joints and
                fingers; of an object: those of all its movable joints.
        """
        if name is None:
            if pose is not None or q is not None:
                raise CommandError("reset with a pose or with q needs the name of what they are for")
            everything = list(self.bodies.values())
            forget_contacts(self.client, everything)
            for body in everything:
                if body.name not in self._copies:
                    self._put_home(body)
            self._carried.follow()
            return
        body = self.body(name)
        if name in self._copies:
            raise CommandError(f"{name!r} stands where the real arm is; move that")
        if pose is not None and body.is_robot:
            raise CommandError(f"{name!r} is a robot: its base stays where the rig says")
        if pose is not None and body.carried:
            raise CommandError(f"{name!r} is attached to an arm: it goes where that goes")
        base = body.base if pose is None else transform(pose)
        joints = body.home if q is None else {**body.home, **joint_positions(body, q)}
        forget_contacts(self.client, [body])
        self._put(body, base, joints)
        self._carried.follow()

    # --- for drivers, the renderer and the viewer ----------------------------------------------------------------

    def follow(self, name: str, q: Sequence[float], dq: Sequence[float], width: float | None = None) -> None:
        """Put the copy of a real arm where that arm is. For every step anew; one that is not told anything stays.

        Args:
            name: of an arm that another driver moves.
            q: (n,) rad.
            dq: (n,) rad/s, which it goes on with during the next step.
            width: of its gripper, m; None where nobody knows.

        Raises:
            DeviceNotFound: no such body.
            CommandError: the arm is a simulated one, or the numbers are not n finite ones. The copy stays.
        """
        copy = self._copies.get(name)
        if copy is None:
            self.body(name)
            raise CommandError(f"{name!r} is not the copy of a real arm")
        copy.follow(q, dq, width)
        self._changes += 1

    def body(self, name: str) -> Body:
        """The body of that name, or a DeviceNotFound that lists all."""
        if name not in self.bodies:
            raise DeviceNotFound(f"the world has no body {name!r}{nearest(name, self.bodies)}")
        return self.bodies[name]

    def link(self, body: Body, name: str | None) -> int:
        """Index of a link by name; of the base link for None."""
        if name is None:
            return -1
        if name not in body.links:
            raise DeviceNotFound(f"{body.name!r} has no link {name!r}{nearest(name, body.links)}")
        return body.links[name]

    def handle(self, name: str, active: bool) -> None:
        """Say whether a robot's fingers move or hold something, which is computed with more care.

        Fingers that stand still with nothing between them need no gear: each motor holds its own.
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
        """Have ``callback`` called whenever the robot of that name was put somewhere by a reset."""
        self._on_reset.setdefault(name, []).append(callback)

    def off_reset(self, name: str, callback: Callable[[], None]) -> None:
        """The end of :meth:`on_reset`."""
        self._on_reset[name].remove(callback)

    def snapshot(self) -> list[float]:
        """Where everything is now: what :meth:`show` of a mirror at the same :attr:`revision` takes."""
        return self._picture.take()

    def show(self, snapshot: Sequence[float]) -> None:
        """Put every body where a snapshot of the same revision says.

        Raises:
            ValueError: it was taken from a world with other bodies.
        """
        self._picture.show(snapshot)

    def _arrange(self) -> None:
        """Number the bodies and look again at what stands still, after bodies came, went or were moved by hand."""
        for index, body in enumerate(self.bodies.values()):
            body.index = index
        self._picture = Picture(self.client, self.bodies.values())

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
