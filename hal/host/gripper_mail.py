"""How a gripper's commands and states lie in the memory that an app shares with the process that owns it."""

from __future__ import annotations

import math
import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple

from ..types import Fault, GripperOutcome, GripperState, Stamp
from . import fault_layout
from .history import History
from .mailbox import Mailbox
from .newest import newest

if TYPE_CHECKING:
    from ..driver import GripperReading

__all__ = ["GripperAct", "GripperCommand", "GripperMail", "GripperRecord"]

_COMMAND = "QQB5d"
_STATE = "ddQdd?bdQB?"
_LAYOUT = struct.Struct("<" + _STATE + fault_layout.FORMAT)
STATES = 512
"""So many states of a gripper stay readable: 2 s at 240 Hz, 5 s at 100 Hz."""
_UNKNOWN, _NO, _YES = -1, 0, 1


class GripperAct(IntEnum):
    """What a gripper is told to do."""

    MOVE = 1
    GRASP = 2
    HOME = 3
    STOP = 4


class GripperCommand(NamedTuple):
    """A gripper's newest command. Only a motion has a width (m), a speed (m/s) and a force (N)."""

    seq: int
    """Counts the commands of one gripper, from 1."""
    stops: int
    """How often ``rig.stop()`` had been called when it was sent: a later stop ends it before it begins."""
    act: GripperAct
    width: float = 0.0
    speed: float = 0.0
    force: float = 0.0
    inner: float = 0.0
    """A grasped thing may be so much narrower than ``width``, m."""
    outer: float = 0.0
    """A grasped thing may be so much wider than ``width``, m."""


class GripperRecord(NamedTuple):
    """What the process that owns a gripper says of it."""

    state: GripperState
    lost: bool
    """The device did not answer when it was asked last; ``state`` is an older one, and its fault says why."""


class GripperMail:
    """The mailboxes of one gripper."""

    def __init__(self, buffer: memoryview) -> None:
        self.command = Mailbox(buffer, _COMMAND)
        self.state = Mailbox(buffer[Mailbox.size(_COMMAND) :], _STATE + fault_layout.FORMAT, STATES)
        self.history = History(self.state, _state)
        """The last :data:`STATES` states."""
        self.get_command = newest(self.command, _command)
        """The newest command; None before the first one."""
        self.get = newest(self.state, _record)
        """The newest record; None before the first one."""

    @classmethod
    def size(cls) -> int:
        """Bytes that the mailboxes take."""
        return Mailbox.size(_COMMAND) + Mailbox.size(_STATE + fault_layout.FORMAT, STATES)

    def put_command(self, command: GripperCommand) -> None:
        """Tell the gripper what to do; the newest command wins."""
        self.command.write(*command)

    def put(
        self,
        reading: GripperReading,
        target_seq: int = 0,
        outcome: GripperOutcome = GripperOutcome.NONE,
        fault: Fault | None = None,
        lost: bool = False,
    ) -> None:
        """Publish a reading, and how the command with the number ``target_seq`` goes."""
        grasped = _UNKNOWN if reading.grasped is None else (_YES if reading.grasped else _NO)
        force = math.nan if reading.force is None else reading.force
        values = (*reading[:6], grasped, force, target_seq, outcome, lost)  # reading: t .. moving
        self.state.write(*values, *fault_layout.fault_values(fault))


def _command(values: tuple[Any, ...]) -> GripperCommand:
    seq, stops, act, *numbers = values
    return GripperCommand(seq, stops, GripperAct(act), *numbers)


def _record(values: tuple[Any, ...]) -> GripperRecord:
    t, t_device, seq, width, target, moving, grasped, force, target_seq, outcome, lost, *fault = values
    state = GripperState(
        stamp=Stamp(t, t_device, seq),
        width=width,
        width_target=target,
        moving=moving,
        grasped=None if grasped == _UNKNOWN else grasped == _YES,
        force=None if math.isnan(force) else force,
        outcome=GripperOutcome(outcome),
        fault=fault_layout.fault_of(*fault),
        target_seq=target_seq,
    )
    return GripperRecord(state, lost)


def _state(record: bytes) -> GripperState:
    return _record(_LAYOUT.unpack(record)).state
