"""How joints are driven: position motors, and torques on top of gravity compensation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .engine import Body, PyBulletClient

__all__ = ["JointTorques", "PassiveJoints", "hold", "position_gain"]

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
    """Drive joints to positions and keep them there, within their speed and effort.

    The speed limit stays with each motor: it bounds every later set-point of that joint as well.

    Args:
        client: The world.
        body: The body.
        targets: Position by joint index, rad or m.
        dt: The physics step, s.
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


class JointTorques:
    """Drives some joints of a body by torques, on top of the compensation of gravity and motion.

    PyBullet takes a torque for one step, so they must be applied again for each. The compensation covers gravity on
    everything that the joints move, and Coriolis and centrifugal torques; an object in the gripper is not compensated.
    """

    def __init__(self, client: PyBulletClient, body: Body, joints: Sequence[int]) -> None:
        self._client = client
        self._body = body
        self._joints = list(joints)
        self._efforts = [body.efforts[joint] for joint in joints]
        self._movable = sorted(body.movable)  # PyBullet's order of degrees of freedom
        self._places = [self._movable.index(joint) for joint in joints]
        self._still = [0.0] * len(self._movable)
        self._compensation: Floats = ()
        self._applied: Floats = [0.0] * len(self._joints)
        """Torques of the coming step, Nm."""
        self._sum: Floats = self._applied
        """What PyBullet has added up for that step, Nm: the same but for rounding."""
        self.last_applied: Floats = self._applied
        """Torques that acted in the last step, Nm; PyBullet reports those of motors only."""

    def take_over(self) -> None:
        """Switch the joints' own motors off, and start to apply torques."""
        self.switch_off()
        self._applied = self._sum = [0.0] * len(self._joints)
        self.next_step()

    def switch_off(self) -> None:
        """Switch the joints' own motors off."""
        client, nothing = self._client, [0.0] * len(self._joints)
        client.setJointMotorControlArray(self._body.id, self._joints, client.VELOCITY_CONTROL, forces=nothing)

    def next_step(self) -> None:
        """Start the next physics step, to which no torques are applied yet."""
        client, body = self._client, self._body
        q, dq, _, _ = zip(*client.getJointStates(body.id, self._movable), strict=True)
        compensation = client.calculateInverseDynamics(body.id, q, dq, self._still)
        self._compensation = [compensation[place] for place in self._places]
        self.last_applied, self._applied = self._applied, [0.0] * len(self._joints)
        self._sum = self._applied

    def apply(self, tau: Floats) -> None:
        """Apply torques (Nm) plus the compensation, within the efforts, to the next step."""
        wanted = [
            max(-effort, min(effort, own + held))
            for own, held, effort in zip(tau, self._compensation, self._efforts, strict=True)
        ]
        more = [new - old for new, old in zip(wanted, self._applied, strict=True)]
        self._add(more)
        self._applied = wanted

    def _add(self, more: Floats) -> None:
        client = self._client
        client.setJointMotorControlArray(self._body.id, self._joints, client.TORQUE_CONTROL, forces=more)
        self._sum = [a + b for a, b in zip(self._sum, more, strict=True)]

    def save(self) -> dict[str, Floats]:
        """Return the torques of the coming step, which are no part of PyBullet's states."""
        parts = {"sum": self._sum, "applied": self._applied, "compensation": self._compensation}
        return {name: list(part) for name, part in parts.items()}

    def withdraw(self) -> None:
        """Withdraw what was applied to the coming step."""
        self._add([-part for part in self._sum])
        self._applied = self._sum

    def restore(self, state: Mapping[str, Floats]) -> None:
        """Apply the torques of :meth:`save` to the coming step, to which nothing is applied yet."""
        self._sum = [0.0] * len(self._joints)
        self._add(state["sum"])
        self._applied, self._compensation = state["applied"], state["compensation"]

    def mass_matrix(self, q: Floats) -> list[list[float]]:
        """Return the inertia matrix (n, n) at ``q`` (n,) rad, kg m2; the body's other joints keep their positions."""
        client, body = self._client, self._body
        everything = [state[0] for state in client.getJointStates(body.id, self._movable)]
        for place, x in zip(self._places, q, strict=True):
            everything[place] = x
        rows = client.calculateMassMatrix(body.id, everything)
        return [[rows[i][k] for k in self._places] for i in self._places]
