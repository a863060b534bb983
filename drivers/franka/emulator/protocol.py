"""Franka's protocols 5 (Panda, FER) and 10 (FR3): requests with their codes and sizes, statuses, enumerations.

Known from the public headers of libfranka-common and from what the client libraries do. What a controller answers in
which situation is documented only in part; where the emulator had to choose, the choice is called an assumption.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum, IntEnum

__all__ = [
    "HEADER",
    "PORT",
    "PROTOCOLS",
    "Controller",
    "ControllerMode",
    "Generator",
    "GeneratorMode",
    "Outcome",
    "Protocol",
    "Request",
    "RobotMode",
]

PORT = 1337
"""TCP; the client library knows no other."""
HEADER = struct.Struct("<III")
"""Before every request and response: code, number of the request, size with this header."""


class RobotMode(IntEnum):
    """``robot_mode`` of a state."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERY = 6


class Generator(IntEnum):
    """What a Move asks to command."""

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
    """Which controller a Move asks for."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    """Torques come from the client."""


class ControllerMode(IntEnum):
    """``controller_mode`` of a state."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    OTHER = 3


class Outcome(Enum):
    """What became of a request; its number depends on the request and on the protocol."""

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
class Request:
    """One kind of request."""

    name: str
    size: int
    """Bytes, with the header."""
    statuses: dict[Outcome, int]


_YES_NO = {Outcome.SUCCESS: 0, Outcome.NOT_POSSIBLE: 1}
_PLAIN = _YES_NO | {Outcome.INVALID: 2}
_CONNECT = {Outcome.SUCCESS: 0, Outcome.NOT_POSSIBLE: 1}
_MODEL = _YES_NO | {Outcome.INVALID: 1}


def _numbered(first: int, *outcomes: Outcome) -> dict[Outcome, int]:
    return {outcome: first + k for k, outcome in enumerate(outcomes)}


_MOVE = (Outcome.NOT_POSSIBLE, Outcome.INVALID, Outcome.REFLEX, Outcome.EMERGENCY, Outcome.INPUT_ERROR, Outcome.ABORTED)
_MOVE_BEGUN = _numbered(0, Outcome.SUCCESS, Outcome.STARTED, Outcome.PREEMPTED)
# "Start at a singular pose" lies between "not possible" and "invalid argument"; the emulator never says it.
_MOVE_5 = _MOVE_BEGUN | {Outcome.NOT_POSSIBLE: 3} | _numbered(5, *_MOVE[1:])
_MOVE_10 = _MOVE_BEGUN | {Outcome.NOT_POSSIBLE: 5} | _numbered(7, *_MOVE[1:])
_STOP_5 = _YES_NO | _numbered(2, Outcome.EMERGENCY, Outcome.REFLEX, Outcome.ABORTED)
_STOP_10 = _YES_NO | _numbered(3, Outcome.EMERGENCY, Outcome.REFLEX, Outcome.ABORTED)
_RECOVERY_5 = _YES_NO | _numbered(2, Outcome.MANUAL, Outcome.REFLEX, Outcome.EMERGENCY, Outcome.ABORTED)
_RECOVERY_10 = _YES_NO | _numbered(3, Outcome.MANUAL, Outcome.REFLEX, Outcome.EMERGENCY, Outcome.ABORTED)


@dataclass(frozen=True)
class Protocol:
    """One version of the protocol."""

    version: int
    requests: dict[int, Request]
    """By code."""
    codes: dict[str, int]

    def status(self, name: str, outcome: Outcome) -> int:
        """The number that says so in a response; "not possible" where the response has none for it."""
        statuses = self.requests[self.codes[name]].statuses
        return statuses.get(outcome, statuses[Outcome.NOT_POSSIBLE])


def _protocol(version: int, requests: list[Request]) -> Protocol:
    return Protocol(version, dict(enumerate(requests)), {request.name: k for k, request in enumerate(requests)})


_SETTERS = [
    Request("SetCollisionBehavior", 428, _PLAIN),
    Request("SetJointImpedance", 68, _PLAIN),
    Request("SetCartesianImpedance", 60, _PLAIN),
    Request("SetGuidingMode", 19, _PLAIN),
    Request("SetEEToK", 140, _PLAIN),
    Request("SetNEToEE", 140, _PLAIN),
    Request("SetLoad", 116, _PLAIN),
]

PROTOCOLS = {
    5: _protocol(
        5,
        [
            Request("Connect", 16, _CONNECT),
            Request("Move", 68, _MOVE_5),
            Request("StopMove", 12, _STOP_5),
            Request("GetCartesianLimit", 16, _PLAIN),
            *_SETTERS,
            Request("SetFilters", 52, _PLAIN),
            Request("AutomaticErrorRecovery", 12, _RECOVERY_5),
            Request("LoadModelLibrary", 14, _MODEL),
        ],
    ),
    10: _protocol(
        10,
        [
            Request("Connect", 16, _CONNECT),
            Request("Move", 125, _MOVE_10),
            Request("StopMove", 12, _STOP_10),
            *_SETTERS,
            Request("AutomaticErrorRecovery", 12, _RECOVERY_10),
            Request("GetRobotModel", 12, _MODEL),
        ],
    ),
}
"""By version. A request's code is its place in the list."""
