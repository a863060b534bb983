"""One arm in a group's cycle: its driver, its gripper, its servo and its mailboxes."""

from __future__ import annotations

import math
import traceback
from typing import Any

from .. import registry
from ..errors import ConnectionLost, ControlTaken
from ..gripper import GripperDriver
from ..histogram import Histogram
from ..inbox import Inbox, Session
from ..kinematics import Kinematics
from ..robot import Reading, RobotDriver
from ..servo.audit import SetpointAudit
from ..servo.servo import Servo
from ..specs import RobotSpec
from ..types import Fault, RobotStatus
from .records import AppRecord, RobotMail, ServoRecord

__all__ = ["ArmUnit"]


class ArmUnit:
    """An arm with everything that belongs to it: driver, gripper, servo, mailboxes."""

    def __init__(self, spec: RobotSpec, dt: float, mail: RobotMail, world: object | None) -> None:
        self.spec = spec
        self.dt = dt
        self.mail = mail
        self.driver: RobotDriver = registry.load(spec.driver, "robot")(spec, world)
        self.gripper: GripperDriver | None = None
        if spec.gripper is not None:
            self.gripper = registry.load(spec.gripper.driver, "gripper")(spec.gripper, world)
        self.kinematics = Kinematics(spec.kinematics)
        self.servo = Servo(spec, dt, self.kinematics)
        self.reset_statistics()
        self.reading: Reading | None = None
        self.error: ConnectionLost | None = None
        """Why the device counts as lost."""
        self._write_failed = False
        self._gripper_reason = ""
        self._stops: int | None = None
        self._sound: Reading | None = None
        self._setpoint: Any = None
        self._gripper_seq = 0
        self._latest_target = 0
        self._t_written = 0.0
        self._session = 0

    def reset_statistics(self) -> None:
        """Measure from now on: peaks of the set-points, latencies."""
        self.audit = SetpointAudit(self.spec.limits, self.dt)
        self.latency = Histogram(1e-4, 5000)

    def open(self, now: float) -> None:
        """Connect to the arm and its gripper, and read them once. Nothing moves."""
        self.driver.open()
        if self.gripper is not None:
            self.gripper.open()
        self.reading = self.driver.read(now)
        self._anchor()

    def _anchor(self) -> None:
        """The set-point is where the device holds."""
        assert self.reading is not None
        commanded = self.reading.q_commanded
        self.servo.anchor(commanded if commanded is not None else self.reading.q)
        self.audit.reset()

    # Per cycle.

    def read(self, now: float) -> None:
        """Ask the device. One that took no set-point stays lost for a whole cycle, though it answers again."""
        try:
            self.reading = self.driver.read(now)
            if not self._write_failed:
                self.error = None
        except Exception as error:
            self._lose(error)

    def _lose(self, error: Exception) -> None:
        """A driver that fails, in whatever way, is a device that does not answer."""
        if isinstance(error, ConnectionLost):
            self.error = error
            return
        if self.error is None:
            traceback.print_exception(error)  # into the process's log: this is a mistake in a driver
        self.error = ConnectionLost(f"{self.spec.name}: {type(error).__name__}: {error}")

    def tick(self, now: float, app: AppRecord) -> None:
        """Compute the next set-point."""
        self._look_for_end()
        if self.error is not None or self.reading is None:
            self._setpoint = self.servo.lost(now)
            return
        self._setpoint = self.servo.tick(now, self.reading, self._inbox(app))

    def _inbox(self, app: AppRecord) -> Inbox:
        mail = self.mail
        return Inbox(mail.get_command(), mail.get_deadman(), app.stops, mail.get_marks().rearms, app.t)

    def write(self, now: float) -> None:
        """Hand it to the device."""
        setpoint = self._setpoint
        failed, self._write_failed = self._write_failed, False
        if setpoint is None or (self.error is not None and not failed):
            return
        try:
            self.driver.write(setpoint)
        except Exception as error:
            self._write_failed = True
            self._lose(error)
            return
        self._t_written = now
        self.audit.add(setpoint.q)

    def finish_session(self) -> bool:
        """After the last set-point of a session: hand the arm back to its own hold. True while none is open."""
        if self._setpoint is None and self._session and self.servo.report.status in (
            RobotStatus.IDLE, RobotStatus.LOST, RobotStatus.FAULT,
        ) and not self.servo.active:  # fmt: skip
            self._session = 0
            try:
                if self.error is None:
                    self.driver.halt()
            except Exception as error:
                self._lose(error)
        return self._session == 0

    def _look_for_end(self) -> None:
        """Was the session ended? The app says so in memory: that needs no answer and waits for nothing."""
        if self._session and self.mail.get_marks().ended == self._session:
            self.servo.end()

    def serve_gripper(self, app: AppRecord) -> None:
        """Start the newest motion that the app asked of the gripper; keep its fingers where a stop finds them.

        A command that a gripper does not take is forgotten: it must not move when it comes back.
        """
        gripper = self.gripper
        if gripper is None:
            return
        stopped = self._stops is not None and app.stops != self._stops
        self._stops = app.stops
        command = self.mail.get_gripper_command()
        fresh = command is not None and command.seq > self._gripper_seq
        if not (stopped or fresh):
            return
        try:
            if stopped:
                gripper.stop()
            elif command is not None:
                gripper.move(command.width, command.speed, command.force)
        except Exception as error:
            self._note_gripper(error)
        if command is not None:
            self._gripper_seq = command.seq

    def _note_gripper(self, error: Exception) -> None:
        """The arm goes on without its gripper, whose state grows old. Each new reason is written down once."""
        reason = f"{type(error).__name__}: {error}"
        if reason != self._gripper_reason:
            self._gripper_reason = reason
            traceback.print_exception(error)

    def note_latency(self, clock_now: float) -> None:
        """Time from a pad's event to the set-point that follows it, once per command."""
        target = self.servo.report.target_seq
        if target == self._latest_target:
            return
        self._latest_target = target
        command = self.mail.get_command()
        if command is not None and command.seq == target and command.t_event > 0.0:
            self.latency.add(clock_now - command.t_event)

    def publish(self, now: float) -> None:
        """Tell the app: what the servo does, with the newest reading that makes sense."""
        self._publish_gripper(now)
        reading, report = self.reading, self.servo.report
        if reading is not None and self._makes_sense(reading):
            self._sound = reading
        reading = self._sound
        if reading is None:
            return
        if self.error is not None:
            reading = reading._replace(fault=Fault("lost", str(self.error), "see that it is on and connected"))
        tcp, jacobian = self.kinematics.fk_and_jacobian(reading.q)
        servo = ServoRecord(
            RobotStatus.LOST if self.error is not None else report.status,
            report.trip,
            report.limited,
            report.target_seq,
            self._session,
            report.arrived,
            report.refused,
            self._t_written,
            report.t_stop,
            report.q_set,
            report.dq_set,
        )
        self.mail.put_state(reading, servo, tcp, self.kinematics.fk(report.q_set), jacobian.dot(reading.dq).tolist())

    def _makes_sense(self, reading: Reading) -> bool:
        n = len(self.spec.joints)
        return len(reading.q) == len(reading.dq) == n and math.isfinite(math.hypot(*reading.q, *reading.dq))

    def _publish_gripper(self, now: float) -> None:
        if self.gripper is None:
            return
        try:
            self.mail.put_gripper(self.gripper.read(now))
        except Exception as error:
            self._note_gripper(error)

    # Requests.

    def begin(self, session: Session, app: AppRecord) -> None:
        """Open a control session. Raises ControlTaken while another one is open, ConnectionLost without an arm."""
        if self.mail.get_marks().ended == session.id:
            return  # the app gave up while this request was on its way
        if self._session:
            raise ControlTaken(f"{self.spec.name} is under the control of session {self._session}")
        if self.error is not None:
            raise self.error
        self._anchor()
        self.servo.begin(session, self._inbox(app))
        self._session = session.id

    def recover(self) -> None:
        """Clear a fault of the device."""
        self.driver.recover()

    def moved(self) -> None:
        """The arm was put elsewhere (a reset of the simulated world)."""
        self.reading = self.driver.read(self.reading.t if self.reading else 0.0)
        self._anchor()

    def close(self) -> None:
        """Let go of the devices. Every close is tried; the first error is raised at the end."""
        errors = []
        for device in (self.driver, self.gripper):
            try:
                if device is not None:
                    device.close()
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]
