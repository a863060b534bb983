"""What a physics engine implements of a simulated world: :class:`SceneEngine`, and the bodies in it.

:class:`.world.SimulatedWorld` adds the requests of ``rig.world``, and only passes on bodies and numbers that exist and
make sense.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from hal.errors import NotSupported
from hal.geometry import Transform
from hal.kinematics.urdf import UrdfModel
from hal.specs import BodySpec, RobotSpec
from hal.world import WorldDriver

IDENTITY: Transform = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(kw_only=True)
class SimulatedBody:
    """A robot or an object of a simulated world. Links and joints have numbers, by which the engine finds them."""

    name: str
    spec: BodySpec | RobotSpec
    links: dict[str, int]
    """Numbers of the links by name; the first one is the base link."""
    joints: dict[str, int]
    """Numbers of all joints by name, including fixed ones."""
    movable: tuple[int, ...]
    """Numbers of the joints that move, in the order of the URDF."""
    floating: bool
    """Whether physics can move its base."""
    home: dict[int, float] = field(default_factory=dict)
    """Initial position of each movable joint: rad, or m."""
    base: Transform = IDENTITY
    """Initial pose of the base link in the world; in the frame of the arm's link for an object that is attached."""
    urdf: UrdfModel | None = None
    """Its file; None for an object without one."""
    index: int = -1
    """Its place among the world's bodies: its value in segmentation images."""

    def link_name(self, number: int) -> str:
        """Return the name of the link with this number."""
        return next(name for name, other in self.links.items() if other == number)

    @property
    def is_robot(self) -> bool:
        """Whether this is an arm."""
        return isinstance(self.spec, RobotSpec)

    @property
    def carried(self) -> bool:
        """Whether it is attached to a link of an arm."""
        return isinstance(self.spec, BodySpec) and self.spec.robot is not None

    @cached_property
    def _trunk(self) -> frozenset[int]:
        """Numbers of the links of an arm that its own joints do not move, such as a torso."""
        assert self.urdf is not None
        own, urdf = set(self.spec.joints) if isinstance(self.spec, RobotSpec) else set(), self.urdf
        return frozenset(k for link, k in self.links.items() if own.isdisjoint(j.name for j in urdf.above(link)))

    def ignored_by(self, other: SimulatedBody) -> frozenset[int]:
        """Return the numbers of this body's links that ``other`` never touches.

        They are its trunk, if ``other`` is another arm of the same robot: engines compute no contacts within one robot.
        """
        of_this_robot = isinstance(other.spec, RobotSpec) and other.spec.same == self.name
        return self._trunk if of_this_robot else frozenset()

    @property
    def roams(self) -> bool:
        """Whether its base may be elsewhere after the next step."""
        return self.floating or self.carried

    @property
    def moves(self) -> bool:
        """Whether its base or any joint may move."""
        return self.roams or bool(self.movable)


B = TypeVar("B", bound=SimulatedBody)


@dataclass
class AppliedForce(Generic[B]):
    """A constant force on a link."""

    body: B
    link: int
    force: Sequence[float]
    """(3,) N in the world."""
    point: Sequence[float] | None
    """Where it acts, (3,) m in the frame of the link; None for the centre of mass."""
    steps: int
    """Number of steps for which it still acts."""


class RayFound(NamedTuple):
    """What a ray meets first."""

    body: SimulatedBody
    link: int
    position: Sequence[float]
    """(3,) m in the world."""
    normal: Sequence[float]
    """(3,) unit vector out of the body."""


class SceneEngine(WorldDriver, Generic[B]):
    """The part of a simulated world that each physics engine implements."""

    ENGINE: ClassVar[str]
    """Name of the engine for messages."""
    UNSUPPORTED: ClassVar[Mapping[str, str]] = {}
    """Dynamics that the engine does not have -> what to set instead."""

    @abstractmethod
    def load_body(self, spec: BodySpec | RobotSpec) -> B:
        """Load a body, whose name is new, into the engine. It need not stand at its initial pose yet.

        Raises ConfigError with all problems if it cannot be loaded; nothing of it stays.
        """

    @abstractmethod
    def arrange_bodies(self, added: Sequence[B]) -> None:
        """Complete the world after bodies were added, before they are put home, or removed; ``bodies`` are up to date.

        Objects that are attached (:meth:`list_attachments`) leave physics here: no weight, no contacts. Nor
        does an arm touch the body of its robot (:meth:`SimulatedBody.ignored_by`).
        """

    @abstractmethod
    def unload_body(self, body: B) -> None:
        """Remove a body from the engine; :meth:`arrange_bodies` follows."""

    @abstractmethod
    def place_attached(self) -> None:
        """Place every object that is attached at its link of an arm, after a step or a reset."""

    @abstractmethod
    def find_overlap(self, a: B, b: B) -> tuple[float, str, str]:
        """Return how deep two bodies overlap, m, 0 if they are apart, and by which link of each.

        Links of :meth:`SimulatedBody.ignored_by` do not count.
        """

    @abstractmethod
    def read_pose(self, body: B, link: int) -> Transform:
        """Return the pose in the world of a link's own frame."""

    @abstractmethod
    def read_velocity(self, body: B) -> tuple[Sequence[float], Sequence[float]]:
        """Return the velocity in the world: linear (3,) m/s of the base link's centre of mass, angular (3,) rad/s."""

    @abstractmethod
    def move_base(self, body: B, pose: Transform) -> None:
        """Place the base link there, at rest; its joints keep their positions."""

    @abstractmethod
    def move_joints(self, body: B, positions: Mapping[int, float]) -> None:
        """Place these joints (rad or m) at rest; those of a robot then hold there."""

    @abstractmethod
    def read_joints(self, body: B) -> Sequence[float]:
        """Return the positions of the joints that move, rad or m, in the order of the URDF."""

    @abstractmethod
    def write_velocity(self, body: B, linear: Sequence[float], angular: Sequence[float]) -> None:
        """Set the velocity of a free base, as of :meth:`read_velocity`."""

    @abstractmethod
    def read_dynamics(self, body: B, link: int) -> dict[str, Any]:
        """Return :data:`.values.DYNAMICS` of a link, without those of :attr:`UNSUPPORTED`."""

    @abstractmethod
    def write_dynamics(self, body: B, link: int, values: Mapping[str, Any], before: Mapping[str, Any]) -> None:
        """Set properties of a link; ``before`` is what :meth:`read_dynamics` returned just before."""

    @abstractmethod
    def forget_contacts(self, bodies: Sequence[B]) -> None:
        """Clear what the solver keeps from one step to the next about these bodies.

        Called before they are reset, so that the steps after it repeat those after the start, and after their dynamics
        have changed, so that these act at once.
        """

    @abstractmethod
    def push_link(self, force: AppliedForce[B]) -> None:
        """Let a force act in the coming step, in addition to others on the same link."""

    @abstractmethod
    def write_gravity(self, gravity: Sequence[float]) -> None:
        """Set the gravity, (3,) m/s2 in the world."""

    @abstractmethod
    def cast_ray(self, start: Sequence[float], end: Sequence[float]) -> RayFound | None:
        """Return what a ray between two points (3,) in the world meets first; objects that are attached never."""

    @abstractmethod
    def measure_distance(self, a: B, links_a: Sequence[int], b: B, links_b: Sequence[int]) -> float | None:
        """Return the smallest distance between links of two bodies, m, negative if they overlap.

        None if one side has no collision shape.
        """

    @abstractmethod
    def find_contacts(self, a: B | None, b: B | None) -> list[dict[str, Any]]:
        """Return the contacts of the last step, each as the fields of a :class:`hal.world.Contact`; None: any body."""

    @abstractmethod
    def measure_box(self, body: B) -> tuple[list[float], list[float]]:
        """Return the lower and upper corner (3,) m of the box along the world's axes around a body.

        It may be larger by the engine's collision margin (mm).
        """

    @abstractmethod
    def place_mirror(self, body: B, q: list[float], dq: list[float], width: float | None) -> None:
        """Place the mirror of a real arm; the numbers are checked."""

    def save_engine(self) -> Any:
        """Return the state of the engine, as JSON; an engine has it with the motors', or without."""
        raise NotSupported(f"{self.ENGINE} does not save states", code="no_states")

    def restore_engine(self, state: Any) -> None:
        """Put the engine into a state of :meth:`save_engine`, of a world with the same bodies.

        Raises ValueError if it is no such state; nothing changes.
        """
        raise NotSupported(f"{self.ENGINE} does not restore states", code="no_states")

    def start_bodies(self, added: Sequence[B]) -> None:  # optional
        """Complete new bodies, which are now at their initial poses."""
