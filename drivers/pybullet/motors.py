"""How joints are driven: position motors, and torques on top of gravity compensation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.geometry import rotate
from hal.kinematics.arm import bounded_urdf
from hal.specs import RobotSpec

from .engine import Body, PyBulletClient

Array = NDArray[np.float64]
Floats = Sequence[float]

STIFFNESS = 72.0
"""Rate at which a position error decays, 1/s; at 240 Hz a gain of 0.3 per step. A loaded arm follows best with it: from
0.5 on, the solver's remaining errors are fed back and grow."""
GEAR_SHARE = 0.8
"""Share of the error between coupled joints that one physics step takes away."""
GEAR_FORCE = 10.0
"""Strength of a coupling, as a multiple of the effort of the joints that it couples."""
CONSTRAINT_ERP = 0.2
"""PyBullet's own share, which it multiplies a gear's by."""


def position_gain(dt: float) -> float:
    """Return the share of the position error that a motor takes away in one physics step of ``dt`` s."""
    return min(1.0, STIFFNESS * dt)


def hold(client: PyBulletClient, body: Body, targets: Mapping[int, float], dt: float) -> None:
    """Drive joints (index -> position, rad or m) and keep them there, within their speed and effort.

    The speed limit stays with each motor: it bounds every later set-point of that joint as well.
    """
    for joint, position in targets.items():
        client.setJointMotorControl2(
            body.id,
            joint,
            client.POSITION_CONTROL,
            targetPosition=position,
            targetVelocity=0.0,
            force=body.efforts[joint],
            positionGain=position_gain(dt),
            velocityGain=1.0,
            maxVelocity=body.speeds[joint],
        )


class PassiveJoints:
    """The friction and damping of an object's joints, which its URDF gives.

    PyBullet's own motor of a joint becomes its friction: it stops the joint with a force that is limited to friction
    and damping. So a great damping stops the joint at most, while PyBullet's own, an explicit force, makes it unstable.
    """

    def __init__(self, client: PyBulletClient, body: Body) -> None:
        assert body.urdf is not None
        joints = [joint for joint in body.urdf.joints.values() if joint.movable]
        self._client, self._id = client, body.id
        self._joints = [body.joints[joint.name] for joint in joints]
        self._friction = [joint.friction for joint in joints]
        self._damping = [joint.damping for joint in joints]
        self._still = [0.0] * len(joints)

    def release(self) -> None:
        """Put friction in the place of PyBullet's motors and damping."""
        for joint in self._joints:
            self._client.changeDynamics(self._id, joint, jointDamping=0.0)
        self._limit(self._friction)

    def prepare_step(self) -> None:
        """Limit the motors to friction and damping at the present speeds."""
        states = self._client.getJointStates(self._id, self._joints)
        rows = zip(self._friction, self._damping, states, strict=True)
        self._limit([friction + damping * abs(state[1]) for friction, damping, state in rows])

    def _limit(self, forces: Floats) -> None:
        client = self._client
        client.setJointMotorControlArray(
            self._id, self._joints, client.VELOCITY_CONTROL, targetVelocities=self._still, forces=forces
        )


class SimulatedDynamics:
    """Gravity and inertia of an arm as PyBullet simulates it, computed by pinocchio.

    PyBullet's own inverse dynamics keep the masses, and the place of the base, of the first call.
    """

    def __init__(self, client: PyBulletClient, body: Body) -> None:
        import pinocchio as pin

        assert isinstance(body.spec, RobotSpec)
        self._pin: Any = pin
        self._client = client
        self._body = body
        self._model: Any = pin.buildModelFromXML(bounded_urdf(body.spec.urdf))
        self._data: Any = self._model.createData()
        self._links = {link: self._model.frames[self._model.getBodyId(name)] for name, link in body.links.items()}
        names = {number: name for name, number in body.joints.items()}
        self.movable = sorted(body.movable, key=lambda joint: int(self._joint(names[joint]).idx_v))
        """Joints in the order of all vectors here."""
        self._edits = -1

    def _joint(self, name: str) -> Any:
        return self._model.joints[self._model.getJointId(name)]

    def update(self) -> None:
        """Read masses, base and gravity again if they were changed."""
        client, body, pin = self._client, self._body, self._pin
        if self._edits == body.edits:
            return
        self._edits = body.edits
        inertias = [pin.Inertia.Zero() for _ in range(self._model.njoints)]
        for link, frame in self._links.items():
            mass, _, moments, position, orientation = client.getDynamicsInfo(body.id, link)[:5]
            if mass > 0.0 and frame.parentJoint > 0:
                place = frame.placement * pin.XYZQUATToSE3(np.array([*position, *orientation]))
                inertias[frame.parentJoint] += place.act(pin.Inertia(mass, np.zeros(3), np.diag(moments)))
        for k, inertia in enumerate(inertias):
            self._model.inertias[k] = inertia
        x, y, z, w = body.base_pose(client)[1]
        world = client.getPhysicsEngineParameters()
        down = [world[f"gravityAcceleration{axis}"] for axis in "XYZ"]
        self._model.gravity.linear = np.array(rotate((-x, -y, -z, w), down))

    def gravity(self, q: Array) -> Array:
        """Return the torques (n,), Nm, that hold all joints still at ``q`` (n,)."""
        torques: Array = self._pin.computeGeneralizedGravity(self._model, self._data, q)
        return torques

    def bias(self, q: Array, dq: Array) -> Array:
        """Return gravity, Coriolis and centrifugal torques (n,), Nm."""
        torques: Array = self._pin.nonLinearEffects(self._model, self._data, q, dq)
        return torques

    def inertia(self, q: Array) -> Array:
        mass: Array = self._pin.crba(self._model, self._data, q)
        return mass


class JointTorques:
    """Drives some joints of a body by torques, on top of the compensation of gravity.

    PyBullet takes a torque for one step, so they must be applied again for each. The compensation covers gravity on
    everything that the joints move; an object in the gripper is not compensated.

    While torques drive the arm, damping in the URDF is integrated implicitly here: PyBullet takes it from the speed at
    the start of the step, which is unstable for a light wrist (0.5 Nm s/rad on 0.001 kg m2 at 240 Hz). It follows from
    the speed that is expected at the end instead, ``(M + dt D) v = M v0 + dt (tau - bias + external)``; contacts and
    loads are estimated from what the step before changed unexpectedly.
    """

    def __init__(self, client: PyBulletClient, body: Body, joints: Sequence[int], dt: float) -> None:
        self._client = client
        self._body = body
        self._joints = list(joints)
        self._dt = dt
        self._efforts = [body.efforts[joint] for joint in joints]
        self._model = SimulatedDynamics(client, body)
        places = [self._model.movable.index(joint) for joint in joints]
        self._places = np.array(places)
        self._block = np.ix_(places, places)
        damping = [float(client.getJointInfo(body.id, joint)[6]) for joint in joints]
        self._damping: Array | None = np.array(damping) if any(damping) else None
        """Nm s/rad; None if no joint has any."""
        self._positions = np.zeros(0)
        """Of all joints of the body, at the start of the present step."""
        self._gravity: Floats = ()
        self._weighed = -1
        """Number of the body's edits that the gravity and the inertia of the present step have."""
        self._applied: Floats = [0.0] * len(self._joints)
        """Torques of the coming step, Nm."""
        self._sum: Floats = self._applied
        """What PyBullet has added up for that step, Nm: those torques and the damping's."""
        self.last_applied: Floats = self._applied
        """Torques that acted in the last step, Nm; PyBullet reports those of motors only."""
        self._external = np.zeros(len(joints))
        """Estimated torques of contacts and loads, Nm."""
        self._v0 = self._mass = self._bias = np.zeros(0)
        """Of the present step: speeds at its start (n,), inertia (n, n), and gravity and Coriolis torques (n,)."""
        self._handover: Array | float = 0.0
        """Torques (n,) of the motors in the step in which they hand over, Nm."""
        self._driving = False
        self._reloads = body.reloads
        """That of the body to which the torques were added."""

    def take_over(self, dq: Floats) -> None:
        """Switch the motors off, which follow these speeds (n,), rad/s, and start to apply torques.

        PyBullet's solver stops before its motors have exactly the speed that they follow. In the first step they get
        there, within their effort, so that an arm that was held does not drift away.
        """
        self.switch_off()
        self._applied = self._sum = [0.0] * len(self._joints)
        self._external = np.zeros(len(self._joints))
        self._v0 = np.zeros(0)
        self.next_step()
        q, now = self._state()
        self._handover = self._model.inertia(q)[self._block] @ (np.array(dq) - now[self._places]) / self._dt

    def switch_off(self) -> None:
        client, nothing = self._client, [0.0] * len(self._joints)
        client.setJointMotorControlArray(self._body.id, self._joints, client.VELOCITY_CONTROL, forces=nothing)
        if not self._driving:
            self._driving = True
            self._set_damping([0.0] * len(self._joints))

    def end(self) -> None:
        """Let PyBullet damp the joints again, because their motors follow. Idempotent."""
        if self._driving:
            self._driving = False
            if self._damping is not None:
                self._set_damping(self._damping.tolist())

    def _set_damping(self, damping: Floats) -> None:
        if self._damping is not None:
            for joint, value in zip(self._joints, damping, strict=True):
                self._client.changeDynamics(self._body.id, joint, jointDamping=value)

    def next_step(self) -> None:
        """Start the next physics step, to which no torques are applied yet."""
        self._model.update()
        q, dq = self._state()
        self._positions = q
        if len(self._v0):
            expected = np.array(self._sum) - self._bias
            self._external = self._mass @ (dq[self._places] - self._v0) / self._dt - expected
        self._weigh(q, dq)
        self.last_applied, self._applied = self._applied, [0.0] * len(self._joints)
        self._sum = self._applied
        self._handover = 0.0

    def _state(self) -> tuple[Array, Array]:
        q, dq, _, _ = zip(*self._client.getJointStates(self._body.id, self._model.movable), strict=True)
        return np.array(q), np.array(dq)

    def _weigh(self, q: Array, dq: Array) -> None:
        self._weighed = self._body.edits
        self._gravity = self._model.gravity(q)[self._places].tolist()
        if self._damping is not None:
            self._v0 = dq[self._places]
            self._mass = self._model.inertia(q)[self._block]
            self._bias = self._model.bias(q, dq)[self._places]

    def apply(self, tau: Floats) -> None:
        """Apply torques (Nm) plus the compensation, within the efforts, to the next step."""
        if self._weighed != self._body.edits:
            self._model.update()
            self._weigh(*self._state())
        wanted = [
            max(-effort, min(effort, own + held))
            for own, held, effort in zip(np.add(tau, self._handover), self._gravity, self._efforts, strict=True)
        ]
        total = wanted if self._damping is None else self._add_damping(wanted, self._damping)
        self._add([new - old for new, old in zip(total, self._sum, strict=True)])
        self._applied = wanted

    def _add_damping(self, torques: Floats, damping: Array) -> list[float]:
        """Return the torques of the motors with those of the damping (n,), Nm."""
        dt = self._dt
        free = self._mass @ self._v0 + dt * (np.array(torques) - self._bias + self._external)
        speeds = np.linalg.solve(self._mass + np.diag(dt * damping), free)
        total: list[float] = (torques - damping * speeds).tolist()
        return total

    def _add(self, more: Floats) -> None:
        client = self._client
        client.setJointMotorControlArray(self._body.id, self._joints, client.TORQUE_CONTROL, forces=more)
        self._sum = [a + b for a, b in zip(self._sum, more, strict=True)]
        self._reloads = self._body.reloads

    def save(self) -> dict[str, Floats]:
        """Return the torques of the coming step, which are no part of PyBullet's states."""
        parts = {"sum": self._sum, "applied": self._applied, "gravity": self._gravity}
        return {name: list(part) for name, part in parts.items()} | {"external": self._external.tolist()}

    def withdraw(self) -> None:
        """Withdraw what was applied to the coming step; a body that was loaded again has nothing of it."""
        if self._reloads == self._body.reloads:
            self._add([-part for part in self._sum])
        self._applied = self._sum = [0.0] * len(self._joints)

    def restore(self, state: Mapping[str, Floats]) -> None:
        """Apply the torques of :meth:`save` to the coming step, to which nothing is applied yet."""
        self._sum = [0.0] * len(self._joints)
        self._add(state["sum"])
        self._model.update()
        self._positions, dq = self._state()
        self._weigh(self._positions, dq)
        self._applied, self._gravity = state["applied"], state["gravity"]
        self._external = np.array(state["external"])

    def mass_matrix(self, q: Floats) -> Array:
        """Return the inertia matrix (n, n) at ``q`` (n,) rad, kg m2; the body's other joints keep their positions."""
        self._model.update()
        everything = self._positions.copy() if self._driving else self._state()[0]
        everything[self._places] = q
        return self._model.inertia(everything)[self._block]
