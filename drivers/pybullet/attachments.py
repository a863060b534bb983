"""Bodies that are placed rather than simulated: mirrors of real arms, and objects attached to links of arms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from hal.drivers.scene.gripper import FingerTravel
from hal.geometry import compose
from hal.specs import RobotSpec

from .engine import Body, PyBulletClient
from .motors import position_gain


class AttachedObjects:
    """Keeps objects that are attached to a link of an arm, such as a board in a gripper, at that link.

    They take no part in the physics: they have no weight and touch nothing. ``places`` has each object, its arm, and
    the index of the arm's link.
    """

    def __init__(self, client: PyBulletClient, places: Sequence[tuple[Body, Body, int]]) -> None:
        self._client = client
        self._places = places

    def leave_physics(self, bodies: Iterable[Body]) -> None:
        """Disable the contacts of those of these bodies that are attached."""
        for body in bodies:
            if body.carried:
                for link in body.links.values():
                    self._client.setCollisionFilterGroupMask(body.id, link, 0, 0)

    def follow(self) -> None:
        """Place every attached object at its link."""
        client = self._client
        for body, arm, link in self._places:
            if link == -1:
                here = arm.base_pose(client)
            else:
                state = client.getLinkState(arm.id, link, computeForwardKinematics=True)
                here = (state[4], state[5])
            body.set_base_pose(client, compose(here, body.base))


STRENGTH = 30.0
"""Torques of the mirror's motors, as a multiple of the arm's: nothing in the world stops it or makes it sag."""


class MirroredArm:
    """Places a body by the states that a real arm reports, before each physics step.

    Its joints take the arm's positions, and the arm's speeds during the step, so they push what they touch as the arm
    would. Its fingers are driven to the arm's width with the force of its grip: on an object that exists only in the
    simulation they close until they touch it, and hold it.
    """

    def __init__(self, client: PyBulletClient, body: Body, dt: float) -> None:
        spec = body.spec
        assert isinstance(spec, RobotSpec)
        gripper = spec.gripper
        self._client = client
        self._body = body
        self._dt = dt
        self._joints = [body.joints[name] for name in spec.joints]
        self._torques = [STRENGTH * body.efforts[joint] for joint in self._joints]
        self._fingers = [body.joints[name] for name in gripper.joints] if gripper else []
        self._gripper = gripper
        self._grip = FingerTravel(gripper).efforts(gripper.force, gripper.width_max / 2.0) if gripper else []
        self._gains = [position_gain(dt)] * len(self._joints)
        self._fresh = False
        """Whether a state of the arm has arrived since the last step."""
        self._following = False
        self._ahead: tuple[list[float], list[float]] = ([], [])
        """Where the arm is after the step, rad, and its speeds, rad/s."""
        self._placed = False
        """Whether its fingers have been placed at the arm's width once."""
        self._hold()

    def follow(self, positions: list[float], speeds: list[float], width: float | None) -> None:
        if width is not None and self._fingers:
            self._follow_width(width)
        self._place(positions, speeds)
        client = self._client
        client.setJointMotorControlArray(
            self._body.id, self._joints, client.VELOCITY_CONTROL, targetVelocities=speeds, forces=self._torques
        )
        self._ahead = [q + dq * self._dt for q, dq in zip(positions, speeds, strict=True)], speeds
        self._fresh = self._following = True

    def _place(self, positions: list[float], speeds: list[float]) -> None:
        self._client.resetJointStatesMultiDof(self._body.id, self._joints, _singly(positions), _singly(speeds))

    def _follow_width(self, width: float) -> None:
        assert self._gripper is not None
        client, count = self._client, len(self._fingers)
        positions = self._gripper.finger_positions(width)
        if not self._placed:
            client.resetJointStatesMultiDof(self._body.id, self._fingers, _singly(positions), [[0.0]] * count)
            self._placed = True
        client.setJointMotorControlArray(
            self._body.id,
            self._fingers,
            client.POSITION_CONTROL,
            targetPositions=positions,
            forces=self._grip,
            positionGains=[1.0] * count,
            velocityGains=[1.0] * count,
        )

    def prepare_step(self) -> None:
        """Prepare the next physics step: without a new state since the last one the mirror stays where it is."""
        if self._following and not self._fresh:
            self._hold()
            self._following = False
        self._fresh = False

    def finish_step(self) -> None:
        """Place the mirror where the arm is after the step: what it pushed does not stop a real arm."""
        if self._following:
            self._place(*self._ahead)

    def _hold(self) -> None:
        client = self._client
        client.setJointMotorControlArray(
            self._body.id,
            self._joints,
            client.POSITION_CONTROL,
            targetPositions=[state[0] for state in client.getJointStates(self._body.id, self._joints)],
            forces=self._torques,
            positionGains=self._gains,
            velocityGains=[1.0] * len(self._joints),
        )


def _singly(values: Iterable[float]) -> list[list[float]]:
    """Return each value in a list of its own, as PyBullet takes those of joints with several degrees of freedom."""
    return [[value] for value in values]
