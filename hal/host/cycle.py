"""One cycle of a group of devices: advance, read all, tick each servo, write all, publish.

The same code runs in a process of its own in real time (:mod:`hal.host.main`) and in the caller's process in
lock-step (:mod:`hal.host.hosts`).
"""

from __future__ import annotations

import math
from typing import Any

from .. import registry
from ..errors import ConnectionLost, ControlTaken, DeviceNotFound, NotSupported
from ..gripper import GripperDriver
from ..histogram import Histogram
from ..inbox import Inbox, Session
from ..kinematics import Kinematics
from ..robot import Reading, RobotDriver
from ..servo.audit import SetpointAudit
from ..servo.servo import Servo
from ..specs import GroupSpec, RobotSpec
from ..types import RobotStatus
from .records import AppRecord, GroupMemory, RobotMail, ServoRecord

__all__ = ["ArmUnit", "Cycle"]


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
        self.gripper_error: ConnectionLost | None = None
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
        """Ask the device."""
        try:
            self.reading = self.driver.read(now)
            self.error = None
        except ConnectionLost as error:
            self.error = error

    def tick(self, now: float, app: AppRecord) -> None:
        """Compute the next set-point."""
        if self.error is not None or self.reading is None:
            self._setpoint = self.servo.lost(now)
            return
        self._setpoint = self.servo.tick(now, self.reading, self._inbox(app))

    def _inbox(self, app: AppRecord) -> Inbox:
        mail = self.mail
        return Inbox(mail.get_command(), mail.get_deadman(), app.stops, mail.get_rearms(), app.t)

    def write(self, now: float) -> None:
        """Hand it to the device."""
        setpoint = self._setpoint
        if setpoint is None or self.error is not None:
            return
        try:
            self.driver.write(setpoint)
        except ConnectionLost as error:
            self.error = error
            return
        self._t_written = now
        self.audit.add(setpoint.q)

    def finish_session(self) -> bool:
        """After the last set-point of a session: hand the arm back to its own hold. True while none is open."""
        if self._setpoint is None and self._session and self.servo.report.status in (
            RobotStatus.IDLE, RobotStatus.LOST, RobotStatus.FAULT,
        ) and not self.servo.active:  # fmt: skip
            self._session = 0
            if self.error is None:
                self.driver.halt()
        return self._session == 0

    def serve_gripper(self) -> None:
        """Start the newest motion that the app asked of the gripper."""
        if self.gripper is None:
            return
        command = self.mail.get_gripper_command()
        if command is not None and command.seq != self._gripper_seq:
            self._gripper_seq = command.seq
            try:
                self.gripper.move(command.width, command.speed, command.force)
            except ConnectionLost as error:
                self.gripper_error = error

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
        kinematics = self.kinematics
        twist = (kinematics.jacobian(reading.q) @ reading.dq).tolist()
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
        self.mail.put_state(reading, servo, kinematics.fk(reading.q), kinematics.fk(report.q_set), twist)

    def _makes_sense(self, reading: Reading) -> bool:
        n = len(self.spec.joints)
        return len(reading.q) == len(reading.dq) == n and all(map(math.isfinite, (*reading.q, *reading.dq)))

    def _publish_gripper(self, now: float) -> None:
        if self.gripper is None:
            return
        try:
            self.mail.put_gripper(self.gripper.read(now))
            self.gripper_error = None
        except ConnectionLost as error:
            self.gripper_error = error

    # Requests.

    def begin(self, session: Session, app: AppRecord) -> None:
        """Open a control session. Raises ControlTaken while another one is open, ConnectionLost without an arm."""
        if self._session:
            raise ControlTaken(f"{self.spec.name} is under the control of session {self._session}")
        if self.error is not None:
            raise self.error
        self._anchor()
        self.servo.begin(session, self._inbox(app))
        self._session = session.id

    def end(self, session: int) -> None:
        """Close a session: the arm brakes, then holds by its own means."""
        if self._session == session:
            self.servo.end()

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


class Cycle:
    """A group: its world, if it has one, and its arms."""

    def __init__(self, spec: GroupSpec, memory: GroupMemory) -> None:
        self.spec = spec
        self.memory = memory
        self.dt = 1.0 / spec.rate_hz
        self.ticks = 0
        self._counted_from = 0
        self.world: Any = None
        if spec.world is not None:
            self.world = registry.load(spec.world.driver, "world")(spec.world)
        self.arms = {r.name: ArmUnit(r, self.dt, memory.robots[r.name], self.world) for r in spec.robots}
        self._units = tuple(self.arms.values())

    @property
    def paces_itself(self) -> bool:
        """Does a device's blocking read set the pace?"""
        return any(unit.driver.paces_itself for unit in self._units)

    def open(self, now: float) -> None:
        """Connect to every device and publish a first state. Nothing moves."""
        for unit in self._units:
            unit.open(now)
            unit.publish(now)

    def step(self, now: float, app: AppRecord) -> None:
        """One cycle. ``now`` is the time on the group's clock."""
        self.ticks += 1
        if self.world is not None:
            self.world.step()
        for unit in self._units:
            unit.read(now)
            unit.tick(now, app)
        for unit in self._units:
            unit.write(now)
            unit.serve_gripper()
            unit.finish_session()

    def publish(self, now: float) -> None:
        """Tell the app what every device reports."""
        for unit in self._units:
            unit.publish(now)

    def stop_sessions(self) -> bool:
        """Bring every arm to rest; True when all of them are. Call it between steps until it is."""
        resting = True
        for unit in self._units:
            if not unit.finish_session():
                unit.servo.end()
                resting = False
        return resting

    def request(self, method: str, params: dict[str, Any]) -> Any:
        """What the app asks for between two steps. Names: see the ``_do_`` methods and the world's requests."""
        if method.startswith("world."):
            return self._world_request(method.removeprefix("world."), params)
        handler = getattr(self, f"_do_{method}", None)
        if handler is None:
            raise NotSupported(f"no request {method!r}")
        return handler(**params)

    def _arm(self, robot: str) -> ArmUnit:
        if robot not in self.arms:
            raise DeviceNotFound(f"no robot {robot!r}; robots: {', '.join(self.arms)}")
        return self.arms[robot]

    def _do_begin(self, robot: str, session: list[Any]) -> None:
        fields = Session(*session)
        goal = tuple(fields.move_to) if fields.move_to is not None else None
        self._arm(robot).begin(fields._replace(move_to=goal), self.memory.get_app())

    def _do_end(self, robot: str, session: int) -> None:
        self._arm(robot).end(session)

    def _do_recover(self, robot: str) -> None:
        self._arm(robot).recover()

    def _do_inject(self, robot: str, device: str, knobs: dict[str, Any]) -> None:
        unit = self._arm(robot)
        target: Any = unit.gripper if device == "gripper" else unit.driver
        if target is None:
            raise DeviceNotFound(f"{robot} has no gripper")
        target.inject(**knobs)

    def _do_gripper_stop(self, robot: str) -> None:
        gripper = self._arm(robot).gripper
        if gripper is None:
            raise DeviceNotFound(f"{robot} has no gripper")
        gripper.stop()

    def _do_statistics(self) -> dict[str, Any]:
        return {
            "ticks": self.ticks - self._counted_from,
            "robots": {
                name: {"peak": unit.audit.peaks(), "latency_s": unit.latency.summary()}
                for name, unit in self.arms.items()
            },
        }

    def _do_reset_statistics(self) -> None:
        self._counted_from = self.ticks
        for unit in self._units:
            unit.reset_statistics()

    def _world_request(self, method: str, params: dict[str, Any]) -> Any:
        if self.world is None:
            raise NotSupported("this rig has no simulated world; rig.world exists in simulation only")
        result = self.world.request(method, params)
        if method == "reset":
            name = params.get("name")
            for unit in self._units:
                if name is None or name == unit.spec.name:
                    unit.moved()
        return result

    def close(self) -> None:
        """Let go of every device. Idempotent."""
        errors = []
        for unit in self._units:
            try:
                unit.close()
            except Exception as error:
                errors.append(error)
        if self.world is not None:
            self.world.close()
        if errors:
            raise errors[0]
