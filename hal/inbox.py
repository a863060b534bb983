"""What reaches an arm's servo from outside, once per tick: the newest of everything, never a queue."""

from __future__ import annotations

from typing import NamedTuple

from .commands import Kind

__all__ = ["NO_INBOX", "CommandRecord", "DeadmanRecord", "Inbox", "Session"]


class Session(NamedTuple):
    """The terms of one control session; they do not change while it lasts."""

    id: int
    speed: float
    """Share of the joint speed limits."""
    tcp_speed: float
    """Greatest speed of the tcp, m/s."""
    deadman: bool
    """Motion only while a dead-man is held."""
    move_to: tuple[float, ...] | None = None
    """Go to these joint positions (rad) and stay; None for a session that follows streamed commands."""
    stops: int = 0
    """Calls of ``rig.stop()`` that the app knew of, and had acknowledged, when it opened the session."""


class CommandRecord(NamedTuple):
    """One command as it travels: see :mod:`hal.commands` for what the values mean."""

    seq: int
    session: int
    """The session that sent it; a command of another one is ignored."""
    t: float
    """When it was sent, on the host's clock, s."""
    deadline: float
    """When the next one must have come, s."""
    kind: Kind
    values: tuple[float, ...]
    """JOINT_TARGET: q then dq; JOINT_VELOCITY: dq; JOINT_TORQUE: tau; CARTESIAN_TARGET: position and quaternion;
    TWIST: linear, angular, then 1.0 where they are given along the tcp's axes and 0.0 where along the base's;
    JOINT_CHUNK: k times, counted from ``t``, then k times q."""
    t_event: float = 0.0
    """When the pad event behind it happened, s; 0 where there is none. Only latency is computed from it."""


class DeadmanRecord(NamedTuple):
    """A dead-man switch."""

    held: bool
    connected: bool
    presses: int
    """Counts presses, so that a release between two ticks is not missed."""
    t_alive: float
    """Last proof that the pad is alive, on the host's clock, s."""


class Inbox(NamedTuple):
    """Everything that the servo looks at besides the reading."""

    command: CommandRecord | None
    deadman: DeadmanRecord | None
    stops: int
    """Counts calls of ``rig.stop()``."""
    rearms: int
    """Counts calls of ``control.rearm()``."""
    t_app: float
    """The app's heartbeat, on the host's clock, s."""


NO_INBOX = Inbox(None, None, 0, 0, 0.0)
