"""Control sessions: exclusive, dead-man-guarded streaming of commands to one arm.

:class:`Control` is the session. Every command passes :class:`~hal.commands.CommandChecks` before it is sent.
"""

from __future__ import annotations

import math
import threading
import warnings
from types import TracebackType
from typing import TYPE_CHECKING, Any

from . import registry
from .arguments import number
from .commands import (
    NO_SESSION,
    Command,
    CommandChecks,
    CommandRecord,
    JointChunk,
    JointTarget,
    JointTorque,
    PathSection,
    Sent,
    Session,
    SessionRecord,
    encode,
)
from .deadman import Deadman
from .errors import (
    CommandError,
    ConnectionLost,
    ControlTaken,
    HalError,
    MotionStopped,
    NotSupported,
    RobotFault,
)
from .types import RobotStatus, Trip

if TYPE_CHECKING:
    from collections.abc import Callable

    from .host.records import ServoRecord
    from .robot import Robot
    from .servo.controllers import Controller

_SHORTEST_DEADLINE = 0.1
_PERIODS = 2.5
"""Deadline of the next command after one: so many periods of the session's rate, at least the shortest, s."""
_REFUSED = "a first target too far away, too late, or torques and another kind of command without a rest in between"
"""Why the servo refuses a command."""
_MOST_AT_ONCE = 100
"""Number of commands in a row without any passing of time that counts as a mistake: a lock-step clock stands still."""
_REST_LIMIT = 5.0
"""Longest wait for the arm to come to rest at the end of a session, s."""


class Control:
    """A control session of one arm; created by :meth:`hal.robot.Robot.control`, used in a ``with`` statement.

    Leaving the ``with`` block, for whatever reason, brings the arm to rest; an exception of the block is the one that
    is raised. The arguments are those of :meth:`hal.robot.Robot.control`, and ``goal`` (n,), rad, or ``path`` for
    a session that makes this one motion.

    Attributes:
        controller: What follows the set-point, with a value for every gain.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        deadman: Deadman | None,
        rate_hz: float,
        speed: float | None,
        tcp_speed: float | None,
        unattended: bool,
        controller: Controller | None = None,
        goal: tuple[float, ...] | None = None,
        path: tuple[PathSection, ...] | None = None,
    ) -> None:
        _check_permission(robot, deadman, unattended)
        spec = robot.spec
        rate_hz = number("rate_hz", rate_hz, "Hz", least=0.0, above=True)
        self._rate_hz = rate_hz
        self._deadline = max(_SHORTEST_DEADLINE, _PERIODS / rate_hz)
        streams = goal is None and path is None
        if streams and self._deadline > spec.deadline_max:
            slowest = _PERIODS / spec.deadline_max
            raise CommandError(
                f"{rate_hz:g} Hz is too slow for {robot.name}: send at {slowest:.1f} Hz or more", code="rate_too_low"
            )
        self.robot = robot
        self.deadman = deadman
        usual, most = (spec.speed, spec.speed) if streams else (spec.move_speed, 1.0)
        self.speed = _choose_share("speed", speed, usual, most)
        if not streams and robot.recorded and self.speed > spec.speed:
            text = f"{robot.name} is recorded: its speed is {spec.speed:g} and not {self.speed:g}, so that a replay"
            warnings.warn(f"{text}, which may be no faster, can follow", RuntimeWarning, stacklevel=5)
            self.speed = spec.speed
        self.tcp_speed = _choose_share("tcp_speed", tcp_speed, spec.tcp_speed, spec.tcp_speed)
        self._goal, self._path = goal, path
        self._mail = robot._mail
        self._host = robot._host
        self._id = 0
        self._record = NO_SESSION
        """What the servo is told about this session."""
        self._opened = 0
        """Number of the newest state when the session was opened: later ones are of this session."""
        self._seen = 0
        """Number of stops that the caller knows of: those that were shown to it as the trip."""
        self._lock = threading.RLock()
        """Held while a record is made and sent: any thread may use the session."""
        self._reported = False
        self._unreported: Trip | None = None
        """The stop that no call has reported when the session began to end; None before."""
        self._detach: Callable[[], None] | None = None
        self._grip = (0.0, 0.0, 0)
        """Width, m, force, N, and number of the newest command to the gripper; 0 before the first one."""
        self._paused = False  # whether no grip was asked for since: then one that failed is sent again
        self._refused = 0
        self._t_sent = -math.inf
        self._at_once = 0
        """Number of commands that were sent without any time passing."""
        self._checks = CommandChecks(robot)
        self.controller = self._resolve_controller(controller)
        self._law: dict[str, Any] | None = self._describe_controller()
        """The controller as plain data; None for the arm's own."""

    def _resolve_controller(self, controller: Controller | None) -> Controller:
        """Return the controller with a value for every gain, checked against the arm."""
        from .servo.controllers import Position, resolve  # together with the servo's libraries, so only when needed

        if controller is None or isinstance(controller, Position):
            return Position()
        robot = self.robot
        self._checks.check_torques()
        simulated = registry.load(robot.spec.driver, "robot").simulated
        return resolve(controller, robot.spec, robot.kinematics, self._host.spec.rate_hz, simulated)

    def _describe_controller(self) -> dict[str, Any] | None:
        from .servo.controllers import controller_data

        return controller_data(self.controller)

    # Opening and closing.

    def __enter__(self) -> Control:
        """Open the session.

        Raises:
            ControlTaken: The session is open already, or another one of this arm is.
            MotionStopped: ``rig.stop()`` was called and is not acknowledged (``code`` is ``rig_stop``).
            ConnectionLost: The arm does not answer.
        """
        robot = self.robot
        if self._id:
            raise ControlTaken("this control session is open already")
        motion = robot._motion
        if motion is not None and robot._open is not None and not motion.release():
            raise ControlTaken(f"{robot.name} still makes the motion that was started: wait for it, or cancel it")
        if robot._open is not None:
            raise ControlTaken(
                f"{robot.name} is under the control of another session of this program: leave its 'with' block first"
            )
        self._host.check()
        # The count first: a stop that comes after this line trips the session in its first tick.
        self._seen = stops = robot._latch.stops
        self._check_latch()
        robot._sessions += 1
        self._id = robot._sessions
        terms = (self.speed, self.tcp_speed, self.deadman is not None)
        session = Session(self._id, *terms, self._goal, self._law, self._path)
        try:
            robot._open = self
            if session.is_motion:
                points = [q for section in self._path or () for q in section.q] or [self._goal or ()]
                self._mail.put_way(self._id, points)
            self._publish(SessionRecord(self._id, stops, 0))
            if self.deadman is not None:
                self._detach = self.deadman.attach(self._mail.put_deadman)
            self._host.request("begin", {"robot": robot.name, "session": list(session)})
        except BaseException:  # Ctrl-C too: the host may have opened the session, or may still do so
            self._forget()
            raise
        self._opened = self._mail.state.seq()
        robot._latch.acknowledge(stops)
        return self

    def _publish(self, record: SessionRecord) -> None:
        with self._lock:
            self._record = record
            self._mail.put_session(record)

    def _check_latch(self) -> None:
        latch = self.robot._latch
        if self.deadman is None:
            latch.check()
        elif latch.stopped and self.deadman.held:
            raise MotionStopped("rig.stop() was called", "release the dead-man first", code=Trip.STOP.code)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except (HalError, OSError):
            if error is None:
                raise

    def close(self) -> None:
        """Bring the arm to rest and end the session. Idempotent; warns of a stop that no ``send`` has reported.

        Raises:
            ConnectionLost: The arm did not come to rest in time, or its process is gone.
        """
        if not self._id or self._host.forked:
            return
        self.brake()
        unreported, self._unreported = self._unreported, None
        try:
            self._wait_for_rest()
        finally:
            self._forget()
        if unreported:
            text = f"{self.robot.name} was stopped in this session: {unreported.text}"
            warnings.warn(text, RuntimeWarning, stacklevel=3)

    def brake(self) -> None:
        """Begin to end the session, and do not wait as :meth:`close` does: so that several arms brake at once."""
        if self._id and self._unreported is None:
            found = self._mail.peek()
            known = found is None or found.session != self._id or self._reported
            self._unreported = Trip.NONE if found is None or known else found.trip
            self._publish(NO_SESSION)  # needs no answer: the arm brakes, whatever happens to this program

    def _forget(self) -> None:
        """End the session on this side; the host ends it too if it has not yet."""
        self._publish(NO_SESSION)
        self._id = 0
        self.robot._open = None
        if self._detach is not None:
            self._detach()
            self._detach = None

    def _wait_for_rest(self) -> None:
        clock = self.robot.clock
        deadline = clock.now() + _REST_LIMIT
        while (found := self._peek()).session == self._id:
            if clock.now() > deadline:
                raise ConnectionLost(f"{self.robot.name} did not come to rest within {_REST_LIMIT:g} s: {found.status}")
            clock.sleep(1.0 / self._host.spec.rate_hz)

    # Commands.

    def set_gains(self, **gains: Any) -> None:
        """Change gains of the session's controller; they take effect within 0.2 s.

        Args:
            **gains: Arguments of the controller with their new values, for example ``stiffness=300.0``. The frame and
                ``position_only`` stay as they are, and so does whether the gains are stiffnesses or rates.

        Raises:
            CommandError: No such gain, or a wrong value for this arm (``code`` is ``bad_controller``).
        """
        from .servo.controllers import replace_gains

        self._require_open()
        before, self.controller = self.controller, self._resolve_controller(replace_gains(self.controller, gains))
        law = self._describe_controller()
        try:
            self._host.request("gains", {"robot": self.robot.name, "session": self._id, "controller": law})
        except HalError:
            self.controller = before
            raise

    def _require_open(self) -> None:
        if not self._id:
            raise CommandError("this control session is not open: use it in a 'with' statement", code="session_closed")

    @property
    def status(self) -> RobotStatus:
        """Status of the arm."""
        return self._peek().status

    @property
    def trip(self) -> Trip:
        """Reason for the latched stop; ``Trip.NONE`` if no stop is latched."""
        servo = self._peek()
        self._note_stops(servo)
        return servo.trip

    def check(self) -> None:
        """Raise MotionStopped, RobotFault or ControlTaken, as :meth:`send` would now; send nothing."""
        self._check_trip(self._peek())

    def _note_stops(self, servo: ServoRecord) -> None:
        """Note that the caller sees this trip: :meth:`rearm` acknowledges no later stop."""
        if servo.trip is Trip.STOP:
            self._seen = servo.stops

    def _peek(self) -> ServoRecord:
        self._host.check()
        found = self._mail.peek()
        if found is None:
            raise ConnectionLost(f"{self.robot.name} has not reported a state yet")
        return found

    def send(
        self,
        command: Command | None,
        *,
        grip: float | None = None,
        width: float | None = None,
        force: float | None = None,
        t_event: float | None = None,
    ) -> Sent:
        """Send a command to the arm, and optionally a grip or a width to its gripper. Any thread may call it.

        Args:
            command: Target, chunk, velocity, twist, pose or torque, see :mod:`hal.commands`; None leaves the arm alone.
            grip: Grip from 0 (open) to 1 (closed); None leaves the gripper alone.
            width: Distance between the fingers, m, instead of ``grip``.
            force: Greatest force on an object in between, N; the gripper's default if left out.
            t_event: Time of the pad event behind the command, s, for latency figures; None or -inf without one.

        Returns:
            What was sent, and the reasons for every difference from ``command``.

        Raises:
            CommandError: A wrong shape, a value that is not finite, a grip, width or force out of range, or a first
                target too far away; nothing is sent.
            Unreachable: A pose beyond the arm's reach; nothing is sent.
            NotSupported: Torques or a grip, for an arm without; nothing is sent.
            MotionStopped: After a trip, until it is acknowledged (see :meth:`rearm`); ``code`` is that of the trip.
            RobotFault: While the robot reports a fault.
            ControlTaken: The arm does not follow this session any more (``code`` is ``session_ended``).
            ConnectionLost: The process that owns the arm is gone.
        """
        self._require_open()
        t_event = 0.0 if t_event is None or t_event == -math.inf else number("t_event", t_event, "s")
        servo, now = self._peek(), self.robot.clock.now()
        self._check_trip(servo)
        waiting = self.deadman is not None and not self.deadman.held
        reasons: list[str] = []
        if servo.limited and servo.status is RobotStatus.FOLLOWING:
            reasons.append(f"the servo limits the motion: {servo.limited}")
        if servo.session == self._id and servo.refused > self._refused:
            self._refused = servo.refused
            reasons.append(f"the servo refused an earlier command: {_REFUSED}")
        target = self._finger_target(grip, width, force)
        if command is not None:
            command = self._send_command(command, servo, now, t_event, waiting, reasons)
        self._paused |= target is None
        if target is not None:
            with self._lock:
                self._send_fingers(target, waiting, reasons)
        return Sent(command, tuple(reasons))

    def _send_command(
        self, command: Command, servo: ServoRecord, now: float, t_event: float, waiting: bool, reasons: list[str]
    ) -> Command:
        """Send a command to the servo, checked before; return what was sent."""
        if self._goal is not None or self._path is not None:
            raise CommandError("this session makes one motion; it takes no commands", code="move_to_session")
        command = self._checks.check_command(command, now, reasons)
        if isinstance(command, JointTorque) and self._law:
            raise CommandError("this session has a controller: it takes no torques", code="torques_by_controller")
        self._check_time(now)
        if waiting:
            reasons.append("the dead-man is not held: the arm does not move")
        elif servo.status is RobotStatus.HOLDING:
            self._checks.check_first(command, now, servo.q_set)
        kind, values = encode(command, now)
        deadline = float(command.t[-1]) if isinstance(command, JointChunk) else now + self._deadline
        with self._lock:
            self.robot._commands += 1
            record = CommandRecord(self.robot._commands, self._id, now, deadline, kind, values, t_event)
            self._mail.put_command(record)
        self._host.wake()
        return command

    def hold_until_following(self) -> bool:
        """Return whether the arm follows commands; if not, command it to stay where it is. Call it once per turn.

        For programs that play a motion which starts at a certain time: start it, or continue it after a pause, only
        when this is True. A command that was sent before the servo noticed a new press of the dead-man has no effect.

        Raises:
            MotionStopped: As for :meth:`send`, with the other errors that it raises.
        """
        held = self.deadman is None or self.deadman.held
        if held and self.status is RobotStatus.FOLLOWING:
            return True
        self.send(JointTarget(self.robot.state().q_set))
        return False

    def hold_for(self, seconds: float) -> None:
        """Command the arm to stay where it is for up to ``seconds``, at most 3, until the next command.

        Without a further command the session trips at the end of that time, as at the end of any chunk.
        """
        now, q_set = self.robot.clock.now(), self.robot.state().q_set
        self.send(JointChunk([now, now + seconds], [q_set, q_set]))

    def _check_time(self, now: float) -> None:
        """Refuse a loop in which the time of a lock-step clock never passes: its arm would not move."""
        self._at_once = self._at_once + 1 if now == self._t_sent else 0
        self._t_sent = now
        if self._at_once >= _MOST_AT_ONCE:
            raise CommandError(
                f"no time passed while {_MOST_AT_ONCE} commands were sent: with clock='lock_step' it passes only while "
                "the program waits for it, with rig.clock.rate() or rig.clock.sleep()",
                code="no_time_passed",
            )

    def _check_trip(self, servo: ServoRecord) -> None:
        """Raise RobotFault or MotionStopped if the servo has latched a stop that it still holds.

        Raises:
            ControlTaken: The servo follows no session, or another one.
        """
        if servo.session != self._id and self._mail.state.seq() > self._opened and self._peek().session != self._id:
            raise ControlTaken(
                f"{self.robot.name} does not follow this session any more: it was closed; open another one",
                code="session_ended",
            )
        if servo.status is RobotStatus.FAULT:
            fault = self.robot.state(max_age=math.inf).fault
            self._report_stop()
            cause, remedy = (fault.cause, fault.remedy) if fault else ("the robot reports a fault", "")
            raise RobotFault(cause, f"{remedy}; then robot.recover()" if remedy else "call robot.recover()")
        if servo.trip is Trip.NONE:
            self._reported = False
            if servo.session == self._id:
                self.robot._latch.acknowledge(servo.stops)  # by a press of the dead-man, or by a rearm
            return
        if servo.rearms != self._record.rearms:
            return  # the servo has not handled the rearm yet
        self._note_stops(servo)
        self._report_stop()
        remedy = "release the dead-man and press it again" if self.deadman else "call control.rearm() to continue"
        raise MotionStopped(servo.trip.text + self._details(servo), remedy, code=servo.trip.code)

    def _report_stop(self) -> None:
        """Note that the program learns of a stop, and let the pad of the dead-man rumble, once."""
        if self.deadman is not None and not self._reported:
            self.deadman.alarm()
        self._reported = True

    def _details(self, servo: ServoRecord) -> str:
        """Return what to add to the words for a trip."""
        if servo.trip is Trip.COMMAND_LATE and servo.refused > servo.target_seq:
            return f" that the servo can follow; it refused newer ones: {_REFUSED}"
        if servo.trip is Trip.COMMAND_LATE:
            longest = f"at most {1e3 * self._deadline:.0f} ms may pass between two at rate_hz={self._rate_hz:g}"
            return f" ({longest}; for a slower loop pass a lower rate_hz, or send chunks)"
        if servo.trip is Trip.LIMIT and servo.overrun:
            return f" (here: {servo.overrun})"
        state = self._mail.get_state() if servo.status is RobotStatus.LOST else None
        return f" ({state.fault.cause})" if state is not None and state.fault is not None else ""

    def rearm(self) -> None:
        """Acknowledge the trip that :meth:`send` raised or :attr:`trip` returned, in a session without a dead-man.

        The arm then follows the next command. A ``rig.stop()`` that came since is not acknowledged: the next ``send``
        raises it.

        Raises:
            MotionStopped: The session has a dead-man: releasing and pressing it again is the acknowledgement (``code``
                is ``deadman_session``).
        """
        if self.deadman is not None:
            raise MotionStopped("this session has a dead-man", "release it and press it again", code="deadman_session")
        self._require_open()
        self._host.check()
        seen = max(self._seen, self.robot._latch.rearmed)  # rig.rearm() acknowledges every stop before it
        with self._lock:
            self._publish(self._record._replace(acknowledged=seen, rearms=self._record.rearms + 1))
        self.robot._latch.acknowledge(seen)

    def _finger_target(
        self, grip: float | None, width: float | None, force: float | None
    ) -> tuple[float, float] | None:
        """Return the width, m, and force, N, that ``send`` asks of the gripper, or None; checked before it is sent."""
        if grip is None and width is None:
            return None
        if grip is not None and width is not None:
            raise CommandError("pass one of grip= (0 open to 1 closed) and width= (m), not both")
        gripper = self.robot.gripper
        if gripper is None:
            raise NotSupported(f"{self.robot.name} has no gripper", code="no_gripper")
        if grip is not None:
            width = gripper.width_of(grip)
        assert width is not None
        width, _, force = gripper._check_motion(width, None, force)
        return width, force

    def _send_fingers(self, target: tuple[float, float], waiting: bool, reasons: list[str]) -> None:
        gripper = self.robot.gripper
        assert gripper is not None
        trouble = gripper.trouble
        if trouble:
            reasons.append(trouble)
        if waiting:
            reasons.append("the dead-man is not held: the gripper does not move")
            return
        before, pressed, number = self._grip
        small = abs(target[0] - before) <= gripper.spec.width_max * 0.005 and target[1] == pressed
        repeats = self._paused and bool(trouble)
        self._paused = False
        if not (number and small) or repeats or gripper._is_over(number):
            self._grip = (*target, gripper._send(self._id, *target))


def _choose_share(name: str, value: float | None, default: float, most: float) -> float:
    """Return ``value`` or the default, checked against the most that the rig allows."""
    return number(name, default if value is None else value, least=0.0, above=True, most=most)


def _check_permission(robot: Robot, deadman: Deadman | None, unattended: bool) -> None:
    """Raise CommandError unless a dead-man that can be trusted permits what really moves, or nobody is near it."""
    check_deadman(deadman)
    spec = robot.spec
    if spec.attended and deadman is None and not unattended:
        raise CommandError(
            f"{robot.name} really moves: pass deadman=pad.hold('l2'), or unattended=True if no person is near it",
            code="deadman_required",
        )
    if deadman is not None and spec.attended and not spec.emulated:
        deadman.check_trust()


def check_deadman(deadman: object) -> None:
    """Raise CommandError if ``deadman`` is neither None nor a Deadman, for example a gamepad."""
    if deadman is not None and not isinstance(deadman, Deadman):
        raise CommandError(
            f"deadman must be a dead-man, as pad.hold('l2') returns it, not a {type(deadman).__name__}",
            code="not_a_deadman",
        )
