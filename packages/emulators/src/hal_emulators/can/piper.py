"""An emulated PiPER: its controller on board, which takes joint targets and reports without being asked.

The controller moves towards each target at its speed setting, with an acceleration limit, and holds the last one for
ever. It knows its own weight. How a real one tracks is not published; the figures here are chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from hal.drivers.can.piper_protocol import (
    ALL_JOINTS,
    ARM_STATUS,
    CAN_CONTROL,
    ENABLED,
    HOMED,
    JOINTS,
    MOVE_J,
    STANDBY,
    TORQUE_PER_AMPERE,
    EnableRequest,
    FirmwareQuery,
    GripperRequest,
    GripperStatus,
    GripperStroke,
    JointLimits,
    JointMotion,
    JointRequest,
    JointStatus,
    JointTargets,
    LimitQuery,
    ModeRequest,
    ParameterQuery,
    PiperStatus,
)
from hal.drivers.can.settings import PiperArmSettings, PiperGripperSettings
from hal.specs import RobotSpec
from hal_emulators.shared_world import ArmInWorld

from .piper_frames import (
    Acknowledgement,
    EmergencyRequest,
    decode_command,
    encode_joint_angles,
    encode_pose,
    encode_report,
    firmware_pieces,
)
from .plant import OFF, ArmPlant, Drive, JointMechanics

Send = Callable[[int, bytes, int], None]
"""Sends a frame: id, data, and the number of the motor that it comes from (0 for the controller)."""

_SPEED = 3.0
"""Joint speed at a setting of 100 %, rad/s (piper_sdk's default of the joints' limits)."""
_ACCELERATION = 20.0
"""Of the controller's own set-point, rad/s2; chosen."""
_LAG = 0.015
"""Time constant with which the set-point follows a target, s; chosen."""
_STIFFNESS, _DAMPING = 60_000.0, 600.0
"""Of the position control, Nm/rad and Nm s/rad; so high that friction costs less than the 0.001 degrees of a report."""
_MECHANICS = (JointMechanics(0.03, 0.3, 0.15, 36.0),) * 3 + (JointMechanics(0.002, 0.06, 0.02, 12.0),) * 3
_REPORT, _SLOW_REPORT = 0.005, 0.025
"""Periods of the reports, s: 200 Hz, and 40 Hz for voltages and temperatures."""
_FINGER_SPEED = 0.1
"""Of the width, m/s."""
_BEYOND_LIMIT, _STOPPED = 0x4, 0x1
"""See ARM_STATUS."""


class EmulatedPiperArm:
    """An emulated PiPER with its gripper; ``status`` is a key of ``ARM_STATUS``."""

    def __init__(self, spec: RobotSpec) -> None:
        """Build it from the arm's record in a rig."""
        self.name = spec.name
        self.bus = PiperArmSettings.of(spec).shared
        self.plant = ArmPlant(spec.kinematics, _MECHANICS, spec.initial, spec.base_orientation)
        if spec.payload is not None:
            self.plant.load(payload=(spec.payload.mass, spec.payload.position))
        self.firmware = "S-V1.8-5"
        self.gripper_width = 0.5 * self._stroke
        self._object = 0.0
        self._temperatures = [(30, 30)] * JOINTS
        self.flags = [0] * JOINTS
        """Further bits of each joint's flags, see JointStatus."""
        self.peak: list[float] = [0.0] * JOINTS
        """Greatest speed of each joint since the last reset, rad/s."""
        self.commands = 0
        self.world: ArmInWorld | None = None
        gripper = spec.gripper
        own = gripper is not None and gripper.driver == spec.driver
        self._force_per_torque = PiperGripperSettings.of(gripper).force_per_torque if gripper and own else 0.0
        self._since_report = self._since_slow = 0.0
        self.restart()

    _stroke = 0.07

    def restart(self) -> None:
        """Become as after switching on: no motor has power."""
        self.enabled = [False] * JOINTS
        self.status = 0
        self.control = STANDBY
        self.move = MOVE_J
        self.speed = 1.0
        self.target = self.plant.q.tolist()
        self._set_q, self._set_dq = list(self.target), [0.0] * JOINTS
        self._gripper = GripperRequest(self.gripper_width, 1.0, enabled=False)
        self._gripper_torque = 0.0

    def take(self, id: int, data: bytes, send: Send) -> None:
        """Take a frame from the bus, and answer it."""
        command = decode_command(id, data)
        if command is None:
            return
        self.commands += 1
        match command:
            case EnableRequest(motor, enabled):
                self._enable(motor, enabled)
            case ModeRequest():
                self.control, self.move, self.speed = command.control, command.move, command.speed_percent / 100.0
            case JointTargets(first, q):
                self._set_targets(first, q)
            case GripperRequest():
                self._gripper = command
            case EmergencyRequest(emergency=1):
                self.status = _STOPPED
                self.target = list(self._set_q)
            case EmergencyRequest(emergency=2):  # "resume": it cuts the power
                self._enable(ALL_JOINTS, False)
                self.status, self.control = 0, STANDBY
            case JointRequest(clear_error=True):
                self.status, self.flags = 0, [0] * JOINTS
            case LimitQuery(motor) if 1 <= motor <= JOINTS:
                upper, lower = self.plant.upper[motor - 1], self.plant.lower[motor - 1]
                send(*encode_report(JointLimits(motor, upper, lower, _SPEED)), 0)
            case ParameterQuery(content=4):
                send(*encode_report(GripperStroke(round(self._stroke * 1e3))), 0)
            case FirmwareQuery():
                for frame in firmware_pieces(self.firmware):
                    send(*frame, 0)
        if id >= 0x470 and not isinstance(command, FirmwareQuery):
            send(*encode_report(Acknowledgement(id & 0xFF)), 0)

    def _enable(self, motor: int, enabled: bool) -> None:
        chosen = [motor - 1] if 1 <= motor <= JOINTS else range(JOINTS)
        for k in chosen:
            if enabled and not self.enabled[k]:
                self.target[k] = self._set_q[k] = float(self.plant.q[k])
                self._set_dq[k] = 0.0
            self.enabled[k] = enabled
        if motor == 0xFF:
            self._gripper = self._gripper._replace(enabled=enabled)
        if all(self.enabled):
            self.plant.held = False

    def _set_targets(self, first: int, q: tuple[float, float]) -> None:
        if self.control != CAN_CONTROL or self.move != MOVE_J or self.status not in (0, _BEYOND_LIMIT):
            return
        inside = all(
            self.plant.lower[first + k] - 1e-3 <= value <= self.plant.upper[first + k] + 1e-3
            for k, value in enumerate(q)
        )
        self.status = 0 if inside else _BEYOND_LIMIT
        if inside:
            self.target[first : first + 2] = q

    def step(self, dt: float, send: Send) -> None:
        """Let ``dt``, s, pass, and report when it is time."""
        gravity = None if self.plant.held else self.plant.gravity()
        drives = []
        for k in range(JOINTS):
            if not self.enabled[k] or gravity is None:
                drives.append(OFF)
                continue
            self._follow(k, dt)
            weight = float(gravity[k])
            drives.append(Drive(self._set_q[k], self._set_dq[k], _STIFFNESS, _DAMPING, weight))
        self.plant.step(dt, drives)
        self.peak = [max(peak, abs(speed)) for peak, speed in zip(self.peak, self.plant.dq.tolist(), strict=True)]
        if self.world is not None:
            self._object = self.world.object_width or 0.0
        self._step_gripper(dt)
        if self.world is not None:
            force = -self._gripper_torque * self._force_per_torque
            self.world.fingers = self.world.now, self.gripper_width, force
            self.world.exchange(dt, self.plant.q.tolist())
        self._since_report += dt
        self._since_slow += dt
        if self._since_report >= _REPORT - 1e-9:
            self._since_report = 0.0
            self._report(send)
        if self._since_slow >= _SLOW_REPORT - 1e-9:
            self._since_slow = 0.0
            self._report_slow(send)

    def _follow(self, k: int, dt: float) -> None:
        """Move the controller's set-point of a joint towards its target."""
        error = self.target[k] - self._set_q[k]
        largest = min(abs(error) / _LAG, math.sqrt(2.0 * _ACCELERATION * abs(error)), self.speed * _SPEED)
        wanted = math.copysign(largest, error)
        change = min(max(wanted - self._set_dq[k], -_ACCELERATION * dt), _ACCELERATION * dt)
        self._set_dq[k] += change
        self._set_q[k] += self._set_dq[k] * dt

    def _step_gripper(self, dt: float) -> None:
        self._gripper_torque = 0.0
        if not self._gripper.enabled:
            return
        goal = min(max(self._gripper.width, 0.0), self._stroke)
        step = min(max(goal - self.gripper_width, -_FINGER_SPEED * dt), _FINGER_SPEED * dt)
        width = max(self.gripper_width + step, self._object)
        if width > goal + 1e-6 and width >= self.gripper_width - 1e-9:
            self._gripper_torque = -self._gripper.torque  # closes on the object
        self.gripper_width = width

    def _report(self, send: Send) -> None:
        plant = self.plant
        moving = max(abs(a - b) for a, b in zip(self.target, plant.q.tolist(), strict=True)) > 2e-3
        send(*encode_report(PiperStatus(self.control, self.status, self.move, moving=int(moving))), 0)
        position, angles = plant.flange()
        for frame in (*encode_pose(position.tolist(), angles.tolist()), *encode_joint_angles(plant.q.tolist())):
            send(*frame, 0)
        flags = HOMED | (ENABLED if self._gripper.enabled else 0)
        send(*encode_report(GripperStatus(self.gripper_width, self._gripper_torque, flags)), 0)
        for k in range(JOINTS):
            current = float(plant.tau[k]) / TORQUE_PER_AMPERE[k]
            send(*encode_report(JointMotion(k, float(plant.dq[k]), current, float(plant.q[k]))), k + 1)

    def _report_slow(self, send: Send) -> None:
        for k in range(JOINTS):
            driver, motor = self._temperatures[k]
            flags = self.flags[k] | (ENABLED if self.enabled[k] else 0)
            send(*encode_report(JointStatus(k, 24.0, driver, motor, flags)), k + 1)

    def report(self) -> dict[str, Any]:
        """Return the state of the controller, for programs and people."""
        return {
            "enabled": self.enabled,
            "status": ARM_STATUS.get(self.status, str(self.status)),
            "control": self.control,
            "target": self.target,
            "commands": self.commands,
            "gripper_width": self.gripper_width,
        }

    # Faults.

    def set_status(self, number: int, status: int) -> None:
        """Set the arm's state (number 0; see ``ARM_STATUS``), or further flags of a joint (see JointStatus)."""
        if number == 0:
            self.status = status
        else:
            self.flags[number - 1] = status

    def set_temperature(self, number: int, driver: int, motor: int) -> None:
        self._temperatures[number - 1] = (driver, motor)

    def set_object(self, width: float | None) -> None:
        """Put an object of this width, m, between the fingers; None takes it away."""
        self._object = width or 0.0

    def set_register(self, number: int, name: str, value: float) -> None:
        raise ValueError("a PiPER has no registers")

    @property
    def numbers(self) -> Sequence[int]:
        return range(1, JOINTS + 1)
