"""Dynamics of one arm: gravity, inertia and inverse dynamics, by pinocchio, from the masses in its URDF.

Torques computed here move real motors, so a URDF without masses, or with made-up ones, is refused with its links.
Vectors are in the order of the arm's joints; a call takes some microseconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import CommandError, NotSupported
from .geometry import rotate
from .kinematics.arm import add_tcp, reduced_model
from .kinematics.inertials import find_wrong_inertials
from .kinematics.urdf import read_urdf

if TYPE_CHECKING:
    from .specs import KinematicsSpec, PayloadSpec, RobotSpec, Vector3

Array = NDArray[np.float64]
Floats = Sequence[float] | Array

STANDARD_GRAVITY = 9.81
"""m/s2"""


class Dynamics:
    """Gravity, inertia and inverse dynamics of one arm with ``n`` joints and what it carries.

    Joints are in the order of the spec. Those that are not the arm's are still, such as the fingers'. Friction, damping
    and the inertia of the motors' rotors are left out. An object has scratch memory, so every thread needs its own.

    The equation of motion is ``tau = M(q) ddq + c(q, dq) + g(q)``; :meth:`mass_matrix`, :meth:`coriolis` and
    :meth:`gravity` return its parts, :meth:`inverse` the whole and :meth:`forward` its solution for ddq. Torques that
    an arm is commanded (:class:`hal.JointTorque`) come on top of g: an arm carries itself, and nothing else.

    Args:
        spec: The arm's joints, links and tcp.
        payload: A mass that it carries in addition.
        gravity: Acceleration of gravity (3,) in the arm's base frame, m/s2. See :meth:`of`.
        others: Positions of joints that are not the arm's, rad or m; absent ones are at 0.

    Raises:
        NotSupported: The URDF has links without a mass, or with an impossible inertia (``code`` is
            ``wrong_inertials``); the message names each.
        ValueError: The URDF is not valid, or lacks a joint or a link of the spec.
    """

    def __init__(
        self,
        spec: KinematicsSpec,
        payload: PayloadSpec | None = None,
        gravity: Vector3 = (0.0, 0.0, -STANDARD_GRAVITY),
        others: Mapping[str, float] | None = None,
    ) -> None:
        import pinocchio as pin

        wrong = find_wrong_inertials(spec.urdf, spec.joints)
        if wrong:
            links = "; ".join(f"{link} {problem}" for link, problem in wrong.items())
            raise NotSupported(
                f"{Path(spec.urdf).name} cannot give the arm's weight and inertia: {links}. Put the masses and the "
                "inertias that the arm's maker publishes into it",
                code="wrong_inertials",
            )
        self.spec = spec
        self.payload = payload
        self.n = len(spec.joints)
        self._shape = (self.n,)
        self._pin: Any = pin
        self._model: Any = reduced_model(spec, pin, others)
        self._tcp = add_tcp(self._model, spec, pin)
        if payload is not None:
            self._attach(payload)
        self._model.gravity.linear = np.zeros(3)
        self._weightless: Any = pin.Model(self._model)
        self._model.gravity.linear = np.array(gravity, float)
        self._data: Any = self._model.createData()
        # Place of each joint of the spec in pinocchio's vectors; None if the orders agree, as they usually do.
        columns = [int(self._model.joints[self._model.getJointId(name)].idx_v) for name in spec.joints]
        self._columns: NDArray[np.intp] | None = None
        self._inverse_columns: NDArray[np.intp] | None = None
        if columns != list(range(self.n)):
            self._columns, self._inverse_columns = np.array(columns), np.argsort(columns)
        self.damping: tuple[float, ...] = tuple(self._restore_order(self._model.damping).tolist())
        """Viscous damping of each joint (n,), Nm s/rad: simulated arms have it, the methods leave it out."""

    @classmethod
    def of(cls, spec: RobotSpec, width: float | None = None) -> Dynamics:
        """Return the dynamics of an arm of a rig, with its payload, and with gravity as its base is mounted.

        Args:
            spec: The arm.
            width: Width of its gripper, m; None: open, as a simulated arm starts. Fingers that open wide have a large
                share of the inertia of the last joint.
        """
        x, y, z, w = spec.base_orientation
        down = rotate((-x, -y, -z, w), (0.0, 0.0, -STANDARD_GRAVITY))
        fingers: dict[str, float] = {}
        if spec.gripper is not None:
            width = spec.gripper.width_max if width is None else width
            fingers = dict(zip(spec.gripper.joints, spec.gripper.finger_positions(width), strict=True))
            for one in read_urdf(Path(spec.urdf), meshes=False).mimics:
                if one.of in fingers:
                    fingers[one.joint] = one.multiplier * fingers[one.of] + one.offset
        return cls(spec.kinematics, spec.payload, (down[0], down[1], down[2]), fingers)

    def gravity(self, q: Floats) -> Array:
        """Return the joint torques (n,), Nm, that hold the arm still at ``q`` (n,), rad."""
        return self._restore_order(self._pin.computeGeneralizedGravity(self._model, self._data, self._reorder(q)))

    def inverse(self, q: Floats, dq: Floats, ddq: Floats) -> Array:
        """Return the joint torques (n,), Nm, of a motion: gravity, Coriolis and inertia.

        Args:
            q: Joint positions (n,), rad.
            dq: Joint velocities (n,), rad/s.
            ddq: Joint accelerations (n,), rad/s2.
        """
        ordered = self._reorder
        return self._restore_order(self._pin.rnea(self._model, self._data, ordered(q), ordered(dq), ordered(ddq)))

    def coriolis(self, q: Floats, dq: Floats) -> Array:
        """Return the Coriolis and centrifugal torques (n,), Nm, at ``q`` (n,) rad and ``dq`` (n,) rad/s."""
        effects = self._pin.nonLinearEffects(self._weightless, self._data, self._reorder(q), self._reorder(dq))
        return self._restore_order(effects)

    def forward(self, q: Floats, dq: Floats, tau: Floats) -> Array:
        """Return the joint accelerations (n,), rad/s2, under torques: the inverse of :meth:`inverse`.

        Args:
            q: Joint positions (n,), rad.
            dq: Joint velocities (n,), rad/s.
            tau: All torques of the joints (n,), Nm, those that carry the arm's weight included.
        """
        ordered = self._reorder
        return self._restore_order(self._pin.aba(self._model, self._data, ordered(q), ordered(dq), ordered(tau)))

    def mass_matrix(self, q: Floats) -> Array:
        """Return the joint-space inertia (n, n), kg m2, at ``q`` (n,), rad. It is symmetric and positive definite."""
        mass = self._pin.crba(self._model, self._data, self._reorder(q))
        inertia: Array = mass.copy() if self._columns is None else mass[np.ix_(self._columns, self._columns)]
        return inertia

    def task_inertia(self, q: Floats) -> Array:
        """Return the inertia (6, 6) of the tcp, kg, kg m and kg m2: (J M^-1 J^T)^-1.

        A force and a torque on the tcp, along the base's axes, accelerate it by the inverse (Khatib, IEEE J. Robotics
        and Automation 3(1), 1987). It is the pseudo-inverse: 0 in directions in which the tcp cannot move, at a
        singularity or with fewer than six joints.

        Args:
            q: Joint positions (n,), rad.
        """
        pin, model, data = self._pin, self._model, self._data
        position = self._reorder(q)
        jacobian = pin.computeFrameJacobian(
            model, data, position, self._tcp, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        ).copy()
        mobility = jacobian @ np.linalg.solve(pin.crba(model, data, position), jacobian.T)
        inertia: Array = np.linalg.pinv(mobility, rcond=1e-9, hermitian=True)
        return inertia

    def _attach(self, payload: PayloadSpec) -> None:
        """Add a payload to the link that carries the tcp."""
        if not (isfinite(payload.mass) and payload.mass >= 0.0):
            raise ValueError(f"a payload has a mass of 0 kg or more, not {payload.mass}")
        frame = self._model.frames[self._tcp]
        lever = frame.placement.act(np.array(payload.position, float))
        inertia = self._pin.Inertia(payload.mass, lever, np.zeros((3, 3)))
        self._model.appendBodyToJoint(frame.parentJoint, inertia, self._pin.SE3.Identity())

    def _reorder(self, values: Floats) -> Array:
        array = np.asarray(values, float)
        if array.shape != self._shape:
            raise CommandError(f"one number for each joint is needed, shape {self._shape}, not {array.shape}")
        return array if self._inverse_columns is None else array[self._inverse_columns]

    def _restore_order(self, array: Array) -> Array:
        """Return a copy of pinocchio's vector, in the order of the spec."""
        values: Array = array.copy() if self._columns is None else array[self._columns]
        return values
