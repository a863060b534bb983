"""The simulated world: bodies, poses, dynamics, contacts. It exists in simulation only."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import NotSupported
from .geometry import Pose, frozen
from .specs import BodySpec, to_json

__all__ = ["Contact", "NoWorld", "Poses", "World"]

Array = NDArray[np.float64]


class Contact(NamedTuple):
    """Two bodies that touch."""

    a: str
    b: str
    link_a: str | None
    link_b: str | None
    position: Array
    """On ``b``, in the world, m."""
    normal: Array
    """From ``b`` towards ``a``."""
    distance: float
    """Negative where they overlap, m."""
    force: float
    """Along the normal, N."""


class Poses(NamedTuple):
    """Where bodies were at one moment."""

    t: float
    """The time of the world that they show, s on ``rig.clock``."""
    poses: Mapping[str, Pose]
    """Of each body's base in the world, by the body's name."""


class World:
    """``rig.world``. Every call runs between two physics steps, with simulated time standing still.

    An unknown body or link raises DeviceNotFound, which lists those that are there.
    """

    def __init__(self, request: Callable[[str, dict[str, Any]], Any], edited: Callable[[str, Any, int], None]) -> None:
        self._request = request
        self._edited = edited
        """Told of every edit that changes what is drawn: method, parameters, revision."""

    def _ask(self, method: str, **params: Any) -> Any:
        return self._request(f"world.{method}", params)

    def _edit(self, method: str, **params: Any) -> None:
        self._edited(method, params, int(self._ask(method, **params)))

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies; a body's place here is its number in ``Frame.segmentation``."""
        return tuple(self._ask("names"))

    def add(self, body: BodySpec) -> None:
        """Put a body into the world."""
        self._edit("add", spec=to_json(body))

    def remove(self, name: str) -> None:
        """Take a body out of the world. Robots stay."""
        self._edit("remove", name=name)

    def set_color(self, name: str, rgba: Sequence[float]) -> None:
        """Paint a body (red, green, blue, alpha; 0..1)."""
        self._edit("set_color", name=name, rgba=[float(value) for value in rgba])

    def pose(self, name: str, link: str | None = None) -> Pose:
        """Pose of a body's base, or of one of its links, in the world: ground truth."""
        return _pose(self._ask("pose", name=name, link=link))

    def poses(self, names: Collection[str] | None = None) -> Poses:
        """Those of the bases of many bodies, else of all, at one moment: one request, however many there are."""
        found = self._ask("poses", names=None if names is None else list(names))
        return Poses(float(found["t"]), {name: _pose(pose) for name, pose in found["poses"].items()})

    def set_pose(self, name: str, pose: Pose) -> None:
        """Put a body somewhere else, at rest. Robots are moved by their servo, or put back by :meth:`reset`."""
        self._ask("set_pose", name=name, pose=_plain(pose))

    def velocity(self, name: str) -> tuple[Array, Array]:
        """Linear (3,) m/s and angular (3,) rad/s velocity of a body's base, in the world."""
        linear, angular = self._ask("velocity", name=name)
        return frozen(linear), frozen(angular)

    def set_velocity(self, name: str, linear: ArrayLike = (0, 0, 0), angular: ArrayLike = (0, 0, 0)) -> None:
        """Give a body a velocity, m/s and rad/s, in the world."""
        self._ask(
            "set_velocity",
            name=name,
            linear=np.asarray(linear, float).tolist(),
            angular=np.asarray(angular, float).tolist(),
        )

    def dynamics(self, name: str, link: str | None = None) -> dict[str, Any]:
        """Mass (kg), frictions, restitution, dampings, contact stiffness and damping, as the physics uses them."""
        return dict(self._ask("dynamics", name=name, link=link))

    def set_dynamics(self, name: str, link: str | None = None, **values: float) -> dict[str, Any]:
        """Change some of them; returns those values as they were, so that they can be put back."""
        return dict(self._ask("set_dynamics", name=name, link=link, **values))

    @contextmanager
    def changed_dynamics(self, name: str, link: str | None = None, **values: float) -> Iterator[None]:
        """Change some of them for as long as the ``with`` block lasts."""
        before = self.set_dynamics(name, link, **values)
        try:
            yield
        finally:
            self.set_dynamics(name, link, **before)

    def contacts(self, a: str | None = None, b: str | None = None) -> tuple[Contact, ...]:
        """Where bodies touch, all or only those of ``a``, or between ``a`` and ``b``."""
        found = self._ask("contacts", a=a, b=b)
        return tuple(
            Contact(**(contact | {"position": frozen(contact["position"]), "normal": frozen(contact["normal"])}))
            for contact in found
        )

    def aabb(self, name: str) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of the box along the world's axes around a body, m."""
        found = self._ask("aabb", name=name)
        return frozen(found["lower"]), frozen(found["upper"])

    def reset(self, name: str | None = None, *, pose: Pose | None = None, q: ArrayLike | None = None) -> None:
        """Put one thing, or everything, back: at rest, to its configured pose and joints or to those given here.

        ``pose`` is a body's in the world; ``q`` (n,) are an arm's joint positions, rad.
        """
        params: dict[str, Any] = {"name": name}
        if pose is not None:
            params["pose"] = _plain(pose)
        if q is not None:
            params["q"] = np.asarray(q, float).tolist()
        self._request("world.reset", params)


class NoWorld:
    """What ``rig.world`` is where nothing is simulated: every use of it says so."""

    def __getattr__(self, name: str) -> Any:
        raise NotSupported("rig.world exists in simulation only: this rig has no simulated world")


def _pose(data: Mapping[str, Any] | Sequence[Any]) -> Pose:
    if isinstance(data, Mapping):
        return Pose(data["position"], data["orientation"])
    return Pose(*data)


def _plain(pose: Pose) -> dict[str, list[float]]:
    return {"position": pose.position.tolist(), "orientation": pose.orientation.tolist()}
