"""Driver of the grippers 2F-85, 2F-140 and Hand-E of Robotiq. Tested against an emulator, not against a real one."""

from __future__ import annotations

from collections.abc import Iterator
from time import monotonic

from hal.driver import GripperDriver, GripperReading
from hal.errors import ConnectionLost, Fault
from hal.preflight import CheckResult
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .link import Link, Request, Status
from .settings import MODELS, RobotiqSettings

_ACTIVE = 3
"""gSTA of a gripper that was activated."""
_CLEARED = 0.2
"""Time after the start of an activation in which the fault from before it may still be reported, s."""
_CLOSE_TIMEOUT = 0.2
"""Time for moving fingers to take a stop before the connection is closed, s."""
_ACTIVATE = (
    "take out what is between the fingers, then let them open and close: hal calibrate gripper, or gripper.home()"
)
_FAULTS = {
    0x08: Fault("too_hot", "the gripper is above its operating temperature", "let it cool down"),
    0x0A: Fault("low_voltage", "the supply of the gripper is below its least voltage", f"check it (24 V); {_ACTIVATE}"),
    0x0B: Fault("releasing", "the gripper is opening: an automatic release was asked for", "wait until it is open"),
    0x0C: Fault("internal", "the gripper has an internal fault", f"{_ACTIVATE}; if it comes back, ask Robotiq"),
    0x0D: Fault("activation_failed", "the activation failed", f"look for what blocks the fingers; {_ACTIVATE}"),
    0x0E: Fault("overcurrent", "the gripper took too much current", _ACTIVATE),
    0x0F: Fault("released", "the gripper has opened: an automatic release was asked for", _ACTIVATE),
}
"""gFLT of the manual. 5 and 7 are those of a gripper that is not activated; 9 is over once it answers."""
_INACTIVE = Fault("not_activated", "the gripper is not activated, as after its power was off", _ACTIVATE)
_INTERRUPTED = Fault("lost", "the connection was lost during the activation", _ACTIVATE)
_LOST = Fault("lost", "the connection was lost before the gripper took the command", "give it again")


class RobotiqGripper(GripperDriver):
    """A 2F-85, 2F-140 or Hand-E (settings: :class:`~.settings.RobotiqSettings`).

    Only :meth:`home` activates the gripper, because its fingers then move, and let go of what they hold. Fingers that
    rest, or hold something, never get a stop: the gripper keeps pressing, also without a connection.
    """

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = RobotiqSettings.of(spec)
        self._figures = MODELS[self.settings.model]
        self._link = Link(spec.name, self.settings)
        self._is_open = False
        self._forget()

    def _forget(self) -> None:
        self._request = Request(0)
        """Newest request."""
        self._target: float | None = None
        """Width of the newest command, m; None before the first one."""
        self._busy = self._activating = False
        """Whether the newest command runs, and whether that is an activation."""
        self._taken, self._t_sent = True, 0.0
        """Whether the gripper has taken the newest request, and when that was sent, s."""
        self._failed: Fault | None = None
        """Why the newest command failed."""
        self._stopping = False
        """Whether a stop has yet to reach the gripper."""
        self._seq, self._t_status = 0, 0.0

    def open(self) -> None:
        """Connect, and wait for a first status. Nothing is written."""
        if not self._is_open:
            self._forget()
            self._link.open()
            self._is_open = True

    def close(self) -> None:
        """Stop moving fingers, keep a grasp as it is, and disconnect. Idempotent."""
        try:
            self.stop()
            deadline = monotonic() + _CLOSE_TIMEOUT
            while self._link.pending is not None and monotonic() < deadline:
                self._link.poll()
        except ConnectionLost:
            pass
        self._is_open = False
        self._link.close()

    # State.

    def read(self, now: float) -> GripperReading:
        offset = now - monotonic()
        status = self._poll()
        if self._stopping:
            self.stop()
        if status.t != self._t_status:
            self._seq, self._t_status = self._seq + 1, status.t
        fault = self._find_fault(status)
        if fault is not None and self._busy:
            self._failed, self._busy, self._activating = fault, False, False
        moving = self._busy = self._follow(status)
        self._activating &= moving
        width = self._width_at(status.po)
        return GripperReading(
            t=status.t + offset,
            t_device=status.t,
            seq=self._seq,
            width=width,
            width_target=width if self._target is None else self._target,
            moving=moving,
            grasped=status.obj in (1, 2) if status.gto and status.sta == _ACTIVE else None,
            outcome=None if self._failed is None else GripperOutcome.FAILED,
            fault=self._failed or fault,
        )

    def statistics(self) -> dict[str, int]:
        """Return the position that the gripper reports, which tells its ``counts``."""
        status = self._link.status
        return {} if status is None else {"count": status.po}

    def _poll(self) -> Status:
        """Return the newest status. Raises ConnectionLost: of what was not taken, only a stop is given again."""
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open", code="closed")
        try:
            self._link.poll()
        except ConnectionLost:
            if self._activating:
                self._failed = _INTERRUPTED
            elif not self._taken and self._request.gto:
                self._failed = _LOST
            elif not self._taken:
                self._stopping = True
            self._taken, self._activating = True, False
            raise
        assert self._link.status is not None
        return self._link.status

    def _find_fault(self, status: Status) -> Fault | None:
        if self._activating:  # it first clears what was before
            late = self._request.act and status.t - self._t_sent > _CLEARED
            return _FAULTS.get(status.flt) if late else None
        return _FAULTS.get(status.flt, None if status.sta == _ACTIVE else _INACTIVE)

    def _follow(self, status: Status) -> bool:
        """Send what the newest command needs next; return whether the fingers move, or are about to."""
        request = self._request
        if self._link.pending is not None:
            return True
        if self._activating:
            if not request.act and not status.act:  # the reset was taken
                self._send(Request(1))
            return status.sta != _ACTIVE or not request.act
        if status.sta != _ACTIVE:
            self._taken = True  # what it did not take is not given again after an activation by others
            return bool(status.act) and status.sta == 1
        self._taken |= status.gto == request.gto and (status.pr == request.pr or not request.gto)
        if not self._taken:
            self._send(request)
        return not self._taken or bool(status.gto and status.obj == 0)

    def _width_at(self, count: int) -> float:
        """Return the width, m, at a position, which goes with the way of the finger joint."""
        opened, closed = self.settings.counts
        width = self.spec.width_at((closed - count) / (closed - opened))
        return min(self.spec.width_max, max(0.0, width))

    def _count_at(self, width: float) -> int:
        if width <= self.spec.width_min:
            return 255  # beyond where they meet, so that they press
        opened, closed = self.settings.counts
        share = 1.0 if width >= self.spec.width_max else self.spec.travel_at(width)
        return min(255, max(0, round(closed - share * (closed - opened))))

    # Commands.

    def move(self, width: float, speed: float, force: float) -> None:
        """Move the fingers to ``width`` (m), or until they meet something, which they then hold."""
        status = self._poll()
        self._stopping = False
        self._target = min(max(width, 0.0), self.spec.width_max)
        self._activating = False
        self._failed = self._find_fault(status)
        if self._failed is None:
            speed_byte = _scale(min(speed, self.spec.speed), *self._figures.speed)
            self._send(Request(1, 1, self._count_at(self._target), speed_byte, _scale(force, *self._figures.force)))

    def home(self) -> None:
        """Activate the gripper, which moves its fingers; one that is active and has no fault stays as it is."""
        self._failed = None
        status = self._poll()
        self._stopping = False
        if self._find_fault(status) is not None:
            self._target, self._activating = None, True
            self._send(Request(0))

    def stop(self) -> None:
        """Stop moving fingers; an activation ends. What is held stays held.

        Raises:
            ConnectionLost: It does not answer; :meth:`read` stops it once it does.
        """
        self._stopping = True
        status = self._poll()
        self._stopping = False
        pending = self._link.pending
        if pending is not None and not pending.act and not self._activating:
            return  # its reset is on its way; act=1 behind it would activate again
        if self._activating or (status.act and status.sta == 1):
            self._activating = False
            self._send(Request(0))
        elif self._follow(status):
            self._send(self._request._replace(act=1, gto=0))

    def _send(self, request: Request) -> None:
        self._request = request
        if self._link.pending != request:  # repeated in every cycle, it would keep the link from reading
            self._link.pending = request
        self._busy, self._taken, self._t_sent = True, False, monotonic()


def _scale(value: float, least: float, most: float) -> int:
    """Return a number of a register, 0 for ``least`` and 255 for ``most``."""
    return min(255, max(0, round(255 * (value - least) / (most - least))))


def check(spec: GripperSpec, duration: float) -> Iterator[CheckResult]:
    """Check that a gripper answers, and that it is activated. Nothing moves."""
    driver = RobotiqGripper(spec)
    try:
        driver.open()
        reading = driver.read(monotonic())
    except ConnectionLost as error:
        found, _, remedy = str(error).partition("; ")
        yield CheckResult("gripper", "fail", found, remedy)
        return
    finally:
        driver.close()
    if reading.fault is not None:
        yield CheckResult("gripper", "warn", reading.fault.cause, reading.fault.remedy)
    else:
        state = f"answers at {driver.settings.place}, activated, {1e3 * reading.width:.0f} mm open"
        yield CheckResult("gripper", "ok", state)
