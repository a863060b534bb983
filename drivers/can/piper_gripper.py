"""Driver of the gripper of an AgileX PiPER, on the bus of its arm."""

from __future__ import annotations

from math import inf

from hal.driver import GripperDriver, GripperReading
from hal.errors import Fault
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .piper_link import FRESH_READS, SILENCE, PiperLink, gripper_fault
from .piper_protocol import ENABLED, GRIPPER_IDS, GripperRequest, GripperStatus, PiperFeedback
from .settings import PiperGripperSettings

_AT_REST = 0.15
"""Time without motion after which the fingers are at rest, s."""
_STILL = 2e-4
"""Largest change of the width of fingers at rest, m."""
_BLOCKED, _PRESSING = 0.05, 0.5
"""Fingers press on something that have not moved for so long, s, with this share of the commanded torque."""
_LARGEST_TORQUE = 5.0
"""Nm."""
_CLEARED = 0.05
"""Time after a command in which the gripper may still report what that clears, s."""
_OFF = Fault(
    "switched_off",
    "the gripper went off: what it held may be loose",
    "check the arm's power supply; give the command again",
)


class PiperGripper(GripperDriver):
    """The gripper of a PiPER (settings: :class:`~.settings.PiperGripperSettings`), on the bus of its arm.

    The gripper has no speed of its own, so the target runs along at the speed of the command. It holds its last target
    for ever, with the torque of the command.
    """

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = PiperGripperSettings.of(spec)
        self._link = PiperLink(spec.name, self.settings, self._take, GRIPPER_IDS)
        self._forget()

    def _forget(self) -> None:
        self._now = -inf
        self._reads = 0
        self._status: GripperStatus | None = None
        self._t_status = -inf
        self._seq = 0
        self._target: float | None = None
        """Width of the newest command, m; None before the first one."""
        self._ramp: float | None = None
        """Width that the gripper was sent last, m; None before the first command."""
        self._goal = 0.0
        """Width at which the ramp ends, m."""
        self._speed = 0.0
        self._torque = 0.0
        self._stopped = True
        self._was_on = False
        """Whether the gripper has been on since the newest command."""
        self._t_command = -inf
        """When that was given, s."""
        self._t_moved = self._t_still = -inf
        """Last time at which the fingers moved, or should have, s; and since when they have not moved."""
        self._still_at = 0.0

    def open(self) -> None:
        """Connect, and wait until the gripper has reported. Nothing is sent."""
        if self._link.bus is None:
            self._forget()
            self._link.open(lambda: "" if self._status is not None else "no gripper reports (0x2A8)")

    def close(self) -> None:
        """Give up the bus. The gripper holds its last target."""
        self._link.close()

    def read(self, now: float) -> GripperReading:
        if self._reads < FRESH_READS:  # what came while it was opened
            self._reads += 1
            self._t_status = now
        dt, self._now = max(0.0, now - self._now), now
        self._link.poll()
        status = self._status
        if status is None or now - self._t_status > SILENCE:
            self._stopped = True
            raise self._link.lose(f"the gripper has sent nothing for {1e3 * SILENCE:.0f} ms")
        self._link.lost = None
        fault = self._find_fault(status)
        if fault is not None:
            self._stopped = True
        if abs(status.width - self._still_at) > _STILL:
            self._still_at, self._t_moved, self._t_still = status.width, now, now
        self._advance(dt)
        moving = not self._stopped and (self._ramp != self._goal or now - self._t_moved < _AT_REST)
        blocked = status.width - self._goal > self.settings.tolerance
        return GripperReading(
            t=self._t_status,
            t_device=self._t_status,
            seq=self._seq,
            width=status.width,
            width_target=status.width if self._target is None else self._target,
            moving=moving,
            grasped=self._target is not None and not moving and not self._stopped and blocked,
            force=abs(status.torque) * self.settings.force_per_torque,
            outcome=None if fault is None else GripperOutcome.FAILED,
            fault=fault,
        )

    def _find_fault(self, status: GripperStatus) -> Fault | None:
        """Return why the newest command failed; None before the first one."""
        if self._t_status <= self._t_command + _CLEARED:
            return None
        on = bool(status.flags & ENABLED)
        off = _OFF if self._was_on and not on else None
        self._was_on |= on and self._target is not None
        return (gripper_fault(status) if self._target is not None else None) or off

    def _advance(self, dt: float) -> None:
        """Move the target along at the speed of the command, and send it."""
        if self._stopped or self._ramp is None or self._ramp == self._goal:
            return
        step, rest = self._speed * min(dt, _AT_REST), self._goal - self._ramp
        self._ramp = self._goal if abs(rest) <= step else self._ramp + (step if rest > 0.0 else -step)
        self._t_moved = self._now
        self._send(self._ramp, clear=False)

    def _send(self, width: float, clear: bool) -> None:
        self._link.send([GripperRequest(width, self._torque, clear_error=clear).frame()])

    def _take(self, record: PiperFeedback) -> None:
        if type(record) is GripperStatus:
            self._status = record
            self._t_status = self._now
            self._seq += 1

    def move(self, width: float, speed: float, force: float) -> None:
        self._link.send(())  # raises if it is lost
        status = self._status
        assert status is not None
        widest = self.spec.width_max
        self._target = self._goal = min(max(width, 0.0), widest)
        present = min(max(status.width, 0.0), widest)
        if self._ramp is None or not status.flags & ENABLED:
            self._ramp = present
        elif self._goal > self._ramp:  # fingers that an object stopped start to open where they are
            self._ramp = min(max(self._ramp, present), self._goal)
        self._speed = min(speed, self.spec.speed)
        self._torque = min(max(force / self.settings.force_per_torque, 0.0), _LARGEST_TORQUE)
        self._stopped = self._was_on = False
        self._t_moved = self._t_command = self._now
        self._send(self._ramp, clear=gripper_fault(status) is not None)

    def stop(self) -> None:
        """Keep the fingers where they are; an object that they hold stays held with the same torque."""
        self._link.send(())
        status, ramp = self._status, self._ramp
        if status is None or ramp is None or (ramp == self._goal and self._now - self._t_moved >= _AT_REST):
            return
        if abs(status.torque) < _PRESSING * self._torque or self._now - self._t_still < _BLOCKED:
            ramp = min(max(status.width, 0.0), self.spec.width_max)  # the target is ahead of slow fingers
            self._send(ramp, clear=False)
        self._ramp = self._goal = ramp
