"""A real arm's copy in the simulated world: it goes where the arm goes, whatever is in its way."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from hal.specs import RobotSpec

from .body import Body
from .library import Client
from .motors import position_gain
from .values import numbers

__all__ = ["ArmCopy"]

STRENGTH = 10.0
"""Torques of the copy's motors, as a multiple of the arm's: nothing in the world holds it back or makes it sag."""


class ArmCopy:
    """Poses a body of the world by what an arm elsewhere reports, in time for each physics step.

    Its joints are put where the arm's are, and have the arm's speeds during the step, so they push what they touch as
    the arm would. Its fingers are driven to the arm's width with the force of its grip: on a thing that exists only in
    the simulation they close as far as that, and hold it.
    """

    def __init__(self, client: Client, body: Body, dt: float) -> None:
        spec = body.spec
        assert isinstance(spec, RobotSpec)
        gripper = spec.gripper
        self._client = client
        self._body = body
        self._joints = [body.joints[name] for name in spec.joints]
        self._torques = [STRENGTH * body.efforts[joint] for joint in self._joints]
        self._fingers = [body.joints[name] for name in gripper.joints] if gripper else []
        self._grip = [gripper.force if gripper else 0.0] * len(self._fingers)
        self._gains = [position_gain(dt)] * len(self._joints)
        self._fresh = False
        """Was it told where the arm is since the last step?"""
        self._following = False
        self._placed = False
        """Were its fingers put where the arm's are?"""
        self._hold()

    def follow(self, q: Sequence[float], dq: Sequence[float], width: float | None) -> None:
        """Go where the arm is: see :meth:`.world.World.follow`."""
        name, count = self._body.name, len(self._joints)
        positions, speeds = numbers(f"q of {name!r}", q, count), numbers(f"dq of {name!r}", dq, count)
        if width is not None and self._fingers:
            self._follow_width(numbers(f"the width of {name!r}", [width])[0] / 2.0)
        client = self._client
        client.resetJointStatesMultiDof(self._body.id, self._joints, _singly(positions), _singly(speeds))
        client.setJointMotorControlArray(
            self._body.id, self._joints, client.VELOCITY_CONTROL, targetVelocities=speeds, forces=self._torques
        )
        self._fresh = self._following = True

    def _follow_width(self, half: float) -> None:
        client, count = self._client, len(self._fingers)
        if not self._placed:
            client.resetJointStatesMultiDof(self._body.id, self._fingers, [[half]] * count, [[0.0]] * count)
            self._placed = True
        client.setJointMotorControlArray(
            self._body.id,
            self._fingers,
            client.POSITION_CONTROL,
            targetPositions=[half] * count,
            forces=self._grip,
            positionGains=[1.0] * count,
            velocityGains=[1.0] * count,
        )

    def prepare_step(self) -> None:
        """To be called before each physics step. A copy that was told nothing since the last one stays where it is."""
        if self._following and not self._fresh:
            self._hold()
            self._following = False
        self._fresh = False

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
    """Each in a list of its own, as PyBullet wants the values of joints that could have more than one."""
    return [[value] for value in values]
