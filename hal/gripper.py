"""A gripper: the driver's abstract class and the public class. Widths in metres."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from .errors import CommandError, NotSupported, StaleStateError
from .types import Fault, GripperOutcome, GripperState

if TYPE_CHECKING:
    from .clock import Clock
    from .host.hosts import Host
    from .specs import GripperSpec
    from .stops import StopLatch

__all__ = ["Gripper", "GripperDriver", "GripperReading"]


class GripperReading(NamedTuple):
    """What a gripper driver reports."""

    t: float
    t_device: float
    seq: int
    width: float
    """Distance between the fingers, m."""
    width_target: float
    """Width of the newest command, m."""
    moving: bool
    grasped: bool | None = None
    force: float | None = None
    outcome: GripperOutcome | None = None
    """How the newest command ended; None where the driver cannot know, and it is judged by the width."""
    fault: Fault | None = None
    """Why the last command failed, with what to do about it."""


class GripperDriver(ABC):
    """One gripper. ``move``, ``grasp`` and ``home`` start a motion and return at once: a gripper never blocks the arm.

    The newest command wins; one motion is in flight. Neither ``stop`` nor ``close`` opens the fingers or lets go of
    what they hold. All calls, ``read`` too, come from one thread and return within a few ms.
    """

    simulated: ClassVar[bool] = False

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        self.spec = spec
        self.world = world

    @abstractmethod
    def open(self) -> None:
        """Connect. Nothing moves."""

    @abstractmethod
    def read(self, now: float) -> GripperReading:
        """The newest state."""

    @abstractmethod
    def move(self, width: float, speed: float, force: float) -> None:
        """Start towards ``width`` (m) at ``speed`` (m/s), pressing with at most ``force`` (N)."""

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Start to close on something of ``width`` (m) at ``speed`` (m/s) and hold it with ``force`` (N).

        It is held when the fingers end between ``width - inner`` and ``width + outer`` (m).
        """
        self.move(width, speed, force)

    def home(self) -> None:  # noqa: B027  # most have nothing to do
        """Start to find out how far the fingers open. Only some grippers need it, once after they are switched on."""

    @abstractmethod
    def stop(self) -> None:
        """Stay where the fingers are, keep the grip force."""

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Let go of the device, not of the object. Idempotent."""


class Gripper:
    """The gripper of an arm. The newest command wins; fingers keep what they hold when a session ends or trips."""

    def __init__(self, spec: GripperSpec, robot: str, host: Host, clock: Clock, latch: StopLatch) -> None:
        self.spec = spec
        self.name = spec.name
        self.clock = clock
        self._robot = robot
        self._host = host
        self._latch = latch
        self._mail = host.memory.robots[robot]
        self._commands = 0

    @property
    def width_max(self) -> float:
        """Greatest distance between the fingers, m."""
        return self.spec.width_max

    def state(self, max_age: float = 0.5) -> GripperState:
        """The newest state.

        Raises StaleStateError when it is older than ``max_age`` s, ConnectionLost when the process that owns the
        gripper is gone.
        """
        self._host.check()
        found = self._mail.get_gripper()
        if found is None:
            raise StaleStateError(f"the gripper of {self._robot} has not reported a state yet")
        age = self.clock.now() - found.stamp.t
        if age > max_age:
            raise StaleStateError(f"the gripper of {self._robot} has been silent for {age:.3f} s")
        return found

    def width_of(self, fraction: float) -> float:
        """Width in m of a grip from 0 (open) to 1 (closed). CommandError outside that."""
        if not 0.0 <= fraction <= 1.0:
            raise CommandError(f"a grip goes from 0 (open) to 1 (closed), not {fraction}")
        return (1.0 - fraction) * self.spec.width_max

    def start(self, width: float, speed: float | None = None, force: float | None = None) -> None:
        """Start towards ``width`` (m) at ``speed`` (m/s) with at most ``force`` (N); returns at once.

        Raises CommandError for numbers that the gripper cannot do, MotionStopped while ``rig.stop()`` is latched.
        """
        speed = self.spec.speed if speed is None else speed
        force = self.spec.force if force is None else force
        if not 0.0 <= width <= self.spec.width_max:
            raise CommandError(f"width must lie in 0..{self.spec.width_max:g} m, not {width}")
        if not 0.0 < speed <= self.spec.speed:
            raise CommandError(f"speed must be above 0 and at most {self.spec.speed:g} m/s, not {speed}")
        if not 0.0 < force < math.inf:
            raise CommandError(f"force must be positive, not {force}")
        self._latch.check()
        self._host.check()
        self._send(width, speed, force)

    def _send(self, width: float, speed: float, force: float) -> None:
        self._commands += 1
        self._mail.gripper_command.write(self._commands, width, speed, force)

    def move(
        self, width: float, speed: float | None = None, force: float | None = None, timeout: float = 10.0
    ) -> GripperState:
        """Move to ``width`` and wait until the fingers rest: there, or on what they hold. Raises TimeoutError."""
        before = self.state().stamp
        self.start(width, speed, force)
        deadline = self.clock.now() + timeout
        period = max(0.01, 1.0 / self._host.spec.rate_hz)
        while True:
            self.clock.sleep(period)
            state = self.state()
            taken = state.stamp.t > before.t and abs(state.width_target - width) < 1e-6
            if taken and not state.moving:
                return state
            if self.clock.now() > deadline:
                raise TimeoutError(f"the gripper of {self._robot} is still moving after {timeout:g} s: {state}")

    def grip(self, fraction: float, force: float | None = None) -> GripperState:
        """Close by a fraction from 0 (open) to 1 (closed) and wait: a helper on top of :meth:`move`."""
        return self.move(self.width_of(fraction), force=force)

    def open(self) -> GripperState:
        """Open all the way and wait."""
        return self.move(self.spec.width_max)

    def stop(self) -> None:
        """Stay where the fingers are, with the force that they have."""
        self._host.request("gripper_stop", {"robot": self._robot})

    def inject(self, **knobs: object) -> None:
        """Switch faults of a simulated driver on or off, for tests."""
        self._host.request("inject", {"robot": self._robot, "device": "gripper", "knobs": knobs})

    def __repr__(self) -> str:
        return f"<Gripper of {self._robot}: 0..{self.spec.width_max:g} m, driver {self.spec.driver}>"
