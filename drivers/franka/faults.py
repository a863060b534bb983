"""A Franka's faults as states: what a flag, a mode or an exception of the client libraries means, and what mends it.

``pylibfranka`` raises classes of its own, ``panda_py`` mostly a plain RuntimeError; both carry libfranka's text, and
that is what is understood here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from hal.types import Fault

from .fault_texts import FLAG_TEXTS, LOSSY
from .troubles import NO_HAND, REFUSED, Trouble

__all__ = ["ARM_PORT", "HAND_PORT", "fault_of", "fault_of_exception", "flags_in", "is_connection_lost", "version_fault"]

ARM_PORT, HAND_PORT = 1337, 1338
"""The client libraries know no others."""
_CODE, _CAUSE = 48, 160
"""Bytes that a fault's code and cause may have (``hal/host/records.py``)."""
_ALL = 0.995
"""A success rate above this says nothing: it was looked at before the packets went missing."""
_CALM = ("idle", "move")
_MODES = {
    "userstopped": Fault(
        "user_stopped",
        "the user stop is pressed; the joints hold by themselves",
        "see that nobody is in the arm's way, then release the user stop (the external activation device)",
    ),
    "guiding": Fault(
        "guiding",
        "somebody guides the arm by hand: the guiding buttons are pressed",
        "let go of the guiding buttons and step back",
    ),
    "automaticerrorrecovery": Fault(
        "recovering", "the robot is recovering from an error", "wait until it is done; that takes a few seconds"
    ),
    "reflex": Fault(
        "reflex",
        "the robot stopped by a reflex, and does not say why",
        "look at the message in Desk, and whether something touches the arm",
    ),
    "other": Fault(
        "not_ready",
        "the robot is not ready: its brakes are closed, or Desk is using it",
        "in Desk, end what runs there, unlock the joints and activate FCI",
    ),
}
_MODES["recovering"] = _MODES["automaticerrorrecovery"]
_PANDA, _FR3, _HAND = 5, 10, 3
"""Protocols; that of the hand is the same on both arms."""
_ARMS = {_PANDA: ("a Panda (FER)", "panda"), _FR3: ("an FR3", "fr3")}
"""Protocol -> the arm in words, and its model."""


def fault_of(
    names: Sequence[str],
    robot_mode: str,
    success_rate: float | None = None,
    realtime_kernel: bool | None = None,
) -> Fault | None:
    """What keeps the robot from moving, by its state; None where nothing does.

    ``names`` are the flags that are set now, or that ended the last motion: in the modes ``idle`` and ``move`` they
    are history. ``robot_mode`` is spelt as any of the libraries does (``Reflex``, ``kUserStopped``, ``user_stopped``).
    ``success_rate`` is the share of the last 100 set-points that came in time, ``realtime_kernel`` whether this
    computer has one; None where nobody knows.
    """
    mode = _plain(robot_mode)
    if mode in _CALM:
        return None
    if mode == "reflex" and names:
        return _fault_of_flags(names, success_rate, realtime_kernel)
    known = _MODES.get(mode)
    return known or Fault(
        "unknown_mode", f"the robot is in a mode that is not known here: {robot_mode}", "look at Desk"
    )


def fault_of_exception(
    error: BaseException,
    *,
    host: str | None = None,
    port: int = ARM_PORT,
    success_rate: float | None = None,
    realtime_kernel: bool | None = None,
) -> Fault:
    """What an exception of a client library means. The rest is as in :func:`fault_of`."""
    text = str(error)
    versions = _versions_in(error, text)
    if versions is not None:
        return version_fault(*versions)
    names = flags_in(text)
    if names:
        rate = _rate_in(text)
        return _fault_of_flags(names, success_rate if rate is None else rate, realtime_kernel)
    mode = re.search(r'in the current mode \("(\w[\w ]*)"\)', text)
    if mode is not None:
        return fault_of((), mode[1]) or _busy(mode[1])
    trouble = Trouble.in_text(text)
    if trouble is not None:
        if trouble is REFUSED and port == HAND_PORT:
            trouble = NO_HAND
        return trouble.fault("the robot" if host is None else f"{host}:{port}")
    told = " ".join(text.split()).removeprefix("libfranka: ") or type(error).__name__
    return Fault("libfranka", _cut(told), "look at Desk, and run hal-check")


def is_connection_lost(error: BaseException) -> bool:
    """Is the robot gone, as far as this object of the library is concerned? Then only a new one helps."""
    if isinstance(error, OSError) or _versions_in(error, str(error)) is not None:
        return True
    if flags_in(str(error)):
        return False
    trouble = Trouble.in_text(str(error))
    return type(error).__name__ == "NetworkException" or (trouble is not None and trouble.lost)


def flags_in(text: str) -> tuple[str, ...]:
    """The error flags that a text of libfranka names, by their names in :data:`~.flags.FLAGS`.

    Two of them are spelt differently there.
    """
    words = (word.lower().removesuffix("_flag") for word in re.findall(r'"(\w+)"', text))
    return tuple(word for word in words if word in FLAG_TEXTS)


def version_fault(server: int, library: int) -> Fault:
    """The robot speaks protocol ``server``, the client library ``library``."""
    if library == _HAND:
        remedy = "bring the hand's system up to date in Desk, together with the arm's"
        return Fault("version", f"the hand speaks protocol {server}, the client library {library}", remedy)
    expected = _ARMS[library][0] if library in _ARMS else "the model in the rig's file"
    cause = f"the robot speaks protocol {server}, and {expected} speaks {library}"
    if server in _ARMS:
        name, model = _ARMS[server]
        return Fault("version", f"{cause}: it is {name}", f"say model: {model} in the rig's file")
    if server < _PANDA:
        return Fault("version", f"{cause}: it is a Panda with an old system", "bring it to version 4.2.1 or later")
    if server < _FR3:
        remedy = "bring its system up to date in Desk, until it speaks protocol 10"
        return Fault("version", f"{cause}: it is an FR3 with an older system", remedy)
    return Fault("version", f"{cause}: it is newer than this driver", "pip install -U 'robot-hal[franka]'")


def _fault_of_flags(names: Sequence[str], success_rate: float | None, realtime_kernel: bool | None) -> Fault:
    """The most telling flag, and which others there are, or how many."""
    known = [name for name in FLAG_TEXTS if name in names]
    if not known:
        return Fault(_code(names[0]), f"the robot reports {names[0]}, which is not known here", "look at Desk")
    first, *others = known
    cause, remedy = FLAG_TEXTS[first]
    if first in LOSSY and success_rate:
        cause += f"; {success_rate:.0%} of the last 100 came in time"
    if first == "communication_constraints_violation" and realtime_kernel is False:
        remedy = f"this kernel is not a real-time kernel: install one; {remedy}"
    if others:
        also = f"{cause}; also {', '.join(others)}"
        cause = also if len(also) <= _CAUSE else f"{cause}; and {len(others)} more"
    return Fault(_code(first), cause, remedy)


def _code(name: str) -> str:
    """A flag's name, shortened where it is too long for a state in memory."""
    return name if len(name) <= _CODE else name.replace("motion_generator", "mg").removesuffix("_violation")[:_CODE]


def _cut(text: str) -> str:
    return text if len(text.encode()) <= _CAUSE else text.encode()[: _CAUSE - 3].decode(errors="ignore") + "..."


def _plain(mode: str) -> str:
    """A mode's name in small letters, without ``RobotMode.``, the C++ libraries' k, blanks and underscores."""
    name = mode.rpartition(".")[2]
    if re.match(r"k[A-Z]", name):
        name = name[1:]
    return re.sub(r"[^a-z]", "", name.lower())


def _busy(mode: str) -> Fault:
    doing = "moving already" if _plain(mode) == "move" else "idle, and refuses all the same"
    return Fault("busy", f"the robot refused a command: it is {doing}", "end the motion first, or wait a moment")


def _versions_in(error: BaseException, text: str) -> tuple[int, int] | None:
    """The server's protocol and the library's, where the two do not fit."""
    server, library = getattr(error, "server_version", None), getattr(error, "library_version", None)
    if isinstance(server, int) and isinstance(library, int):
        return server, library
    found = re.search(r"server version: (\d+), library version: (\d+)", text)
    return (int(found[1]), int(found[2])) if found else None


def _rate_in(text: str) -> float | None:
    found = re.search(r"control_command_success_rate: ([\d.]+)", text)
    return float(found[1].rstrip(".")) if found else None
