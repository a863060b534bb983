"""An engine without physics, outside of robot-hal: arms are where their set-points are, objects where they are put."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

from hal.drivers.scene.engine import AppliedForce, RayFound, SimulatedBody
from hal.drivers.scene.gripper import FingerTravel
from hal.drivers.scene.robot import SimulatedRobot
from hal.drivers.scene.world import SimulatedWorld
from hal.errors import NotSupported
from hal.geometry import Pose, Transform, apply_rotation, compose
from hal.kinematics.urdf import read_urdf
from hal.registry import DriverSpec
from hal.specs import BodySpec, RobotSpec, WorldSpec

DRIVER = DriverSpec(
    name="kinematic",
    world="kinematic_engine:KinematicWorld",
    robot="kinematic_engine:KinematicRobot",
    camera="hal.drivers.scene.camera:SimulatedCamera",
    pictures="hal.drivers.scene.camera:SimulatedPictures",
)

Vector = Sequence[float]
ZERO = (0.0, 0.0, 0.0)


class Body(SimulatedBody):
    """A body, with its state."""

    at: Transform
    linear: Vector = ZERO
    angular: Vector = ZERO
    q: dict[int, float]
    """Position by the number of the joint, rad or m."""

    def joint_values(self) -> dict[str, float]:
        return {name: self.q[number] for name, number in self.joints.items() if number in self.q}


class KinematicWorld(SimulatedWorld[Body]):
    """Bodies that move as they are told; nothing falls, and nothing touches."""

    ENGINE = "Kinematic"

    def __init__(self, spec: WorldSpec) -> None:
        super().__init__(spec)
        self.load_bodies((*spec.bodies, *spec.robots))
        self.check_overlaps()

    def step(self) -> None:
        for prepare in self.preparations.values():
            prepare()
        for body in self.bodies.values():
            if body.floating:
                position = [x + self.dt * v for x, v in zip(body.at[0], body.linear, strict=True)]
                turned = apply_rotation(body.at[1], [self.dt * w for w in body.angular])
                body.at = tuple(position), tuple(turned)
        self.place_attached()
        self.steps += 1

    def snapshot(self) -> list[float]:
        bodies = list(self.bodies.values())
        fixed = [x for body in bodies if not body.roams for part in body.at for x in part]
        moving: list[float] = []
        for body in bodies:
            if body.moves:
                moving += [x for part in body.at for x in part] if body.roams else []
                moving += self.read_joints(body)
        return fixed + moving

    def close(self) -> None:
        self.bodies = {}

    # Bodies.

    def load_body(self, spec: BodySpec | RobotSpec) -> Body:
        is_robot = isinstance(spec, RobotSpec)
        urdf = read_urdf(Path(spec.urdf)) if spec.urdf else None
        links = [urdf.root, *(joint.child for joint in urdf.outwards)] if urdf else ["base"]
        joints = {name: number for number, name in enumerate(urdf.joints)} if urdf else {}
        home = {number: 0.0 for name, number in joints.items() if urdf is not None and urdf.joints[name].movable}
        if is_robot:
            home |= {joints[name]: value for name, value in zip(spec.joints, spec.initial, strict=True)}
        base = (spec.base_position, spec.base_orientation) if is_robot else (spec.position, spec.orientation)
        body = Body(
            name=spec.name,
            spec=spec,
            links={name: number for number, name in enumerate(links)},
            joints=joints,
            movable=tuple(home),
            floating=not is_robot and spec.robot is None and not spec.fixed and spec.mass > 0.0,
            home=home,
            base=base,
            urdf=urdf,
        )
        body.at, body.q = base, dict(home)
        return body

    def unload_body(self, body: Body) -> None:
        """Nothing is kept elsewhere."""

    def arrange_bodies(self, added: Sequence[Body]) -> None:
        """Nothing depends on the other bodies."""

    def place_attached(self) -> None:
        for body, arm, link in self.list_attachments():
            body.at = compose(self.read_pose(arm, link), body.base)

    def place_mirror(self, body: Body, q: list[float], dq: list[float], width: float | None) -> None:
        values = dict(zip(body.spec.joints, q, strict=True))
        if width is not None:
            values |= zip(body.spec.gripper.joints, FingerTravel(body.spec.gripper).positions(width), strict=True)
        body.q |= {body.joints[name]: value for name, value in values.items()}

    # States.

    def read_pose(self, body: Body, link: int) -> Transform:
        if body.urdf is None:
            return body.at
        within: Pose = body.urdf.poses(body.joint_values())[body.link_name(link)]
        return compose(body.at, (tuple(within.position.tolist()), tuple(within.orientation.tolist())))

    def read_velocity(self, body: Body) -> tuple[Vector, Vector]:
        return list(body.linear), list(body.angular)

    def write_velocity(self, body: Body, linear: Vector, angular: Vector) -> None:
        if body.floating:
            body.linear, body.angular = linear, angular

    def move_base(self, body: Body, pose: Transform) -> None:
        body.at, body.linear, body.angular = pose, ZERO, ZERO

    def move_joints(self, body: Body, positions: Mapping[int, float]) -> None:
        body.q |= positions

    def read_joints(self, body: Body) -> Vector:
        return [body.q[number] for number in body.movable]

    def save_engine(self) -> Any:
        return [[body.at, body.linear, body.angular, list(body.q.values())] for body in self.bodies.values()]

    def restore_engine(self, state: Any) -> None:
        for body, (at, linear, angular, q) in zip(self.bodies.values(), state, strict=True):
            body.at, body.linear, body.angular = (tuple(at[0]), tuple(at[1])), linear, angular
            body.q = dict(zip(body.q, q, strict=True))

    # Without shapes and forces.

    def find_overlap(self, a: Body, b: Body) -> tuple[float, str, str]:
        return 0.0, "", ""

    def measure_box(self, body: Body) -> tuple[list[float], list[float]]:
        return list(body.at[0]), list(body.at[0])

    def find_contacts(self, a: Body | None, b: Body | None) -> list[dict[str, Any]]:
        return []

    def cast_ray(self, start: Vector, end: Vector) -> RayFound | None:
        raise self.lacks("rays")

    def measure_distance(self, a: Body, links_a: Sequence[int], b: Body, links_b: Sequence[int]) -> float | None:
        raise self.lacks("distances")

    def read_dynamics(self, body: Body, link: int) -> dict[str, Any]:
        raise self.lacks("dynamics")

    def write_dynamics(self, body: Body, link: int, values: Mapping[str, Any], before: Mapping[str, Any]) -> None:
        raise self.lacks("dynamics")

    def push_link(self, force: AppliedForce[Body]) -> None:
        raise self.lacks("forces")

    def forget_contacts(self, bodies: Sequence[Body]) -> None:
        """There are none."""

    def write_gravity(self, gravity: Vector) -> None:
        """Nothing falls."""

    def lacks(self, what: str) -> NotSupported:
        return NotSupported(f"{self.ENGINE} is an engine without {what}; use PyBullet or MuJoCo")


class KinematicRobot(SimulatedRobot[KinematicWorld]):
    """An arm that is at its set-point after each step."""

    WORLD = KinematicWorld
    modes = frozenset({"position"})

    def find_device(self) -> None:
        self.body = self.scene.body(self.spec.name)
        self.numbers = [self.body.joints[name] for name in self.spec.joints]
        self.speed, self.moved = [0.0] * len(self.numbers), -inf

    def read_state(self) -> tuple[Vector, Vector, Vector]:
        speed = self.speed if self.scene.steps <= self.moved + 1 else [0.0] * len(self.numbers)
        return [self.body.q[k] for k in self.numbers], speed, [0.0] * len(self.numbers)

    def follow_setpoint(self, q: Vector, dq: Vector) -> None:
        self.body.q |= dict(zip(self.numbers, q, strict=True))
        self.speed, self.moved = list(dq), self.scene.steps

    def hold_at(self, q: Vector) -> None:
        self.body.q |= dict(zip(self.numbers, q, strict=True))
        self.speed = [0.0] * len(self.numbers)

    def release_motors(self) -> None:
        """It takes no torques."""

    def apply_torques(self, tau: Vector) -> None:
        """It takes no torques."""
