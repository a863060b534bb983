"""Franka's protocols 5 (Panda, FER) and 10 (FR3): requests, statuses, and the bytes of states and commands.

Known from the public headers of libfranka-common and from the behaviour of the client libraries. Which answer a
controller gives in which situation is documented only in part; where the emulator had to choose, the choice is marked
as an assumption.

Packets are little-endian and without gaps. Matrices are 4x4 by columns. Protocol 5 has states in double precision,
protocol 10 in single precision with two blocks of accelerometers; commands are doubles in both.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

from hal.drivers.franka.flags import FLAGS

# Requests.

PORT = 1337
"""TCP port, fixed in the client libraries."""
HEADER = struct.Struct("<III")
"""Header of every request and response: code, number of the request, size with this header."""


class Generator(IntEnum):
    """Quantity that a Move requests to command."""

    JOINT_POSITION = 0
    JOINT_VELOCITY = 1
    CARTESIAN_POSITION = 2
    CARTESIAN_VELOCITY = 3
    NONE = 4


class GeneratorMode(IntEnum):
    """``motion_generator_mode`` of a state: the numbers of :class:`Generator` plus one."""

    IDLE = 0
    JOINT_POSITION = 1
    JOINT_VELOCITY = 2
    CARTESIAN_POSITION = 3
    CARTESIAN_VELOCITY = 4
    NONE = 5


class Controller(IntEnum):
    """Controller that a Move requests."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    """The client sends torques."""


class ControllerMode(IntEnum):
    """``controller_mode`` of a state."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    OTHER = 3


class RequestOutcome(Enum):
    """Outcome of a request; its number depends on the request and on the protocol."""

    SUCCESS = "success"
    STARTED = "started"
    PREEMPTED = "preempted"
    NOT_POSSIBLE = "not possible"
    INVALID = "invalid argument"
    REFLEX = "aborted by a reflex"
    EMERGENCY = "aborted by a stop"
    INPUT_ERROR = "aborted: input error"
    ABORTED = "aborted"
    MANUAL = "manual recovery required"


@dataclass(frozen=True)
class RequestType:
    name: str
    size: int
    """Bytes, with the header."""
    statuses: dict[RequestOutcome, int]


_YES_NO = {RequestOutcome.SUCCESS: 0, RequestOutcome.NOT_POSSIBLE: 1}
_PLAIN = _YES_NO | {RequestOutcome.INVALID: 2}
_CONNECT = {RequestOutcome.SUCCESS: 0, RequestOutcome.NOT_POSSIBLE: 1}
_MODEL = _YES_NO | {RequestOutcome.INVALID: 1}


def _number_outcomes(first: int, *outcomes: RequestOutcome) -> dict[RequestOutcome, int]:
    return {outcome: first + k for k, outcome in enumerate(outcomes)}


_MOVE = (
    RequestOutcome.NOT_POSSIBLE,
    RequestOutcome.INVALID,
    RequestOutcome.REFLEX,
    RequestOutcome.EMERGENCY,
    RequestOutcome.INPUT_ERROR,
    RequestOutcome.ABORTED,
)
_MOVE_BEGUN = _number_outcomes(0, RequestOutcome.SUCCESS, RequestOutcome.STARTED, RequestOutcome.PREEMPTED)
# "Start at a singular pose" is between "not possible" and "invalid argument"; the emulator never sends it.
_MOVE_5 = _MOVE_BEGUN | {RequestOutcome.NOT_POSSIBLE: 3} | _number_outcomes(5, *_MOVE[1:])
_MOVE_10 = _MOVE_BEGUN | {RequestOutcome.NOT_POSSIBLE: 5} | _number_outcomes(7, *_MOVE[1:])
_STOP_5 = _YES_NO | _number_outcomes(2, RequestOutcome.EMERGENCY, RequestOutcome.REFLEX, RequestOutcome.ABORTED)
_STOP_10 = _YES_NO | _number_outcomes(3, RequestOutcome.EMERGENCY, RequestOutcome.REFLEX, RequestOutcome.ABORTED)
_RECOVERY_5 = _YES_NO | _number_outcomes(
    2, RequestOutcome.MANUAL, RequestOutcome.REFLEX, RequestOutcome.EMERGENCY, RequestOutcome.ABORTED
)
_RECOVERY_10 = _YES_NO | _number_outcomes(
    3, RequestOutcome.MANUAL, RequestOutcome.REFLEX, RequestOutcome.EMERGENCY, RequestOutcome.ABORTED
)


@dataclass(frozen=True)
class FrankaProtocol:
    version: int
    requests: dict[int, RequestType]
    """By code."""
    codes: dict[str, int]

    def status(self, name: str, outcome: RequestOutcome) -> int:
        """Return the status number of an outcome; that of "not possible" if the response has none for it."""
        statuses = self.requests[self.codes[name]].statuses
        return statuses.get(outcome, statuses[RequestOutcome.NOT_POSSIBLE])


def _protocol(version: int, requests: list[RequestType]) -> FrankaProtocol:
    return FrankaProtocol(version, dict(enumerate(requests)), {request.name: k for k, request in enumerate(requests)})


_SETTERS = [
    RequestType("SetCollisionBehavior", 428, _PLAIN),
    RequestType("SetJointImpedance", 68, _PLAIN),
    RequestType("SetCartesianImpedance", 60, _PLAIN),
    RequestType("SetGuidingMode", 19, _PLAIN),
    RequestType("SetEEToK", 140, _PLAIN),
    RequestType("SetNEToEE", 140, _PLAIN),
    RequestType("SetLoad", 116, _PLAIN),
]

PROTOCOLS = {
    5: _protocol(
        5,
        [
            RequestType("Connect", 16, _CONNECT),
            RequestType("Move", 68, _MOVE_5),
            RequestType("StopMove", 12, _STOP_5),
            RequestType("GetCartesianLimit", 16, _PLAIN),
            *_SETTERS,
            RequestType("SetFilters", 52, _PLAIN),
            RequestType("AutomaticErrorRecovery", 12, _RECOVERY_5),
            RequestType("LoadModelLibrary", 14, _MODEL),
        ],
    ),
    10: _protocol(
        10,
        [
            RequestType("Connect", 16, _CONNECT),
            RequestType("Move", 125, _MOVE_10),
            RequestType("StopMove", 12, _STOP_10),
            *_SETTERS,
            RequestType("AutomaticErrorRecovery", 12, _RECOVERY_10),
            RequestType("GetRobotModel", 12, _MODEL),
        ],
    ),
}
"""By version. A request's code is its position in the list."""


# Packets.


class PacketField(NamedTuple):
    """One field: a number of values of one kind (a letter of :mod:`struct`), ``offset`` bytes from the start."""

    offset: int
    values: int
    kind: str


class FieldSpan(NamedTuple):
    """Adjacent fields, written and read together."""

    struct: struct.Struct
    offset: int


class PacketLayout:
    def __init__(self, fields: Iterable[tuple[str, int, str]]) -> None:
        self.fields: dict[str, PacketField] = {}
        self.size = 0
        for name, count, kind in fields:
            self.fields[name] = PacketField(self.size, count, kind)
            self.size += struct.calcsize(f"<{count}{kind}")

    def span(self, first: str, last: str | None = None) -> FieldSpan:
        """Return the fields from ``first`` to ``last``, in the order of the packet."""
        names = list(self.fields)
        chosen = names[names.index(first) : names.index(last or first) + 1]
        kinds = "".join(f"{self.fields[name].values}{self.fields[name].kind}" for name in chosen)
        return FieldSpan(struct.Struct(f"<{kinds}"), self.fields[first].offset)


_REALS = (
    ("O_T_EE", 16),
    ("O_T_EE_d", 16),
    ("F_T_EE", 16),
    ("EE_T_K", 16),
    ("F_T_NE", 16),
    ("NE_T_EE", 16),
    ("m_ee", 1),
    ("I_ee", 9),
    ("F_x_Cee", 3),
    ("m_load", 1),
    ("I_load", 9),
    ("F_x_Cload", 3),
    ("elbow", 2),
    ("elbow_d", 2),
    ("tau_J", 7),
    ("tau_J_d", 7),
    ("dtau_J", 7),
    ("q", 7),
    ("q_d", 7),
    ("dq", 7),
    ("dq_d", 7),
    ("ddq_d", 7),
    ("joint_contact", 7),
    ("cartesian_contact", 6),
    ("joint_collision", 7),
    ("cartesian_collision", 6),
    ("tau_ext_hat_filtered", 7),
    ("O_F_ext_hat_K", 6),
    ("K_F_ext_hat_K", 6),
    ("O_dP_EE_d", 6),
    ("O_ddP_O", 3),
    ("elbow_c", 2),
    ("delbow_c", 2),
    ("ddelbow_c", 2),
    ("O_T_EE_c", 16),
    ("O_dP_EE_c", 6),
    ("O_ddP_EE_c", 6),
    ("theta", 7),
    ("dtheta", 7),
)
_ACCELEROMETERS = (("accelerometer_top", 18), ("accelerometer_bottom", 18))


def _state_layout(real: str, reals: Sequence[tuple[str, int]]) -> PacketLayout:
    return PacketLayout(
        [
            ("message_id", 1, "Q"),
            *((name, count, real) for name, count in reals),
            ("motion_generator_mode", 1, "B"),
            ("controller_mode", 1, "B"),
            ("errors", len(FLAGS), "B"),
            ("reflex_reason", len(FLAGS), "B"),
            ("robot_mode", 1, "B"),
            ("control_command_success_rate", 1, real),
        ]
    )


_COMMAND_5 = (
    ("message_id", 1, "Q"),
    ("q_c", 7, "d"),
    ("dq_c", 7, "d"),
    ("O_T_EE_c", 16, "d"),
    ("O_dP_EE_c", 6, "d"),
    ("elbow_c", 2, "d"),
    ("valid_elbow", 1, "B"),
    ("motion_generation_finished", 1, "B"),
    ("tau_J_d", 7, "d"),
)

STATE = {5: _state_layout("d", _REALS), 10: _state_layout("f", (*_REALS, *_ACCELEROMETERS))}
"""State packets by protocol: 2373 and 1377 bytes."""
COMMAND = {5: PacketLayout(_COMMAND_5), 10: PacketLayout((*_COMMAND_5, ("torque_command_finished", 1, "B")))}
"""Command packets by protocol: 370 and 371 bytes."""


class StatePacket:
    """A state packet that is changed in place; the fields that change every cycle are written by few calls."""

    def __init__(self, version: int) -> None:
        self.layout = STATE[version]
        self.buffer = bytearray(self.layout.size)
        self._spans = {name: self.layout.span(name) for name in self.layout.fields}
        self._joints = self.layout.span("tau_J", "ddq_d")
        self._motors = self.layout.span("theta", "dtheta")
        self._modes = self.layout.span("motion_generator_mode", "controller_mode")

    def put(self, name: str, values: Iterable[float]) -> None:
        """Write one field. Raises struct.error for a wrong number of values."""
        span = self._spans[name]
        span.struct.pack_into(self.buffer, span.offset, *values)

    def get(self, name: str) -> tuple[float, ...]:
        span = self._spans[name]
        return span.struct.unpack_from(self.buffer, span.offset)

    def spoilt(self, values: Mapping[str, float]) -> bytearray:
        """Return a copy in which each of these fields begins with that value."""
        copy = bytearray(self.buffer)
        for name, value in values.items():
            field = self.layout.fields[name]
            struct.pack_into(f"<{field.kind}", copy, field.offset, value)
        return copy

    def put_joints(self, values: Sequence[float]) -> None:
        """Write tau_J, tau_J_d, dtau_J, q, q_d, dq, dq_d, ddq_d: 56 values."""
        self._joints.struct.pack_into(self.buffer, self._joints.offset, *values)

    def put_motors(self, values: Sequence[float]) -> None:
        """Write theta and dtheta: 14 values."""
        self._motors.struct.pack_into(self.buffer, self._motors.offset, *values)

    def put_modes(self, generator: int, controller: int) -> None:
        self._modes.struct.pack_into(self.buffer, self._modes.offset, generator, controller)


class CommandPacket(NamedTuple):
    message_id: int
    q: tuple[float, ...]
    dq: tuple[float, ...]
    tau: tuple[float, ...]
    finished: bool
    """Whether the motion, or the torque control, ends; the other values are ignored then."""


_HEAD = struct.Struct("<Q7d7d")
_FINISHED = COMMAND[10].fields["motion_generation_finished"].offset
_TAU = COMMAND[10].span("tau_J_d")
_TORQUE_FINISHED = COMMAND[10].fields["torque_command_finished"].offset


def read_command(data: bytes, version: int) -> CommandPacket | None:
    """Decode a command packet; return None if it has the wrong size. Cartesian values are ignored."""
    if len(data) != COMMAND[version].size:
        return None
    head = _HEAD.unpack_from(data)
    finished = data[_FINISHED] != 0 or (version == 10 and data[_TORQUE_FINISHED] != 0)
    return CommandPacket(head[0], head[1:8], head[8:15], _TAU.struct.unpack_from(data, _TAU.offset), finished)
