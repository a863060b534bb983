"""A gripper: the driver's abstract class and the public class. Widths in metres."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ._moved import names_of
from .arguments import number
from .errors import ConnectionLost, Fault, MotionStopped, RobotFault, StaleStateError
from .host.records import GripperAct, GripperCommand
from .types import GripperOutcome, GripperState

if TYPE_CHECKING:
    from .clock import Clock
    from .control import StopLatch
    from .host.hosts import Host
    from .specs import GripperSpec

__all__ = [
    "Gripper",
    "GripperMotion",
    "GripperResult",
]

# [gripper_motion.py] A motion of a gripper that was started: is it over, and how did it end?

_SHORTEST_LOOK = 0.01
_PATIENCE = 2.0
"""A gripper that is busy may say nothing new for so long, s."""
_ON_ITS_WAY = (GripperOutcome.NONE, GripperOutcome.RUNNING)


@dataclass(frozen=True, slots=True)
class GripperResult:
    """How a motion ended. True where the fingers did what they were told."""

    outcome: GripperOutcome
    state: GripperState
    """The gripper when the end was first seen."""
    fault: Fault | None
    """Why it failed, where it did."""

    def __bool__(self) -> bool:
        return self.outcome is GripperOutcome.DONE


class GripperMotion:
    """A motion under way. Made by :meth:`hal.gripper.Gripper.start` and its siblings; nothing depends on keeping it."""

    def __init__(self, gripper: Gripper, seq: int) -> None:
        self._gripper = gripper
        self._seq = seq
        self._result: GripperResult | None = None

    @property
    def done(self) -> bool:
        """Is it over, however it ended? Never waits; raises ConnectionLost or StaleStateError when nobody can tell."""
        if self._look() is None:
            self._gripper.state(_PATIENCE)
        return self._result is not None

    def wait(self, timeout: float = 10.0) -> GripperResult:
        """Wait until it is over; in lock-step this makes time go on.

        A motion that a newer command or a stop ended is ``STOPPED``. Raises TimeoutError after ``timeout`` s,
        ConnectionLost when the gripper does not answer, StaleStateError when it says nothing new for 2 s.
        """
        gripper = self._gripper
        clock = gripper.clock
        deadline = clock.now() + timeout
        period = max(_SHORTEST_LOOK, gripper.period)
        while (result := self._look()) is None:
            state = gripper.state(_PATIENCE)
            if clock.now() >= deadline:
                raise TimeoutError(f"{gripper.name} is still moving after {timeout:g} s: {state}")
            clock.sleep(period)
        return result

    def _look(self) -> GripperResult | None:
        """The result, once there is one."""
        state = self._gripper.newest() if self._result is None else None
        if self._result is None and state is not None:
            if state.target_seq > self._seq:
                self._result = GripperResult(GripperOutcome.STOPPED, state, None)
            elif state.target_seq == self._seq and state.outcome not in _ON_ITS_WAY:
                failed = state.outcome is GripperOutcome.FAILED
                self._result = GripperResult(state.outcome, state, state.fault if failed else None)
        return self._result

    def __repr__(self) -> str:
        how = self._result.outcome if self._result is not None else "not over when it was looked at last"
        return f"<GripperMotion {self._seq} of {self._gripper.name}: {how}>"


class Gripper:
    """The gripper of an arm. The newest command wins; fingers keep what they hold when a session ends or trips.

    ``move``, ``grasp``, ``home``, ``open`` and ``grip`` wait until the fingers rest. They raise RobotFault, with cause
    and remedy, when the gripper failed, MotionStopped when a stop or a newer command came first, TimeoutError, and
    ConnectionLost. ``start``, ``start_grasp`` and ``start_home`` return at once, with a motion to ask or to wait for.
    All of them raise CommandError for numbers that the gripper cannot do, and MotionStopped while ``rig.stop()`` is
    latched.
    """

    def __init__(self, spec: GripperSpec, robot: str, host: Host, clock: Clock, latch: StopLatch) -> None:
        self.spec = spec
        self.name = spec.name
        self.clock = clock
        self._robot = robot
        self._host = host
        self._latch = latch
        self._mail = host.memory.grippers[spec.name]
        self._commands = 0
        self._motion: GripperMotion | None = None
        self._sending = threading.RLock()  # a signal handler may call stop() in the middle of a command

    # How it is.

    @property
    def width_max(self) -> float:
        """Greatest distance between the fingers, m."""
        return self.spec.width_max

    @property
    def period(self) -> float:
        """New states come about this often, s."""
        return 1.0 / self._host.spec.rate_hz

    def check(self) -> None:
        """Raise ConnectionLost when the process that owns the gripper is gone."""
        self._host.check()

    def newest(self) -> GripperState | None:
        """The newest state, however old; None before the first one."""
        found = self._mail.get()
        return None if found is None else found.state

    def state(self, max_age: float = 0.5) -> GripperState:
        """The newest state.

        When it is older than ``max_age`` s: StaleStateError, or ConnectionLost where it is known that the gripper does
        not answer. ConnectionLost, too, when the process that owns it is gone.
        """
        self.check()
        found = self._mail.get()
        if found is None:
            raise StaleStateError(f"the gripper of {self._robot} has not reported a state yet")
        age = self.clock.now() - found.state.stamp.t
        if not age <= max_age:
            number("max_age", max_age, "s")
            if found.lost:
                why = f": {found.state.fault}" if found.state.fault is not None else ""
                raise ConnectionLost(f"the gripper of {self._robot} has not answered for {age:.3f} s{why}")
            raise StaleStateError(f"the gripper of {self._robot} has been silent for {age:.3f} s")
        return found.state

    def state_at(self, t: float) -> GripperState:
        """The state at ``t`` (s on ``rig.clock``), interpolated; as :meth:`hal.robot.Robot.state_at`."""
        from .interpolation import gripper_at

        self.check()
        return gripper_at(self._mail.history, t, f"the gripper of {self._robot}")

    def states(self, after: float) -> list[GripperState]:
        """Every state that is newer than ``after`` (s on ``rig.clock``), oldest first; the last second is kept."""
        self.check()
        return self._mail.history.since(after)

    @property
    def trouble(self) -> str:
        """Why commands do not move the fingers: nobody answers, or the newest command failed. Empty when they do.

        Never waits: for loops that go on without a gripper.
        """
        try:
            state = self.state()
        except (ConnectionLost, StaleStateError) as error:
            return str(error)
        failed = state.outcome is GripperOutcome.FAILED
        return f"the gripper of {self._robot} failed: {state.fault}" if failed else ""

    def width_of(self, fraction: float) -> float:
        """Width in m of a grip from 0 (open) to 1 (closed). CommandError outside that."""
        grip = number("a grip, from 0 (open) to 1 (closed),", fraction, least=0.0, most=1.0)
        return (1.0 - grip) * self.spec.width_max

    # Commands that return at once.

    def start(self, width: float, speed: float | None = None, force: float | None = None) -> GripperMotion:
        """Start towards ``width`` (m) at ``speed`` (m/s) with at most ``force`` (N)."""
        return self._begin(GripperAct.MOVE, *self._checked(width, speed, force))

    def start_grasp(
        self,
        width: float,
        force: float | None = None,
        speed: float | None = None,
        inner: float = 0.005,
        outer: float = 0.005,
    ) -> GripperMotion:
        """Start to close on something of about ``width`` (m) and hold it with ``force`` (N).

        It is held when the fingers end between ``width - inner`` and ``width + outer`` (m); what is narrower, wider or
        not there at all is ``MISSED``.
        """
        for name, value in (("inner", inner), ("outer", outer)):
            number(name, value, "m", least=0.0)
        return self._begin(GripperAct.GRASP, *self._checked(width, speed, force), inner, outer)

    def start_home(self) -> GripperMotion:
        """Start to find out how far the fingers open. Some grippers need it once after they are switched on.

        They open and close for it, and drop what they hold; grippers that need none do nothing.
        """
        return self._begin(GripperAct.HOME)

    def stop(self) -> None:
        """Stay where the fingers are, with the force that they have. Returns at once; any thread may call it."""
        self.check()
        self._put(self._host.stops, GripperAct.STOP)

    def _checked(self, width: float, speed: float | None, force: float | None) -> tuple[float, float, float]:
        speed = self.spec.speed if speed is None else speed
        force = self.spec.force if force is None else force
        return (
            number("width", width, "m", least=0.0, most=self.spec.width_max),
            number("speed", speed, "m/s", least=0.0, above=True, most=self.spec.speed),
            number("force", force, "N", least=0.0, above=True),
        )

    def _begin(self, act: GripperAct, *numbers: float) -> GripperMotion:
        stops = self._host.stops  # before the latch: a stop that comes after this line ends the motion
        self._latch.check()
        self.check()
        with self._sending:
            self._motion = GripperMotion(self, self._put(stops, act, *numbers))
            return self._motion

    def _send(self, width: float, speed: float, force: float) -> None:
        """Start a motion out of a loop that drives an arm: nobody has to be there, and nothing waits."""
        stops = self._host.stops
        if not self._latch.stopped:
            self._put(stops, GripperAct.MOVE, width, speed, force)

    def _put(self, stops: int, act: GripperAct, *numbers: float) -> int:
        with self._sending:
            if self._motion is not None:
                self._motion._look()  # how it ended cannot be seen any more after the next command
            self._commands += 1
            self._mail.put_command(GripperCommand(self._commands, stops, act, *numbers))
            return self._commands

    # Commands that wait.

    def move(
        self, width: float, speed: float | None = None, force: float | None = None, timeout: float = 10.0
    ) -> GripperState:
        """Move to ``width`` and wait until the fingers rest: there, or on what they hold."""
        return self._finish(self.start(width, speed, force), timeout).state

    def grasp(
        self,
        width: float,
        force: float | None = None,
        speed: float | None = None,
        inner: float = 0.005,
        outer: float = 0.005,
        timeout: float = 10.0,
    ) -> bool:
        """Close on something of about ``width`` and wait: True when it is held. See :meth:`start_grasp`."""
        return bool(self._finish(self.start_grasp(width, force, speed, inner, outer), timeout))

    def home(self, timeout: float = 30.0) -> GripperState:
        """Find out how far the fingers open, and wait: see :meth:`start_home`."""
        result = self._finish(self.start_home(), timeout)
        if not result:
            raise RobotFault(f"{self.name} did not finish homing", "see that nothing is between its fingers; try again")
        return result.state

    def grip(self, fraction: float, force: float | None = None) -> GripperState:
        """Close by a fraction from 0 (open) to 1 (closed) and wait: a helper on top of :meth:`move`."""
        return self.move(self.width_of(fraction), force=force)

    def open(self) -> GripperState:
        """Open all the way and wait."""
        return self.move(self.spec.width_max)

    def _finish(self, motion: GripperMotion, timeout: float) -> GripperResult:
        result = motion.wait(timeout)
        if result.outcome is GripperOutcome.FAILED:
            fault = result.fault
            raise RobotFault(*((fault.cause, fault.remedy) if fault else (f"{self.name} failed", "")))
        if result.outcome is GripperOutcome.STOPPED:
            self._latch.check()
            raise MotionStopped(
                f"{self.name} was stopped, or got a newer command, before it was there", code="gripper_stopped"
            )
        return result

    def inject(self, **knobs: object) -> None:
        """Switch faults of a simulated driver on or off, for tests."""
        self._host.request("inject_gripper", {"gripper": self.name, "knobs": knobs})

    def __repr__(self) -> str:
        return f"<Gripper of {self._robot}: 0..{self.spec.width_max:g} m, driver {self.spec.driver}>"


__getattr__ = names_of(__name__)
