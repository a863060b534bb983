"""The arm as PyBullet's rigid bodies, in a world of its own without anything else in it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from .model import RigidBody
from .plant import VISCOUS, Plant
from .samples import DT, Floats, Sample
from .urdf import without_shapes

__all__ = ["PyBulletPlant"]

_GAIN = 0.072
"""Share of the position error that a motor takes away per step; with much more a loaded arm trembles."""
_TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)


class PyBulletPlant(Plant):
    """Position control by PyBullet's motors, torque control by torques on top of gravity.

    A motor is a velocity constraint with a torque limit. Collisions are not looked at, and meshes not loaded.
    """

    def __init__(self, body: RigidBody, urdf: Path, q: Floats) -> None:
        """Raises ValueError when PyBullet is not there or does not take the URDF."""
        super().__init__(body, q)
        try:
            import pybullet
        except ImportError:
            raise ValueError("--plant pybullet needs PyBullet: pip install 'robot-hal[sim]'") from None
        self._bullet: Any = pybullet
        pybullet.connect(pybullet.DIRECT)
        pybullet.setTimeStep(DT)
        pybullet.setGravity(0.0, 0.0, -9.81)
        self._arm = self._load(urdf)
        count = pybullet.getNumJoints(self._arm)
        names = {pybullet.getJointInfo(self._arm, k)[1].decode(): k for k in range(count)}
        self._joints = [next(k for name, k in names.items() if name.endswith(f"joint{n}")) for n in range(1, 8)]
        for joint, damping in zip(self._joints, VISCOUS, strict=True):
            pybullet.changeDynamics(self._arm, joint, jointDamping=damping, linearDamping=0.0, angularDamping=0.0)
        self._motors_on = True
        self.place(q)

    def place(self, q: Floats) -> None:
        super().place(q)
        for joint, position in zip(self._joints, q, strict=True):
            self._bullet.resetJointState(self._arm, joint, position)

    def _load(self, urdf: Path) -> int:
        bullet = self._bullet
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as bare:
            bare.write(without_shapes(urdf.read_text(encoding="utf-8")))
            bare.flush()
            try:
                arm: int = bullet.loadURDF(bare.name, useFixedBase=True, flags=bullet.URDF_USE_INERTIA_FROM_FILE)
            except bullet.error as error:
                raise ValueError(f"PyBullet cannot load {urdf}: {error}") from None
        return arm

    def follow(self, desired: Sample) -> None:
        self._motors_on = True
        self._bullet.setJointMotorControlArray(
            self._arm,
            self._joints,
            self._bullet.POSITION_CONTROL,
            [p - v * DT for p, v in zip(desired.q, desired.dq, strict=True)],
            desired.dq,
            _TORQUE,
            [_GAIN] * 7,
            [1.0] * 7,
        )
        self._step()

    def push(self, torques: Floats) -> None:
        bullet = self._bullet
        if self._motors_on:
            bullet.setJointMotorControlArray(self._arm, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * 7)
            self._motors_on = False
        gravity = self.body.torques(self.q, (0.0,) * 7, (0.0,) * 7)
        applied = [a + b for a, b in zip(gravity, torques, strict=True)]
        bullet.setJointMotorControlArray(self._arm, self._joints, bullet.TORQUE_CONTROL, forces=applied)
        self._step()
        self.tau = applied

    def _step(self) -> None:
        self._bullet.stepSimulation()
        states = self._bullet.getJointStates(self._arm, self._joints)
        self.q, self.dq, _, self.tau = zip(*states, strict=True)

    def close(self) -> None:
        self._bullet.disconnect()
