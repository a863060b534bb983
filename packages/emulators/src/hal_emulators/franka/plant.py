"""The simulated arm behind the emulated controller: rigid-body model, plants, and the URDF that a client gets.

Kinematics and dynamics are computed by pinocchio from a URDF, in which the hand is open.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from abc import ABC, abstractmethod
from math import exp, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from .motion import DT, Floats, MotionSample

Pose16 = tuple[float, ...]
"""A 4x4 matrix by columns, as in packets."""

_ROOT = sqrt(0.5)
IDENTITY: Pose16 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
FLANGE_TO_HAND: Pose16 = (_ROOT, -_ROOT, 0.0, 0.0, _ROOT, _ROOT, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.1034, 1.0)
"""From the flange to the tcp of the Franka Hand: -45 degrees about z and 103.4 mm, as set by Franka's Desk."""


def multiply(a: Pose16, b: Pose16) -> Pose16:
    """Return the product of two transformations."""
    product = _matrix(a) @ _matrix(b)
    return tuple(product.T.ravel().tolist())


def _matrix(pose: Pose16) -> NDArray[np.float64]:
    matrix: NDArray[np.float64] = np.array(pose).reshape(4, 4).T
    return matrix


class RigidBody:
    """The arm with its end effector. Positions are (7,), rad, from base to flange."""

    def __init__(self, urdf: Path) -> None:
        """Raises ValueError if the URDF cannot be read, or lacks the seven joints or the flange."""
        model = pin.buildModelFromUrdf(str(urdf))
        names = [_find_name(model, f"joint{k}") for k in range(1, 8)]
        others = [k for k in range(1, model.njoints) if model.names[k] not in names]
        reference = pin.neutral(model)
        for k in others:
            if "JointModelP" in model.joints[k].shortname():  # a finger, open
                reference[model.joints[k].idx_q] = model.upperPositionLimit[model.joints[k].idx_q]
        self._model: Any = pin.buildReducedModel(model, others, reference)
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
        """Return the pose (4, 4) of the flange in the base frame, m."""
        pin.forwardKinematics(self._model, self._data, np.array(q))
        pin.updateFramePlacement(self._model, self._data, self._flange)
        pose: NDArray[np.float64] = self._placement.homogeneous
        return pose

    def tip(self, q: Floats, flange_to_tip: Pose16) -> Pose16:
        """Return the pose of the frame at ``flange_to_tip`` from the flange, in the base frame."""
        pose = self.flange(q) @ _matrix(flange_to_tip)
        return tuple(pose.T.ravel().tolist())

    def torques(self, q: Floats, dq: Floats, ddq: Floats) -> list[float]:
        """Return the joint torques (7,), Nm, gravity included, for a motion."""
        torques: list[float] = pin.rnea(self._model, self._data, np.array(q), np.array(dq), np.array(ddq)).tolist()
        return torques

    def step(self, q: Floats, dq: Floats, tau: Floats, friction: Floats, dt: float) -> list[float]:
        """Return the joint velocities (7,), rad/s, after ``dt`` s under torques ``tau`` (7,), Nm, without gravity.

        ``friction`` (7,), Nm s/rad, is evaluated at the end of the step, so any value is stable.
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


def _find_name(model: Any, ending: str) -> str:
    found = [str(name) for name in model.names if str(name).endswith(ending) and "finger" not in str(name)]
    if len(found) != 1:
        raise ValueError(f"the URDF has {len(found)} joints whose name ends in {ending!r}, not one")
    return found[0]


VISCOUS = (0.5, 0.5, 0.5, 0.5, 0.2, 0.2, 0.2)
"""Viscous joint friction that remains after the robot's own compensation, Nm s/rad. Chosen here."""
COULOMB = (0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
"""Coulomb friction that remains, Nm."""
_STICKING = 1e-3
"""Speed below which Coulomb friction acts like viscous friction, rad/s."""


class Plant(ABC):
    """An arm that follows desired motion or torques; ``q`` rad, ``dq`` rad/s and ``tau`` Nm, (7,), are measured."""

    def __init__(self, body: RigidBody, q: Floats) -> None:
        self.body = body
        self.q: Floats = tuple(q)
        self.dq: Floats = (0.0,) * 7
        self.tau: Floats = body.torques(self.q, self.dq, self.dq)

    def place(self, q: Floats) -> None:
        """Put the arm at rest at ``q`` (7,), rad."""
        self.q, self.dq = tuple(q), (0.0,) * 7
        self.tau = self.body.torques(self.q, self.dq, self.dq)

    @abstractmethod
    def follow(self, desired: MotionSample) -> None:
        """Advance one cycle under the robot's own joint controller."""

    def push(self, torques: Floats) -> None:
        """Advance one cycle under the client's torques (7,), Nm; the robot compensates gravity."""
        friction = [a + b / (abs(v) + _STICKING) for a, b, v in zip(VISCOUS, COULOMB, self.dq, strict=True)]
        self.dq = self.body.step(self.q, self.dq, torques, friction, DT)
        self.q = [p + v * DT for p, v in zip(self.q, self.dq, strict=True)]
        gravity = self.body.torques(self.q, (0.0,) * 7, (0.0,) * 7)
        self.tau = [a + b for a, b in zip(gravity, torques, strict=True)]


class IdealPlant(Plant):
    """Follows the desired motion exactly."""

    _last: MotionSample | None = None

    def place(self, q: Floats) -> None:
        super().place(q)
        self._last = None

    def follow(self, desired: MotionSample) -> None:
        if desired is self._last:
            return
        self._last = desired
        self.q, self.dq = desired.q, desired.dq
        self.tau = self.body.torques(desired.q, desired.dq, desired.ddq)

    def push(self, torques: Floats) -> None:
        self._last = None
        super().push(torques)


_LAG = 0.01
"""Time constant, s."""


class LaggingPlant(Plant):
    """Follows with a first-order lag of 10 ms, roughly like a stiff joint controller."""

    _share = 1.0 - exp(-DT / _LAG)

    def follow(self, desired: MotionSample) -> None:
        before, speed = self.q, self.dq
        self.q = [p + (goal - p) * self._share for p, goal in zip(before, desired.q, strict=True)]
        self.dq = [(new - old) / DT for new, old in zip(self.q, before, strict=True)]
        ddq = [(new - old) / DT for new, old in zip(self.dq, speed, strict=True)]
        self.tau = self.body.torques(self.q, self.dq, ddq)


# URDF.

_PREFIX = re.compile(r"^.*_(?=(link|joint)\d$)")


def remove_shapes(urdf: str) -> str:
    """Return a URDF without visual and collision shapes. Raises ValueError if it is not valid XML."""
    root = _parse_urdf(urdf)
    for link in root.findall("link"):
        for name in ("visual", "collision"):
            for shape in link.findall(name):
                link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")


def arm_only(urdf: str) -> str:
    """Return the part of a URDF that a client gets: base to flange, without the hand and without shapes.

    Prefixes before ``link`` and ``joint`` are removed. The client's library requires seven joints and a frame named
    exactly ``link8``, and does not check either: with other names it reads beyond its memory when it loads the model.
    Raises ValueError without a link whose name ends in ``link8``.
    """
    root = _parse_urdf(remove_shapes(urdf))
    joints = {_end(joint, "child"): joint for joint in root.findall("joint")}
    link = next((name for name in joints if name.endswith("link8")), None)
    if link is None:
        raise ValueError("the URDF has no link whose name ends in 'link8', the flange")
    kept = {link}
    while link in joints:
        link = _end(joints[link], "parent")
        kept.add(link)
    for joint in joints.values():
        if _end(joint, "child") not in kept:
            root.remove(joint)
    for element in root.findall("link"):
        if element.get("name") not in kept:
            root.remove(element)
    for element in root.iter():
        for key in ("name", "link"):
            if key in element.attrib:
                element.set(key, _PREFIX.sub("", element.attrib[key]))
    return ElementTree.tostring(root, encoding="unicode")


def _parse_urdf(urdf: str) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ValueError(f"the URDF is not valid XML: {error}") from None


def _end(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")
