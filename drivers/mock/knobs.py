"""The knobs that make a mock misbehave: one frozen record per kind of device, every default harmless."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import TypeVar

from hal.errors import CommandError

__all__ = ["CameraKnobs", "GripperKnobs", "PadKnobs", "RobotKnobs", "turned"]


@dataclass(frozen=True)
class RobotKnobs:
    """Faults of :class:`~hal.drivers.mock.robot.MockRobot`."""

    delay_s: float = 0.0
    """The arm follows each set-point this much later, s. What it says it was commanded is not delayed."""
    drop: int = 0
    """Every n-th set-point is not taken: the arm keeps the one before, and ``q_commanded`` says so. 0 for never."""
    freeze: bool = False
    """Readings repeat, stamps and number too, while the arm goes on following."""
    following_error: float | Sequence[float] = 0.0
    """Measured minus commanded position, rad: one number for all joints, or one for each."""
    disconnect: bool = False
    """Every call but ``close`` raises ConnectionLost, and the arm stops where it is."""
    garbage: str | None = None
    """Readings that cannot be: ``nan``, ``inf``, or ``short`` (one joint too few)."""
    fault: str | None = None
    """The arm reports a fault with this cause and takes no set-points, until ``recover()``."""
    tau_ext: Sequence[float] | None = None
    """External torques to report, Nm."""
    wrench_ext: Sequence[float] | None = None
    """External force and torque to report, N and Nm."""


@dataclass(frozen=True)
class GripperKnobs:
    """Faults of :class:`~hal.drivers.mock.gripper.MockGripper`, and what lies between its fingers."""

    object_width: float | None = None
    """Width of a rigid object between the fingers, m; fingers that close on it stop there. None for nothing."""
    freeze: bool = False
    """Readings repeat while the fingers go on."""
    stuck: bool = False
    """The fingers do not move, whatever they are told."""
    fail: str | None = None
    """Commands are taken, move nothing, and end as ``FAILED`` with a fault of this cause."""
    disconnect: bool = False
    """Every call but ``close`` raises ConnectionLost."""
    garbage: str | None = None
    """A width that cannot be: ``nan`` or ``inf``."""


@dataclass(frozen=True)
class CameraKnobs:
    """Faults of :class:`~hal.drivers.mock.camera.MockCamera`."""

    delay_s: float = 0.0
    """Frames are handed out this much after they were taken, s."""
    drop: int = 0
    """Every n-th frame is lost, which leaves a gap in the numbers. 0 for never."""
    freeze: bool = False
    """No new frames, though the camera is there."""
    disconnect: bool = False
    """Every call but ``close`` raises ConnectionLost."""
    garbage: str | None = None
    """Pictures that cannot be: ``shape`` (one row too few) or ``nan`` (depth without a number in it)."""


@dataclass(frozen=True)
class PadKnobs:
    """Faults of :class:`~hal.drivers.mock.gamepad.MockPad`."""

    freeze: bool = False
    """The pad stays connected and says nothing more: ``t_alive`` stops, and what is pressed stays pressed."""
    disconnect: bool = False
    """Unplugged: readings with ``connected=False``, sticks centred and nothing pressed."""


_GARBAGE = {RobotKnobs: ("nan", "inf", "short"), GripperKnobs: ("nan", "inf"), CameraKnobs: ("shape", "nan")}

_K = TypeVar("_K", RobotKnobs, GripperKnobs, CameraKnobs, PadKnobs)


def turned(knobs: _K, changes: Mapping[str, object]) -> _K:
    """``knobs`` with ``changes`` made. Raises CommandError for a knob that does not exist or a value it cannot have."""
    known = [f.name for f in fields(knobs)]
    for name in changes:
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise CommandError(f"there is no knob {name!r}{hint}; knobs: {', '.join(known)}")
    for name, value in changes.items():
        if name == "garbage" and value is not None and value not in _GARBAGE[type(knobs)]:
            raise CommandError(f"garbage must be one of {', '.join(_GARBAGE[type(knobs)])} or None, not {value!r}")
        if name in ("freeze", "disconnect", "stuck") and not isinstance(value, bool):
            raise CommandError(f"{name} must be True or False, not {value!r}")
        if name == "drop" and not (type(value) is int and value >= 0):
            raise CommandError(f"drop must be a count, 0 for never, not {value!r}")
        if name == "delay_s" and not (isinstance(value, (int, float)) and 0 <= value < float("inf")):
            raise CommandError(f"delay_s must be seconds, 0 or more, not {value!r}")
    return replace(knobs, **changes)  # type: ignore[arg-type]
