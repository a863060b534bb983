"""The faults that mock devices can have: one frozen record per kind of device; by default there are none.

:class:`MockDevice` is what the devices share: setting faults, and being unplugged or closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Generic, TypeVar

from hal.errors import CommandError, ConnectionLost, suggest


@dataclass(frozen=True)
class MockRobotFaults:
    """Faults of :class:`~hal.drivers.mock.robot.MockRobot`."""

    delay_s: float = 0.0
    """Delay with which the arm follows each set-point, s. The commanded position that it reports is not delayed."""
    drop: int = 0
    """Every n-th set-point is lost: the arm keeps the one before, and reports that as ``q_commanded``. 0 for never."""
    freeze: bool = False
    """Readings repeat, with their stamps and number, while the arm still follows its set-points."""
    following_error: float | Sequence[float] = 0.0
    """Measured minus commanded position, rad: one number for all joints, or one for each."""
    disconnect: bool = False
    """Every call except ``close`` raises ConnectionLost, and the arm stops where it is."""
    garbage: str | None = None
    """Invalid readings: ``nan``, ``inf``, or ``short`` (one joint too few)."""
    garbage_in: str = "q"
    """The field of :class:`~hal.driver.Reading` that begins with that ``nan`` or ``inf``."""
    fault: str | None = None
    """The arm reports a fault with this cause and ignores set-points, until ``recover()``."""
    tau_ext: Sequence[float] | None = None
    """External torques to report, Nm."""
    wrench_ext: Sequence[float] | None = None
    """External force and torque to report, N and Nm."""


@dataclass(frozen=True)
class MockGripperFaults:
    """Faults of :class:`~hal.drivers.mock.robot.MockGripper`, and an object between its fingers."""

    object_width: float | None = None
    """Width of a rigid object between the fingers, m; closing fingers stop there. None for no object."""
    freeze: bool = False
    """Readings repeat while the fingers move on."""
    stuck: bool = False
    """The fingers do not move."""
    fail: str | None = None
    """Commands are accepted, move nothing, and end as ``FAILED`` with a fault of this cause."""
    disconnect: bool = False
    """Every call except ``close`` raises ConnectionLost."""
    garbage: str | None = None
    """An invalid width: ``nan`` or ``inf``."""


@dataclass(frozen=True)
class MockCameraFaults:
    """Faults of :class:`~hal.drivers.mock.camera.MockCamera`."""

    delay_s: float = 0.0
    """Delay between a frame's capture and its delivery, s."""
    drop: int = 0
    """Every n-th frame is lost, which leaves a gap in the sequence numbers. 0 for never."""
    freeze: bool = False
    """No new frames, although the camera is connected."""
    disconnect: bool = False
    """Every call except ``close`` raises ConnectionLost."""
    garbage: str | None = None
    """Invalid pictures: ``shape`` (one row too few) or ``nan`` (depth of NaN only)."""


@dataclass(frozen=True)
class MockPadFaults:
    """Faults of :class:`~hal.drivers.mock.gamepad.MockPad`."""

    freeze: bool = False
    """The pad stays connected and silent: ``t_alive`` stops, and pressed buttons stay pressed."""
    disconnect: bool = False
    """The pad is unplugged: readings with ``connected=False``, sticks centred and no button pressed."""


FIELDS = ("q", "dq", "tau", "q_commanded", "dq_commanded", "tau_ext", "wrench_ext", "tau_commanded")
"""Fields of a reading that hold numbers of joints, or a wrench."""
_GARBAGE = {
    MockRobotFaults: ("nan", "inf", "short"),
    MockGripperFaults: ("nan", "inf"),
    MockCameraFaults: ("shape", "nan"),
}

_F = TypeVar("_F", MockRobotFaults, MockGripperFaults, MockCameraFaults, MockPadFaults)


class MockDevice(Generic[_F]):
    """A device in memory with faults."""

    kind: ClassVar[str]
    """What it is called in messages."""
    spec: Any
    faults: _F
    is_open = False

    def inject(self, **faults: object) -> None:
        """Set fields of :attr:`faults`; those that are not named stay as they are.

        Raises CommandError if there is no such fault (code ``unknown_fault``), or it cannot have that value
        (``bad_fault_value``); nothing changes.
        """
        known = [f.name for f in fields(self.faults)]
        for name, value in faults.items():
            if name not in known:
                raise CommandError(f"unknown fault {name!r}{suggest(name, known)}", code="unknown_fault")
            expected = _describe_expected(name, value, _GARBAGE.get(type(self.faults), ()))
            if expected is not None:
                raise CommandError(f"{name} must be {expected}, not {value!r}", code="bad_fault_value")
        self.faults = replace(self.faults, **faults)  # type: ignore[arg-type]

    def clear(self) -> None:
        """Remove every fault, and the object of a gripper."""
        self.faults = type(self.faults)()

    def _expect_connected(self) -> None:
        if self.faults.disconnect:
            raise ConnectionLost(f"{self.kind} {self.spec.name!r} does not answer (the mock's fault 'disconnect')")

    def _expect_open(self) -> None:
        self._expect_connected()
        if not self.is_open:
            raise ConnectionLost(f"{self.kind} {self.spec.name!r} is not open")


def _describe_expected(name: str, value: object, garbage: Sequence[str]) -> str | None:
    """Return what the fault's value must be; None where ``value`` is right."""
    if name == "garbage" and value is not None and value not in garbage:
        return f"one of {', '.join(garbage)} or None"
    if name == "garbage_in" and value not in FIELDS:
        return f"one of {', '.join(FIELDS)}"
    if name in ("freeze", "disconnect", "stuck") and not isinstance(value, bool):
        return "True or False"
    if name == "drop" and not (type(value) is int and value >= 0):
        return "a count, 0 for never"
    if name == "delay_s" and not (isinstance(value, (int, float)) and 0 <= value < float("inf")):
        return "seconds, 0 or more"
    return None
