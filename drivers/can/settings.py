"""Settings of arms on a CAN bus: the ``real:`` part of a model or a rig, checked before a device is opened.

Nothing here imports python-can.
"""

from __future__ import annotations

import ipaddress
import itertools
import shlex
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, Literal
from zlib import crc32

from pydantic import AfterValidator, BeforeValidator, Field, StringConstraints, model_validator

from hal.config.files import DeviceSettings
from hal.config.schema import Flag, Quantity, Several, Size, Strict, describe
from hal.errors import find_closest
from hal.kinematics.inertials import find_wrong_inertials
from hal.specs import GripperSpec, RobotSpec

from .damiao_protocol import KD_MAX, KP_MAX, MASTER_OFFSET, MOTOR_RANGES, MotorRange
from .piper_protocol import JOINTS

EMULATED_INTERFACES = frozenset({"virtual", "udp_multicast"})
"""Interfaces of python-can behind which there is no hardware."""
_SHAREABLE = frozenset({"socketcan", "udp_multicast"})
"""Interfaces that several processes of a computer can open at once."""
_USUAL_GROUP, _USUAL_PORT = "239.74.163.2", 43113
"""Channel and port of python-can's own default for ``udp_multicast``."""
_FIRST_PORT, _PORTS = 20_000, 12_000
"""Range of the ports of other channels, below those that Linux gives to outgoing connections."""
_LONGEST_NAME = 15
"""Longest name of a network interface of Linux."""
_LARGEST_ID = 0x7FE
_LARGEST_MOTOR_ID = 0xFF
"""Ids of commands in other modes begin above it."""
_MISFIT = 2.0
"""Largest factor between ranges that the rig gives and those of the motor's type: public tables differ by up to 2."""


def is_emulated(options: Mapping[str, Any]) -> bool:
    """Return whether the bus in these options is one without hardware, so that an emulator answers."""
    return str(options.get("interface", "")).strip().lower() in EMULATED_INTERFACES


def group_key(options: Mapping[str, Any]) -> str | None:
    """Return a key that arms on one adapter share if only one process can open it; None if several can.

    The options are not checked yet.
    """
    interface, channel = (str(options.get(key, "")).strip() for key in ("interface", "channel"))
    return None if interface.lower() in _SHAREABLE else f"{interface} {channel}"


def emulator_remedy(source: str) -> str:
    """Return the command that starts the emulator of a rig's file; ``<dict>`` and "" stand for a rig without one."""
    known = bool(source) and not source.startswith("<")
    file = shlex.quote(source) if known else "FILE, with the rig in a file"
    return f"start the emulator in another terminal: hal emulate can --config {file}"


# Values.


def _motor_type(value: Any) -> str:
    if isinstance(value, str) and value in MOTOR_RANGES:
        return value
    near = find_closest(value.upper(), MOTOR_RANGES) if isinstance(value, str) else None
    hint = f"; did you mean {near!r}?" if near else ""
    raise ValueError(f"there is no motor type {describe(value)}{hint}; types: {', '.join(MOTOR_RANGES)}")


def _check_widths(rows: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    table = sorted(rows)
    steps = [(second[0] - first[0], second[1] - first[1]) for first, second in itertools.pairwise(table)]
    if not all(angle > 0.0 for angle, _ in steps):
        raise ValueError("has the same angle twice")
    if not (all(width > 0.0 for _, width in steps) or all(width < 0.0 for _, width in steps)):
        raise ValueError("must rise or fall all along: each width belongs to one angle")
    if table[0][1] < 0.0 or table[-1][1] < 0.0:
        raise ValueError("has a negative width")
    return tuple(table)


Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]
_RANGES = Several(Quantity("", 0.0, 1e4, above=True), 3, "PMAX in rad, VMAX in rad/s, TMAX in Nm")
Id = Annotated[int, Field(ge=0, le=_LARGEST_ID, strict=True)]
MotorId = Annotated[int, Field(ge=1, le=_LARGEST_MOTOR_ID, strict=True)]
BitRate = Annotated[int, Field(ge=10_000, le=10_000_000, strict=True)]
Angle = Annotated[float, Quantity("rad", -100.0, 100.0)]
Stiffness = Annotated[float, Quantity("Nm/rad", 0.0, KP_MAX, above=True)]
Damping = Annotated[float, Quantity("Nm s/rad", 0.0, KD_MAX, above=True)]
Friction = Annotated[float, Quantity("Nm", 0.0, 10.0)]
Temperature = Annotated[float, Quantity("deg C", 30.0, 200.0)]
FollowingLimit = Annotated[float, Quantity("rad", 0.05, 3.0)]
WidthTable = Annotated[tuple[tuple[float, float], ...], Field(min_length=2), AfterValidator(_check_widths)]


# Records.


class BusSettings(DeviceSettings):
    """A CAN bus, as python-can opens it."""

    interface: Text
    """An interface of python-can, for example ``socketcan``."""
    channel: Text
    """A channel of the interface, for example ``can0``."""
    fd: Flag = False
    """Whether frames are sent as CAN-FD, with the faster bit rate for their data."""
    bus: dict[str, Any] = Field(default_factory=dict)
    """Further arguments of ``can.Bus``, for example ``bitrate`` of a serial adapter."""
    bit_rate: BitRate = 1_000_000
    """Bit rate, bit/s. SocketCAN's is set by ``ip link``; this one is used for its command and for the bus load."""
    data_bit_rate: BitRate = 5_000_000
    """Bit rate of the data of CAN-FD frames, bit/s."""

    @model_validator(mode="after")
    def _channel_of_its_kind(self) -> BusSettings:
        if self.interface == "udp_multicast":
            try:
                group = ipaddress.ip_address(self.channel).is_multicast
            except ValueError:
                group = False
            if not group:
                raise ValueError(f"channel: must be a multicast address such as {_USUAL_GROUP}, not {self.channel}")
        if self.interface == "socketcan" and (len(self.channel) > _LONGEST_NAME or "/" in self.channel):
            raise ValueError(
                f"channel: must be the name of an interface such as can0, not {self.channel}; a serial adapter has "
                "`interface: slcan`"
            )
        return self

    @property
    def key(self) -> tuple[str, str]:
        """Interface and channel, by which a bus is identified on this computer."""
        return self.interface, self.channel

    def arguments(self) -> dict[str, Any]:
        """Return the arguments with which ``can.Bus`` opens this bus.

        Frames over ``udp_multicast`` never leave this computer. Each of its channels gets a port of its own: a socket
        on a common port receives the frames of every group that a program on this computer has joined.
        """
        more: dict[str, Any] = {"fd": True} if self.fd else {}
        if self.interface == "udp_multicast":
            port = _USUAL_PORT if self.channel == _USUAL_GROUP else _FIRST_PORT + crc32(self.channel.encode()) % _PORTS
            more = {"fd": self.fd, "hop_limit": 0, "port": port}
        return {"interface": self.interface, "channel": self.channel, "ignore_config": True, **more, **self.bus}

    @property
    def shared(self) -> BusSettings:
        return BusSettings(**{name: getattr(self, name) for name in BusSettings.model_fields})


class DamiaoMotorSettings(Strict):
    """One motor of a chain, and how its joint is mounted on it."""

    id: MotorId
    """Id that the motor listens at (its register ESC_ID)."""
    type: Annotated[str, BeforeValidator(_motor_type)]
    kp: Stiffness
    """Gain of the position, Nm/rad."""
    kd: Damping
    """Gain of the velocity, Nm s/rad."""
    direction: Literal[1, -1] = 1
    """1 if the joint turns in the motor's direction, -1 if in the opposite one."""
    offset: Angle = 0.0
    """Position of the joint at the motor's zero, rad: joint = direction * motor + offset."""
    friction: Friction = 0.0
    """Coulomb friction of the joint that a command adds in the direction of its motion, Nm: less than there is."""
    master: Id | None = None
    """Id that the motor answers with (its register MST_ID); the motor's id + 0x10 if it is left out."""
    ranges: Annotated[MotorRange, _RANGES] | None = None
    """PMAX, VMAX and TMAX of this motor, rad, rad/s and Nm, if they are not those of its type."""

    @property
    def reply_id(self) -> int:
        """Id that the motor answers with."""
        return self.id + MASTER_OFFSET if self.master is None else self.master

    @cached_property
    def limits(self) -> MotorRange:
        return self.ranges or MOTOR_RANGES[self.type]

    @model_validator(mode="after")
    def _fitting(self) -> DamiaoMotorSettings:
        usual = MOTOR_RANGES[self.type]
        for name, unit in (("velocity", "rad/s"), ("torque", "Nm")):
            ours, theirs = getattr(self.limits, name), getattr(usual, name)
            if not 1.0 / _MISFIT <= ours / theirs <= _MISFIT:
                raise ValueError(
                    f"ranges: a {self.type} has a {name} of {theirs:g} {unit}, not {ours:g}: another motor's table?"
                )
        return self


class DamiaoArmSettings(BusSettings):
    """Settings under ``real:`` of an arm with Damiao motors."""

    motors: tuple[DamiaoMotorSettings, ...] = Field(min_length=1)
    """The motors, one for each joint, from base to tip."""
    mosfet_limit: Temperature = 120.0
    """Temperature at which the motors' electronics switch off, deg C: fixed, by Damiao's manual of the DM9008; assumed
    for the other types. The rotor's is the register OT_VALUE, for which that manual advises 100 at most."""
    following_limit: FollowingLimit = 0.5
    """Largest distance of a joint from its set-point, rad. Beyond it, or where the motor pushes with half of its
    greatest torque because of it, the arm is blocked, and holds where it is."""


class DamiaoGripperSettings(BusSettings):
    """Settings under ``real:`` of a gripper with a Damiao motor; those of the bus default to the arm's."""

    motor: DamiaoMotorSettings
    widths: WidthTable
    """Angle of the motor's joint, rad, and distance between the fingers, m, in rising order of the angle; linear in
    between."""
    mosfet_limit: Temperature = 120.0
    """As in the arm's settings."""
    tolerance: Size = 0.001
    """Largest distance from the target width at which the fingers count as arrived, m."""


class PiperArmSettings(BusSettings):
    """Settings under ``real:`` of a PiPER."""

    speed_percent: Annotated[int, Field(ge=1, le=100, strict=True)] = 100
    """Speed at which the arm's own controller goes to a target, percent of each joint's largest. It must not be below
    the speed of the set-points, or the arm lags behind."""
    mounting: Literal["upright", "left", "right"] | None = None
    """How the arm is mounted, seen with its cables behind; None leaves it as it is set in the arm."""

    @property
    def mounting_code(self) -> int:
        return 0 if self.mounting is None else 1 + ("upright", "left", "right").index(self.mounting)


class PiperGripperSettings(BusSettings):
    """Settings under ``real:`` of a PiPER's gripper; those of the bus default to the arm's."""

    force_per_torque: Annotated[float, Quantity("N/Nm", 1.0, 200.0)] = 40.0
    """Grip force for each Nm of the motor, N/Nm. An assumption: no public source has it. The vendor's two libraries
    disagree about the number in the frame (piper_sdk: 0.001 Nm, up to 5000; pyAgxArm: 0.001 N), and both set 1000 by
    default. Measure it before a force matters."""
    tolerance: Size = 0.001
    """Largest distance from the target width at which the fingers count as arrived, m."""


# Checks of a rig. Keys are relative to the device's entry.


def check_damiao_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig, message and code."""
    settings, problems = DamiaoArmSettings.check(spec)
    yield from problems
    if settings is None:
        return
    if len(settings.motors) != len(spec.joints):
        message = f"has {len(settings.motors)} motors for {len(spec.joints)} joints ({', '.join(spec.joints)})"
        yield "real.motors", message, "wrong_count"
        return
    gripper = spec.gripper
    shared = gripper is not None and gripper.driver == spec.driver
    other = DamiaoGripperSettings.check(gripper)[0] if gripper is not None and shared else None
    motors = [*settings.motors, *([other.motor] if other is not None and other.key == settings.key else [])]
    yield from _collisions(motors)
    for k, (joint, motor) in enumerate(zip(spec.joints, settings.motors, strict=True)):
        ends = [motor.direction * (q - motor.offset) for q in (spec.limits.lower[k], spec.limits.upper[k])]
        if max(map(abs, ends)) >= motor.limits.position:
            message = (
                f"the limits of {joint} are {min(ends):.4g} to {max(ends):.4g} rad at the motor, beyond its range of "
                f"{motor.limits.position:g} rad"
            )
            yield f"real.motors.{k}.offset", message, "out_of_range"
        if spec.limits.velocity[k] > motor.limits.velocity:
            message = f"is {spec.limits.velocity[k]:g} rad/s for {joint}, beyond VMAX, {motor.limits.velocity:g} rad/s"
            yield "limits.velocity", message, "out_of_range"
    for link, problem in find_wrong_inertials(spec.urdf, spec.joints).items():
        message = f"the URDF's link {link} {problem}: without its mass and centre the arm's weight cannot be carried"
        yield "model", message, "wrong_inertials"


def check_damiao_gripper(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a gripper's record: key in the gripper's entry of the rig, message and code."""
    settings, problems = DamiaoGripperSettings.check(spec)
    yield from problems
    if settings is None:
        return
    yield from _collisions([settings.motor])
    widest = max(width for _, width in settings.widths)
    if widest < spec.width_max - 1e-6:
        yield "real.widths", f"ends at {widest:g} m, below the greatest width, {spec.width_max:g} m", "out_of_range"
    beyond = [angle for angle, _ in settings.widths if abs(angle - settings.motor.offset) >= settings.motor.limits[0]]
    if beyond:
        yield "real.widths", f"has an angle beyond the motor's range: {beyond[0]:g} rad", "out_of_range"


_PIPER_RATE = 200.0
"""Rate at which a PiPER takes targets and reports, Hz."""
_PIPER_BIT_RATE = 1_000_000


def check_piper_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig, message and code."""
    settings, problems = PiperArmSettings.check(spec)
    yield from problems
    if len(spec.joints) != JOINTS:
        yield "model", f"must have {JOINTS} joints for a PiPER, not {len(spec.joints)}", "wrong_count"
    if spec.rate_hz > _PIPER_RATE:
        yield "rate_hz", f"must be at most {_PIPER_RATE:g} Hz for a PiPER, not {spec.rate_hz:g}", "out_of_range"
    if settings is not None:
        yield from _piper_bus(settings)


def check_piper_gripper(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a gripper's record: key in the gripper's entry of the rig, message and code."""
    settings, problems = PiperGripperSettings.check(spec)
    yield from problems
    if settings is not None:
        yield from _piper_bus(settings)


def _piper_bus(settings: BusSettings) -> Iterator[tuple[str, str, str]]:
    if settings.fd:
        yield "real.fd", "must be false: a PiPER has classic CAN, and an FD frame would stop its bus", "not_supported"
    if settings.bit_rate != _PIPER_BIT_RATE:
        yield "real.bit_rate", f"must be {_PIPER_BIT_RATE}, a PiPER's only one, not {settings.bit_rate}", "out_of_range"


def _collisions(motors: list[DamiaoMotorSettings]) -> Iterator[tuple[str, str, str]]:
    """Yield the ids that two motors on one bus have, or that are used to command and to answer."""
    commands: dict[int, int] = {}
    replies: dict[int, int] = {}
    for k, motor in enumerate(motors):
        key = f"real.motors.{k}" if len(motors) > 1 else "real.motor"
        if motor.id in commands:
            yield f"{key}.id", f"{motor.id} is also the id of motor {commands[motor.id] + 1}", "id_collision"
        if motor.reply_id in replies:
            other = replies[motor.reply_id] + 1
            message = f"{motor.reply_id:#x} is also the master id of motor {other}: their replies look the same"
            yield f"{key}.master", message, "id_collision"
        commands.setdefault(motor.id, k)
        replies.setdefault(motor.reply_id, k)
    for id in sorted(commands.keys() & replies.keys()):
        key = f"real.motors.{replies[id]}.master" if len(motors) > 1 else "real.motor.master"
        message = f"{id:#x} is also the id of motor {commands[id] + 1}: its commands look like replies"
        yield key, message, "id_collision"
