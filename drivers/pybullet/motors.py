"""How joints are driven: one gain, one rule, for holding and for following."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .body import Body
from .library import Client

Floats = Sequence[float]

__all__ = ["Gear", "Torques", "hold", "position_gain"]

STIFFNESS = 72.0
"""1/s: a position error dies away at this rate. At 240 Hz that is a gain of 0.3 per step. A loaded arm follows best
with it: from 0.5 on, the solver's remaining errors are fed back and grow."""
GEAR_SHARE = 0.8
"""Share of the error between coupled joints that one physics step takes away."""
GEAR_FORCE = 10.0
"""Strength of a coupling, as a multiple of the effort of the joints that it couples."""
CONSTRAINT_ERP = 0.2
"""PyBullet's own share, which it multiplies a gear's by."""


def position_gain(dt: float) -> float:
    """Share of the position error that a motor takes away in one physics step of ``dt`` seconds."""
    return min(1.0, STIFFNESS * dt)


def hold(client: Client, body: Body, targets: Mapping[int, float], dt: float) -> None:
    """Drive joints to positions (rad or m) and keep them there, within their speed and effort.

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


class Gear:
    """Makes one joint of a body follow another: ``q[follower] = multiplier * q[leader]``, plus what it is at the start.

    It acts between the two joints, so a finger that is blocked holds back the other one too.
    """

    def __init__(self, client: Client, body: int, leader: int, follower: int, multiplier: float, effort: float) -> None:
        """``effort`` is the greatest torque or force of the two joints, Nm or N."""
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
        """Uncouple the joints, which makes a physics step 4 % shorter. Idempotent."""
        if self._number is not None:
            self._client.removeConstraint(self._number)
            self._number = None


class Torques:
    """Some joints of a body, driven by torques on top of what carries their weight.

    PyBullet takes a torque for one step, so they must be given anew for each. Everything that is moved by the joints is
    carried, and what the motion itself asks for (Coriolis and centrifugal torques); what the gripper holds is not.
    """

    def __init__(self, client: Client, body: Body, joints: Sequence[int]) -> None:
        self._client = client
        self._body = body
        self._joints = list(joints)
        self._efforts = [body.efforts[joint] for joint in joints]
        self._movable = list(body.movable)
        self._places = [self._movable.index(joint) for joint in joints]
        self._still = [0.0] * len(self._movable)
        self._carry: Floats = ()
        self._given: Floats = [0.0] * len(self._joints)
        """What this step has got already, Nm: PyBullet adds up."""
        self.applied: Floats = self._given
        """What acted in the last step, Nm. PyBullet tells that of motors only."""

    def begin(self) -> None:
        """Switch the joints' own motors off."""
        client, nothing = self._client, [0.0] * len(self._joints)
        client.setJointMotorControlArray(self._body.id, self._joints, client.VELOCITY_CONTROL, forces=nothing)
        self._given = nothing
        self.next_step()

    def next_step(self) -> None:
        """A physics step is over; the next one has got nothing yet."""
        client, body = self._client, self._body
        q, dq, _, _ = zip(*client.getJointStates(body.id, self._movable), strict=True)
        carry = client.calculateInverseDynamics(body.id, q, dq, self._still)
        self._carry = [carry[place] for place in self._places]
        self.applied, self._given = self._given, [0.0] * len(self._joints)

    def give(self, tau: Floats) -> None:
        """These torques (Nm) and what carries the arm, within the efforts, for the next step."""
        wanted = [
            max(-effort, min(effort, own + carry))
            for own, carry, effort in zip(tau, self._carry, self._efforts, strict=True)
        ]
        more = [new - old for new, old in zip(wanted, self._given, strict=True)]
        client = self._client
        client.setJointMotorControlArray(self._body.id, self._joints, client.TORQUE_CONTROL, forces=more)
        self._given = wanted

    def mass_matrix(self, q: Floats) -> list[list[float]]:
        """Joint-space inertia of the joints at ``q`` (rad), kg m2; the body's other joints stay where they are."""
        client, body = self._client, self._body
        everything = [state[0] for state in client.getJointStates(body.id, self._movable)]
        for place, x in zip(self._places, q, strict=True):
            everything[place] = x
        rows = client.calculateMassMatrix(body.id, everything)
        return [[rows[i][k] for k in self._places] for i in self._places]
