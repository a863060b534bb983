"""PyBullet for one world: the library, and the bodies that it holds.

PyBullet is imported when it is first used, and what its C code prints is kept off the terminal.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from hal.drivers.scene.engine import SimulatedBody
from hal.errors import DriverMissing
from hal.geometry import Transform, compose, inverse

GEAR_SHARE = 0.8
"""Share of the error between coupled joints that one physics step takes away."""
GEAR_FORCE = 10.0
"""Strength of a coupling, as a multiple of the effort of the joints that it couples."""
CONSTRAINT_ERP = 0.2
"""PyBullet's own share, by which it multiplies a gear's."""


# --- the library -----------------------------------------------------------------------------------------------------


class CapturedOutput:
    """What a silenced block printed; complete once the block has ended."""

    text: str = ""


@contextmanager
def silence_output() -> Iterator[CapturedOutput]:
    """Capture what C code prints, for example PyBullet's import line and its URDF warnings.

    The file descriptors of the whole process are redirected: keep the block short.
    """
    captured = CapturedOutput()
    with tempfile.TemporaryFile() as file:
        _flush()
        kept = {}
        for descriptor in (1, 2):
            with suppress(OSError):  # a process may have closed them
                kept[descriptor] = os.dup(descriptor)
                os.dup2(file.fileno(), descriptor)
        try:
            yield captured
        finally:
            _flush()
            for descriptor, original in kept.items():
                os.dup2(original, descriptor)
                os.close(original)
            file.seek(0)
            captured.text = file.read().decode(errors="replace")


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # they may be replaced, or closed
            stream.flush()
    ctypes.CDLL(None).fflush(None)


def load_pybullet() -> Any:
    """Import and return the ``pybullet`` module. Raises DriverMissing."""
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    try:
        with silence_output():
            import pybullet
    except ImportError as error:
        raise DriverMissing(
            f"PyBullet is not installed ({error}); install it with: pip install 'robot-hal[sim]' "
            "(Python 3.10, 3.11, or a C++ compiler)"
        ) from error
    return pybullet


class PyBulletClient:
    """PyBullet's functions with the id of one world filled in; ``client.stepSimulation()`` steps that world.

    Each function is bound once, so a call costs no look-up (``pybullet_utils``' client binds it at every call). Raises
    DriverMissing if PyBullet is not installed.
    """

    def __init__(self) -> None:
        self._module = load_pybullet()
        with silence_output():
            self.id: int = self._module.connect(self._module.DIRECT)

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._module, name)
        if isinstance(attribute, Callable) and not isinstance(attribute, type):  # type: ignore[arg-type]  # its error
            attribute = partial(attribute, physicsClientId=self.id)
        setattr(self, name, attribute)
        return attribute

    def close(self) -> None:
        """Delete the world and free its memory. Idempotent."""
        number, self.id = self.id, -1
        if number >= 0:
            with suppress(self._module.error):
                self._module.disconnect(physicsClientId=number)

    def __del__(self) -> None:
        if "id" in self.__dict__:  # __init__ completed
            self.close()


# --- bodies ----------------------------------------------------------------------------------------------------------


class Gear:
    """A coupling that makes the joint ``follower`` of a body follow the joint ``leader``.

    ``q[follower] = multiplier * q[leader]``, plus their difference when it is engaged. It acts between the two joints,
    so a finger that is blocked holds back the other one too. ``effort`` is the greatest torque or force of both, Nm or
    N.
    """

    def __init__(
        self, client: PyBulletClient, body: int, leader: int, follower: int, multiplier: float, effort: float
    ) -> None:
        self.joints = frozenset((leader, follower))
        self._client = client
        self._make = (body, leader, body, follower, client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0))
        self._set = {
            "gearRatio": -1.0 / multiplier,
            "erp": GEAR_SHARE / CONSTRAINT_ERP,
            "maxForce": GEAR_FORCE * effort,
        }
        self._number: int | None = None
        self.engage()

    def engage(self) -> None:
        if self._number is None:
            self._number = self._client.createConstraint(*self._make)
            self._client.changeConstraint(self._number, **self._set)

    def release(self) -> None:
        """Uncouple the joints, which makes a physics step shorter. Idempotent."""
        if self._number is not None:
            self._client.removeConstraint(self._number)
            self._number = None


Weight = tuple[float, tuple[float, ...]]
"""Mass, kg, and principal moments of inertia (3,), kg m2."""


@dataclass(kw_only=True)
class Body(SimulatedBody):
    """A robot or an object, with its PyBullet number, and the frame in which its pose is given.

    Links and joints have PyBullet's indices; that of the base link is -1. PyBullet keeps a body's pose in the frame of
    its base link's *centre of mass* (its "inertial frame"); everything else uses the base link's own frame.
    ``inertial`` is the constant transform between the two.
    """

    id: int
    """PyBullet's number."""
    inertial: Transform
    """The centre of mass's frame in the frame of the base link."""
    efforts: dict[int, float] = field(default_factory=dict)
    """Greatest torque or force of each driven joint: Nm, or N."""
    speeds: dict[int, float] = field(default_factory=dict)
    """Greatest speed of each driven joint: rad/s, or m/s."""
    damping: tuple[float, float] = (0.0, 0.0)
    """Linear and angular damping, 1/s, which PyBullet does not report. Its own default of 0.04 is switched off."""
    gears: list[Gear] = field(default_factory=list)
    """Couplings between joints that move together (fingers)."""
    fingers: dict[int, tuple[Weight, Weight]] = field(default_factory=dict)
    """Links of light fingers: their mass and moments, and those that they have while they move or hold something."""
    handling: bool = True
    """Whether the fingers move or hold something."""
    edits: int = 0
    """Number of changes of masses, of the base's place, and of gravity."""
    reloads: int = 0
    """How often it was loaded again, which takes away what was applied to its joints for the coming step."""
    hardened: set[int] = field(default_factory=set)
    """Links whose contacts were made soft and then hard again (see :mod:`.dynamics`)."""

    @property
    def damped(self) -> bool:
        """Whether it is an object with damping in its joints."""
        joints = () if self.urdf is None or self.is_robot else self.urdf.joints.values()
        return any(joint.damping > 0.0 for joint in joints if joint.movable)

    def base_pose(self, client: PyBulletClient) -> Transform:
        return compose(client.getBasePositionAndOrientation(self.id), inverse(self.inertial))

    def set_base_pose(self, client: PyBulletClient, pose: Transform) -> None:
        """Place the base link at ``pose`` in the world. Velocities stay."""
        client.resetBasePositionAndOrientation(self.id, *compose(pose, self.inertial))
        self.edits += 1

    def weigh_fingers(self, client: PyBulletClient, handling: bool) -> None:
        """Give the fingers the mass that they have while they move or hold something, or their own."""
        self.handling = handling
        for link, (own, heavy) in self.fingers.items():
            mass, moments = heavy if handling and heavy[0] > own[0] else own
            client.changeDynamics(self.id, link, mass=mass, localInertiaDiagonal=moments)
        self.edits += 1
