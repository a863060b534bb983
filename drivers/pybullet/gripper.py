"""A simulated parallel gripper: two coupled fingers, each with a motor of limited speed and force."""

from __future__ import annotations

from hal.drivers.scene.gripper import SimulatedGripper

from .engine import Body
from .motors import hold, position_gain
from .world import PyBulletWorld

__all__ = ["PyBulletGripper"]


class PyBulletGripper(SimulatedGripper[PyBulletWorld, Body]):
    """The driver of the fingers of one robot in a :class:`~hal.drivers.pybullet.world.PyBulletWorld`.

    To hold an object of mass m, friction needs ``2 mu force >= m (g + a)``, with ``mu`` the product of the frictions of
    finger and object (PyBullet's rule): 20 N for the 2 kg cube on the Panda's fingers (1.0 and 0.5) at rest.
    """

    WORLD = PyBulletWorld

    def _find(self) -> None:
        self._joints = [self._body.joints[name] for name in self.spec.joints]
        self._read = self._world.client.getJointStates

    def _handle(self, active: bool) -> None:
        self._world.handle(self._body.name, active)

    def _drive(self, speed: float) -> None:
        client, travel, width = self._world.client, self._travel, self._width()[0]
        drives = zip(
            self._joints,
            travel.positions(self._target),
            travel.efforts(self._force, width),
            travel.speeds(speed, width),
            strict=True,
        )
        for joint, position, effort, fastest in drives:
            client.setJointMotorControl2(
                self._body.id,
                joint,
                client.POSITION_CONTROL,
                targetPosition=position,
                force=effort,
                positionGain=position_gain(self._world.dt),
                velocityGain=1.0,
                maxVelocity=fastest,
            )

    def _resume(self) -> None:
        if self._driven is not None:
            self._drive(self._driven)
        else:
            targets = dict(zip(self._joints, self._travel.positions(self._target), strict=True))
            hold(self._world.client, self._body, targets, self._world.dt)

    def _width(self) -> tuple[float, float, float, float]:
        positions, speeds, _, efforts = zip(*self._read(self._body.id, self._joints), strict=True)
        return self._travel.reading(positions, speeds, efforts)
