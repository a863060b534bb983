"""The simulated world of a rig: one MuJoCo model that simulated arms and grippers are views of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hal.drivers.scene.engine import AppliedForce, RayFound
from hal.drivers.scene.values import transform
from hal.drivers.scene.world import SimulatedWorld
from hal.errors import CommandError, ConfigError, Fault, Problem
from hal.geometry import Transform, compose, rotate
from hal.specs import BodySpec, RobotSpec, WorldSpec

from .contacts import add_pairs, bounding_box, cast_ray, deepest_overlap, distance, find_contacts
from .dynamics import read_dynamics, write_dynamics
from .engine import Body, load_mujoco, wxyz
from .loading import BodyPlan, build, plan_object, plan_robot, take_out
from .motors import Motors
from .sleep import Sleep

Array = NDArray[np.float64]

LONGEST_STEP = 1.0 / 240.0
"""Longest step of MuJoCo's, s: a world of a lower rate makes several of them in one of its own."""
FASTEST = 1e4
"""Speed of a joint or a body, rad/s or m/s, from which on a simulation counts as unstable."""
SOUND_EVERY = 16
"""Steps after which the positions are kept to which an unstable simulation is set back."""
_POSE = ("position", "orientation")


class MujocoWorld(SimulatedWorld[Body]):
    """One model of MuJoCo's and all bodies in it. Raises DriverMissing, and ConfigError with every problem.

    Arms come first in the model, so that their joints are the first degrees of freedom. An object is added or removed
    by compiling the model again; all other bodies keep their state.
    """

    ENGINE = "MuJoCo"
    UNSUPPORTED: ClassVar[Mapping[str, str]] = {
        "linear_damping": "leave it out: bodies move without air resistance",
        "angular_damping": "leave it out: bodies turn without air resistance",
    }

    def __init__(self, spec: WorldSpec) -> None:
        super().__init__(spec)
        self.mujoco = mujoco = load_mujoco()
        self.substeps = max(1, math.ceil(self.dt / LONGEST_STEP - 1e-6))
        """Steps of MuJoCo's in one step of the world."""
        self._plans: dict[str, BodyPlan] = {}
        self._fresh: set[str] = set()
        """Mirrors of real arms that have a new state since the last step."""
        self._following: set[str] = set()
        """Mirrors that had one before it."""
        self._width_known: set[str] = set()
        """Mirrors whose fingers have been placed once."""
        self._spec: Any = mujoco.MjSpec()
        self.model: Any = None
        self.data: Any = None
        self._spec.compiler.degree = False
        option = self._spec.option
        option.timestep = self.dt / self.substeps
        option.gravity = spec.gravity
        option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 1000.0  # what is held slides less
        option.disableflags = mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # Several contacts between two convex shapes: on by default since MuJoCo 4.
        option.enableflags = int(getattr(mujoco.mjtEnableBit, "mjENBL_MULTICCD", 0))
        self.motors = Motors(0, self.dt, option.timestep)
        try:
            self.load_bodies((*spec.bodies, *spec.robots))
            self.check_overlaps()
        except BaseException:
            self.close()
            raise

    def step(self) -> None:
        if self.fault is not None:
            self.steps += 1
            return
        for prepare in self.preparations.values():
            prepare()
        if self._following:
            self._hold_mirrors()
        motors, model, data = self.motors, self.model, self.data
        if not self.steps % SOUND_EVERY:
            self._sound[:] = self._qpos
        if self.forces:  # before the step, so that they wake what sleeps
            self._kinematics()
            for force in self.forces:
                self.push_link(force)
        for _ in range(self.substeps):
            self._step1(model, data)
            motors.drive()
            self._step2(model, data)
            if self.substeps > 1:
                motors.target += motors.feed * motors.h  # as far as it moves in this part of the step
        if self.substeps > 1:
            motors.target -= motors.feed * self.dt
        if self.forces:
            data.xfrc_applied[:] = 0.0
            self.spend_forces()
        self.steps += 1
        self._placed = False
        self._touched = True
        speed = self._speeds.dot(self._speeds)
        if not speed < FASTEST * FASTEST:  # NaN too
            self._stop(speed)

    def _stop(self, speed: float) -> None:
        """Let the world stand still for good: its numbers mean nothing any more."""
        what = f"a body is faster than {FASTEST:g} m/s or rad/s" if speed < math.inf else "a number is not finite"
        remedy = "reset the world; use a smaller contact_stiffness, masses that differ less, or a higher physics_hz"
        self.fault = Fault("simulation_unstable", f"the simulation became unstable at {self.t:.3f} s: {what}", remedy)
        self.data.qpos[:], self.data.qvel[:], self.motors.applied[:] = self._sound, 0.0, 0.0
        self.motors.state[np.isnan(self.motors.state)] = 0.0

    def close(self) -> None:
        self.bodies = {}
        self._plans = {}
        self.model = self.data = self._spec = None

    # --- for drivers -------------------------------------------------------------------------------------------------

    def handle(self, name: str, active: bool) -> None:
        """Report whether a robot's fingers move or hold something, for which they have to be coupled."""
        body = self.bodies[name]
        for joints, number in body.couplings:
            if joints <= self._fingers[name]:
                self.data.eq_active[number] = active

    def mass_matrix(self, at: Any, q: Sequence[float]) -> Array:
        """Return the joint-space inertia (n, n), kg m2, of the arm whose joints are at the places ``at``, if they were
        at ``q`` (n,), rad; all other joints are where they are.
        """
        mujoco, model, data = self.mujoco, self.model, self._scratch
        np.copyto(data.qpos, self._qpos)
        data.qpos[at] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        return self.motors.inertia(data, at)

    def dofs(self, body: Body, names: Sequence[str]) -> Any:
        """Return the places of some of an arm's joints among the first degrees of freedom: a slice where possible."""
        places = [body.qvel[body.joints[name]] for name in names]
        if places == list(range(places[0], places[0] + len(places))):
            return slice(places[0], places[0] + len(places))
        return np.array(places)

    # --- loading -----------------------------------------------------------------------------------------------------

    def load_body(self, spec: BodySpec | RobotSpec) -> Body:
        if isinstance(spec, RobotSpec):
            plan = plan_robot(spec, mirrored=spec.driver != self.spec.driver)
        else:
            plan = plan_object(spec)
        self._plans[spec.name] = plan
        self.warnings += plan.warnings
        return plan.body

    def unload_body(self, body: Body) -> None:
        take_out(self._spec, self._plans.pop(body.name))

    def arrange_bodies(self, added: Sequence[Body]) -> None:
        for body in sorted(added, key=lambda body: not body.is_robot):
            build(self._spec, self._plans[body.name])
        for part, whole, ignored in self.list_parts(added):
            for k, m in product(part.links.values(), ignored):
                first, second = part.link_path(k), whole.link_path(m)
                self._spec.add_exclude(bodyname1=first, bodyname2=second, name=f"{first}|{second}")
        add_pairs(self._spec, self.bodies.values())
        try:
            model = self._spec.compile()
        except ValueError as error:
            problems = [_not_compiled(body, str(error)) for body in added]
            named = [problem for problem in problems if "link" in problem.message]
            for body in added:
                del self.bodies[body.name]
                take_out(self._spec, self._plans.pop(body.name))
            raise ConfigError(named or problems or [_report_refusal(str(error))]) from None
        new = {body.name for body in added}
        self._adopt(model, [body for body in self.bodies.values() if body.name not in new])

    def _adopt(self, model: Any, old: Sequence[Body]) -> None:
        """Use a new model; the bodies ``old`` keep the state that they have in the present one."""
        mujoco, data = self.mujoco, self.mujoco.MjData(model)
        self.sleep = Sleep(mujoco, model, data)
        kept = {body.name: self._state_of(body) for body in old}
        for body in self.bodies.values():
            _find(body, model)
        self.model, self.data = model, data
        for body in old:
            self._set_state(body, kept[body.name])
        for body in self.bodies.values():
            if not body.floating:
                self._place_base(body)
        robots = [body for body in self.bodies.values() if body.is_robot]
        n = sum(len(body.movable) for body in robots)
        if n != self.motors.n:  # the first time: arms stay
            self.motors = Motors(n, self.dt, model.opt.timestep)
            for body in robots:
                self._set_limits(body)
                assert isinstance(body.spec, RobotSpec)
                places = [body.qvel[body.joints[name]] for name in body.spec.joints]
                self.motors.arms[body.name] = np.array(places)
        self.motors.bind(mujoco, model, data)
        self._fingers = {
            body.name: frozenset(body.joints[joint] for joint in body.spec.gripper.joints)
            for body in robots
            if isinstance(body.spec, RobotSpec) and body.spec.gripper is not None
        }
        self._mirrored = [body for body in robots if self.is_mirrored(body)]
        self._attached = self.list_attachments()
        self._step1, self._step2 = mujoco.mj_step1, mujoco.mj_step2
        self._speeds, self._sound = data.qvel, data.qpos.copy()
        self._qpos = data.qpos
        self.q, self.dq = data.qpos[:n], data.qvel[:n]
        self._scratch = mujoco.MjData(model)
        """For quantities of other states than the present one."""
        self.sleep.wake()
        self._placed = self._touched = False
        self._lay_out()

    def _set_limits(self, body: Body) -> None:
        for joint, place in body.qvel.items():
            self.motors.efforts[place], self.motors.speeds[place] = body.efforts[joint], body.speeds[joint]
            self.motors.damping[place] = body.damping.get(joint, 0.0)

    def _state_of(self, body: Body) -> tuple[list[Array], list[Array], list[bool]]:
        data, (at, along) = self.data, _places(body)
        active = [bool(data.eq_active[number]) for _, number in body.couplings]
        return [data.qpos[at]], [data.qvel[along], data.qacc_warmstart[along]], active

    def _set_state(self, body: Body, state: tuple[list[Array], list[Array], list[bool]]) -> None:
        data, (at, along) = self.data, _places(body)
        data.qpos[at] = state[0][0]
        data.qvel[along], data.qacc_warmstart[along] = state[1]
        for (_, number), active in zip(body.couplings, state[2], strict=True):
            data.eq_active[number] = active

    # --- the engine of SimulatedWorld --------------------------------------------------------------------------------

    def _kinematics(self) -> None:
        """Compute the poses of all links, if they are not those of the present state."""
        if self._placed:
            return
        self.mujoco.mj_kinematics(self.model, self.data)
        self._placed = True
        if self._attached:
            for body, arm, link in self._attached:
                body.place = compose(self._pose_of(arm.ids[link]), body.base)
                self._place_base(body)
                self.data.body_awake[body.ids] = True  # a fixed base is computed only then
            self.mujoco.mj_kinematics(self.model, self.data)

    def _pose_of(self, number: int) -> Transform:
        w, x, y, z = self.data.xquat[number].tolist()
        return tuple(self.data.xpos[number].tolist()), (x, y, z, w)

    def _place_base(self, body: Body) -> None:
        """Put a base that physics does not move at :attr:`.engine.Body.place`."""
        root, model = body.ids[0], self.model
        model.body_pos[root], model.body_quat[root] = body.place[0], wxyz(body.place[1])

    def place_attached(self) -> None:
        self._placed = False

    def read_pose(self, body: Body, link: int) -> Transform:
        self._kinematics()
        return self._pose_of(body.ids[link])

    def read_velocity(self, body: Body) -> tuple[Sequence[float], Sequence[float]]:
        if body.free is None:
            return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        at, along = body.free
        w, x, y, z = self.data.qpos[at + 3 : at + 7].tolist()
        speeds = self.data.qvel[along : along + 6].tolist()
        angular = rotate((x, y, z, w), speeds[3:])  # MuJoCo's is in the frame of the body
        lever = rotate((x, y, z, w), self.model.body_ipos[body.ids[0]].tolist())
        return [v + d for v, d in zip(speeds[:3], _cross(angular, lever), strict=True)], list(angular)

    def write_velocity(self, body: Body, linear: Sequence[float], angular: Sequence[float]) -> None:
        assert body.free is not None
        at, along = body.free
        w, x, y, z = self.data.qpos[at + 3 : at + 7].tolist()
        lever = rotate((x, y, z, w), self.model.body_ipos[body.ids[0]].tolist())
        own = [v - d for v, d in zip(linear, _cross(angular, lever), strict=True)]
        self.data.qvel[along : along + 6] = [*own, *rotate((-x, -y, -z, w), angular)]

    def move_base(self, body: Body, pose: Transform) -> None:
        self._placed = False
        if body.free is None:
            body.place = pose
            self._place_base(body)
            self.sleep.wake()
            self._lay_out()
            return
        self.sleep.wake()
        at, along = body.free
        self.data.qpos[at : at + 7] = [*pose[0], *wxyz(pose[1])]
        self.data.qvel[along : along + 6] = 0.0

    def move_joints(self, body: Body, positions: Mapping[int, float]) -> None:
        self._placed = False
        for joint, position in positions.items():
            place = body.qvel[joint]
            self.data.qpos[body.qpos[joint]], self.data.qvel[place] = position, 0.0
            if body.is_robot:
                self.motors.rest(place, position)
        if body.is_robot:
            self.motors.drive_by_motors(body.name)
            if not self.is_mirrored(body):
                self._set_limits(body)
                self.motors.limit()

    def read_joints(self, body: Body) -> Sequence[float]:
        return [float(self.data.qpos[body.qpos[joint]]) for joint in body.movable]

    def read_dynamics(self, body: Body, link: int) -> dict[str, Any]:
        return read_dynamics(self.model, body, link)

    def write_dynamics(self, body: Body, link: int, values: Mapping[str, Any], before: Mapping[str, Any]) -> None:
        write_dynamics(self._spec, body, link, values)
        try:
            self.arrange_bodies(())
        except ConfigError as error:
            write_dynamics(self._spec, body, link, {name: before[name] for name in values})
            self.arrange_bodies(())
            message = f"{body.name!r} cannot have these dynamics: {error.problems[0].message}"
            raise CommandError(message, code="bad_dynamics") from None

    def forget_contacts(self, bodies: Sequence[Body]) -> None:
        self.sleep.wake()
        if len(bodies) == len(self.bodies):
            self.fault, self._touched = None, False
        for body in bodies:
            self.data.qacc_warmstart[_places(body)[1]] = 0.0

    def save_engine(self) -> dict[str, Any]:
        mujoco, motors = self.mujoco, self.motors
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        values = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, values, kind)
        return {
            "integration": values.tolist(),
            "motors": [motors.state.tolist(), motors.efforts.tolist(), motors.speeds.tolist()],
            "sleep": self.sleep.save(),
            "places": {
                body.name: [list(part) for part in body.place] for body in self.bodies.values() if body.free is None
            },
        }

    def restore_engine(self, state: Any) -> None:
        mujoco, motors = self.mujoco, self.motors
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        values, parts = np.array(state["integration"], float), [np.array(part, float) for part in state["motors"]]
        shapes = (mujoco.mj_stateSize(self.model, kind),), motors.state.shape, motors.efforts.shape, motors.speeds.shape
        if tuple(part.shape for part in (values, *parts)) != shapes:
            raise ValueError("it has another size")
        if not all(np.isfinite(part).all() for part in (values, *parts)):
            raise ValueError("a number in it is not finite")
        sleep = self.sleep.check(state["sleep"])
        places = {name: transform(dict(zip(_POSE, place, strict=True))) for name, place in state["places"].items()}
        if set(places) != {body.name for body in self.bodies.values() if body.free is None}:
            raise ValueError("it has other fixed bodies")
        for name, place in places.items():
            self.bodies[name].place = place
            self._place_base(self.bodies[name])
        self.sleep.wake()
        mujoco.mj_setState(self.model, self.data, values, kind)
        self.sleep.restore(sleep)
        fingers = np.ones(motors.n, bool)
        for arm in motors.arms.values():
            fingers[arm] = False  # the limits of an arm are the rig's
        motors.state[:], motors.efforts[fingers], motors.speeds[fingers] = (
            parts[0], parts[1][fingers], parts[2][fingers],
        )  # fmt: skip
        motors.limit()
        for name in list(motors.torques):
            motors.drive_by_motors(name)  # an arm that torques drive applies its own
        self.fault, self._placed, self._touched = None, False, False
        self._lay_out()

    def push_link(self, force: AppliedForce[Body]) -> None:
        number, data = force.body.ids[force.link], self.data
        acting = data.xfrc_applied[number]  # at the centre of mass
        acting[:3] += force.force
        if force.point is not None:
            w, *xyz = data.xquat[number].tolist()
            lever = data.xpos[number] + rotate((*xyz, w), force.point) - data.xipos[number]
            acting[3:] += np.cross(lever, force.force)

    def write_gravity(self, gravity: Sequence[float]) -> None:
        self._spec.option.gravity = gravity
        self.model.opt.gravity[:] = gravity
        self.sleep.wake()

    def cast_ray(self, start: Sequence[float], end: Sequence[float]) -> RayFound | None:
        self._kinematics()
        return cast_ray(self.mujoco, self.model, self.data, self.bodies.values(), start, end)

    def measure_distance(self, a: Body, links_a: Sequence[int], b: Body, links_b: Sequence[int]) -> float | None:
        self._kinematics()
        own = [shape for link in links_a for shape in a.shapes[link]]
        others = [shape for link in links_b for shape in b.shapes[link]]
        return distance(self.mujoco, self.model, self.data, own, others)

    def find_contacts(self, a: Body | None, b: Body | None) -> list[dict[str, Any]]:
        if not self._touched:
            return []
        mujoco, model, data, bodies = self.mujoco, self.model, self.data, self.bodies.values()
        sleepers = set(self.sleep.sleepers().tolist())
        found = find_contacts(mujoco, model, data, bodies, a, b, without=sleepers)
        if sleepers:
            still, kind = self._scratch, mujoco.mjtState.mjSTATE_INTEGRATION
            mujoco.mj_copyState(model, data, still, kind)
            with self.sleep.off():
                mujoco.mj_forward(model, still)
            found += find_contacts(mujoco, model, still, bodies, a, b, only=sleepers)
        return found

    def find_overlap(self, a: Body, b: Body) -> tuple[float, str, str]:
        self._kinematics()
        return deepest_overlap(self.mujoco, self.model, self.data, a, b)

    def measure_box(self, body: Body) -> tuple[list[float], list[float]]:
        self._kinematics()
        return bounding_box(self.mujoco, self.model, self.data, body)

    # --- mirrors of real arms ----------------------------------------------------------------------------------------

    def place_mirror(self, body: Body, q: list[float], dq: list[float], width: float | None) -> None:
        assert isinstance(body.spec, RobotSpec)
        motors, data, at = self.motors, self.data, self.dofs(body, body.spec.joints)
        data.qpos[at], data.qvel[at] = q, dq
        motors.rest(at, [a + b * self.dt for a, b in zip(q, dq, strict=True)])
        motors.feed[at] = motors.wanted[at] = dq
        self._placed = False
        self._following.add(body.name)
        self._fresh.add(body.name)
        if width is not None and body.spec.gripper is not None:
            fingers = self.dofs(body, body.spec.gripper.joints)
            positions = body.spec.gripper.finger_positions(width)
            motors.target[fingers] = positions
            if body.name not in self._width_known:
                self._width_known.add(body.name)
                data.qpos[fingers], data.qvel[fingers] = positions, 0.0
                motors.rest(fingers, positions)

    def _hold_mirrors(self) -> None:
        """Let mirrors without a new state since the last step stay where they are."""
        for name in self._following - self._fresh:
            body = self.bodies[name]
            assert isinstance(body.spec, RobotSpec)
            at = self.dofs(body, body.spec.joints)
            self.motors.rest(at, self.data.qpos[at])
        self._following = set(self._fresh)
        self._fresh.clear()

    # --- snapshots ---------------------------------------------------------------------------------------------------

    def _lay_out(self) -> None:
        """Read the fixed bases again, and where a snapshot finds the others."""
        still: list[float] = []
        places: list[int] = []
        carried: list[tuple[int, Body]] = []
        everything = list(self.bodies.values())
        for body in everything:
            if not body.roams:
                still += [*body.place[0], *body.place[1]]
        for body in everything:
            if body.free is not None:
                at = body.free[0]
                places += [at, at + 1, at + 2, at + 4, at + 5, at + 6, at + 3]
            elif body.carried:
                carried.append((len(still) + len(places), body))
                places += [0] * 7
            places += [body.qpos[joint] for joint in body.movable]
        self._still, self._places, self._carried = still, np.array(places, int), carried

    def snapshot(self) -> list[float]:
        values: list[float] = self._still + self._qpos[self._places].tolist()
        if self._carried:
            self._kinematics()
            for at, body in self._carried:
                values[at : at + 7] = [*body.place[0], *body.place[1]]
        return values


def _find(body: Body, model: Any) -> None:
    body.ids = [model.body(body.mujoco_name(link)).id for link in body.links]
    body.shapes = [np.flatnonzero(model.geom_bodyid == number).tolist() for number in body.ids]
    names = {number: name for name, number in body.joints.items()}
    made = {joint: model.joint(body.mujoco_name(names[joint])) for joint in body.movable}
    body.qpos = {joint: int(found.qposadr[0]) for joint, found in made.items()}
    body.qvel = {joint: int(found.dofadr[0]) for joint, found in made.items()}
    free = model.joint(body.mujoco_name()) if body.floating else None
    body.free = None if free is None else (int(free.qposadr[0]), int(free.dofadr[0]))
    couplings = []
    for number in range(model.neq):
        name = model.equality(number).name
        if name.startswith(body.mujoco_name()):
            ends = [model.joint(int(of[number])).name for of in (model.eq_obj1id, model.eq_obj2id)]
            ends = [end.removeprefix(body.mujoco_name()) for end in ends]
            couplings.append((frozenset(body.joints[end] for end in ends), number))
    body.couplings = couplings


def _report_refusal(reason: str) -> Problem:
    return Problem("world", "world", f"MuJoCo: {' '.join(reason.removeprefix('Error: ').split())}", "bad_urdf")


def _not_compiled(body: Body, reason: str) -> Problem:
    """Return the problem of a body that MuJoCo refuses; it names a link if the reason does."""
    reason = " ".join(reason.removeprefix("Error: ").split())
    key = f"{'robots' if body.is_robot else 'objects'}.{body.name}"
    link = next((link for link in body.links if f"'{body.mujoco_name(link)}" in reason), None)
    if link is None:
        return Problem("world", key, f"MuJoCo cannot load it: {reason}", "bad_urdf")
    return Problem(body.spec.urdf or "world", f"{key}.urdf", f"MuJoCo cannot load link {link!r}: {reason}", "bad_urdf")


def _places(body: Body) -> tuple[list[int], list[int]]:
    """Return the places of a body's state in ``qpos`` and in ``qvel``."""
    at, along = list(body.qpos.values()), list(body.qvel.values())
    if body.free is not None:
        at += range(body.free[0], body.free[0] + 7)
        along += range(body.free[1], body.free[1] + 6)
    return at, along


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
