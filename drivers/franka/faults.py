"""Faults of a Franka: what each error flag, robot mode and client-library exception means, and how to fix it.

``pylibfranka`` raises classes of its own, ``panda_py`` mostly a plain RuntimeError. Both carry libfranka's message,
which :func:`fault_of_exception` interprets.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from hal.errors import Fault

from .flags import FLAG_TEXTS, LOSSY_FLAGS

ARM_PORT, HAND_PORT = 1337, 1338
"""Fixed TCP ports of the arm and of the Franka Hand."""
_CODE, _CAUSE = 48, 160
"""Largest size of a fault's code and cause in a state record, bytes (``hal/host/records.py``)."""

# Messages of the client libraries.


@dataclass(frozen=True)
class KnownError:
    """An error that is recognised by the libraries' message, other than flags and versions."""

    pattern: str
    """Regular expression for the message."""
    code: str
    cause: str
    """``{where}`` stands for the address."""
    remedy: str
    lost: bool = False
    """Whether the connection is lost with it."""

    def fault(self, where: str) -> Fault:
        """Return the fault; ``where`` is the robot's address, or "the robot"."""
        return Fault(self.code, self.cause.format(where=where), self.remedy.format(where=where))


_CABLE = "check that the robot is switched on, and that the cable goes to Control's LAN port, not to the arm's base"
_DESK_MESSAGE = "read the message in Desk, and check whether something touches the arm"
_RELEASE = "check that the arm's workspace is clear, then release the user stop (the external activation device)"

REFUSED = KnownError(
    "Connection to FCI refused",
    "refused",
    "{where} refuses: FCI is not active, another program holds the robot, or this is not a robot",
    "in Desk, unlock the joints and activate FCI; end other programs that use this arm",
    lost=True,
)
UNREACHABLE = KnownError(
    "Connection timeout",
    "unreachable",
    "no answer from {where}",
    f"{_CABLE}; compare the address with the one in Desk (Settings, Network)",
    lost=True,
)
UNKNOWN_HOST = KnownError(
    "Host not found",
    "unknown_host",
    "unknown host {where}",
    "give the robot's address as numbers, such as real: {{host: 172.16.0.2}}",
    lost=True,
)
NO_ROUTE = KnownError(
    "Connection error",
    "no_way",
    "no network of this computer leads to {where}",
    "give a network port of this computer an address in the robot's network, such as 172.16.0.1/24",
    lost=True,
)
NO_HAND = KnownError(
    REFUSED.pattern,
    "no_hand",
    "{where} refuses: there is no hand, or it is not set up in Desk",
    "connect the hand and select it in Desk as the end effector; for an arm without one, gripper: {{enabled: false}}",
    lost=True,
)
"""Meaning of a refusal at the hand's port."""

KNOWN_ERRORS = (
    # The network.
    REFUSED,
    UNREACHABLE,
    UNKNOWN_HOST,
    NO_ROUTE,
    KnownError(
        "UDP receive: Timeout",
        "silent",
        "the robot has sent no state for 1 s ({where})",
        f"{_CABLE}; if it never sent one, a firewall may block UDP (sudo iptables -L)",
        lost=True,
    ),
    KnownError(
        r"TCP connection got interrupted|server closed connection|TCP send|Net Exception|UDP (send|receive)",
        "closed",
        "the robot closed the connection ({where}): it is restarting, or FCI was deactivated in Desk",
        "wait until it has started, and activate FCI in Desk",
        lost=True,
    ),
    KnownError(
        "incorrect object size|incorrect model library|Unexpected response|protocol error",
        "packets",
        "the robot's packets do not match the client library ({where})",
        "update the robot's system; pip install -U 'robot-hal[franka]'",
        lost=True,
    ),
    KnownError(
        "position_based_velocity_limits|parse URDF|[Uu]rdf",
        "model",
        "the client library cannot read the robot model that the robot sends",
        "update the robot's system; pip install -U 'robot-hal[franka]'",
        lost=True,
    ),
    # What stops a motion, or keeps it from starting.
    KnownError(
        "User Stop pressed",
        "user_stopped",
        "the user stop was pressed; the arm holds its position",
        _RELEASE,
    ),
    KnownError(
        "safety function",
        "safety_rule",
        "a safety rule of the robot forbids external motion commands",
        "in Desk, open Watchman and disable or delete the rule that limits this motion",
    ),
    KnownError(
        "manual error recovery required",
        "manual_recovery",
        "automatic recovery cannot clear this error",
        "do what the arm's fault says; if it stays, press and release the user stop, or clear the error in Desk",
    ),
    KnownError(
        "aborted by reflex",
        "reflex",
        "the robot stopped by a reflex, without a reason",
        _DESK_MESSAGE,
    ),
    KnownError(
        "singular pose",
        "singular",
        "the arm is in a singular pose and cannot start there",
        "guide it by hand until its elbow is bent",
    ),
    KnownError(
        "invalid argument|invalid input|out of range",
        "invalid_argument",
        "the robot refused a setting as out of range",
        "check the numbers under real: in the rig file",
    ),
    KnownError(
        "infinite or NaN",
        "not_a_number",
        "a set-point was not a finite number; nothing was sent",
        "fix the program that commands the arm",
    ),
    KnownError(
        "preempted",
        "preempted",
        "another command ended the motion",
        "end the other program, or the Desk task, that uses this arm",
    ),
    KnownError(
        "while another control or read operation",
        "occupied",
        "two parts of this program used the arm at once",
        "this is an error in the driver; restart the program",
    ),
    KnownError(
        "realtime|real-time",
        "realtime",
        "the client library was denied real-time scheduling",
        "install a real-time kernel and allow rtprio; hal check prints the commands",
    ),
    # The hand.
    KnownError(
        "gripper: Command failed",
        "hand_failed",
        "the hand could not carry out the command",
        "check that the fingers can move; home the hand, which is needed once after it was switched on",
    ),
    KnownError(
        "gripper: Command aborted",
        "hand_aborted",
        "the hand's motion was stopped",
        "send the next command when the fingers are free",
    ),
    KnownError(
        "command aborted",
        "aborted",
        "the robot ended the motion, without a reason",
        "read the message in Desk",
    ),
)
"""In order of precedence. Each message was observed from the libraries themselves, libfranka 0.9 (Panda) and 0.21
(FR3); the unit tests raise them.
"""

_MODES = {
    "userstopped": Fault("user_stopped", "the user stop is pressed; the arm holds its position", _RELEASE),
    "guiding": Fault(
        "guiding",
        "the arm is being guided by hand: the guiding buttons are pressed",
        "release the guiding buttons and step back",
    ),
    "automaticerrorrecovery": Fault(
        "recovering", "the robot is recovering from an error", "wait until it is done; that takes a few seconds"
    ),
    "reflex": Fault("reflex", "the robot stopped by a reflex, without a reason", _DESK_MESSAGE),
    "other": Fault(
        "not_ready",
        "the robot is not ready: its brakes are closed, or Desk is using it",
        "in Desk, end what runs there, unlock the joints and activate FCI",
    ),
}
_MODES["recovering"] = _MODES["automaticerrorrecovery"]

_PANDA, _FR3, _HAND = 5, 10, 3
"""Protocol versions; the hand's is the same on both arms."""
_ARMS = {_PANDA: ("a Panda (FER)", "panda"), _FR3: ("an FR3", "fr3")}
"""Protocol version -> name of the arm, and its model in a rig file."""


def fault_of(names: Sequence[str], robot_mode: str, realtime_kernel: bool | None = None) -> Fault | None:
    """Return the fault that keeps the robot from moving, according to its state; None if there is none.

    Args:
        names: Flags that are set now, or that ended the last motion; in the modes ``idle`` and ``move`` they are
            history and are ignored.
        robot_mode: Mode in the spelling of any library (``Reflex``, ``kUserStopped``, ``user_stopped``).
    """
    mode = _plain(robot_mode)
    if mode in ("idle", "move"):
        return None
    if mode == "reflex" and names:
        return _fault_of_flags(names, None, realtime_kernel)
    known = _MODES.get(mode)
    return known or Fault("unknown_mode", f"the robot is in an unknown mode: {robot_mode}", "look at Desk")


def fault_of_exception(
    error: BaseException,
    *,
    host: str | None = None,
    port: int = ARM_PORT,
    realtime_kernel: bool | None = None,
) -> Fault:
    """Return the fault that an exception of ``pylibfranka`` or ``panda_py`` stands for.

    A refusal at the hand's port means that there is no hand. Without a ``host`` the texts name "the robot".
    """
    text = str(error)
    versions = _versions_in(error, text)
    if versions is not None:
        return version_fault(*versions)
    names = flags_in(text)
    if names:
        return _fault_of_flags(names, _rate_in(text), realtime_kernel)
    mode = re.search(r'in the current mode \("(\w[\w ]*)"\)', text)
    if mode is not None:
        state = "moving already" if _plain(mode[1]) == "move" else "idle, but refuses"
        busy = f"the robot refused a command: it is {state}"
        return fault_of((), mode[1]) or Fault("busy", busy, "end the motion first, or wait a moment")
    known = _known_error_in(text)
    if known is not None:
        if known is REFUSED and port == HAND_PORT:
            known = NO_HAND
        return known.fault("the robot" if host is None else f"{host}:{port}")
    message = " ".join(text.split()).removeprefix("libfranka: ") or type(error).__name__
    return Fault("libfranka", _shorten(message), "look at Desk, and run hal check")


def is_connection_lost(error: BaseException) -> bool:
    """Return whether an exception of a client library means that only a new connection helps."""
    if isinstance(error, OSError) or _versions_in(error, str(error)) is not None:
        return True
    if flags_in(str(error)):
        return False
    known = _known_error_in(str(error))
    return type(error).__name__ == "NetworkException" or (known is not None and known.lost)


def flags_in(text: str) -> tuple[str, ...]:
    """Return the error flags that a message of libfranka names, by their names in :data:`~.flags.FLAGS`.

    libfranka spells two of them differently.
    """
    words = (word.lower().removesuffix("_flag") for word in re.findall(r'"(\w+)"', text))
    return tuple(word for word in words if word in FLAG_TEXTS)


def version_fault(server: int, library: int) -> Fault:
    """Return the fault for a robot that speaks protocol ``server`` and a client library that speaks ``library``."""
    if library == _HAND:
        remedy = "update the hand's system in Desk, together with the arm's"
        return Fault("version", f"the hand speaks protocol {server}, the client library {library}", remedy)
    expected = _ARMS[library][0] if library in _ARMS else "the model in the rig file"
    cause = f"the robot speaks protocol {server}, and {expected} speaks {library}"
    if server in _ARMS:
        name, model = _ARMS[server]
        return Fault("version", f"{cause}: it is {name}", f"set model: {model} in the rig file")
    if server < _PANDA:
        return Fault("version", f"{cause}: it is a Panda with an old system", "update it to version 4.2.1 or later")
    if server < _FR3:
        remedy = "update its system in Desk until it speaks protocol 10"
        return Fault("version", f"{cause}: it is an FR3 with an older system", remedy)
    return Fault("version", f"{cause}: it is newer than this driver", "pip install -U 'robot-hal[franka]'")


def _fault_of_flags(names: Sequence[str], success_rate: float | None, realtime_kernel: bool | None) -> Fault:
    """Return the fault of the most important flag; the others are named, or counted where space is short."""
    known = [name for name in FLAG_TEXTS if name in names]
    if not known:
        return Fault(_code(names[0]), f"the robot reports an unknown flag, {names[0]}", "look at Desk")
    first, *others = known
    cause, remedy = FLAG_TEXTS[first]
    if first in LOSSY_FLAGS and success_rate:
        cause += f"; {success_rate:.0%} of the last 100 arrived in time"
    if first == "communication_constraints_violation" and realtime_kernel is False:
        remedy = f"this kernel is not a real-time kernel: install one; {remedy}"
    if others:
        also = f"{cause}; also {', '.join(others)}"
        cause = also if len(also) <= _CAUSE else f"{cause}; and {len(others)} more"
    return Fault(_code(first), cause, remedy)


def _known_error_in(text: str) -> KnownError | None:
    return next((known for known in KNOWN_ERRORS if re.search(known.pattern, text)), None)


def _code(name: str) -> str:
    """A flag's name, shortened to the size of a state record."""
    return name if len(name) <= _CODE else name.replace("motion_generator", "mg").removesuffix("_violation")[:_CODE]


def _shorten(text: str) -> str:
    return text if len(text.encode()) <= _CAUSE else text.encode()[: _CAUSE - 3].decode(errors="ignore") + "..."


def _plain(mode: str) -> str:
    """A mode's name in lower case, without ``RobotMode.``, the C++ libraries' k, blanks and underscores."""
    name = mode.rpartition(".")[2]
    if re.match(r"k[A-Z]", name):
        name = name[1:]
    return re.sub(r"[^a-z]", "", name.lower())


def _versions_in(error: BaseException, text: str) -> tuple[int, int] | None:
    """Protocol versions of the server and of the library, where they differ."""
    server, library = getattr(error, "server_version", None), getattr(error, "library_version", None)
    if isinstance(server, int) and isinstance(library, int):
        return server, library
    found = re.search(r"server version: (\d+), library version: (\d+)", text)
    return (int(found[1]), int(found[2])) if found else None


def _rate_in(text: str) -> float | None:
    found = re.search(r"control_command_success_rate: ([\d.]+)", text)
    return float(found[1].rstrip(".")) if found else None
