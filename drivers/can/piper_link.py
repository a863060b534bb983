"""What the drivers of a PiPER's arm and gripper share: their link to the bus, and the errors that the arm reports."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from hal.errors import ConnectionLost, DeviceNotFound, Fault, HalError, RobotFault

from . import piper_protocol as protocol
from .bus import CanBus
from .piper_protocol import COMMAND_IDS, ENABLED, JOINTS, GripperStatus, PiperFeedback, PiperStatus, decode_feedback
from .settings import EMULATED_INTERFACES, BusSettings, emulator_remedy

SILENCE = 0.1
"""Silence after which the arm or the gripper counts as lost, s."""
FRESH_READS = 2
"""Number of readings after the opening for which what came until then counts as new: the first one has the time at
which the host began to open its devices."""
_OPENING = 1.0
"""Longest time to wait for a device's state when it is opened, s."""
_LEADER_IDS = range(0x3A1, 0x3A9)
"""Ids at which an arm reports that is set up as the leader of a pair."""


# Faults

_SUPPORT = (
    "support the arm by hand: clearing this with the vendor's reset, or by a restart, cuts its power and it falls"
)
_LOOK = "check what the arm touches, and its load"
_COOL = "let it cool down; lower its load or its speed"
_STATUS_FAULTS: dict[int, tuple[str, str]] = {
    0x1: ("the emergency stop was triggered: the arm sinks slowly", _SUPPORT),
    0x2: ("there is no solution for a Cartesian target", "end the other program that drives this arm"),
    0x3: ("the arm is in a singularity", "end the other program that drives this arm"),
    0x4: (
        "a target is beyond the arm's own limit",
        "compare the arm's limits with the model's (hal check --real)",
    ),
    0x5: ("the arm's controller does not reach a motor", f"check the cables along the arm; {_SUPPORT}"),
    0x6: ("a brake is not released", f"{_SUPPORT}; then restart it"),
    0x7: ("the arm has met an obstacle: collision", _LOOK),
    0x8: ("the arm was moved too fast by hand while teaching", "end teaching (the button on the arm)"),
    0x9: ("a motor reports an error", _LOOK),
    0xA: ("the arm reports an error without a name", f"look it up with the vendor's tool; {_SUPPORT}"),
    0xE: ("the arm's controller is too hot", _COOL),
    0xF: ("the brake resistor is too hot", _COOL),
}
"""Status of the arm -> cause and remedy. 0xB to 0xD (teaching) are no errors."""
_FLAG_FAULTS: dict[int, tuple[str, str, str]] = {
    protocol.OVER_CURRENT: ("over_current", "draws too much current", _LOOK),
    protocol.DRIVER_HOT: ("driver_hot", "has electronics that are too hot", _COOL),
    protocol.MOTOR_HOT: ("motor_hot", "has a motor that is too hot", _COOL),
    protocol.LOW_VOLTAGE: ("low_voltage", "has too low a voltage", "check the power supply, its plugs and its cables"),
    protocol.COLLISION: ("collision", "has met an obstacle: collision protection", _LOOK),
    protocol.STALLED: ("stalled", "is blocked: stall protection", _LOOK),
    protocol.ERROR: ("joint_error", "reports an error", f"if recovering does not help, {_SUPPORT}"),
}
"""Flag of a motor -> code, what the joint does, remedy; the most telling first."""
_CONTROL = {0: "standby", 2: "teaching", 3: "Ethernet", 4: "Wi-Fi", 5: "remote control", 6: "leader", 7: "trajectory"}


def arm_fault(status: PiperStatus, flags: Iterable[int]) -> Fault | None:
    """Return the error in the arm's state and in the flags of its motors, joint 1 first; None if there is none."""
    flags = tuple(flags)
    for bit, (code, what, remedy) in _FLAG_FAULTS.items():
        joints = join_joints(k for k, value in enumerate(flags) if value & bit)
        if joints:
            return Fault(code, f"{joints} {what}", remedy)
    if status.status not in _STATUS_FAULTS:
        return None
    cause, remedy = _STATUS_FAULTS[status.status]
    bits = {0x4: status.beyond_limit, 0x5: status.no_communication}.get(status.status, 0)
    joints = join_joints(k for k in range(JOINTS) if bits >> k & 1)
    return Fault(protocol.ARM_STATUS[status.status], f"{cause} ({joints})" if joints else cause, remedy)


def control_fault(status: PiperStatus, flags: Iterable[int]) -> Fault | None:
    """Return why an arm that was engaged no longer follows targets; None if it does."""
    off = join_joints(k for k, value in enumerate(flags) if not value & ENABLED)
    if off:
        remedy = "support the arm; check its power supply and its emergency stop, and whether another program drives it"
        return Fault("switched_off", f"{off} of the arm is off", remedy)
    if status.control != protocol.CAN_CONTROL:
        mode = _CONTROL.get(status.control, f"mode {status.control}")
        return Fault("not_in_control", f"the arm went to {mode} control", "end it (the button on the arm)")
    if status.move != protocol.MOVE_J:
        return Fault("not_in_control", "another program changed the arm's mode", "end that program")
    return None


def refusal(name: str, fault: Fault) -> RobotFault:
    return RobotFault(f"{name}: {fault.cause}", fault.remedy, code=fault.code)


def gripper_fault(status: GripperStatus) -> Fault | None:
    """Return the error that a gripper reports; None if there is none."""
    for bit, (code, what, _) in _FLAG_FAULTS.items():
        if status.flags & bit and bit not in (protocol.COLLISION, protocol.STALLED):
            return Fault(code, f"the gripper {what}", "check what it holds; the next command clears this")
    return None


def join_joints(numbers: Iterable[int]) -> str:
    """Return joints, by their index from 0, in words; empty if there are none."""
    names = [str(k + 1) for k in numbers]
    return f"joint {names[0]}" if len(names) == 1 else f"joints {', '.join(names)}" if names else ""


# Connection


def silence_remedy(bus: CanBus, source: str) -> str:
    """Return why an arm may be silent, with what to do about it; ``source`` is the rig's file."""
    if any(id in _LEADER_IDS for id in bus.unexpected_ids):
        return (
            "an arm reports at 0x3A1 and above, as the leader of a pair does: make it a follower with the vendor's "
            "tool (0x470, FC), then restart it"
        )
    if bus.settings.key[0] in EMULATED_INTERFACES:
        return emulator_remedy(source)
    return "check the arm's power, the cable (CAN_H, CAN_L), the termination, and the bit rate: hal check --real"


class PiperLink:
    """A device's use of the bus; ``handle`` takes each decoded frame with one of ``ids``, ``source`` names the rig."""

    def __init__(
        self,
        name: str,
        settings: BusSettings,
        handle: Callable[[PiperFeedback], None],
        ids: tuple[int, ...],
        source: str = "",
    ) -> None:
        self.name = name
        self.source = source
        self.settings = settings.shared
        self.bus: CanBus | None = None
        self.lost: ConnectionLost | None = None
        """Why the device counts as lost; None while it answers."""
        self._handle = handle
        self._ids = ids
        self._sent = tuple(id for id in COMMAND_IDS if id not in ids)  # the firmware's question and answer share one

    def open(self, missing: Callable[[], str]) -> None:
        """Open the bus, and wait until the device has reported; ``missing`` names what it has not, in words."""
        bus = CanBus.acquire(self.settings)
        try:
            bus.drain()  # what came before is old
            bus.subscribe({id: partial(self._receive, id) for id in self._ids}, self._sent)
        except BaseException:
            bus.release()
            raise
        self.bus, self.lost = bus, None
        deadline = time.monotonic() + _OPENING
        while missing():
            if not bus.poll() or time.monotonic() > deadline:
                error: HalError = bus.error(self.name)
                if bus.fault is None:
                    where = f"{self.settings.interface} {self.settings.channel}"
                    text = f"{self.name}: {missing()} on {where}; {silence_remedy(bus, self.source)}"
                    error = DeviceNotFound(text, code="no_answer")
                self.close()
                raise error
            time.sleep(0.002)

    def close(self) -> None:
        bus, self.bus = self.bus, None
        if bus is not None:
            bus.unsubscribe(self._ids, self._sent)
            bus.release()

    def poll(self) -> None:
        """Handle all frames that have come. Raises ConnectionLost while the bus does not work."""
        bus = self._open_bus()
        if not bus.poll():
            self.lost = bus.error(self.name)
            bus.try_reopen()
            raise self.lost

    def wait(self, done: Callable[[], bool], seconds: float) -> None:
        """Handle what comes until ``done`` returns True, at most for a time in s. Raises ConnectionLost."""
        deadline = time.monotonic() + seconds
        while not done() and time.monotonic() < deadline:
            time.sleep(0.001)
            self.poll()

    def send(self, frames: Iterable[tuple[int, bytes]]) -> bool:
        """Send frames; return whether the bus took all. Raises ConnectionLost while the device counts as lost."""
        bus = self._open_bus()
        if self.lost is not None:
            raise self.lost
        taken = [bus.send(*frame) for frame in frames]
        return all(taken)

    def lose(self, what: str) -> ConnectionLost:
        """Return the exception for a device that does not report any more, and note that it is lost."""
        remedy = silence_remedy(self._open_bus(), self.source)
        self.lost = ConnectionLost.of(self.name, Fault("silent", what, remedy))
        return self.lost

    def statistics(self) -> dict[str, Any]:
        return {} if self.bus is None else self.bus.statistics()

    def _open_bus(self) -> CanBus:
        if self.bus is None:
            raise ConnectionLost(f"{self.name} is not open", code="not_open")
        return self.bus

    def _receive(self, id: int, data: bytearray) -> None:
        record = decode_feedback(id, bytes(data))
        if record is not None:
            self._handle(record)
