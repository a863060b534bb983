"""A gripper of an arm: its state, and motions that block or run in the background. Widths are in m."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

from .arguments import number
from .errors import ConnectionLost, Fault, MotionStopped, RobotFault, StaleStateError
from .host.records import GripperAct, GripperCommand
from .types import GripperOutcome, GripperState

if TYPE_CHECKING:
    from .clock import Clock
    from .host.hosts import Host
    from .specs import GripperSpec

_SHORTEST_WAIT = 0.01
"""Shortest time between two checks of a motion, s."""
_PATIENCE = 2.0
"""Greatest age of a state while a motion runs, s: some grippers send none while they are busy."""
_UNFINISHED = (GripperOutcome.NONE, GripperOutcome.RUNNING)


class Gripper:
    """The gripper of an arm, the same for every driver. The newest command replaces the one before.

    ``move``, ``grasp``, ``home``, ``open`` and ``grip`` block until the fingers rest; ``start``, ``start_grasp`` and
    ``start_home`` return at once, with a :class:`GripperMotion`. They need no session, and no dead-man; ``rig.stop()``
    and the end of the program stop them. What ``control.send(grip=)`` starts stops as soon as that session may not
    move. In every case fingers keep what they hold.

    Every command raises CommandError for values that the gripper cannot do, MotionStopped while ``rig.stop()`` is
    latched, and ConnectionLost. The blocking ones also raise RobotFault, with cause and remedy, if the gripper failed,
    MotionStopped if a stop or a newer command came first (``code`` is ``gripper_stopped``), and TimeoutError.
    """

    def __init__(self, spec: GripperSpec, robot: str, host: Host, clock: Clock) -> None:
        self.spec = spec
        self.name = spec.name
        self.clock = clock
        self._robot = robot
        self._host = host
        self._latch = host.latch
        self._mail = host.memory.grippers[spec.name]
        state = self.peek()
        self._commands = 0 if state is None else state.target_seq  # one at another computer knows earlier programs
        self._motion: GripperMotion | None = None
        self._sending = threading.RLock()  # a signal handler may call stop() in the middle of a command

    # State.

    @property
    def width_max(self) -> float:
        """Greatest distance between the fingers, m."""
        return self.spec.width_max

    @property
    def width_min(self) -> float:
        """Distance between the fingers when closed on nothing, m: not all of them meet."""
        return self.spec.width_min

    @property
    def force_max(self) -> float:
        """Greatest force that may be asked of the fingers, N."""
        return self.spec.force_max or self.spec.force

    @property
    def period(self) -> float:
        """Time between two states, s."""
        return 1.0 / self._host.spec.rate_hz

    def check(self) -> None:
        """Raise ConnectionLost if the process that owns the gripper is gone."""
        self._host.check()

    def peek(self) -> GripperState | None:
        """Return the newest state of any age; None before the first."""
        found = self._mail.get()
        return None if found is None else found.state

    def state(self, max_age: float = 0.5) -> GripperState:
        """Return the newest state; never waits.

        Args:
            max_age: Greatest age of the state, s.

        Raises:
            StaleStateError: The newest state is older than ``max_age``, or there is none yet (``code`` is
                ``no_state``).
            ConnectionLost: It is older, and the gripper is known not to answer; or the process that owns it is gone.
        """
        self.check()
        found = self._mail.get()
        if found is None:
            raise StaleStateError(f"the gripper of {self._robot} has not reported a state yet", code="no_state")
        age = self.clock.now() - found.state.stamp.t
        if not age <= max_age:
            number("max_age", max_age, "s")
            if found.lost:
                why = f": {found.state.fault}" if found.state.fault is not None else ""
                raise ConnectionLost(f"the gripper of {self._robot} has not answered for {age:.3f} s{why}")
            raise StaleStateError(f"the gripper of {self._robot} has been silent for {age:.3f} s")
        return found.state

    def state_at(self, t: float) -> GripperState:
        """Return the state at ``t`` (s on ``rig.clock``), interpolated; as :meth:`hal.robot.Robot.state_at`."""
        from .interpolation import gripper_at

        self.check()
        return gripper_at(self._mail.history, t, f"the gripper of {self._robot}")

    def states(self, after: float) -> list[GripperState]:
        """Return all states of the last second that are newer than ``after`` (s on ``rig.clock``), oldest first."""
        self.check()
        return self._mail.history.read_since(after)

    @property
    def trouble(self) -> str:
        """Reason why commands do not move the fingers (no answer, or the newest command failed); empty if they do.

        Never waits or raises; for control loops that continue without a gripper.
        """
        found = self._mail.get()
        failed = found is not None and found.state.outcome is GripperOutcome.FAILED
        lost = failed and found is not None and found.lost  # its fault is then the loss
        try:
            state = self.state(-1.0 if lost else 0.5)
        except (ConnectionLost, StaleStateError) as error:
            return str(error)
        return f"the gripper of {self._robot} failed: {state.fault}" if failed else ""

    def width_of(self, fraction: float) -> float:
        """Return the width in m of a grip from 0 (open) to 1 (closed). CommandError for other values."""
        grip = number("a grip, from 0 (open) to 1 (closed),", fraction, least=0.0, most=1.0)
        return self.width_max - grip * (self.width_max - self.width_min)

    def grip_at(self, width: float) -> float:
        """Return the grip, from 0 (open) to 1 (closed), of a width in m; 0 or 1 beyond the gripper's range."""
        return min(1.0, max(0.0, (self.width_max - width) / (self.width_max - self.width_min)))

    # Commands that return at once.

    def start(self, width: float, speed: float | None = None, force: float | None = None) -> GripperMotion:
        """Start a motion of the fingers.

        Args:
            width: Distance between the fingers at the end, m.
            speed: Speed, m/s, up to the gripper's own, which is the default.
            force: Greatest force on an object in between, N, up to the model's ``force_max``; the gripper's default if
                left out.
        """
        return self._start_motion(GripperAct.MOVE, *self._check_motion(width, speed, force))

    def start_grasp(
        self,
        width: float,
        force: float | None = None,
        speed: float | None = None,
        inner: float = 0.005,
        outer: float = 0.005,
    ) -> GripperMotion:
        """Start to close on an object and hold it.

        The fingers are asked to close, whatever the width, so that they press: ``width_target`` is ``width_min``. The
        object counts as held if they end between ``width - inner`` and ``width + outer``; otherwise the outcome is
        ``MISSED``.

        Args:
            width: Expected width of the object, m.
            force: Force to hold it with, N; the gripper's default if left out.
            speed: Speed, m/s, up to the gripper's own, which is the default.
            inner: Greatest amount by which the object may be narrower, m.
            outer: Greatest amount by which the object may be wider, m.
        """
        for name, value in (("inner", inner), ("outer", outer)):
            number(name, value, "m", least=0.0)
        return self._start_motion(GripperAct.GRASP, *self._check_motion(width, speed, force), inner, outer)

    def start_home(self) -> GripperMotion:
        """Start to measure how far the fingers open. Some grippers need it once after they are switched on.

        The fingers open and close, and drop what they hold; grippers that need no homing do nothing.
        """
        return self._start_motion(GripperAct.HOME)

    def stop(self) -> None:
        """Stop the fingers where they are, with the present force. Returns at once; may be called from any thread."""
        self.check()
        self._put(self._latch.stops, GripperAct.STOP)

    def _check_motion(self, width: float, speed: float | None, force: float | None) -> tuple[float, float, float]:
        speed = self.spec.speed if speed is None else speed
        force = self.spec.force if force is None else force
        return (
            number("width", width, "m", least=0.0, most=self.spec.width_max),
            number("speed", speed, "m/s", least=0.0, above=True, most=self.spec.speed),
            number("force", force, "N", least=0.0, above=True, most=self.force_max),
        )

    def _start_motion(self, act: GripperAct, *numbers: float) -> GripperMotion:
        stops = self._latch.stops  # first: a stop that comes after this line ends the motion
        self._latch.check()
        self.check()
        with self._sending:
            self._motion = GripperMotion(self, self._put(stops, act, *numbers))
            return self._motion

    def _send(self, session: int, width: float, force: float) -> int:
        """Start a motion from a control loop: no error if the gripper does not answer, and no wait.

        Returns:
            Its number; 0 after a stop.
        """
        stops = self._latch.stops
        if self._latch.stopped:
            return 0
        return self._put(stops, GripperAct.MOVE, width, self.spec.speed, force, session=session)

    def _is_over(self, number: int) -> bool:
        """Return whether the command of this number was stopped before its end, or another one came since."""
        state = self.peek()
        stopped = state is not None and state.outcome is GripperOutcome.STOPPED and state.target_seq == number
        return stopped or self._commands != number

    def _forget_grip(self) -> None:
        """Let a session send its grip again: the fingers were placed elsewhere."""
        with self._sending:
            self._commands += 1

    def _put(self, stops: int, act: GripperAct, *numbers: float, session: int = 0) -> int:
        with self._sending:
            if self._motion is not None:
                self._motion._find_result()  # its outcome is lost once the next command is sent
            self._commands += 1
            self._mail.put_command(GripperCommand(self._commands, stops, session, act, *numbers))
            return self._commands

    # Commands that wait.

    def move(
        self, width: float, speed: float | None = None, force: float | None = None, timeout: float = 10.0
    ) -> GripperState:
        """Move to ``width`` and wait until the fingers rest, there or on an object; see :meth:`start`.

        Args:
            width: Distance between the fingers at the end, m.
            speed: Speed, m/s.
            force: Greatest force, N.
            timeout: Longest time to wait, s.
        """
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
        """Close on an object and wait until the fingers rest; return whether they hold it.

        Args:
            width: Expected width of the object, m.
            force: Force to hold it with, N.
            speed: Speed, m/s.
            inner: Greatest amount by which the object may be narrower, m.
            outer: Greatest amount by which the object may be wider, m.
            timeout: Longest time to wait, s.
        """
        return bool(self._finish(self.start_grasp(width, force, speed, inner, outer), timeout))

    def home(self, timeout: float = 30.0) -> GripperState:
        """Measure how far the fingers open, and wait; see :meth:`start_home`."""
        result = self._finish(self.start_home(), timeout)
        if not result:
            raise RobotFault(
                f"{self.name} did not finish homing", "clear the space between its fingers, then try again"
            )
        return result.state

    def grip(self, fraction: float, force: float | None = None) -> GripperState:
        """Close by a fraction and wait until the fingers rest.

        Args:
            fraction: From 0 (open) to 1 (closed).
            force: Greatest force on an object in between, N.
        """
        return self.move(self.width_of(fraction), force=force)

    def open(self) -> GripperState:
        """Open completely and wait."""
        return self.move(self.spec.width_max)

    def _finish(self, motion: GripperMotion, timeout: float) -> GripperResult:
        result = motion.wait(timeout)
        if result.outcome is GripperOutcome.FAILED:
            fault = result.fault
            raise RobotFault(*((fault.cause, fault.remedy) if fault else (f"{self.name} failed", "")))
        if result.outcome is GripperOutcome.STOPPED:
            self._latch.check()
            raise MotionStopped(
                f"{self.name} was stopped, or got a newer command, before the end", code="gripper_stopped"
            )
        return result

    def inject(self, **faults: object) -> None:
        """Switch faults of a simulated driver on or off, for tests; see the driver's own ``inject``."""
        self._host.request("inject_gripper", {"gripper": self.name, "faults": faults})

    if not TYPE_CHECKING:  # so that type checkers still report unknown attributes

        def __getattr__(self, name: str) -> NoReturn:
            hint = "; the rig closes the device; to close the fingers use grip(1.0)" if name == "close" else ""
            raise AttributeError(f"a gripper has no attribute {name!r}{hint}", name=name, obj=self)

    def __repr__(self) -> str:
        return f"<Gripper of {self._robot}: {self.width_min:g}..{self.width_max:g} m, driver {self.spec.driver}>"


class GripperMotion:
    """A motion that was started by ``start``, ``start_grasp`` or ``start_home``; it does not depend on this object."""

    def __init__(self, gripper: Gripper, seq: int) -> None:
        self._gripper = gripper
        self._seq = seq
        self._result: GripperResult | None = None

    @property
    def done(self) -> bool:
        """Whether the motion is over, with any outcome; never waits.

        Raises:
            ConnectionLost: The gripper does not answer.
            StaleStateError: It has sent no state for 2 s.
        """
        if self._find_result() is None:
            self._gripper.state(_PATIENCE)
        return self._result is not None

    def wait(self, timeout: float = 10.0) -> GripperResult:
        """Wait until the motion is over; in lock-step this advances time.

        Args:
            timeout: Longest time to wait, s.

        Returns:
            The result; ``STOPPED`` if a newer command or a stop ended the motion.

        Raises:
            TimeoutError: After ``timeout``; the motion continues.
            ConnectionLost: The gripper does not answer.
            StaleStateError: It has sent no state for 2 s.
        """
        gripper = self._gripper
        clock = gripper.clock
        deadline = clock.now() + timeout
        period = max(_SHORTEST_WAIT, gripper.period)
        while (result := self._find_result()) is None:
            state = gripper.state(_PATIENCE)
            if clock.now() >= deadline:
                raise TimeoutError(f"{gripper.name} is still moving after {timeout:g} s: {state}")
            clock.sleep(period)
        return result

    def _find_result(self) -> GripperResult | None:
        """Return the result, or None while the motion runs."""
        state = self._gripper.peek() if self._result is None else None
        if self._result is None and state is not None:
            if state.target_seq > self._seq:
                self._result = GripperResult(GripperOutcome.STOPPED, state, None)
            elif state.target_seq == self._seq and state.outcome not in _UNFINISHED:
                failed = state.outcome is GripperOutcome.FAILED
                self._result = GripperResult(state.outcome, state, state.fault if failed else None)
        return self._result

    def __repr__(self) -> str:
        how = self._result.outcome if self._result is not None else "running when last checked"
        return f"<GripperMotion {self._seq} of {self._gripper.name}: {how}>"


@dataclass(frozen=True, slots=True)
class GripperResult:
    """Outcome of a motion that is over. It is true if the outcome is ``DONE``."""

    outcome: GripperOutcome
    state: GripperState
    """State of the gripper when the end was first seen."""
    fault: Fault | None
    """Why it failed; None if it did not."""

    def __bool__(self) -> bool:
        return self.outcome is GripperOutcome.DONE
