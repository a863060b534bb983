"""The bytes of state and command packets: which field lies where, in the two protocols that the emulator speaks.

Packets are little-endian and without gaps. Matrices are 4x4, column by column. Protocol 5 (Panda) has states in double
precision, protocol 10 (FR3) in single precision with two blocks of accelerometers; commands are doubles in both.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

__all__ = ["COMMAND", "STATE", "CommandPacket", "Layout", "Span", "StatePacket", "read_command"]

FLAG_COUNT = 41


class Field(NamedTuple):
    """One field: so many values of one kind (a letter of :mod:`struct`), ``offset`` bytes from the start."""

    offset: int
    values: int
    kind: str


class Span(NamedTuple):
    """Fields that lie side by side, written and read in one go."""

    struct: struct.Struct
    offset: int


class Layout:
    """Named fields of one kind of packet."""

    def __init__(self, fields: Iterable[tuple[str, int, str]]) -> None:
        self.fields: dict[str, Field] = {}
        self.size = 0
        for name, count, kind in fields:
            self.fields[name] = Field(self.size, count, kind)
            self.size += struct.calcsize(f"<{count}{kind}")

    def span(self, first: str, last: str | None = None) -> Span:
        """The fields from ``first`` to ``last``, in the order of the packet."""
        names = list(self.fields)
        chosen = names[names.index(first) : names.index(last or first) + 1]
        kinds = "".join(f"{self.fields[name].values}{self.fields[name].kind}" for name in chosen)
        return Span(struct.Struct(f"<{kinds}"), self.fields[first].offset)


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


def _state(real: str, reals: Sequence[tuple[str, int]]) -> Layout:
    return Layout(
        [
            ("message_id", 1, "Q"),
            *((name, count, real) for name, count in reals),
            ("motion_generator_mode", 1, "B"),
            ("controller_mode", 1, "B"),
            ("errors", FLAG_COUNT, "B"),
            ("reflex_reason", FLAG_COUNT, "B"),
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

STATE = {5: _state("d", _REALS), 10: _state("f", (*_REALS, *_ACCELEROMETERS))}
"""By protocol: 2373 and 1377 bytes."""
COMMAND = {5: Layout(_COMMAND_5), 10: Layout((*_COMMAND_5, ("torque_command_finished", 1, "B")))}
"""By protocol: 370 and 371 bytes."""


class StatePacket:
    """A state packet that is kept and changed in place; what changes in every cycle is written by few calls."""

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
        """Read one field back."""
        span = self._spans[name]
        return span.struct.unpack_from(self.buffer, span.offset)

    def put_joints(self, values: Sequence[float]) -> None:
        """Write tau_J, tau_J_d, dtau_J, q, q_d, dq, dq_d, ddq_d: 56 values."""
        self._joints.struct.pack_into(self.buffer, self._joints.offset, *values)

    def put_motors(self, values: Sequence[float]) -> None:
        """Write theta and dtheta: 14 values."""
        self._motors.struct.pack_into(self.buffer, self._motors.offset, *values)

    def put_modes(self, generator: int, controller: int) -> None:
        """Write the modes of motion generator and controller."""
        self._modes.struct.pack_into(self.buffer, self._modes.offset, generator, controller)


class CommandPacket(NamedTuple):
    """What a client sends in answer to a state."""

    message_id: int
    q: tuple[float, ...]
    dq: tuple[float, ...]
    tau: tuple[float, ...]
    finished: bool
    """The motion, or the torque control, is to end; the other values do not count then."""


_HEAD = struct.Struct("<Q7d7d")
_FINISHED = COMMAND[10].fields["motion_generation_finished"].offset
_TAU = COMMAND[10].span("tau_J_d")
_TORQUE_FINISHED = COMMAND[10].fields["torque_command_finished"].offset


def read_command(data: bytes, version: int) -> CommandPacket | None:
    """Take a command packet apart; None where it has the wrong size. Cartesian values are not looked at."""
    if len(data) != COMMAND[version].size:
        return None
    head = _HEAD.unpack_from(data)
    finished = data[_FINISHED] != 0 or (version == 10 and data[_TORQUE_FINISHED] != 0)
    return CommandPacket(head[0], head[1:8], head[8:15], _TAU.struct.unpack_from(data, _TAU.offset), finished)
