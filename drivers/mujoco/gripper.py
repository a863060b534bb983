"""A simulated parallel gripper: two coupled fingers, each with a motor of limited speed and force."""

from __future__ import annotations

from hal.drivers.scene.gripper import SimulatedGripper

from .engine import Body
from .world import MujocoWorld


class MujocoGripper(SimulatedGripper[MujocoWorld, Body]):
    """The driver of the fingers of one robot in a :class:`~hal.drivers.mujoco.world.MujocoWorld`.

    To hold an object of mass m, friction needs ``2 mu force >= m (g + a)``, with ``mu`` the product of the frictions of
    finger and object: 20 N for the 2 kg cube on the Panda's fingers (1.0 and 0.5) at rest.
    """

    WORLD = MujocoWorld

    def find_device(self) -> None:
        self._at = self.scene.dofs(self.body, self.spec.joints)
        joints, followers = self.spec.joints, self.body.followers
        self._followers = self.scene.dofs(self.body, [one.joint for one in followers]) if followers else None
        self._follow = [(joints.index(one.of), one.multiplier, one.offset) for one in followers]

    def handle_fingers(self, active: bool) -> None:
        self.scene.handle(self.body.name, active)

    def drive_fingers(self, width: float, force: float, speed: float) -> None:
        motors, at, travel = self.scene.motors, self._at, self.travel
        present = self.read_width()[0]
        targets, speeds = travel.positions(width), travel.speeds(speed, present)
        motors.target[at], motors.feed[at] = targets, 0.0
        motors.efforts[at], motors.speeds[at] = travel.efforts(force, present), speeds
        if self._followers is not None:  # their couplings move them; the law of the motors has to expect it
            motors.target[self._followers] = [ratio * targets[of] + offset for of, ratio, offset in self._follow]
            motors.speeds[self._followers] = [abs(ratio) * speeds[of] for of, ratio, _ in self._follow]
        motors.limit()

    def read_width(self) -> tuple[float, float, float, float]:
        world, at = self.scene, self._at
        return self.travel.reading(world.q[at].tolist(), world.dq[at].tolist(), world.motors.applied[at].tolist())
