"""Dynamics of one arm: gravity, inertia and inverse dynamics, by pinocchio, from the masses in its URDF.

Torques computed here move real motors, so a URDF without masses, or with made-up ones, is refused with its links.
Vectors are plain lists in the order of the arm's joints; a call takes some microseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import NotSupported
from .geometry import rotate
from .kinematics.arm import add_tcp, reduced_model
from .kinematics.inertials import find_wrong_inertials

if TYPE_CHECKING:
    from .specs import KinematicsSpec, PayloadSpec, RobotSpec, Vector3

__all__ = ["STANDARD_GRAVITY", "Dynamics"]

Floats = Sequence[float]

STANDARD_GRAVITY = 9.81
"""m/s2"""


class Dynamics:
    """Gravity, inertia and inverse dynamics of one arm with ``n`` joints and what it carries.

    All joints that are not the arm's, such as those of the fingers, are at zero. Friction and the inertia of the
    motors' rotors are in no URDF, and are left out. An object has scratch memory, so every thread needs its own.

    Args:
        spec: The arm's joints, links and tcp.
        payload: A mass that it carries in addition.
        gravity: Acceleration of gravity (3,) in the arm's base frame, m/s2. See :meth:`of`.

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
        self._pin: Any = pin
        self._model: Any = reduced_model(spec, pin)
        if payload is not None:
            self._attach(payload, add_tcp(self._model, spec, pin))
        self._model.gravity.linear = np.array(gravity, float)
        self._data: Any = self._model.createData()
        # Place of each joint of the spec in pinocchio's vectors; None if the orders agree, as they usually do.
        columns = [int(self._model.joints[self._model.getJointId(name)].idx_v) for name in spec.joints]
        self._columns: NDArray[np.intp] | None = None
        self._inverse_columns: NDArray[np.intp] | None = None
        if columns != list(range(self.n)):
            self._columns, self._inverse_columns = np.array(columns), np.argsort(columns)

    @classmethod
    def of(cls, spec: RobotSpec) -> Dynamics:
        """Return the dynamics of an arm of a rig, with its payload, and with gravity as its base is mounted."""
        x, y, z, w = spec.base_orientation
        down = rotate((-x, -y, -z, w), (0.0, 0.0, -STANDARD_GRAVITY))
        return cls(spec.kinematics, spec.payload, (down[0], down[1], down[2]))

    def gravity(self, q: Floats) -> list[float]:
        """Return the joint torques (n,), Nm, that hold the arm still at ``q`` (n,), rad."""
        return self._listed(self._pin.computeGeneralizedGravity(self._model, self._data, self._ordered(q)))

    def inverse(self, q: Floats, dq: Floats, ddq: Floats) -> list[float]:
        """Return the joint torques (n,), Nm, of a motion: gravity, Coriolis and inertia.

        Args:
            q: Joint positions (n,), rad.
            dq: Joint velocities (n,), rad/s.
            ddq: Joint accelerations (n,), rad/s2.
        """
        ordered = self._ordered
        return self._listed(self._pin.rnea(self._model, self._data, ordered(q), ordered(dq), ordered(ddq)))

    def mass_matrix(self, q: Floats) -> list[list[float]]:
        """Return the joint-space inertia (n, n), kg m2, at ``q`` (n,), rad. It is symmetric and positive definite."""
        mass = self._pin.crba(self._model, self._data, self._ordered(q))
        if self._columns is not None:
            mass = mass[np.ix_(self._columns, self._columns)]
        rows: list[list[float]] = mass.tolist()
        return rows

    def _attach(self, payload: PayloadSpec, tcp: int) -> None:
        """Add a payload to the link that carries the tcp."""
        if not (isfinite(payload.mass) and payload.mass >= 0.0):
            raise ValueError(f"a payload has a mass of 0 kg or more, not {payload.mass}")
        frame = self._model.frames[tcp]
        lever = frame.placement.act(np.array(payload.position, float))
        inertia = self._pin.Inertia(payload.mass, lever, np.zeros((3, 3)))
        self._model.appendBodyToJoint(frame.parentJoint, inertia, self._pin.SE3.Identity())

    def _ordered(self, values: Floats) -> NDArray[np.float64]:
        array = np.array(values, float)
        return array if self._inverse_columns is None else array[self._inverse_columns]

    def _listed(self, array: NDArray[np.float64]) -> list[float]:
        values: list[float] = (array if self._columns is None else array[self._columns]).tolist()
        return values
