"""One Damiao motor as its driver sees it: its state in terms of its joint, its registers and its faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import pi

from hal.errors import Fault
from hal.specs import LimitsSpec

from .damiao_protocol import (
    MIT_MODE,
    READ_REGISTER,
    TIMEOUT_UNIT,
    WRITE_REGISTER,
    MotorCodec,
    MotorRegister,
    MotorStatus,
    decode_register_reply,
    encode_state_request,
)
from .settings import DamiaoMotorSettings

CHECKED_REGISTERS = (
    MotorRegister.PMAX,
    MotorRegister.VMAX,
    MotorRegister.TMAX,
    MotorRegister.TIMEOUT,
    MotorRegister.CTRL_MODE,
    MotorRegister.OT_VALUE,
)
"""Registers that are read before a motor may be switched on."""
SHORTEST_TIMEOUT = 0.05
"""Shortest TIMEOUT with which a busy computer can drive a motor, s."""
LONGEST_TIMEOUT = 1.0
"""Longest TIMEOUT, s: for so long a motor repeats the last command of a killed program, a torque for example."""
HEAT_MARGIN = 5.0
"""Distance from the temperature at which a motor switches itself off that is a fault, K."""
MILD_FAULTS = frozenset({"motor_hot", "other_program"})
"""Codes of the faults with which every motor still follows its commands, so that the arm can be braked."""

_SLACK = 0.3
"""How far beyond its joint's range a motor may report itself at rest, rad."""
_HOT = "let it cool down, with the arm supported; lower its load or its speed"
_STATUS_FAULTS = {
    MotorStatus.OVER_VOLTAGE: ("its supply voltage is too high", "check the power supply, also while braking"),
    MotorStatus.UNDER_VOLTAGE: ("its supply voltage is too low", "check the power supply, its plugs and its cables"),
    MotorStatus.OVER_CURRENT: ("it draws too much current", "check for a collision and for a short circuit"),
    MotorStatus.MOSFET_TOO_HOT: ("its electronics are too hot", _HOT),
    MotorStatus.ROTOR_TOO_HOT: ("its rotor is too hot", _HOT),
    MotorStatus.LOST_COMMUNICATION: (
        "it got no command for its TIMEOUT, and damps",
        "check the cable, the bus load and the load of this computer",
    ),
    MotorStatus.OVERLOAD: ("it is overloaded", "check what the arm carries and touches"),
}
_SUPPORT = "support the arm by hand, because the joint does not hold"


class ChainMotor:
    """State of one motor, in terms of its joint: direction and offset are applied.

    Numbers in feedback are truncated by the motor, so half a step is added to each.
    """

    def __init__(self, settings: DamiaoMotorSettings, label: str) -> None:
        self.settings = settings
        self.label = label
        """The motor in words, with its joint and its id."""
        self.codec = MotorCodec(settings.limits)
        self.id, self.kp, self.kd = settings.id, settings.kp, settings.kd
        self.direction, self.offset = float(settings.direction), settings.offset
        p, v, t = settings.limits
        self._q_step = self.direction * 2.0 * p / 65535.0
        self._q_0 = self.offset - self.direction * p + 0.5 * self._q_step
        self._dq_step = self.direction * 2.0 * v / 4095.0
        self._dq_0 = -self.direction * v + 0.5 * self._dq_step
        self._tau_step = self.direction * 2.0 * t / 4095.0
        self._tau_0 = -self.direction * t + 0.5 * self._tau_step
        head = (self.id & 0xFF) << 16 | self.id >> 8 << 8
        self._marks = frozenset((head | READ_REGISTER, head | WRITE_REGISTER))
        """The first three bytes of a register's reply."""
        self._low = self.id & 15
        self.state_request = encode_state_request(self.id)
        self.registers: dict[int, float] = {}
        """Number -> value of the registers that were read."""
        self.on = False
        """Whether this program switched the motor on, and it still is on as far as its replies tell."""
        self.switched_at = 0.0
        """Time of that, s on the host's clock."""
        self.acknowledged = 0
        """The error that :meth:`.DamiaoArm.recover` acknowledged: it no longer is a fault."""
        self.status = 0
        self.q = self.dq = self.tau = 0.0
        """Position, velocity and torque of the joint, rad, rad/s and Nm."""
        self.rotor_limit = self.rotor_warning = 200.0
        """Temperatures of the rotor at which the motor switches itself off, and at which that is a fault, deg C."""
        self.mosfet = self.rotor = 0
        """Temperatures, deg C."""
        self.t = -1.0
        """Time of the frame that the newest reply answers, s on the host's clock; -1 before the first."""
        self.bits = 0
        self.replies = 0
        """Number of feedback frames since the last update."""
        self.asked = 0
        """Number of frames that were sent to it since then."""
        self.gap = 0
        """Number of replies that were missing, and may still come."""
        self.unasked = self.t_unasked = 0.0
        """Recent answers that nothing here asked for, and the time of the last one, s."""
        self.silent = 0
        """Number of updates in a row without a reply."""
        self.silent_since = 0.0
        """Time of the first frame that the motor has not answered, s."""
        self.reset_statistics()

    def reset_statistics(self) -> None:
        self.missing = self.late = self.doubled = self.foreign = 0

    def receive(self, data: bytearray) -> None:
        """Take a frame from the motor's master id."""
        bits = int.from_bytes(data, "big")
        if len(data) != 8:
            self.foreign += 1
        elif bits >> 40 in self._marks:
            reply = decode_register_reply(data, self.id)
            if reply is not None:
                self.registers[reply.register] = reply.value
        elif bits >> 56 & 15 != self._low:
            self.foreign += 1
        else:
            self.bits = bits
            self.replies += 1

    def decode(self) -> None:
        bits = self.bits
        self.status = bits >> 60
        self.q = (bits >> 40 & 0xFFFF) * self._q_step + self._q_0
        self.dq = (bits >> 28 & 0xFFF) * self._dq_step + self._dq_0
        self.tau = (bits >> 16 & 0xFFF) * self._tau_step + self._tau_0
        self.mosfet = bits >> 8 & 0xFF
        self.rotor = bits & 0xFF

    def command(self, q: float, dq: float, kp: float, kd: float, tau: float) -> bytes:
        """Return the data of a command in terms of the joint; arguments as those of ``MotorCodec.encode_command``."""
        d = self.direction
        return self.codec.encode_command(d * (q - self.offset), d * dq, kp, kd, d * tau)

    def take_registers(self) -> None:
        self.rotor_limit = self.registers[MotorRegister.OT_VALUE]
        self.rotor_warning = self.rotor_limit - HEAT_MARGIN


def motor_fault(motor: ChainMotor, mosfet_limit: float, *, engaged: bool) -> Fault | None:
    """Return the fault of a motor, naming it; None without one. Arguments as those of ``DamiaoChain``.

    One that is not ``engaged`` may have lost communication: that is its rest.
    """
    status = motor.status
    if status > 1 and status != motor.acknowledged and (engaged or status != MotorStatus.LOST_COMMUNICATION):
        if status in _STATUS_FAULTS:
            cause, remedy = _STATUS_FAULTS[MotorStatus(status)]
            return Fault(MotorStatus(status).name.lower(), f"{motor.label}: {cause}", f"{_SUPPORT}; {remedy}")
        cause = f"it reports the undocumented status {status:#x}"
        return Fault(f"status_{status:x}", f"{motor.label}: {cause}", f"{_SUPPORT}; see the motor's manual")
    if motor.rotor >= motor.rotor_warning:
        what = f"its rotor has {motor.rotor} deg C; at {motor.rotor_limit:g} it switches itself off"
        return Fault("motor_hot", f"{motor.label}: {what}", _HOT)
    if motor.mosfet >= mosfet_limit - HEAT_MARGIN:
        what = f"its electronics have {motor.mosfet} deg C; at {mosfet_limit:g} they switch off"
        return Fault("motor_hot", f"{motor.label}: {what}", _HOT)
    return None


def find_turned(motors: Sequence[ChainMotor], limits: LimitsSpec) -> Fault | None:
    """Return the fault of the first motor that reports full turns away from its joint's range; None without one."""
    for motor, low, high in zip(motors, limits.lower, limits.upper, strict=True):
        turns = round((0.5 * (low + high) - motor.q) / (2.0 * pi))
        really = motor.q + 2.0 * pi * turns
        if low - _SLACK <= really <= high + _SLACK and not low - _SLACK <= motor.q <= high + _SLACK:
            cause = f"reports {motor.q:.2f} rad, out of its range of {low:g} to {high:g} by {abs(turns)} full turn(s)"
            remedy = (
                "it was more than half a turn from its zero when it got power: support the arm, switch it off, turn "
                "the joint to the middle of its range, and switch it on again; if that does not help, correct `offset`"
            )
            return Fault("full_turn", f"{motor.label}: {cause}", remedy)
    return None


def register_problems(settings: DamiaoMotorSettings, registers: dict[int, float]) -> Iterator[tuple[str, str, str]]:
    """Yield what is wrong with the registers that were read (number -> value): name of the register, message, code."""
    limits = settings.limits
    for register, wanted, unit in (
        (MotorRegister.PMAX, limits.position, "rad"),
        (MotorRegister.VMAX, limits.velocity, "rad/s"),
        (MotorRegister.TMAX, limits.torque, "Nm"),
    ):
        value = registers.get(register)
        if value is not None and not abs(value - wanted) <= 1e-4 * wanted:
            yield (
                register.name,
                f"is {value:g} {unit}, the rig has {wanted:g} for a {settings.type}: every command would be scaled "
                f"wrongly; correct `type`, or give the motor's own `ranges`",
                "wrong_range",
            )
    timeout = registers.get(MotorRegister.TIMEOUT)
    if timeout is not None and not SHORTEST_TIMEOUT <= timeout * TIMEOUT_UNIT <= LONGEST_TIMEOUT:
        what = f"is {timeout * TIMEOUT_UNIT:g} s, must be {SHORTEST_TIMEOUT:g} to {LONGEST_TIMEOUT:g} s"
        code = "short_timeout"
        if timeout == 0 or timeout * TIMEOUT_UNIT > LONGEST_TIMEOUT:
            what, code = f"{what}: the motor would run on without this program", "no_timeout"
        yield "TIMEOUT", f"{what}; set it to 8000 (0.4 s), the factory's value", code
    mode = registers.get(MotorRegister.CTRL_MODE)
    if mode is not None and mode != MIT_MODE:
        yield "CTRL_MODE", f"is {mode:g}, must be {MIT_MODE} (MIT)", "wrong_mode"
