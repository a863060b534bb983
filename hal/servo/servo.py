"""One arm's servo: the only place where set-points are made. Pure: no clock, device or process inside.

    newest command ─► watchdog ─► motion (goal in joint space) ─► envelope (speed caps) ─► smoother ─► set-point

A session with a controller writes the torques that follow this set-point in its place (:mod:`.compliance`).
The host calls :meth:`Servo.tick` once per cycle between reading the device and writing to it. Whatever happens, an arm
that must not follow is brought to rest by the smoother's time-optimal stop and held where that ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import dist, hypot, isfinite
from typing import Any

from ..commands import PATIENCE, CommandRecord, Inbox, Kind, Session
from ..driver import Reading, Setpoint
from ..errors import CommandError, ControlTaken, Fault
from ..kinematics.arm import Kinematics
from ..specs import RobotSpec
from ..types import ControlMode, Limited, RobotStatus, Trip
from .anchoring import Anchoring
from .cartesian import PoseMotion, TwistMotion
from .collisions import CollisionGuard
from .compliance import Compliance
from .controllers import Controller
from .envelope import Envelope
from .joint import ChunkMotion, JointTargetMotion, JointVelocityMotion, ServoMotion
from .planned import PathMotion, PlannedMotion
from .report import ServoReport
from .smoothing import JointSmoother
from .torque import BRAKE_LIMIT, MassMatrix, TorqueMotion
from .watchdog import SILENCE, WITHHELD, WITHHELD_FAULT, Watchdog, is_alive, is_timely

Floats = Sequence[float]


# Members of enumerations that every tick names: a global is found faster than a member.
_NO_TRIP, _FAULT, _UNLIMITED, _FOLLOWING = Trip.NONE, Trip.FAULT, Limited.NONE, RobotStatus.FOLLOWING
_POSITION = ControlMode.POSITION

_ABSURD = 1e3
"""Joint speeds beyond this are an invalid reading, rad/s."""

_BEYOND = 1.0
"""Joint positions this far beyond the joint's range are an invalid reading, rad."""


@dataclass(slots=True)
class _Course:
    """How far a session has come."""

    seq: int = 0
    """Number of the newest command that was handled or is no longer valid."""
    ending: bool = False
    braking: float = 0.0
    """Time for which a controller has held the session open although it is closing, s."""
    stuck: float = 0.0
    """Time for which its motion has made no progress, s."""
    resting: int = 0
    """Number of ticks for which it has been at rest while closing."""


class Servo:
    """Makes the set-points of one arm, once per ``dt`` seconds.

    Args:
        spec: The arm.
        dt: Time between two ticks, s.
        kinematics: The arm's kinematics, if they are loaded already.
        mass_matrix: Inertia of a device that takes torques; without it, torque commands are refused.
        extrapolates: What the device does when a set-point is lost (see :attr:`.RobotDriver.extrapolates`).
        simulated: Whether the arm has the joint damping of its URDF, which controllers then compensate.
    """

    def __init__(
        self,
        spec: RobotSpec,
        dt: float,
        kinematics: Kinematics | None = None,
        mass_matrix: MassMatrix | None = None,
        extrapolates: bool = False,
        simulated: bool = False,
    ) -> None:
        self.spec = spec
        self.kinematics = Kinematics(spec.kinematics) if kinematics is None else kinematics
        self.report = ServoReport()
        self._smoother = smoother = JointSmoother(spec.limits, dt)
        self._envelope = envelope = Envelope(smoother, self.kinematics, spec.workspace)
        self._watchdog = Watchdog(dt)
        self._anchoring = Anchoring(smoother, extrapolates)
        limits = list(zip(spec.limits.lower, spec.limits.upper, strict=True))
        self._range = [(low - _BEYOND, high + _BEYOND) for low, high in limits]
        # Positions this near to the middle of their ranges are in them: one distance, not two comparisons a joint.
        self._middle = [0.5 * (low + high) for low, high in limits]
        self._radius = min(0.5 * (high - low) for low, high in limits) + _BEYOND
        self._torque = TorqueMotion(smoother, envelope, spec.limits, mass_matrix)
        self._compliance = Compliance(self._torque, envelope, spec, simulated)
        self._motions: dict[Kind, ServoMotion] = {
            Kind.JOINT_TARGET: JointTargetMotion(smoother, envelope),
            Kind.JOINT_CHUNK: ChunkMotion(smoother, envelope),
            Kind.JOINT_VELOCITY: JointVelocityMotion(smoother, envelope),
            Kind.JOINT_TORQUE: self._torque,
            Kind.CARTESIAN_TARGET: PoseMotion(smoother, envelope),
            Kind.TWIST: TwistMotion(smoother, envelope),
        }
        self._path = PathMotion(smoother, envelope)
        self._planned = PlannedMotion(smoother, envelope)
        self._whole: PlannedMotion | None = None
        """The one motion of a session that takes no commands; None in a session that does."""
        self._session: Session | None = None
        self._course = _Course()
        self._motion: ServoMotion | None = None
        """The motion that moves the arm; None until the first command."""
        self._anchored = False
        self._followed = False
        """Whether a motion moved the arm in the last tick."""
        self.possible = True
        """Whether the numbers of the last reading are possible, even if they are old."""
        self._withheld = 0.0
        """Time for which the driver has held back the set-points of such a motion, s."""
        self._t_tick: float | None = None
        """Time of the last tick, s."""
        self._extrapolates = extrapolates
        self._ahead: Setpoint | None = None
        """The set-point that the next reading is answered with."""
        self._compared = self._corrected = False
        """Whether the newest reading was compared with what was given, and the set-point corrected."""
        self._device = _NO_TRIP
        """The trip that this reading causes."""

    @property
    def active(self) -> bool:
        """Whether a session is open or still braking."""
        return self._session is not None

    @property
    def watchdog(self) -> Watchdog:
        """The permission of the session to move."""
        return self._watchdog

    @property
    def smoother(self) -> JointSmoother:
        """The set-point."""
        return self._smoother

    def stop_end(self) -> Floats:
        """Return where a stop of the set-point that begins now ends (n,), rad."""
        return self._smoother.stop_end() if self._whole is None else self._whole.stop_end()

    def set_guard(self, guard: CollisionGuard | None) -> None:
        """Keep the arm off what ``guard`` checks, from the next session on."""
        self._envelope.collisions = guard

    def anchor(self, q: Floats, dq: Floats | None = None) -> None:
        """Set the set-point and discard every goal. Nothing moves.

        Args:
            q: Joint positions (n,), rad.
            dq: Joint speeds (n,), rad/s; zeros if None.

        Raises:
            CommandError: For a wrong number of values, or positions far outside the joints' ranges.
        """
        n = self._smoother.n
        for name, values in (("q", q), ("dq", dq)):
            if values is not None and not (len(values) == n and isfinite(sum(map(abs, values)))):
                raise CommandError(
                    f"cannot anchor to {name} = {list(values)}: needs {n} finite numbers", code="bad_anchor"
                )
        if not self._is_position(q):
            raise CommandError(
                f"cannot anchor to q = {list(q)}: more than {_BEYOND:g} rad beyond the joints' limits",
                code="bad_anchor",
            )
        self._smoother.anchor(self._anchoring.start_position(q) if dq is None else q, dq)
        self._torque.active = self._compliance.active = False
        self._ahead = None
        self._anchoring.forget()
        self._anchored = True
        self._forget_goals()
        self._publish()

    def open_session(self, session: Session, inbox: Inbox, pause: Callable[[], None] = lambda: None) -> None:
        """Open a control session; the servo must have been anchored.

        Args:
            session: The terms of the session.
            inbox: Its present content: presses and rearms in it do not count.
            pause: Called again and again while a long path is checked; it may run ticks, and anchor the servo.

        Raises:
            ControlTaken: While another session is open.
            CommandError: If the terms are invalid.
        """
        if self._session is not None:
            raise ControlTaken(f"session {self._session.id} controls this arm")
        if not self._anchored:
            raise CommandError("anchor the servo before a session begins", code="not_anchored")
        if not (0.0 < session.speed <= 1.0 and session.tcp_speed > 0.0):
            raise CommandError(f"a session needs 0 < speed <= 1 and tcp_speed > 0, not {session}", code="bad_session")
        self._compliance.open_session(session)
        self._whole = None
        if session.path is not None:
            self._planned.set_path(session.path, pause)
            self._whole = self._planned
        elif session.move_to is not None:
            self._path.set_goal(session.move_to)
            self._whole = self._path
        self._session = session
        self._course = _Course()
        self._ahead = None
        self.report.target_seq = self.report.refused = 0
        self.report.arrived = self.report.off_path = False
        self.report.progress, self.report.held_back = 0.0, Limited.NONE
        self._forget_goals()
        self._watchdog.open_session(session, inbox)
        self.report.status = RobotStatus.HOLDING
        self.report.trip = Trip.NONE

    def set_gains(self, session: int, controller: Controller) -> None:
        """Change the gains of the controller of this session, if it is still open, within 0.2 s."""
        if self._session is not None and self._session.id == session:
            self._compliance.set_gains(controller)

    def close_session(self) -> None:
        """Close the session: brake, then be idle."""
        if self._session is not None and not self._course.ending:
            self._course.ending = True
            self._watchdog.close_session()
            self._forget_goals()

    def tick(self, now: float, reading: Reading, inbox: Inbox, late: bool = False) -> Setpoint | None:
        """Compute the next set-point, at ``now``, s; ``late`` after a pause that it does not show (suspended computer).

        Returns:
            The set-point; None while no session is open. A device that was answered gets it with the next
            :meth:`answer`.
        """
        session = self._session
        late = self._is_late(now) or late
        compared, self._compared = self._compared, False
        self._envelope.limited = Limited.REANCHORED if compared and self._corrected else _UNLIMITED
        device = self._device if compared else self._find_trip(now, reading)
        streamed = session is not None and not self._torque.active
        device = self._observe(reading, device)
        if streamed and not compared:
            self._compare(reading, device)
        self._watchdog.update(now, inbox, self._is_at_rest(), device, late)
        faulty = device is _FAULT
        if session is None or (self._course.ending and self._close_if_finished()):
            self._idle(RobotStatus.FAULT if faulty else RobotStatus.IDLE)
            return None
        self._accept_command(now, session, inbox.command)
        setpoint = self._move(now, RobotStatus.FAULT if faulty else None)
        if setpoint is not None and setpoint.tau is None:
            if compared:  # the device has its answer
                self._ahead = setpoint
            else:
                self._anchoring.note_given(setpoint)
        return setpoint

    def _observe(self, reading: Reading, device: Trip) -> Trip:
        """Take what the arm measured; return ``device``, or the trip of an arm that torques have driven too far."""
        if self._session is None:
            self._anchoring.note_rest(None if device else reading.q_commanded)
        torque = self._torque
        known = self._is_known(reading, device)
        self.possible = known or device is Trip.DEVICE_LOST
        if torque.active:
            torque.observe(reading if known else None)
            device = device or self._overruns()
            if device:
                self._compliance.active = False  # torques brake it, as in any other session
        elif known:
            torque.q, torque.dq = reading.q, reading.dq  # where torques would begin
        return device

    def answer(self, now: float, reading: Reading) -> Setpoint | None:
        """Return at once the set-point that a device which extrapolates gets after this reading.

        It is the one that the last tick computed. If there is none, or the device lost the one before, it is one step
        of a stop, from where the device is; the next tick continues from there. So the answer never waits for a long
        computation, a single loss costs a step, and an arm whose set-points are late again and again slows down.

        Returns:
            The set-point; None while no session is open, for another device, and for torques, which need the newest
            reading.
        """
        setpoint, self._ahead = self._ahead, None
        if not self._extrapolates or self._session is None or self._torque.active:
            return None
        self._compared = True
        self._device = self._find_trip(now, reading)
        if self._compare(reading, self._device) or setpoint is None:
            smoother = self._smoother
            q_from = smoother.q
            smoother.stop()
            setpoint = Setpoint(smoother.q, smoother.dq, smoother.ddq, None, q_from)
        self._anchoring.note_given(setpoint)
        return setpoint

    def _compare(self, reading: Reading, device: Trip) -> bool:
        """Compare a reading with what was given; returns whether the set-point was corrected."""
        self._corrected = self._anchoring.check_report(reading, device)
        if self._corrected:
            self._course.resting = 0
            self.report.reanchored += 1
            self._envelope.limited = Limited.REANCHORED
            if self._motion is not None:
                self._motion.reanchored()
        return self._corrected

    @property
    def fault(self) -> Fault | None:
        """Set if the device does not take its set-points as it should, until :meth:`recover`; the arm is stopped."""
        return self._anchoring.fault

    def recover(self) -> None:
        """Clear :attr:`fault`."""
        self._anchoring.recover()

    def note_written(self, taken: bool) -> None:
        """Note whether the driver passed the last set-point on; one that goes on holding back an arm's motion fails."""
        if taken:
            self._withheld = 0.0
            return
        self.note_withheld()
        self._withheld = self._withheld + self._smoother.dt if self._followed else 0.0
        if self._withheld > WITHHELD:
            self._anchoring.fault = WITHHELD_FAULT

    def note_withheld(self) -> None:
        """Note that the driver did not pass the last set-point on (see :meth:`.RobotDriver.write`)."""
        self._anchoring.note_withheld()

    def statistics(self) -> dict[str, Any]:
        """Return what became of the set-points: ``lost``, ``skipped``, ``mismatches``, ``report_error`` (rad)."""
        return self._anchoring.statistics()

    def reset_statistics(self) -> None:
        """Set the counters to zero."""
        self._anchoring.reset_statistics()

    def _is_late(self, now: float) -> bool:
        """Return whether the last tick of a real arm was too long ago: nothing supervised it in between."""
        before, self._t_tick = self._t_tick, now
        return self.spec.attended and before is not None and not now - before <= SILENCE

    def device_lost(self, now: float, inbox: Inbox) -> Setpoint | None:
        """Trip and continue braking, because the device did not answer; return the next set-point or None."""
        self._t_tick = now
        self._envelope.limited = Limited.NONE
        self._ahead = None
        self._watchdog.update(now, inbox, False, Trip.DEVICE_LOST)
        self._anchoring.note_silence()
        self._compliance.active = False
        if self._torque.active:
            self._torque.observe(None)
        if self._session is None or (self._course.ending and self._close_if_finished()):
            self._idle(RobotStatus.LOST)
            return None
        self._forget_goals()
        return self._move(now, RobotStatus.LOST)

    def _find_trip(self, now: float, reading: Reading) -> Trip:
        """Return the trip that this reading causes; ``Trip.NONE`` if the device is all right."""
        if reading.fault is not None or self._anchoring.fault is not None:
            return Trip.FAULT
        smoother = self._smoother
        if not self._is_possible(reading):
            return Trip.BAD_READING
        q, dq = reading.q_commanded, reading.dq_commanded
        # A device that reports exactly what it was given needs no second check.
        if q is not smoother.q and q is not None and not self._is_position(q):
            return Trip.BAD_READING
        if dq is not smoother.dq and dq is not None and not self._is_sound(dq):
            return Trip.BAD_READING
        if reading.tau_commanded is not None and not self._has_sound_torques(reading):
            return Trip.BAD_READING
        if not is_alive(now, reading.t, self._torque.patience if self._torque.active else SILENCE):
            return Trip.DEVICE_LOST  # it repeats an old reading
        return _NO_TRIP

    def _is_known(self, reading: Reading, device: Trip) -> bool:
        """Return whether the numbers of this reading are valid, given the trip ``device`` that it causes."""
        if device is Trip.FAULT:
            return self._is_possible(reading) and self._has_sound_torques(reading)
        return not device

    def _has_sound_torques(self, reading: Reading) -> bool:
        """Return whether the commanded torques in this reading, from which the next ones step on, can be used."""
        tau = reading.tau_commanded
        return tau is None or not self._torque.active or len(tau) == self._smoother.n

    def _is_possible(self, reading: Reading) -> bool:
        """Return whether the measured values of this reading are possible, and all of its torques and forces finite."""
        _, _, _, q, dq, tau, _, _, tau_ext, wrench_ext, _, tau_commanded = reading
        finite = isfinite(hypot(*(tau or ()), *(tau_ext or ()), *(tau_commanded or ()), *(wrench_ext or ())))
        return finite and self._is_position(q) and self._is_sound(dq)

    def _overruns(self) -> Trip:
        """Return ``Trip.LIMIT`` if an arm that follows torques, or is braked by them, runs into a limit."""
        driven = self._compliance.active or self._motion is self._torque
        limit = self._compliance.strays() if self._compliance.active else self._torque.overrun(driven)
        if limit is None:
            return _NO_TRIP
        self._envelope.limited |= limit
        if self._watchdog.trip is _NO_TRIP:
            self.report.overrun = limit if driven else Limited.NONE
        if limit is Limited.COLLISION:
            self._leave_torques()  # what pushes it would push it on while torques brake it
        return Trip.LIMIT

    def _is_position(self, q: Floats) -> bool:
        """Return whether ``q`` has n values, each in its joint's range or near it."""
        if len(q) != self._smoother.n:
            return False
        near = dist(q, self._middle) <= self._radius
        return near or all(low <= x <= high for x, (low, high) in zip(q, self._range, strict=True))

    def _is_sound(self, values: Floats) -> bool:
        """Return whether there are n finite values of plausible size."""
        return len(values) == self._smoother.n and hypot(*values) < _ABSURD

    def _accept_command(self, now: float, session: Session, command: CommandRecord | None) -> None:
        """Accept the newest command if it belongs to this session and is valid; else count it as refused."""
        watchdog, course = self._watchdog, self._course
        allowed, renewed = watchdog.allowed, watchdog.renewed
        if not allowed or renewed:
            self._forget_goals()
        if self._whole is not None:
            if allowed and self._motion is None:
                self._whole.start()
                self._motion = self._whole
            return
        if command is None or command.session != session.id or command.seq <= course.seq:
            return
        if not allowed or (renewed and session.deadman):  # what was sent before the press is not resumed after it
            course.seq = command.seq
        elif command.values or command.kind is not Kind.JOINT_CHUNK:  # else overtaken by the next chunk, which follows
            course.seq = command.seq
            if not self._follow(now, command):
                self.report.refused = command.seq
                watchdog.refuse(command)

    def _follow(self, now: float, command: CommandRecord) -> bool:
        """Follow a command from now on; return whether that is possible."""
        motion = self._motions.get(command.kind)
        if motion is None or (self._compliance.chosen and motion is self._torque):
            return False
        if not is_timely(now, command) or not motion.usable(command.values):
            return False
        if motion is not self._motion and not self._start(motion, command.values):
            return False
        motion.accept(command)
        self._watchdog.expect(command)
        self.report.target_seq = command.seq
        return True

    def _start(self, motion: ServoMotion, values: Floats) -> bool:
        """Replace the motion by one that begins with these values; return whether it may begin here."""
        torque = self._torque
        by_torques = torque.active and not self._compliance.active
        if by_torques and torque.resting:
            self._leave_torques()
            by_torques = False
        if by_torques or motion.too_far(values):
            return False
        motion.start()
        self._motion = motion
        return True

    def _move(self, now: float, status: RobotStatus | None) -> Setpoint | None:
        """Advance the motion or the stop by one tick; ``status`` overrides the usual one."""
        smoother, watchdog, report = self._smoother, self._watchdog, self.report
        motion = self._motion if watchdog.allowed else None
        q_from = smoother.q
        compliance = self._compliance
        if compliance.chosen:
            self._prepare_compliance(motion)
        if motion is not None:
            if motion is self._whole and compliance.held_back:
                smoother.stop()  # the set-point may still have the speed of an arm that was pushed
            else:
                motion.step(now)
            self._envelope.note(smoother)
            if self._whole is not None:
                self._report_whole(self._whole)
            usual = _FOLLOWING
        else:
            if self._followed:
                report.t_stop = now
            self._brake()
            usual = RobotStatus.HOLDING if self._is_at_rest() else RobotStatus.STOPPING
            if watchdog.trip:
                usual = RobotStatus.TRIPPED
        self._followed = motion is not None
        report.status = usual if status is None else status
        report.trip = watchdog.trip
        report.t_trip = watchdog.t_trip
        if compliance.active:
            compliance.drive()
        self._publish()
        if self._torque.active:
            return self._torque.setpoint()
        return Setpoint(smoother.q, smoother.dq, smoother.ddq, None, q_from)

    def _brake(self) -> None:
        """Advance the stop by one tick: along a path, by torques, or joint by joint."""
        by_torques = self._torque.active and not self._compliance.active
        if by_torques and self._torque.brake():
            self._leave_torques()
            by_torques = False
        if not by_torques and not (self._whole is not None and self._whole.brake()):
            self._smoother.stop()

    def _prepare_compliance(self, motion: ServoMotion | None) -> None:
        """Let the controller of the session take over when the arm is to move, and let go when the session closes."""
        compliance, torque = self._compliance, self._torque
        if motion is not None and not torque.active:
            compliance.begin()
        if not compliance.active:
            return
        if compliance.hold_back(motion is not None and motion.cartesian) and motion is not None:
            motion.reanchored()
        if self._course.ending and self._smoother.at_rest():
            self._course.braking += self._smoother.dt
            if torque.still:
                self._leave_torques()  # to positions where it was measured, so without a jerk
            elif self._course.braking > BRAKE_LIMIT:
                compliance.active = False  # torques brake it

    def _report_whole(self, motion: PlannedMotion) -> None:
        """Report how far the motion of the session is."""
        report = self.report
        report.arrived = motion.arrived and (not self._compliance.active or self._torque.still)
        course = self._course
        course.stuck = 0.0 if motion.progress != report.progress else course.stuck + self._smoother.dt
        motion.lost = motion.lost or (course.stuck > PATIENCE and not motion.arrived)
        report.progress = motion.progress
        report.held_back |= self._envelope.limited
        report.off_path = motion.lost

    def _is_at_rest(self) -> bool:
        """Return whether nothing moves, and positions or a controller (not bare torques) hold the arm."""
        return self._smoother.at_rest() and (not self._torque.active or self._compliance.active)

    def _leave_torques(self) -> None:
        """Hand the arm over from torques to positions."""
        self._torque.leave()
        self._compliance.end()
        self._anchoring.forget()

    def _close_if_finished(self) -> bool:
        """Close the session once it has come to rest; returns whether it is closed."""
        if self._torque.active and self._torque.blind:  # the device was left alone: it holds by itself
            self._leave_torques()
        at_rest = self._smoother.at_rest() and not self._torque.active
        course = self._course
        course.resting = course.resting + 1 if at_rest else 0
        if course.resting < (3 if self._extrapolates else 1):  # computed, given, and seen to be taken
            return False
        self._session = None
        self._anchoring.forget()
        return True

    def _idle(self, status: RobotStatus) -> None:
        self.report.status = status
        self.report.trip = Trip.NONE
        self.report.limited = Limited.NONE

    def _forget_goals(self) -> None:
        self._motion = None
        self._watchdog.expect(None)

    def _publish(self) -> None:
        report, smoother = self.report, self._smoother
        report.q_set, report.dq_set, report.ddq_set = smoother.q, smoother.dq, smoother.ddq
        report.controller, report.tau_set = _POSITION, ()
        if self._torque.active:
            report.controller, report.tau_set = self._compliance.mode, self._torque.tau
            if not self._compliance.active:
                report.q_set, report.dq_set, report.ddq_set = self._torque.q, self._torque.dq, [0.0] * smoother.n
        report.limited = self._envelope.limited
