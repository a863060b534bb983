"""The simulated world of a rig: one PyBullet client that simulated arms, grippers and cameras are views of."""

from __future__ import annotations

import base64
import os
import tempfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Any

from hal.drivers.scene.engine import IDENTITY, AppliedForce, RayFound
from hal.drivers.scene.values import completed_dynamics, numbers
from hal.drivers.scene.world import SimulatedWorld
from hal.errors import Fault
from hal.geometry import Transform, compose, inverse
from hal.specs import BodySpec, RobotSpec, WorldSpec

from .attachments import AttachedObjects, MirroredArm
from .dynamics import (
    apply_force,
    bounding_box,
    cast_ray,
    deepest_overlap,
    distance,
    find_contacts,
    forget_contacts,
    read_dynamics,
    write_dynamics,
)
from .engine import Body, PyBulletClient
from .loading import load_object, load_robot
from .motors import PassiveJoints, hold

SOLVER: dict[str, Any] = {
    "deterministicOverlappingPairs": 1,
    "minimumSolverIslandSize": 1,
}
"""Settings of PyBullet's solver.

Each group of bodies that touch is solved by itself: PyBullet solves small groups together, which gives the same numbers
and makes every group wait for the slowest."""
MEMORY = "/dev/shm"
"""Folder for files that stay in the computer's memory, where there is one."""
SOLUTION: dict[str, dict[str, Any]] = {
    "fine": {"solverResidualThreshold": 1e-7, "numSolverIterations": 200},
    "coarse": {"solverResidualThreshold": 3e-6, "numSolverIterations": 100},
}
"""The solver stops once no speed changes by more than the root of the residual in an iteration, m/s or rad/s (0.3 and
1.7 mm/s), and after so many iterations at the latest.

"fine" is needed while fingers move slowly or hold something: with 100 iterations the six joints of a Robotiq 2F-85
press with 52 N of 60. With more iterations a slow computer falls behind an arm that holds something: with 400 a step
takes up to 6 ms of 4. With "coarse" a step takes less time, and an arm follows less exactly; with PyBullet's own 50
iterations fast arms exceed their speed limits a little."""


LEAST_HZ = 100.0
"""Rate of the steps below which contacts give way visibly, Hz."""


class PyBulletWorld(SimulatedWorld[Body]):
    """One simulation and all bodies in it.

    Raises ConfigError with every problem in the record, DriverMissing without PyBullet.
    """

    ENGINE = "PyBullet"

    def __init__(self, spec: WorldSpec) -> None:
        super().__init__(spec)
        self.client = PyBulletClient()
        folder = MEMORY if os.path.isdir(MEMORY) else None
        self._file = tempfile.NamedTemporaryFile(suffix=".bullet", dir=folder)  # noqa: SIM115  # until close()
        """PyBullet saves and restores states by files only."""
        self._mirrored: dict[str, MirroredArm] = {}
        """Mirrors of arms that other drivers move."""
        self._attached = AttachedObjects(self.client, ())
        self._damped: list[PassiveJoints] = []
        """Joints of objects with damping."""
        self._handling = {robot.name for robot in spec.robots if robot.gripper is not None}
        """Robots whose fingers may move or hold something."""
        try:
            self.client.setTimeStep(self.dt)
            self.client.setGravity(*spec.gravity)
            self.client.setPhysicsEngineParameter(**SOLVER)
            self._set_solution()
            self.load_bodies((*spec.bodies, *spec.robots))
            self.check_overlaps()
            if spec.physics_hz < LEAST_HZ:
                self.warnings.append(
                    f"physics_hz is {spec.physics_hz:g}: below {LEAST_HZ:g}, PyBullet lets objects sink into each "
                    "other by some mm; use 240, or MuJoCo, which divides long steps"
                )
        except BaseException:
            self.close()
            raise
        self._step = self.client.stepSimulation

    @property
    def client_id(self) -> int:
        """PyBullet's ``physicsClientId``."""
        return self.client.id

    def step(self) -> None:
        """Make one physics step."""
        if self.fault is not None:
            self.steps += 1
            return
        for prepare in self.preparations.values():
            prepare()
        for arm in self._mirrored.values():
            arm.prepare_step()
        for joints in self._damped:
            joints.prepare_step()
        if self.forces:
            for force in self.forces:
                self.push_link(force)
            self.spend_forces()
        self._step()
        for arm in self._mirrored.values():
            arm.finish_step()
        self._attached.follow()
        self.steps += 1

    def close(self) -> None:
        """Delete the world. Idempotent."""
        self.bodies = {}
        self._mirrored = {}
        self.client.close()
        self._file.close()

    def snapshot(self) -> list[float]:
        values = self._layout.read()
        if self.fault is None and isfinite(sum(values)):
            return values
        self.note_unstable()
        return self._layout.read_sound()

    def note_unstable(self, reason: str = "a number is not finite") -> None:
        """Let the world stand still, with a fault, until it is reset: its numbers mean nothing any more."""
        if self.fault is None:
            self.fault = Fault(
                "simulation_unstable",
                f"the simulation became unstable at {self.t:.3f} s: {reason}",
                "reset the world; use a smaller contact_stiffness, masses that differ less, or a higher physics_hz",
            )

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
        body.weigh_fingers(self.client, active)
        self._set_solution()

    # --- the engine of SimulatedWorld --------------------------------------------------------------------------------

    def _set_solution(self) -> None:
        self.client.setPhysicsEngineParameter(**SOLUTION["fine" if self._handling else "coarse"])

    def load_body(self, spec: BodySpec | RobotSpec) -> Body:
        load = load_robot if isinstance(spec, RobotSpec) else load_object
        body, warnings = load(self.client, spec)  # type: ignore[arg-type]  # of that kind
        self.warnings += warnings
        return body

    def arrange_bodies(self, added: Sequence[Body]) -> None:
        self._attached = AttachedObjects(self.client, self.list_attachments())
        self._attached.leave_physics(added)
        for part, whole, ignored in self.list_parts(added):
            for link, other in product(part.links.values(), ignored):
                self.client.setCollisionFilterPair(part.id, whole.id, link, other, 0)
        self._damped = [PassiveJoints(self.client, body) for body in self.bodies.values() if body.damped]
        self._read_layout()

    def _read_layout(self) -> None:
        """Read the fixed bases again, after bodies were added, removed or placed."""
        self._layout = SnapshotLayout(self.client, self.bodies.values())

    def start_bodies(self, added: Sequence[Body]) -> None:
        for body in added:
            if self.is_mirrored(body):
                self._mirrored[body.name] = MirroredArm(self.client, body, self.dt)

    def unload_body(self, body: Body) -> None:
        self.client.removeBody(body.id)

    def place_attached(self) -> None:
        self._attached.follow()

    def place_mirror(self, body: Body, q: list[float], dq: list[float], width: float | None) -> None:
        self._mirrored[body.name].follow(q, dq, width)

    def find_overlap(self, a: Body, b: Body) -> tuple[float, str, str]:
        return deepest_overlap(self.client, a, b)

    def read_pose(self, body: Body, link: int) -> Transform:
        if link == -1:
            return body.base_pose(self.client)
        state = self.client.getLinkState(body.id, link, computeForwardKinematics=True)
        return state[4], state[5]

    def read_velocity(self, body: Body) -> tuple[Sequence[float], Sequence[float]]:
        linear, angular = self.client.getBaseVelocity(body.id)
        return linear, angular

    def write_velocity(self, body: Body, linear: Sequence[float], angular: Sequence[float]) -> None:
        self.client.resetBaseVelocity(body.id, linear, angular)

    def move_base(self, body: Body, pose: Transform) -> None:
        body.set_base_pose(self.client, pose)
        if body.floating:
            self.client.resetBaseVelocity(body.id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        else:
            self._read_layout()

    def move_joints(self, body: Body, positions: Mapping[int, float]) -> None:
        for joint, position in positions.items():
            self.client.resetJointState(body.id, joint, position, 0.0)
        if body.is_robot:
            hold(self.client, body, positions, self.dt)

    def read_joints(self, body: Body) -> Sequence[float]:
        return [state[0] for state in self.client.getJointStates(body.id, body.movable)] if body.movable else []

    def read_dynamics(self, body: Body, link: int) -> dict[str, Any]:
        return read_dynamics(self.client, body, link)

    def write_dynamics(self, body: Body, link: int, values: Mapping[str, Any], before: Mapping[str, Any]) -> None:
        write_dynamics(self.client, body, link, values, before, self.dt)

    def forget_contacts(self, bodies: Sequence[Body]) -> None:
        if len(bodies) == len(self.bodies) and self.fault is not None:
            self._reload()
            self.fault = None
        forget_contacts(self.client, bodies)

    def _reload(self) -> None:
        """Load all bodies again: a motor of PyBullet's whose numbers were not finite moves nothing any more."""
        client, bodies, said = self.client, list(self.bodies.values()), list(self.warnings)
        dynamics = {
            body.name: {link: read_dynamics(client, body, link) for link in body.links.values()} for body in bodies
        }
        for body in reversed(bodies):
            client.removeBody(body.id)
        for body in bodies:
            new = self.load_body(body.spec)
            body.id, body.gears, body.hardened, body.fingers = new.id, new.gears, new.hardened, new.fingers
            body.damping = new.damping
            body.handling, body.edits, body.reloads = True, body.edits + 1, body.reloads + 1
            for link, values in dynamics[body.name].items():
                before = read_dynamics(client, body, link)
                if changed := {name: value for name, value in values.items() if value != before[name]}:
                    write_dynamics(client, body, link, completed_dynamics(body.name, changed, before), before, self.dt)
        self.warnings = said
        self._handling = {robot.name for robot in self.spec.robots if robot.gripper is not None}
        self._set_solution()
        self.arrange_bodies(bodies)
        for body in bodies:
            self.move_base(body, body.base)
            self.move_joints(body, body.home)
        self.start_bodies(bodies)
        self.place_attached()

    def save_engine(self) -> dict[str, Any]:
        """Return what PyBullet writes into a file, and restore it at once.

        The contacts that the solver remembers are in no state that PyBullet restores. They are forgotten now, and at
        each restore, so that the steps after both are the same.
        """
        data, snapshot = self._write_file(), self._layout.read()
        self._read_file(data)
        return {
            "handling": sorted(self._handling),
            "snapshot": snapshot,
            "bullet": base64.b64encode(zlib.compress(data, 1)).decode(),
        }

    def restore_engine(self, state: Any) -> None:
        handling = set(state["handling"]) & set(self.bodies)
        poses = numbers("the snapshot", state["snapshot"], self._layout.size)
        try:
            data = zlib.decompress(base64.b64decode(state["bullet"], validate=True))
        except zlib.error as error:
            raise ValueError(str(error)) from None
        if self.fault is not None:
            self._reload()
        handled, before = set(self._handling), self._write_file()
        self._handle_only(handling)
        try:
            self._read_file(data)
        except ValueError:
            self._handle_only(handled)
            raise
        if any(abs(new - old) > 1e-6 for new, old in zip(self._layout.read(), poses, strict=True)):
            self._handle_only(handled)
            self._read_file(before)  # PyBullet finds bodies by their order in its own lists
            raise ValueError("its bodies were added or removed in another order")
        self.fault = None

    def _handle_only(self, names: set[str]) -> None:
        for name in self._handling | names:
            self.handle(name, name in names)

    def _write_file(self) -> bytes:
        self.client.saveBullet(self._file.name)
        return Path(self._file.name).read_bytes()

    def _read_file(self, data: bytes) -> None:
        forget_contacts(self.client, self.bodies.values())
        Path(self._file.name).write_bytes(data)
        self.client.setPhysicsEngineParameter(enableFileCaching=0)  # else it reads a file of one name only once
        try:
            self.client.restoreState(fileName=self._file.name)
        except self.client.error as error:
            raise ValueError(str(error)) from None
        finally:
            self.client.setPhysicsEngineParameter(enableFileCaching=1)
        self._read_layout()

    def push_link(self, force: AppliedForce[Body]) -> None:
        apply_force(self.client, force)

    def write_gravity(self, gravity: Sequence[float]) -> None:
        self.client.setGravity(*gravity)
        for body in self.bodies.values():
            body.edits += 1

    def cast_ray(self, start: Sequence[float], end: Sequence[float]) -> RayFound | None:
        return cast_ray(self.client, self.bodies.values(), start, end)

    def measure_distance(self, a: Body, links_a: Sequence[int], b: Body, links_b: Sequence[int]) -> float | None:
        return distance(self.client, a, links_a, b, links_b)

    def find_contacts(self, a: Body | None, b: Body | None) -> list[dict[str, Any]]:
        return find_contacts(self.client, self.bodies.values(), a, b)

    def measure_box(self, body: Body) -> tuple[list[float], list[float]]:
        return bounding_box(self.client, body)


class SnapshotLayout:
    """Reads snapshots of a set of bodies, in the layout of :meth:`hal.world.WorldDriver.snapshot`.

    Fixed bases are read once, by the constructor: make a new layout when one was moved.
    """

    def __init__(self, client: PyBulletClient, bodies: Iterable[Body]) -> None:
        everything = list(bodies)
        self._client = client
        self._still = [body for body in everything if not body.roams]
        self._still_values: list[float] = []
        for body in self._still:
            position, orientation = body.base_pose(client)
            self._still_values += [*position, *orientation]
        self._moving = [body for body in everything if body.moves]
        self._parts = [
            (body.id, body.roams, None if body.inertial == IDENTITY else inverse(body.inertial), body.movable)
            for body in self._moving
        ]
        self.size = len(self._still_values) + sum(7 * body.roams + len(body.movable) for body in self._moving)
        self._start = self.read()

    def read(self) -> list[float]:
        """Return the present snapshot."""
        values = self._still_values.copy()
        pose_of, joints_of = self._client.getBasePositionAndOrientation, self._client.getJointStates
        for number, roams, to_base, movable in self._parts:
            if roams:
                position, orientation = pose_of(number)
                if to_base is not None:  # PyBullet's pose is that of the centre of mass
                    position, orientation = compose((position, orientation), to_base)
                values += position
                values += orientation
            if movable:
                values += [state[0] for state in joints_of(number, movable)]
        return values

    def read_sound(self) -> list[float]:
        """Return the present snapshot, with numbers from before where they are not finite."""
        return [new if isfinite(new) else old for new, old in zip(self.read(), self._start, strict=True)]
