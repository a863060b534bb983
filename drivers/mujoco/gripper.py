"""A simulated parallel gripper: two coupled fingers, each with a motor of limited speed and force."""

from __future__ import annotations

from hal.drivers.scene.gripper import SimulatedGripper

from .engine import Body
from .world import MujocoWorld

__all__ = ["MujocoGripper"]


class MujocoGripper(SimulatedGripper[MujocoWorld, Body]):
    """The driver of the fingers of one robot in a :class:`~hal.drivers.mujoco.world.MujocoWorld`.

    To hold an object of mass m, friction needs ``2 mu force >= m (g + a)``, with ``mu`` the product of the frictions of
    finger and object: 20 N for the 2 kg cube on the Panda's fingers (1.0 and 0.5) at rest.
    """

    WORLD = MujocoWorld

    def _find(self) -> None:
        self._at = self._world.dofs(self._body, self.spec.joints)

    def _handle(self, active: bool) -> None:
        self._world.handle(self._body.name, active)

    def _drive(self, speed: float) -> None:
        motors, at = self._world.motors, self._at
        motors.target[at], motors.feed[at] = self._aim / 2.0, 0.0
        motors.efforts[at], motors.speeds[at] = self._force, speed / 2.0
        motors.limit()

    def _width(self) -> tuple[float, float, float, float]:
        world, at = self._world, self._at
        widths, speeds = world.q[at].tolist(), world.dq[at].tolist()
        forces = world.motors.applied[at].tolist()
        share = 2.0 / len(widths)
        return share * sum(widths), share * sum(speeds), -max(forces), max(map(abs, forces))
