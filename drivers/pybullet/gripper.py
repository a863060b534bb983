"""A simulated parallel gripper: two coupled fingers, each with a motor of limited speed and force."""

from __future__ import annotations

from hal.drivers.scene.gripper import SimulatedGripper

from .engine import Body
from .motors import hold, position_gain
from .world import PyBulletWorld


class PyBulletGripper(SimulatedGripper[PyBulletWorld, Body]):
    """The driver of the fingers of one robot in a :class:`~hal.drivers.pybullet.world.PyBulletWorld`.

    To hold an object of mass m, friction needs ``2 mu force >= m (g + a)``, with ``mu`` the product of the frictions of
    finger and object (PyBullet's rule): 20 N for the 2 kg cube on the Panda's fingers (1.0 and 0.5) at rest.
    """

    WORLD = PyBulletWorld

    def find_device(self) -> None:
        self._joints = [self.body.joints[name] for name in self.spec.joints]
        self._read = self.scene.client.getJointStates

    def handle_fingers(self, active: bool) -> None:
        self.scene.handle(self.body.name, active)

    def drive_fingers(self, width: float, force: float, speed: float) -> None:
        client, travel, present = self.scene.client, self.travel, self.read_width()[0]
        drives = zip(
            self._joints,
            travel.positions(width),
            travel.efforts(force, present),
            travel.speeds(speed, present),
            strict=True,
        )
        for joint, position, effort, fastest in drives:
            client.setJointMotorControl2(
                self.body.id,
                joint,
                client.POSITION_CONTROL,
                targetPosition=position,
                force=effort,
                positionGain=position_gain(self.scene.dt),
                velocityGain=1.0,
                maxVelocity=fastest,
            )

    def resume_motors(self) -> None:
        if self._driven is not None:
            self.drive_fingers(*self._driven)
        else:
            targets = dict(zip(self._joints, self.travel.positions(self._target), strict=True))
            hold(self.scene.client, self.body, targets, self.scene.dt)

    def read_width(self) -> tuple[float, float, float, float]:
        positions, speeds, _, efforts = zip(*self._read(self.body.id, self._joints), strict=True)
        return self.travel.reading(positions, speeds, efforts)
