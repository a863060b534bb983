"""Emulated Damiao motors: registers, MIT mode, watchdog, faults and temperatures, on the mechanics of an arm.

What public sources leave open is assumed: a motor without communication damps as if its windings were shorted (I2RT
calls it damping, Damiao's manual says that the motor leaves its enabled mode); one with another fault applies no
torque; only frames at a motor's own id feed its watchdog.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from hal.drivers.can.damiao_protocol import (
    CLEAR_ERROR,
    DISABLE,
    ENABLE,
    MIT_MODE,
    READ_REGISTER,
    REGISTER_ID,
    STATE_REQUEST,
    TIMEOUT_UNIT,
    WRITE_REGISTER,
    MotorRange,
    MotorRegister,
    MotorStatus,
)
from hal.drivers.can.settings import DamiaoArmSettings, DamiaoGripperSettings, DamiaoMotorSettings
from hal.specs import RobotSpec
from hal_emulators.shared_world import ArmInWorld

from .damiao_frames import SAVE_REGISTERS, SET_ZERO, MotorSide, decode_register_request, encode_register_reply
from .plant import OFF, ArmPlant, Drive, GripperPlant, JointMechanics

Send = Callable[[int, bytes, int], None]
"""Sends a frame: id, data, and the number of the motor that it comes from."""

_FACTORY_TIMEOUT = 8000
"""400 ms, the factory's default (i2rt)."""
_PHASE_RESISTANCE = 0.65
"""Ohm, of the DM4310 in its manual; assumed for the others."""
_IDLE_SPEED = {"DM4310": (24.0, 20.94), "DM4340": (24.0, 5.445), "DM8009": (48.0, 16.75)}
"""Type -> voltage, V, and speed without load, rad/s (enactic/openarm_description)."""
_MECHANICS = {
    "DM4310": JointMechanics(0.0018, 0.06, 0.02, 10.0),
    "DM4340": JointMechanics(0.03, 0.3, 0.15, 28.0),
    "DM8009": JointMechanics(0.02, 0.3, 0.15, 54.0),
}
"""Inertia and viscous friction are chosen, between those of several published models; Coulomb friction: i2rt's
yam_v1.yml for the first two; torque: TMAX."""
_AMBIENT = 30
_NEAR = 1e-3
"""Fingers that are no farther than this from an object, m, press on it."""


def shorted_damping(motor_type: str) -> float:
    """Return the damping of a motor whose windings are shorted, Nm s/rad.

    It is 1.5 k^2 / R, with the peak back-EMF of a phase per joint speed, k = V / (sqrt(3) idle speed).
    """
    voltage, speed = _IDLE_SPEED.get(motor_type, _IDLE_SPEED["DM4310"])
    back_emf = voltage / (math.sqrt(3.0) * speed)
    return 1.5 * back_emf**2 / _PHASE_RESISTANCE


class DamiaoMotor:
    """One motor: what it keeps between two frames."""

    def __init__(self, settings: DamiaoMotorSettings) -> None:
        self.settings = settings
        self.id = settings.id
        limits = settings.limits
        self.registers: dict[int, float] = {
            MotorRegister.OT_VALUE: 100.0,
            MotorRegister.MST_ID: settings.reply_id,
            MotorRegister.ESC_ID: settings.id,
            MotorRegister.TIMEOUT: _FACTORY_TIMEOUT,
            MotorRegister.CTRL_MODE: MIT_MODE,
            MotorRegister.HW_VERSION: 1,
            MotorRegister.SW_VERSION: 5013,
            MotorRegister.SERIAL: 4242 + settings.id,
            MotorRegister.PMAX: limits.position,
            MotorRegister.VMAX: limits.velocity,
            MotorRegister.TMAX: limits.torque,
            MotorRegister.CAN_BR: 4,
        }
        self.mechanics = _MECHANICS.get(settings.type, _MECHANICS["DM4310"])._replace(torque=limits.torque)
        self._damping = shorted_damping(settings.type)
        self.mosfet = self.rotor = _AMBIENT
        self.commands = 0
        """Frames in MIT mode so far."""
        self.set_ranges()
        self.restart()

    def restart(self) -> None:
        self.status = MotorStatus.DISABLED
        self.drive: Drive | None = None
        """Content of the last command since it was enabled."""
        self.silence = 0.0
        """Time since the last frame at its id, s."""

    def set_ranges(self) -> None:
        """Use the ranges in the registers from now on."""
        names = MotorRegister.PMAX, MotorRegister.VMAX, MotorRegister.TMAX
        self.codec = MotorSide(MotorRange(*(self.registers[name] for name in names)))

    def step(self, dt: float) -> Drive:
        """Let ``dt``, s, pass, and return what the motor does now, on the joint's side."""
        self.silence += dt
        timeout = self.registers[MotorRegister.TIMEOUT] * TIMEOUT_UNIT
        if self.status == MotorStatus.ENABLED and 0.0 < timeout < self.silence:
            self.status = MotorStatus.LOST_COMMUNICATION
        if self.status == MotorStatus.LOST_COMMUNICATION:
            return Drive(kd=self._damping)
        return (self.drive if self.status == MotorStatus.ENABLED else None) or OFF

    def command(self, data: bytes) -> None:
        """Take a frame at the motor's id."""
        self.silence = 0.0
        if data == ENABLE:
            if self.status == MotorStatus.DISABLED:
                self.status, self.drive = MotorStatus.ENABLED, None
        elif data == DISABLE:
            if self.status == MotorStatus.ENABLED:
                self.status, self.drive = MotorStatus.DISABLED, None
        elif data == CLEAR_ERROR:
            if self.status != MotorStatus.ENABLED:
                self.status = MotorStatus.DISABLED
        elif data != SET_ZERO and len(data) == 8:
            self.commands += 1
            if self.status == MotorStatus.ENABLED:
                q, dq, kp, kd, tau = self.codec.decode_command(data)
                sign = self.settings.direction
                self.drive = Drive(sign * q + self.settings.offset, sign * dq, kp, kd, sign * tau)

    def feedback(self, q: float, dq: float, tau: float) -> bytes:
        """Return the data of its feedback at this motion of the joint, rad, rad/s and Nm."""
        sign = self.settings.direction
        at_motor = sign * (q - self.settings.offset)
        return self.codec.encode_feedback(
            self.id, self.status, at_motor, sign * dq, sign * tau, self.mosfet, self.rotor
        )


class EmulatedDamiaoArm:
    """An arm with Damiao motors (by their id), and its gripper if that has one on the same bus."""

    def __init__(self, spec: RobotSpec) -> None:
        """Build it from the arm's record in a rig."""
        self.name = spec.name
        self.bus = DamiaoArmSettings.of(spec).shared
        arm = [DamiaoMotor(motor) for motor in DamiaoArmSettings.of(spec).motors]
        self.motors = {motor.id: motor for motor in arm}
        self._arm = arm
        mechanics = [motor.mechanics for motor in arm]
        self.plant = ArmPlant(spec.kinematics, mechanics, spec.initial, spec.base_orientation)
        if spec.payload is not None:
            self.plant.load(payload=(spec.payload.mass, spec.payload.position))
        self.gripper: GripperPlant | None = None
        self._gripper_motor: DamiaoMotor | None = None
        self._object_width: float | None = None
        self.widths: tuple[tuple[float, float], ...] = ()
        if spec.gripper is not None and spec.gripper.driver == spec.driver:
            settings = DamiaoGripperSettings.of(spec.gripper)
            self._gripper_motor = motor = DamiaoMotor(settings.motor)
            self.motors[motor.id] = motor
            self.widths = settings.widths
            lower, upper = settings.widths[0][0], settings.widths[-1][0]
            self.gripper = GripperPlant(motor.mechanics, 0.5 * (lower + upper), lower, upper)
        self.ids = frozenset(self.motors)
        self.peak: list[float] = [0.0] * len(arm)
        """Greatest speed of each joint since the last reset, rad/s."""
        self.world: ArmInWorld | None = None

    def take(self, id: int, data: bytes, send: Send) -> None:
        """Take a frame from the bus, and answer it."""
        motor = self.motors.get(id)
        if motor is not None:
            motor.command(data)
            if data == SET_ZERO:
                return
            self._release()
            send(int(motor.registers[MotorRegister.MST_ID]), self._feedback(motor), motor.id)
        elif id == REGISTER_ID:
            self._answer_request(data, send)

    def _answer_request(self, data: bytes, send: Send) -> None:
        request = decode_register_request(data)
        motor = self.motors.get(request.motor) if request is not None else None
        if request is None or motor is None:
            return
        master = int(motor.registers[MotorRegister.MST_ID])
        if request.operation == STATE_REQUEST:
            send(master, self._feedback(motor), motor.id)
        elif request.operation in (READ_REGISTER, WRITE_REGISTER) and request.register in motor.registers:
            if request.operation == WRITE_REGISTER:
                motor.registers[request.register] = request.value
                motor.set_ranges()
            value = motor.registers[request.register]
            send(master, encode_register_reply(motor.id, request.register, value, request.operation), motor.id)
        elif request.operation == SAVE_REGISTERS:
            send(master, data, motor.id)

    def _release(self) -> None:
        """Let go of an arm that was held once all its motors are on and have a command."""
        if self.plant.held and all(m.status == MotorStatus.ENABLED and m.drive is not None for m in self._arm):
            self.plant.held = False

    def _feedback(self, motor: DamiaoMotor) -> bytes:
        if motor is self._gripper_motor and self.gripper is not None:
            return motor.feedback(self.gripper.q, self.gripper.dq, self.gripper.tau)
        k = self._arm.index(motor)
        plant = self.plant
        return motor.feedback(float(plant.q[k]), float(plant.dq[k]), float(plant.tau[k]))

    def step(self, dt: float, send: Send) -> None:
        """Let ``dt``, s, pass."""
        self.plant.step(dt, [motor.step(dt) for motor in self._arm])
        self.peak = [max(peak, abs(speed)) for peak, speed in zip(self.peak, self.plant.dq.tolist(), strict=True)]
        if self.gripper is not None and self._gripper_motor is not None:
            self.gripper.step(dt, self._gripper_motor.step(dt))
        if self.world is not None:
            if self.gripper is not None:
                self._meet(self.world, self.gripper)
            self.world.exchange(dt, self.plant.q.tolist())

    def _meet(self, world: ArmInWorld, gripper: GripperPlant) -> None:
        """Let an object in the world stop the fingers, and press on it with what the motor has beyond its friction."""
        (a0, w0), (a1, w1) = self.widths[0], self.widths[-1]
        slope = (w1 - w0) / (a1 - a0)
        if world.object_width != self._object_width:
            self._object_width = world.object_width
            self.set_object(self._object_width)
        closing = -gripper.tau * math.copysign(1.0, slope) - gripper.coulomb
        width = w0 + (gripper.q - a0) * slope
        pressing = self._object_width is not None and width < self._object_width + _NEAR
        world.fingers = world.now, width, max(closing / abs(slope), 0.0) if pressing else 0.0

    def report(self) -> dict[str, Any]:
        motors = {
            motor.id: {
                "status": f"{int(motor.status):X}",
                "commands": motor.commands,
                "silence": round(motor.silence, 4),
                "drive": motor.drive,
            }
            for motor in self.motors.values()
        }
        fingers = {} if self.gripper is None else {"gripper": {"q": self.gripper.q, "tau": self.gripper.tau}}
        return {"motors": motors, **fingers}

    # Faults. The number is one of ``numbers``.

    def set_status(self, number: int, status: int) -> None:
        """Give a motor a status, a fault for example; it lasts until the motor's error is cleared."""
        if status not in tuple(MotorStatus):
            known = ", ".join(f"{code:X} {code.name.lower()}" for code in MotorStatus)
            raise ValueError(f"there is no status {status:X}; statuses: {known}")
        self.motors[number].status = MotorStatus(status)

    def set_register(self, number: int, name: str, value: float) -> None:
        """Change a register of a motor."""
        motor = self.motors[number]
        register = MotorRegister.__members__.get(name.upper())
        if register is None:
            raise ValueError(f"there is no register {name!r}; registers: {', '.join(MotorRegister.__members__)}")
        motor.registers[register] = value
        motor.set_ranges()

    def set_temperature(self, number: int, mosfet: int, rotor: int) -> None:
        motor = self.motors[number]
        motor.mosfet, motor.rotor = mosfet, rotor

    def restart(self) -> None:
        """Switch the motors off and on again: their settings last, their state does not."""
        for motor in self.motors.values():
            motor.restart()

    def set_object(self, width: float | None) -> None:
        """Put an object of this width, m, between the fingers; None takes it away."""
        if self.gripper is None:
            raise ValueError("this arm has no gripper on its bus")
        (a0, w0), (a1, w1) = self.widths[0], self.widths[-1]
        self.gripper.lower, self.gripper.upper = a0, a1
        if width is not None:
            angle = a0 + (a1 - a0) * (width - w0) / (w1 - w0)
            if w1 > w0:
                self.gripper.lower = angle
            else:
                self.gripper.upper = angle

    @property
    def numbers(self) -> Sequence[int]:
        return tuple(self.motors)
