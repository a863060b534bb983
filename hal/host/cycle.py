"""One cycle of a group of devices: advance, read all, tick each servo, write all, publish.

The same code runs in a process of its own in real time (:mod:`hal.host.main`) and in the caller's process in
lock-step (:mod:`hal.host.hosts`).
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from .. import registry
from ..commands import Inbox, Session, SessionRecord
from ..driver import Reading, RobotDriver, Setpoint
from ..errors import ConnectionLost, ControlTaken, DeviceNotFound, Fault, NotSupported, RobotFault
from ..geometry import Pose
from ..histogram import Histogram
from ..kinematics.arm import Kinematics
from ..servo.audit import SetpointAudit
from ..servo.controllers import controller_of
from ..servo.servo import Servo
from ..servo.watchdog import is_alive
from ..specs import GroupSpec, RobotSpec, WorldSpec
from ..types import RobotStatus
from .gripper_unit import GripperUnit
from .guards import guard_arms
from .mirrors import make_mirrors
from .records import AppRecord, GroupMemory, RobotMail, ServoRecord

TCP_APART, TCP_TURNED = 0.002, 0.02
"""Largest distance of a device's own tcp from the model's, m and rad."""
_SHARE = 0.3
"""Share of a cycle for which a long path is checked before the next cycle."""
ENGAGE_LIMIT = 1.0
"""Longest time for switching an arm's drives on, s."""
FRESH = 0.02
"""Greatest age of the state at which a drive is switched on, s."""


class ArmUnit:
    """One arm in the cycle: driver, servo and mailboxes."""

    def __init__(self, spec: RobotSpec, dt: float, mail: RobotMail, world: object | None) -> None:
        self.spec = spec
        self.dt = dt
        self.mail = mail
        self.driver: RobotDriver = registry.load(spec.driver, "robot")(spec, world)
        self.kinematics = Kinematics(spec.kinematics)
        mass_matrix = self.driver.mass_matrix if "torque" in self.driver.modes else None
        self.servo = Servo(spec, dt, self.kinematics, mass_matrix, self.driver.extrapolates, self.driver.simulated)
        self.reset_statistics()
        self.reading: Reading | None = None
        self.error: ConnectionLost | None = None
        """Reason why the device counts as lost; None while it answers."""
        self._write_failed = False
        self._engaged = False
        """Whether the drives were on in the last cycle."""
        self._sound: Reading | None = None
        self._setpoint: Setpoint | None = None
        self._answered = False
        """Whether the device has got its set-point in this cycle."""
        self._latest_target = 0
        self._reanchored = 0
        self._t_written = 0.0
        self._t_read = 0.0
        """Time of the last attempt to read the device, s."""
        self._session = 0

    def reset_statistics(self) -> None:
        """Start new statistics: peaks of the set-points, latencies."""
        self.audit = SetpointAudit(self.spec.limits, self.dt)
        self.latency = Histogram(1e-4, 5000)
        self.lost_cycles = 0
        """Number of the device's samples that were missed."""
        self.reanchored = 0
        """Number of set-points that the device did not take."""
        self.servo.reset_statistics()
        self.driver.reset_statistics()

    def open(self, now: float) -> None:
        """Connect to the arm and read it once. Nothing moves."""
        self.driver.open()
        if self.driver.paces_itself:
            self.driver.wait()
        self.reading = self.driver.read(now)
        self._compare_tcp()
        self._anchor()

    def _compare_tcp(self) -> None:
        """Raise ConnectionLost if the device's own tcp differs from the model's: Cartesian motions would be wrong."""
        theirs = self.driver.own_tcp()
        if theirs is None or self.reading is None:
            return
        device = Pose.from_matrix(np.array(theirs, float).reshape(4, 4).T)
        distance, angle = self.kinematics.pose(self.reading.q).distance(device)
        if distance > TCP_APART or angle > TCP_TURNED:
            raise ConnectionLost(
                f"{self.spec.name}: the tool centre points of the arm and of model {self.spec.model!r} differ by "
                f"{1e3 * distance:.1f} mm and {angle:.3f} rad; fix the arm's end effector or the model's tcp",
                code="tcp_mismatch",
            )

    def _anchor(self) -> None:
        """Set the set-point to where the device holds."""
        assert self.reading is not None
        commanded = self.reading.q_commanded
        self.servo.anchor(commanded if commanded is not None else self.reading.q)
        self.audit.reset()

    # Per cycle.

    def read(self, now: float) -> None:
        """Read the device. One whose write failed counts as lost for a whole cycle, although it answers again."""
        before = self.reading
        self._t_read = now
        try:
            self.reading = reading = self.driver.read(now)
            if self.error is not None and not self._write_failed:
                self._compare_tcp()  # it may have come back with another tool
                self.error = None
        except Exception as error:
            self._lose(error)
            return
        if self.driver.paces_itself and before is not None and reading.seq > before.seq + 1:
            self.lost_cycles += reading.seq - before.seq - 1

    def _lose(self, error: Exception) -> None:
        """Count the device as lost, whatever error its driver raised."""
        self.audit.reset()  # what is not written is a gap in the stream
        if isinstance(error, ConnectionLost):
            self.error = error
            return
        if isinstance(error, RobotFault):  # a drive that does not switch on
            self.error = ConnectionLost(str(error), code=error.code)
            return
        if self.error is None:
            traceback.print_exception(error)  # into the process's log: a bug in the driver
        self.error = ConnectionLost(f"{self.spec.name}: {type(error).__name__}: {error}")

    def tick(self, now: float, app: AppRecord, late: bool = False) -> None:
        """Compute the next set-point; first write the one that was computed ahead."""
        said = self.mail.get_session()
        if said.session != self._session:
            self.servo.close_session()
        if self.error is not None or self.reading is None or self._is_switched_off(self.reading):
            self._setpoint, self._answered = self.servo.device_lost(now, self._inbox(app, said)), False
            return
        ahead = self.servo.answer(now, self.reading)
        self._answered = ahead is not None
        if ahead is not None:  # the device waits for it
            self._note_reanchored()
            self._pass_on(ahead, now)
        self._setpoint = self.servo.tick(now, self.reading, self._inbox(app, said), late)
        self._note_reanchored()

    def _note_reanchored(self) -> None:
        if self.servo.report.reanchored != self._reanchored:
            self._reanchored = self.servo.report.reanchored
            self.reanchored += 1
            self.audit.reset()  # the device's own set-points lie in between

    def _is_switched_off(self, reading: Reading) -> bool:
        """Return whether the drives went off without a fault, as by an emergency stop: that trips.

        So they come on again only after a new press of the dead-man, or a rearm.
        """
        before, self._engaged = self._engaged, self.driver.engaged
        return before and not self._engaged and reading.fault is None

    def _inbox(self, app: AppRecord, said: SessionRecord) -> Inbox:
        mail = self.mail
        return Inbox(mail.get_command(), mail.get_deadman(), app.stops, said.rearms, app.t, said.acknowledged)

    def write(self, now: float) -> None:
        """Write the set-point to the device, or switch its drives on where it has to move."""
        failed, self._write_failed = self._write_failed, False
        if self._setpoint is not None and not self._answered and (self.error is None or failed):
            self._pass_on(self._setpoint, now)

    def _pass_on(self, setpoint: Setpoint, now: float) -> None:
        driver = self.driver
        try:
            if not driver.engaged:  # they went off during the session
                if self.servo.report.status is RobotStatus.FOLLOWING and self._is_fresh():
                    driver.engage()
                self.servo.note_withheld()
                return
            self.servo.note_written(driver.write(setpoint) is not False)
        except Exception as error:
            self._write_failed = True
            self._lose(error)
            return
        self._t_written = now
        self.audit.add_setpoint(setpoint)

    def finish_session(self) -> bool:
        """After the last set-point of a session, halt the device. Returns whether no session is open."""
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

    def find_session(self, now: float) -> int:
        """Return the session that may move the arm and its gripper at present; 0 for none."""
        return self._session if self.servo.watchdog.allowed else 0

    def note_latency(self, clock_now: float) -> None:
        """Measure the time from a pad's event to the set-point that follows it, once per command."""
        target = self.servo.report.target_seq
        if target == self._latest_target:
            return
        self._latest_target = target
        command = self.mail.get_command()
        if command is not None and command.seq == target and command.t_event > 0.0:
            ahead = self.dt if self.driver.extrapolates else 0.0  # it is written in the next cycle
            self.latency.add(clock_now + ahead - command.t_event)

    def publish(self, now: float) -> None:
        """Publish the newest valid reading, with the state of the servo."""
        reading, report, watchdog = self.reading, self.servo.report, self.servo.watchdog
        if self.servo.possible:
            self._sound = reading
        reading = self._sound
        if reading is None:
            return
        if self.error is not None:
            lost = self.error.fault or Fault("lost", str(self.error), "check that it is on and connected")
            reading = reading._replace(fault=lost)
        elif reading.fault is None and self.servo.fault is not None:
            reading = reading._replace(fault=self.servo.fault)
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
            report.controller,
            report.tau_set,
            report.held_back,
            report.progress,
            report.off_path,
            report.overrun,
            watchdog.stops,
            watchdog.rearms,
            watchdog.allowed,
        )
        self.mail.put_state(reading, servo, tcp, self.kinematics.fk(report.q_set), jacobian.dot(reading.dq).tolist())

    # Requests.

    def open_session(self, session: Session, app: AppRecord, turn: Callable[[], None], paced: bool = False) -> None:
        """Open a control session. The arm's drives are switched on first.

        Args:
            session: The terms of the session.
            app: The app's newest record.
            turn: Runs one whole cycle of the group, so that its other devices continue meanwhile.
            paced: Whether ``turn`` waits for its time: then a long path is checked between the cycles.

        Raises:
            ControlTaken: While another one is open.
            ConnectionLost: While the arm does not answer.
            RobotFault: Its drives do not switch on.
        """
        if self._session:
            raise ControlTaken(f"{self.spec.name} is under the control of session {self._session}")
        if self.mail.get_session().session == session.id:
            self._engage(turn)
        said = self.mail.get_session()
        if said.session != session.id:
            return  # the app gave up while this request was on its way
        self._anchor()
        began = time.monotonic()

        def pause() -> None:
            nonlocal began
            if paced and time.monotonic() - began > _SHARE * self.dt:
                turn()
                self._anchor()
                began = time.monotonic()

        self.servo.open_session(session, self._inbox(app, said), pause)
        self._session = session.id

    def _engage(self, turn: Callable[[], None]) -> None:
        """Switch the drives on, and read the arm again; nothing if they are on.

        An arm without power can be moved by hand, and would be pulled back to an old position: each step needs a state
        that was measured after the request, and just before the step. This process may have been paused in between.
        """
        began = math.inf
        for _ in range(1 + max(1, round(ENGAGE_LIMIT / self.dt))):
            if self.error is not None:
                raise self.error
            if self.driver.engaged:
                return
            if self.reading is not None and self.reading.t >= began and self._is_fresh():
                self.driver.engage()
            turn()
            began = min(began, self._t_read)
        if not self.driver.engaged:
            raise RobotFault(
                f"{self.spec.name}: its drives did not switch on within {ENGAGE_LIMIT:g} s",
                "check its power supply and its emergency stop",
                code="not_engaged",
            )

    def _is_fresh(self) -> bool:
        """Return whether the newest state is new enough to switch a drive on where it shows the arm."""
        return self.reading is not None and self._t_read - self.reading.t <= max(FRESH, 2.0 * self.dt)

    def recover(self) -> None:
        """Clear a fault of the device, or of how it follows its set-points."""
        self.driver.recover()
        self.servo.recover()

    def anchor_again(self) -> None:
        """Read and anchor again, because a reset of the simulated world moved the arm; a lost one, when it is back."""
        try:
            self.reading = self.driver.read(self.reading.t if self.reading else 0.0)
        except Exception as error:
            self._lose(error)
            self.servo.note_withheld()  # it is where it reports to be when it answers again
            return
        self._anchor()

    def lower(self) -> bool:
        """Lower the arm a little further; return whether it is down."""
        try:
            return self.driver.lower()
        except Exception as error:
            traceback.print_exception(error)  # a bug in the driver, whose close is still called
            return True

    def close(self) -> None:
        """Close the device."""
        self.driver.close()


def _find_allowed(memories: Sequence[GroupMemory], name: str, now: float) -> int:
    """Return the session that may move an arm of another group at ``now`` (s); 0 for none, or if nothing shows it."""
    for memory in memories:
        if name in memory.robots and is_alive(now, memory.get_host().t):
            servo = memory.robots[name].peek()
            return servo.session if servo is not None and servo.allowed else 0
    return 0


LOWER_LIMIT = 7.0
"""Longest time for lowering arms without brakes before they are closed anyway, s."""


def _open_world(group: GroupSpec, spec: WorldSpec) -> Any:
    """Return the group's world: that of the emulators of its arms if they share one, else one of its own."""
    driver = registry.driver(spec.driver)
    find = registry.function(spec.driver, driver.shared_world) if group.clock == "real_time" else None
    shared = find(spec) if find is not None else None
    return shared if shared is not None else registry.load(spec.driver, "world")(spec)


class Cycle:
    """A group: its world, if any, its arms and its grippers."""

    def __init__(self, spec: GroupSpec, memory: GroupMemory, others: Iterable[GroupMemory] = ()) -> None:
        """Load the drivers; nothing is opened."""
        self.spec = spec
        self.memory = memory
        others = list(others)
        self._mirrors = make_mirrors(spec, others)
        self.dt = 1.0 / spec.rate_hz
        self.ticks = 0
        self.t = 0.0
        """Time of the newest cycle on the group's clock, s."""
        self._counted_from = 0
        self.turn: Callable[[], None] = lambda: self.step(self.t + self.dt, self.memory.get_app())
        """Runs one whole cycle, in the middle of a request; the host sets its own, which waits for the cycle's time."""
        self.world: Any = None
        if spec.world is not None:
            self.world = _open_world(spec, spec.world)
        self.arms = {r.name: ArmUnit(r, self.dt, memory.robots[r.name], self.world) for r in spec.robots}
        self._arm_units = tuple(self.arms.values())
        self.notes = guard_arms(spec, self.arms, others)
        self.grippers: dict[str, GripperUnit] = {}
        for gripper in spec.grippers:
            driver = registry.load(gripper.driver, "gripper")(gripper, self.world)
            arm = self.arms.get(gripper.arm)
            allowed = arm.find_session if arm is not None else partial(_find_allowed, others, gripper.arm)
            self.grippers[gripper.name] = GripperUnit(driver, memory.grippers[gripper.name], allowed)
        self._gripper_units = tuple(self.grippers.values())

    @property
    def paces_itself(self) -> bool:
        """Whether a device sets the pace."""
        return any(unit.driver.paces_itself for unit in self._arm_units)

    @property
    def lost_cycles(self) -> int:
        """Number of missed cycles of the device that sets the pace."""
        return sum(unit.lost_cycles for unit in self._arm_units)

    @property
    def attended(self) -> bool:
        """Whether the group has a real arm."""
        return any(unit.spec.attended for unit in self._arm_units)

    def find_looping_driver(self) -> RobotDriver | None:
        """Return a driver whose library needs to own the loop now; None if there is none."""
        return next((unit.driver for unit in self._arm_units if unit.driver.wants_loop), None)

    def open(self, now: float) -> None:
        """Connect to every device and publish a first state. Nothing moves."""
        self.t = now
        for unit in self._arm_units:
            unit.open(now)
        for gripper in self._gripper_units:
            gripper.open()
        self.publish(now)

    def wait(self) -> None:
        """Block until the device that sets the pace has something new."""
        for unit in self._arm_units:
            if unit.driver.paces_itself:
                unit.driver.wait()

    def step(self, now: float, app: AppRecord, late: bool = False) -> None:
        """Run one cycle."""
        self.ticks += 1
        self.t = now
        if self.world is not None:
            for mirror in self._mirrors:
                mirror.follow(self.world)
            self.world.step()
        for unit in self._arm_units:
            unit.read(now)
            unit.tick(now, app, late)
        for unit in self._arm_units:
            unit.write(now)
            unit.finish_session()
        for gripper in self._gripper_units:
            gripper.serve(now, app)

    def publish(self, now: float) -> None:
        """Publish what every device reports."""
        for unit in self._arm_units:
            unit.publish(now)
        for gripper in self._gripper_units:
            gripper.publish(now)

    def stop_sessions(self) -> bool:
        """Bring everything to rest; call it between steps until it returns True. Grippers keep what they hold."""
        for gripper in self._gripper_units:
            gripper.end_motion()
        resting = True
        for unit in self._arm_units:
            if not unit.finish_session():
                unit.servo.close_session()
                resting = False
        return resting

    def request(self, method: str, params: dict[str, Any]) -> Any:
        """Serve a request between two steps: one of the ``_do_`` methods, or ``world.`` and a world's request."""
        if method.startswith("world."):
            return self._world_request(method.removeprefix("world."), params)
        handler = getattr(self, f"_do_{method}", None)
        if handler is None:
            raise NotSupported(f"no request {method!r}", code="no_such_request")
        return handler(**params)

    def _arm(self, robot: str) -> ArmUnit:
        if robot not in self.arms:
            raise DeviceNotFound(f"no robot {robot!r}; robots: {', '.join(self.arms)}")
        return self.arms[robot]

    def _do_begin(self, robot: str, session: list[Any]) -> None:
        paced = self.spec.clock != "lock_step"
        self._arm(robot).open_session(Session.unpack(session), self.memory.get_app(), self.turn, paced)

    def _do_gains(self, robot: str, session: int, controller: dict[str, Any]) -> None:
        self._arm(robot).servo.set_gains(session, controller_of(controller))

    def _do_recover(self, robot: str) -> None:
        self._arm(robot).recover()

    def _do_inject(self, robot: str, faults: dict[str, Any]) -> None:
        self._arm(robot).driver.inject(**faults)

    def _do_inject_gripper(self, gripper: str, faults: dict[str, Any]) -> None:
        self.grippers[gripper].driver.inject(**faults)

    def _do_warnings(self) -> list[str]:
        """Return what the simulation had to change in the files that it loaded, and which collisions are not seen."""
        return [*getattr(self.world, "warnings", ()), *self.notes]

    def _do_statistics(self) -> dict[str, Any]:
        return {
            "ticks": self.ticks - self._counted_from,
            "robots": {
                name: {
                    "peak": unit.audit.peaks(),
                    "latency_s": unit.latency.summary(),
                    "reanchored": unit.reanchored,
                    **unit.servo.statistics(),
                    "driver": unit.driver.statistics(),
                }
                for name, unit in self.arms.items()
            },
            "grippers": {name: unit.driver.statistics() for name, unit in self.grippers.items()},
        }

    def _do_reset_statistics(self) -> None:
        self._counted_from = self.ticks
        for unit in self._arm_units:
            unit.reset_statistics()

    def _world_request(self, method: str, params: dict[str, Any]) -> Any:
        if self.world is None:
            raise NotSupported("this rig has no simulated world; rig.world exists in simulation only", code="no_world")
        result = self.world.request(method, params)
        if isinstance(result, dict) and result.get("t") is not None:
            result["t"] = self.t  # a world only counts its steps
        if method in ("reset", "restore"):
            name = params.get("name")
            for unit in self._arm_units:
                if name is None or name == unit.spec.name:
                    unit.anchor_again()
        return result

    def close(self) -> None:
        """Lower the arms that have no brakes, all at the same time, and close every device. Idempotent."""
        self._lower_arms()
        errors = []
        for close in (*(unit.close for unit in self._arm_units), *(gripper.close for gripper in self._gripper_units)):
            try:
                close()
            except Exception as error:
                errors.append(error)
        if self.world is not None:
            self.world.close()
        if errors:
            raise errors[0]

    def _lower_arms(self) -> None:
        """Lower all arms; the grippers keep what they hold meanwhile."""
        began = time.monotonic()
        left = self._arm_units
        while time.monotonic() - began < LOWER_LIMIT:
            left = tuple(unit for unit in left if not unit.lower())
            if not left:
                return
            for gripper in self._gripper_units:
                gripper.publish(self.t + time.monotonic() - began)
            time.sleep(self.dt)
