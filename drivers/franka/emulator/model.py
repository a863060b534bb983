"""Kinematics and rigid-body dynamics of the emulated arm, by pinocchio, from a URDF.

The Panda has the same kinematics as the FR3 and nearly its masses, so both emulators take the same URDF.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["FLANGE_TO_HAND", "IDENTITY", "RigidBody", "multiply"]

Floats = Sequence[float]
Pose16 = tuple[float, ...]
"""A 4x4 matrix, column by column, as packets have it."""

_ROOT = sqrt(0.5)
IDENTITY: Pose16 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
FLANGE_TO_HAND: Pose16 = (_ROOT, -_ROOT, 0.0, 0.0, _ROOT, _ROOT, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.1034, 1.0)
"""From the flange to the tcp of the Franka Hand: -45 degrees about z and 103.4 mm, as Franka's Desk sets it."""


def multiply(a: Pose16, b: Pose16) -> Pose16:
    """One transformation after the other."""
    product = _matrix(a) @ _matrix(b)
    return tuple(product.T.ravel().tolist())


def _matrix(pose: Pose16) -> NDArray[np.float64]:
    matrix: NDArray[np.float64] = np.array(pose).reshape(4, 4).T
    return matrix


class RigidBody:
    """The arm with what hangs on its flange. Positions are seven numbers in rad, from base to flange."""

    def __init__(self, urdf: Path) -> None:
        """Raises ValueError when the URDF cannot be read or lacks what is needed."""
        model = pin.buildModelFromUrdf(str(urdf))
        names = [_named(model, f"joint{k}") for k in range(1, 8)]
        others = [k for k in range(1, model.njoints) if model.names[k] not in names]
        self._model: Any = pin.buildReducedModel(model, others, pin.neutral(model))
        if [str(name) for name in self._model.names][1:] != names:
            raise ValueError(f"{urdf}: the seven joints must follow each other from base to flange")
        self._data: Any = self._model.createData()
        flange = next((k for k, frame in enumerate(self._model.frames) if frame.name.endswith("link8")), None)
        if flange is None:
            raise ValueError(f"{urdf}: no link whose name ends in 'link8', the flange")
        self._flange = flange
        self._placement: Any = self._data.oMf[flange]
        self._still = np.zeros(7)

    def flange(self, q: Floats) -> NDArray[np.float64]:
        """Pose (4, 4) of the flange in the base frame."""
        pin.forwardKinematics(self._model, self._data, np.array(q))
        pin.updateFramePlacement(self._model, self._data, self._flange)
        pose: NDArray[np.float64] = self._placement.homogeneous
        return pose

    def tip(self, q: Floats, flange_to_tip: Pose16) -> Pose16:
        """Pose of what stands at ``flange_to_tip``, as packets have it."""
        pose = self.flange(q) @ _matrix(flange_to_tip)
        return tuple(pose.T.ravel().tolist())

    def torques(self, q: Floats, dq: Floats, ddq: Floats) -> list[float]:
        """What the joints exert (7,), Nm, gravity included, in that motion."""
        torques: list[float] = pin.rnea(self._model, self._data, np.array(q), np.array(dq), np.array(ddq)).tolist()
        return torques

    def step(self, q: Floats, dq: Floats, tau: Floats, friction: Floats, dt: float) -> list[float]:
        """Joint velocities (7,) after ``dt`` s under torques ``tau`` (7,), Nm, while gravity is carried.

        ``friction`` (7,), Nm s/rad, is taken at the end of the step, so it may be as strong as it likes.
        """
        position, velocity = np.array(q), np.array(dq)
        model, data = self._model, self._data
        coriolis = pin.rnea(model, data, position, velocity, self._still) - pin.rnea(
            model, data, position, self._still, self._still
        )
        upper = np.triu(pin.crba(model, data, position))
        mass = upper + np.triu(upper, 1).T
        right = mass @ velocity + dt * (np.array(tau) - coriolis)
        mass[range(7), range(7)] += dt * np.array(friction)
        after: list[float] = np.linalg.solve(mass, right).tolist()
        return after


def _named(model: Any, ending: str) -> str:
    found = [str(name) for name in model.names if str(name).endswith(ending)]
    if len(found) != 1:
        raise ValueError(f"the URDF has {len(found)} joints whose name ends in {ending!r}, not one")
    return found[0]
