"""The emulated mechanics: a rigid-body arm with gravity, friction and motors, and a gripper with one motor.

Both are integrated with the drives of their motors in the equation: the velocity at the end of a step solves

    (M + A + dt (Kd + B) + dt^2 Kp) v = (M + A) v0 + dt (tau + Kp (q_target - q0) + Kd dq_target - c - g) + friction

with the mass matrix M, the motors' inertia A and viscous friction B. Stiffness and damping act on the end of the step,
so they may be as large as a motor allows, also on a light wrist. Coulomb friction is the torque within its bounds that
brings each joint to rest, found by Gauss-Seidel iterations; a joint that it can hold does not creep.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hal.specs import KinematicsSpec

_STOP_STIFFNESS, _STOP_DAMPING = 2000.0, 50.0
"""A joint's mechanical stop, Nm/rad and Nm s/rad."""
_SWEEPS = 4
"""Gauss-Seidel iterations per step; they start from the friction of the step before."""


class Drive(NamedTuple):
    """What a motor does: torque = kp (q - q_measured) + kd (dq - dq_measured) + tau, within its greatest torque."""

    q: float = 0.0
    dq: float = 0.0
    kp: float = 0.0
    kd: float = 0.0
    tau: float = 0.0


OFF = Drive()
"""A motor without power."""


class JointMechanics(NamedTuple):
    """One joint's motor and gear, on the joint's side."""

    inertia: float
    """Inertia of the rotor behind the gear, kg m2."""
    coulomb: float
    """Coulomb friction, Nm."""
    viscous: float
    """Viscous friction, Nm s/rad."""
    torque: float
    """Greatest torque, Nm."""


class ArmPlant:
    """An arm of n joints. All arrays are (n,), in rad, rad/s and Nm.

    While it is ``held``, by a stand or a hand, it does not move; ``push`` are external torques, ``tau`` those of the
    motors.
    """

    def __init__(
        self,
        kinematics: KinematicsSpec,
        mechanics: Sequence[JointMechanics],
        q: Sequence[float],
        base_orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        """Build it from a URDF, with every joint that is not the arm's locked where it is 0.

        Gravity points down in the world, where the URDF's root has the orientation ``base_orientation`` (xyzw).
        """
        joints = kinematics.joints
        full = pin.buildModelFromUrdf(kinematics.urdf)
        others = [k for k in range(1, full.njoints) if full.names[k] not in joints]
        self._model: Any = pin.buildReducedModel(full, others, pin.neutral(full))
        self._data: Any = self._model.createData()
        if [str(name) for name in self._model.names][1:] != list(joints):
            raise ValueError(f"{kinematics.urdf}: {', '.join(joints)} do not follow each other from base to tip")
        rotation = pin.Quaternion(np.array(base_orientation, float)).toRotationMatrix()
        self._model.gravity.linear = rotation.T @ np.array([0.0, 0.0, -9.81])
        link = self._model.frames[self._model.getFrameId(kinematics.tcp_link)]
        turn = pin.Quaternion(np.array(kinematics.tcp_orientation, float)).toRotationMatrix()
        self._tcp: Any = link.placement * pin.SE3(turn, np.array(kinematics.tcp_position, float))
        self._tcp_joint = int(link.parentJoint)
        self._inertias = [pin.Inertia(inertia) for inertia in self._model.inertias]
        self.lower = [float(x) for x in self._model.lowerPositionLimit]
        self.upper = [float(x) for x in self._model.upperPositionLimit]
        self._mechanics = tuple(mechanics)
        self._rotor = np.array([m.inertia for m in mechanics])
        self._impulses = [0.0] * len(joints)
        self.mass_factor = 1.0
        self.payload: tuple[float, tuple[float, ...]] = (0.0, (0.0, 0.0, 0.0))
        self.friction = 1.0
        """Factor on the Coulomb friction of every joint."""
        self.held = True
        self.place(q)

    def place(self, q: Sequence[float]) -> None:
        """Put the arm at rest at a position, and hold it there."""
        self.q: NDArray[np.float64] = np.array(q, float)
        self.dq: NDArray[np.float64] = np.zeros(len(self.q))
        self.tau: NDArray[np.float64] = np.zeros(len(self.q))
        self.push: NDArray[np.float64] = np.zeros(len(self.q))
        self._impulses = [0.0] * len(self.q)
        self.held = True

    def load(self, mass_factor: float | None = None, payload: tuple[float, Sequence[float]] | None = None) -> None:
        """Change the factor on all masses, or the payload, kg and its place (3,) in the frame of the tcp, m."""
        if mass_factor is not None:
            self.mass_factor = mass_factor
        if payload is not None:
            self.payload = payload[0], tuple(payload[1])
        for k, inertia in enumerate(self._inertias):
            self._model.inertias[k] = pin.Inertia(
                inertia.mass * self.mass_factor, inertia.lever, inertia.inertia * self.mass_factor
            )
        mass, place = self.payload
        if mass > 0.0:
            point = pin.Inertia(mass, self._tcp.act(np.array(place)), np.zeros((3, 3)))
            self._model.inertias[self._tcp_joint] = self._model.inertias[self._tcp_joint] + point

    def gravity(self) -> NDArray[np.float64]:
        """Return the torques that hold the arm, without friction."""
        torques: NDArray[np.float64] = pin.computeGeneralizedGravity(self._model, self._data, self.q).copy()
        return torques

    def flange(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return position (3,), m, and roll, pitch, yaw (3,), rad, of the last joint's frame in the base frame."""
        pin.forwardKinematics(self._model, self._data, self.q)
        pose = self._data.oMi[self._model.njoints - 1]
        return pose.translation.copy(), pin.rpy.matrixToRpy(pose.rotation)

    def step(self, dt: float, drives: Sequence[Drive]) -> None:
        """Move the arm on by ``dt``, s, under these drives of its motors."""
        if self.held:
            self.dq[:] = 0.0
            self.tau[:] = 0.0
            return
        upper = np.triu(pin.crba(self._model, self._data, self.q))
        mass = upper + np.triu(upper, 1).T
        mass[np.diag_indices_from(mass)] += self._rotor
        bias = pin.nonLinearEffects(self._model, self._data, self.q, self.dq)
        start = mass @ self.dq + dt * (self.push - bias)
        active = list(drives)
        velocity = self._solve(dt, mass, start, active)
        torques = self._torques(dt, velocity, active)
        beyond = [k for k, m in enumerate(self._mechanics) if abs(torques[k]) > m.torque]
        if beyond:
            for k in beyond:
                limit = self._mechanics[k].torque
                active[k] = Drive(tau=limit if torques[k] > 0.0 else -limit)
            velocity = self._solve(dt, mass, start, active)
            torques = self._torques(dt, velocity, active)
        self.tau[:] = torques
        self.dq[:] = velocity
        self.q += dt * self.dq

    def _solve(
        self, dt: float, mass: NDArray[np.float64], start: NDArray[np.float64], drives: Sequence[Drive]
    ) -> list[float]:
        """Return the velocities after a step; ``start`` is the momentum that all but drives and friction give."""
        left, right = mass.copy(), start.copy()
        for k, (drive, joint) in enumerate(zip(drives, self._mechanics, strict=True)):
            q = float(self.q[k])
            stiffness, damping = drive.kp, drive.kd + joint.viscous
            torque = drive.tau + drive.kp * (drive.q - q) + drive.kd * drive.dq
            stop = min(max(q, self.lower[k]), self.upper[k])
            if stop != q:
                stiffness += _STOP_STIFFNESS
                damping += _STOP_DAMPING
                torque += _STOP_STIFFNESS * (stop - q)
            left[k, k] += dt * (damping + dt * stiffness)
            right[k] += dt * torque
        inverse = np.linalg.inv(left)
        impulses = self._impulses
        velocity: list[float] = (inverse @ (right + np.array(impulses))).tolist()
        rows: list[list[float]] = inverse.tolist()
        for _ in range(_SWEEPS):
            for k, joint in enumerate(self._mechanics):
                bound = dt * self.friction * joint.coulomb
                impulse = min(max(impulses[k] - velocity[k] / rows[k][k], -bound), bound)
                change = impulse - impulses[k]
                if change:
                    impulses[k] = impulse
                    row = rows[k]  # the inverse is symmetric
                    velocity = [v + change * r for v, r in zip(velocity, row, strict=True)]
        return velocity

    def _torques(self, dt: float, velocity: Sequence[float], drives: Sequence[Drive]) -> list[float]:
        return [
            d.tau + d.kp * (d.q - q - dt * v) + d.kd * (d.dq - v)
            for d, q, v in zip(drives, self.q.tolist(), velocity, strict=True)
        ]


class GripperPlant:
    """A gripper's motor with its fingers: one angle, between two stops and an object that it may close on."""

    def __init__(self, mechanics: JointMechanics, q: float, lower: float, upper: float) -> None:
        self._mechanics = mechanics
        self.coulomb = mechanics.coulomb
        """Coulomb friction, Nm."""
        self.q, self.dq, self.tau = q, 0.0, 0.0
        self.lower, self.upper = lower, upper
        """Where the fingers meet a stop or an object, rad."""

    def step(self, dt: float, drive: Drive) -> None:
        inertia, coulomb, viscous, limit = self._mechanics
        velocity = self._solve(dt, drive, inertia, coulomb, viscous)
        torque = drive.tau + drive.kp * (drive.q - self.q - dt * velocity) + drive.kd * (drive.dq - velocity)
        if abs(torque) > limit:
            torque = limit if torque > 0.0 else -limit
            velocity = self._solve(dt, Drive(tau=torque), inertia, coulomb, viscous)
        self.tau, self.dq = torque, velocity
        self.q += dt * velocity

    def _solve(self, dt: float, drive: Drive, inertia: float, coulomb: float, viscous: float) -> float:
        stiffness, damping = drive.kp, drive.kd + viscous
        torque = drive.tau + drive.kp * (drive.q - self.q) + drive.kd * drive.dq
        stop = min(max(self.q, self.lower), self.upper)
        if stop != self.q:
            stiffness += _STOP_STIFFNESS
            damping += _STOP_DAMPING
            torque += _STOP_STIFFNESS * (stop - self.q)
        left = inertia + dt * (damping + dt * stiffness)
        right = inertia * self.dq + dt * torque
        bound = dt * coulomb
        return (right - min(max(right, -bound), bound)) / left
