"""A simulated arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hal.drivers.scene.robot import SimulatedRobot

from .world import MujocoWorld

Floats = Sequence[float]


class MujocoRobot(SimulatedRobot[MujocoWorld]):
    """The driver of one robot in a :class:`~hal.drivers.mujoco.world.MujocoWorld`, moved by :class:`.motors.Motors`."""

    WORLD = MujocoWorld

    def find_device(self) -> None:
        self.body = self.scene.body(self.spec.name)
        self._at = self.scene.dofs(self.body, self.spec.joints)
        self._inertia: Any = None

    def read_state(self) -> tuple[Floats, Floats, Floats]:
        world, at = self.scene, self._at
        return world.q[at].tolist(), world.dq[at].tolist(), world.motors.applied[at].tolist()

    def follow_setpoint(self, q: Floats, dq: Floats) -> None:
        motors, at = self.scene.motors, self._at
        motors.target[at] = q
        motors.feed[at] = dq

    def hold_at(self, q: Floats) -> None:
        motors, at = self.scene.motors, self._at
        if motors.drive_by_motors(self.spec.name):
            motors.rest(at, q)
        motors.target[at], motors.feed[at] = q, 0.0

    def release_motors(self) -> None:
        """Do nothing: the first torques switch the motors off."""

    def apply_torques(self, tau: Floats) -> None:
        self.scene.motors.drive_by_torques(self.spec.name, self._at, tau)

    def _restore(self, state: dict[str, Any]) -> None:
        super()._restore(state)
        if self._tau is not None:
            self.apply_torques(self._tau)

    def mass_matrix(self, q: Sequence[float]) -> Any:
        """Return the joint-space inertia of the simulated arm (n, n) at ``q``, kg m2."""
        return self.scene.mass_matrix(self._at, q)
