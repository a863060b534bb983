"""Driver of an AgileX PiPER arm.

The arm's own controller takes joint targets and reports 200 times a second. It holds its last target for ever, so
nothing is lost when a program stops to send, and nothing here ever switches its motors off: a raised arm would fall.

* ``engage`` switches the motors on, and takes over control with the measured position as first target.
* ``write`` sends the targets of all joints; ``halt`` and ``close`` send nothing.
* An arm that reports an error, or that leaves CAN control, counts as not engaged until ``recover`` and ``engage``.
"""

from __future__ import annotations

from math import dist, inf
from typing import Any, ClassVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import ConnectionLost, Fault
from hal.following import Following
from hal.lock import DeviceLock
from hal.specs import RobotSpec

from .bus import describe_losses
from .piper_link import FRESH_READS, SILENCE, PiperLink, arm_fault, control_fault, join_joints, refusal
from .piper_protocol import (
    ACKNOWLEDGEMENT,
    CAN_CONTROL,
    ENABLED,
    FEEDBACK_IDS,
    GRIPPER_IDS,
    JOINTS,
    MOVE_J,
    TORQUE_PER_AMPERE,
    EnableRequest,
    JointAngles,
    JointMotion,
    JointRequest,
    JointStatus,
    ModeRequest,
    PiperFeedback,
    PiperStatus,
    encode_joint_targets,
)
from .settings import PiperArmSettings

_PATIENCE = 2.0
"""Longest time to wait for another program to release the arm, s."""
_ASK_AGAIN = 0.02
"""s between two commands to switch the motors on, or to take over control."""
_SWITCHED_ON = 0.8
"""Time in which all motors must be on, s."""
_SLOW_SILENCE = 0.5
"""Silence after which a motor counts as lost whose slow report is missing, s: it comes every 25 ms."""
_CLEARING = 0.12
"""Longest time until an error is cleared, s."""
_OWN_IDS = (*(id for id in FEEDBACK_IDS if id not in GRIPPER_IDS), ACKNOWLEDGEMENT)
_FOLLOWING, _LAG = 0.05, 0.1
"""Largest distance of a joint from its target, rad, and by how much it may be larger for each rad/s of the target, s.
Beyond it the arm is blocked, does not get its targets, or is too slow."""
_AWAY = 0.02
"""An arm that is no longer driven, and this far from its last target, is told to stay where it is, rad."""
_OTHERS_CONTROL = frozenset({2, 5, 6, 7})
"""Control modes in which the arm is moved by a hand, a leader arm or a recorded trajectory (see PiperStatus)."""
_NO_COMMANDS = Fault("no_commands", "the bus takes no commands", "check the adapter and its cable")
_ALL_PAIRS = 0b111
_NO_JOINTS = (0.0,) * JOINTS


class PiperArm(RobotDriver):
    """A PiPER (settings: :class:`~.settings.PiperArmSettings`)."""

    modes: ClassVar[frozenset[str]] = frozenset({"position"})

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = PiperArmSettings.of(spec)
        self.engaged = False
        self._link = PiperLink(spec.name, self.settings, self._take, _OWN_IDS, spec.source)
        joints = [join_joints([k]) for k in range(JOINTS)]
        self._following = Following(joints, [_FOLLOWING] * JOINTS, _LAG)
        self._lock: DeviceLock | None = None
        self.longest_gap = 0.0
        """Longest time between two samples, s."""
        self.faults = 0
        """Number of errors that ended an engagement."""
        self._forget()

    def _forget(self) -> None:
        self.engaged = False
        self._now = -inf
        self._reads = 0
        self._status: PiperStatus | None = None
        self._t_status = -inf
        self._joints: list[JointStatus | None] = [None] * JOINTS
        self._t_joints = [-inf] * JOINTS
        self._flags = [0] * JOINTS
        self._q: tuple[float, ...] | None = None
        self._t_q = -inf
        """Time of the oldest of the three frames that ``_q`` is made of, s."""
        self._seq = 0
        self._dq = list(_NO_JOINTS)
        self._tau = list(_NO_JOINTS)
        self._t_dq = [-inf] * JOINTS
        self._moving: set[int] = set()
        """Joints whose speed has been reported."""
        self._pairs: list[tuple[float, float]] = [(0.0, 0.0)] * 3
        self._pairs_come = self._incomplete = 0
        """Which of the three frames of a sample have come, and samples that lacked one."""
        self._t_pairs = -inf
        self._commanded: tuple[float, ...] | None = None
        """The last target that it got, rad; also after a fault or a loss, since the arm still goes there."""
        self._commanded_dq: tuple[float, ...] = _NO_JOINTS
        self._holding = False
        """Whether that is a position that was measured after a fault or a loss."""
        self._fault: Fault | None = None
        """Error that ended the engagement; kept until recover(), even if the arm no longer reports it."""
        self._t_asked = self._t_engaging = self._t_last_try = -inf
        self._blocked_since: float | None = None
        """Time since which the bus has taken no set-point, s; None while it does."""
        self._confirmed = False

    # Connection

    def open(self) -> None:
        """Connect, and wait until the arm has reported its state. Nothing is sent.

        Raises:
            DeviceNotFound: No arm reports on this bus, or a part of its reports is missing.
            ControlTaken: Another program on this computer uses this arm.
        """
        if self._link.bus is not None:
            return
        self._forget()
        where = " ".join(self.settings.key)
        if self.settings.interface != "virtual":  # a bus of this process
            self._lock = DeviceLock(f"piper-{where}", f"the PiPER on {where}", _PATIENCE)
        try:
            self._link.open(self._missing)
        except BaseException:
            self._release()
            raise

    def close(self) -> None:
        """Give up the bus. The arm holds its last target: its motors stay on."""
        self.engaged = False
        self._link.close()
        self._release()

    def _release(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            lock.release()

    def _missing(self) -> str:
        """Return which reports have not come yet, in words; empty if the state is complete."""
        silent = join_joints(k for k in range(JOINTS) if self._joints[k] is None or k not in self._moving)
        parts = {"no arm status (0x2A1)": self._status is None, "no positions (0x2A5 to 0x2A7)": self._q is None}
        if all(parts.values()) and self._joints == [None] * JOINTS:
            return "no PiPER reports"
        texts = [text for text, absent in parts.items() if absent]
        return ", ".join([*texts, *([f"no report of the motor of {silent}"] if silent else [])])

    # Every cycle

    def read(self, now: float) -> Reading:
        self._now = now
        if self._reads < FRESH_READS:  # what came while it was opened
            self._reads += 1
            self._t_q = self._t_status = now
            self._t_dq, self._t_joints = [now] * JOINTS, [now] * JOINTS
        try:
            self._link.poll()
        except ConnectionLost:
            self._disengage()
            raise
        q = self._q
        if (
            q is None
            or min(self._t_q, self._t_status, *self._t_dq) < now - SILENCE
            or (min(self._t_joints) < now - _SLOW_SILENCE)
        ):
            self._disengage()
            raise self._link.lose(f"the arm has sent no {self._silent_part(now)}")
        self._link.lost = None
        fault = self._present_fault()
        self._hold_measured()
        commanded, commanded_dq = (self._commanded, self._commanded_dq) if self.engaged else (None, None)
        return Reading(
            self._t_q, self._t_q, self._seq, q, tuple(self._dq), tuple(self._tau), commanded, commanded_dq, fault=fault
        )

    def _silent_part(self, now: float) -> str:
        """Return what has not been reported, and for how long, in words."""
        usual, slow = f"for {1e3 * SILENCE:.0f} ms", f"for {1e3 * _SLOW_SILENCE:.0f} ms"
        if self._q is None or self._t_q < now - SILENCE:
            return f"positions {usual}"
        if self._t_status < now - SILENCE:
            return f"status {usual}"
        joints = join_joints(k for k, t in enumerate(self._t_dq) if t < now - SILENCE)
        if joints:
            return f"speed of {joints} {usual}"
        joints = join_joints(k for k, t in enumerate(self._t_joints) if t < now - _SLOW_SILENCE)
        return f"state of the motor of {joints} {slow}"

    def _take(self, record: PiperFeedback) -> None:
        """Keep what a frame reports. It is stamped with the time of the last read: it may be younger, never older."""
        if type(record) is JointMotion:
            k = record.joint
            self._dq[k] = record.dq
            self._tau[k] = record.current * TORQUE_PER_AMPERE[k]
            self._t_dq[k] = self._now
            self._moving.add(k)
        elif type(record) is JointAngles:
            k = record.first // 2
            if k == 0:  # the arm sends them in order: a set that lacks one is dropped
                self._incomplete += self._pairs_come > 0
                self._t_pairs, self._pairs_come = self._now, 0
            self._pairs[k] = record.q
            self._pairs_come |= 1 << k
            if self._pairs_come == _ALL_PAIRS:
                self._pairs_come = 0
                (a, b), (c, d), (e, f) = self._pairs
                self._q = (a, b, c, d, e, f)
                self.longest_gap = max(self.longest_gap, self._t_pairs - self._t_q if self._seq else 0.0)
                self._t_q = self._t_pairs
                self._seq += 1
        elif type(record) is PiperStatus:
            self._status = record
            self._t_status = self._now
        elif type(record) is JointStatus:
            self._joints[record.joint] = record
            self._flags[record.joint] = record.flags
            self._t_joints[record.joint] = self._now

    def _present_fault(self) -> Fault | None:
        """Return what keeps the arm from following; an engaged arm is then no longer engaged."""
        status = self._status
        assert status is not None
        fault = arm_fault(status, self._flags)
        if self.engaged:
            fault = fault or control_fault(status, self._flags) or self._check_following()
            if fault is not None:
                self._fault = fault
                self._disengage()
                self.faults += 1
        return self._fault or fault

    def _hold_measured(self) -> None:
        """Tell an arm that stopped before its target to stay: it neither pushes on nor leaps once it is free."""
        status, q, target = self._status, self._q, self._commanded
        assert status is not None
        if self.engaged or q is None or target is None:
            return
        if status.control != CAN_CONTROL or status.move != MOVE_J:
            return
        if dist(q, target) > _AWAY:
            self._commanded, self._holding = q, True
        if self._holding:
            self._link.send(encode_joint_targets(self._commanded or q))

    def _check_following(self) -> Fault | None:
        """Return a fault if a joint is too far from its target: the arm would race there as soon as it can."""
        if self._commanded is None or self._q is None:
            return None
        fault = self._following.check(self._now, self._q, self._commanded, self._commanded_dq)
        remedy = "check what the arm touches, and `speed_percent` in the rig"
        return None if fault is None else Fault(fault.code, fault.cause, remedy)

    def write(self, setpoint: Setpoint) -> bool:
        if not self.engaged:
            self._link.send(())
            return False
        q = tuple(setpoint.q)
        if not self._link.send(encode_joint_targets(q)):
            if self._blocked_since is None:
                self._blocked_since = self._now
            if self._now - self._blocked_since > SILENCE:
                self._disengage()
                raise self._link.lose(f"the bus has taken no command for {1e3 * SILENCE:.0f} ms")
            return False
        self._blocked_since = None
        self._commanded, self._commanded_dq = q, tuple(setpoint.dq)
        return True

    def halt(self) -> None:
        """Send nothing: the arm holds its last target."""

    # Switching on

    def engage(self) -> None:
        """Switch the motors on, then take over control with the measured position as target. One step per call."""
        if self.engaged:
            return
        self._link.send(())
        now, status, q = self._now, self._status, self._q
        assert status is not None
        assert q is not None
        fault = self._fault or arm_fault(status, self._flags)
        if fault is not None:
            raise refusal(self.spec.name, Fault(fault.code, fault.cause, f"{fault.remedy}; then robot.recover()"))
        if now - self._t_last_try > SILENCE:  # a new attempt
            self._t_engaging, self._t_asked, self._confirmed = now, -inf, False
        self._t_last_try = now
        if status.control in _OTHERS_CONTROL:  # it is moved by a hand or by another program: never take it from them
            raise refusal(self.spec.name, control_fault(status, [ENABLED] * JOINTS) or _NO_COMMANDS)
        fault = control_fault(status, self._flags)
        if fault is None and self._confirmed and self._t_status > self._t_asked:
            self.engaged, self._holding, self._blocked_since = True, False, None
            return
        if now - self._t_engaging > _SWITCHED_ON:
            raise refusal(self.spec.name, fault or _NO_COMMANDS)
        if now - self._t_asked < _ASK_AGAIN:
            return
        self._t_asked = now
        if not all(flags & ENABLED for flags in self._flags):
            self._link.send([EnableRequest().frame()])
            return
        mode = ModeRequest(speed_percent=self.settings.speed_percent, mounting=self.settings.mounting_code)
        targets = encode_joint_targets(q)
        # Also before the mode, so that the arm does not begin with the target of an earlier program.
        self._confirmed = self._link.send([*targets, mode.frame(), *targets])
        self._commanded, self._commanded_dq = q, _NO_JOINTS

    def _disengage(self) -> None:
        self.engaged, self._t_last_try = False, -inf

    def recover(self) -> None:
        """Clear the errors of the joints. It never sends the vendor's reset, which cuts the power of the motors.

        Raises RobotFault if an error stays; the remedy says how to end it.
        """
        self._link.send([JointRequest().frame()])

        def present() -> Fault | None:
            return None if self._status is None else arm_fault(self._status, self._flags)

        self._link.wait(lambda: present() is None, _CLEARING)
        fault = present()
        if fault is not None:
            raise refusal(self.spec.name, fault)
        self._fault = None

    # Statistics

    def reset_statistics(self) -> None:
        self.faults = 0
        self.longest_gap = 0.0
        if self._link.bus is not None:
            self._link.bus.reset_statistics()

    def statistics(self) -> dict[str, Any]:
        joints = [joint for joint in self._joints if joint is not None]
        lost, channel = self._incomplete, self.settings.channel
        return {
            "warnings": describe_losses(self.spec.name, channel, lost, 3 * (self._seq + lost)),
            "bus": self._link.statistics(),
            "samples": self._seq,
            "incomplete": lost,
            "longest_gap_s": self.longest_gap,
            "faults": self.faults,
            "motor_temperatures": [joint.motor_temperature for joint in joints],
            "driver_temperatures": [joint.driver_temperature for joint in joints],
            "voltages": [round(joint.voltage, 1) for joint in joints],
        }
