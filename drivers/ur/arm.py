"""Driver of a UR arm: the servo's set-points go to ``servoj`` at the controller's rate, states come by RTDE.

* ``engage`` starts the control program of ur_rtde, with the controller's watchdog; ``halt`` leaves the arm at its last
  set-point, which the program keeps. ``open`` starts no program: it works while another one runs, and in local control.
* What ends the program, or scales its speed, is a fault until ``recover``. Only that unlocks a protective stop.
"""

from __future__ import annotations

import time
from math import inf, isfinite
from typing import Any, ClassVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import ConnectionLost, Fault, RobotFault
from hal.geometry import difference
from hal.specs import RobotSpec

from .faults import (
    LOCAL,
    NOT_FOLLOWING,
    PLAYING,
    PROGRAM_STOPPED,
    PROTECTIVE_STOP,
    RUNNING,
    SAFETY,
    SILENT,
    WATCHDOG,
    mode_fault,
    safety_fault,
    scaling_fault,
)
from .link import UrLink
from .settings import UrSettings

_LONGEST_WAIT = 0.02
"""s"""
_SILENCE = 0.12
"""Time without a new state after which the connection counts as lost, s."""
_PAUSED = 0.06
"""Time between two calls of read() from which a silence is this process's own, s."""
_RECENT = 1.0
"""Time within which a silence of this computer explains the end of a program, s."""
_EXPLAIN = 0.05
"""Longest time to find out why a program ended, s."""
_FULL = 0.995
"""Share of the full speed below which set-points would run away."""
_LAG = 0.06
"""Time by which the target may follow later than by its lookahead, s, and a distance, rad: chosen."""
_POLL = 2e-4
"""s"""
FLANGE = "tool0"
"""Link of UR's models whose frame is the controller's flange."""


class UrArm(RobotDriver):
    """An arm of an e-Series or CB3 controller, as its settings say (:class:`~.settings.UrSettings`)."""

    paces_itself: ClassVar[bool] = True

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = UrSettings.of(spec)
        self.engaged = False
        self._link = UrLink(spec.name, self.settings, spec.rate_hz, find_tcp(spec) if self.settings.set_tcp else None)
        self._farthest = max(spec.limits.velocity) * (self.settings.lookahead_time + _LAG) + _LAG
        self._clear()

    def _clear(self) -> None:
        self._fault: Fault | None = None
        """Fault of a session, until recover()."""
        self._last: Reading | None = None
        self._t_new = self._t_read = -inf
        self._lost = False
        self._t_ended = inf
        """Since when the control program is over, s."""

    def open(self) -> None:
        """Connect. Nothing moves, and no program is started."""
        self.close()
        self._clear()
        try:
            self._link.open()
        except BaseException:
            self._link.close()
            raise

    def close(self) -> None:
        """End the control program: the arm holds. Idempotent."""
        self.engaged = False
        self._link.close()

    # Every cycle.

    def wait(self) -> None:
        """Wait for the next state, for a bounded time."""
        receive, last = self._link.receive, self._last
        end = time.monotonic() + _LONGEST_WAIT
        seen = last.t_device if last is not None else 0.0
        while time.monotonic() < end:
            time.sleep(_POLL)
            if receive is not None and receive.getTimestamp() != seen:
                return

    def read(self, now: float) -> Reading:
        link, last = self._link, self._last
        receive = self._find_receiver()
        if now - self._t_read > _PAUSED:  # this process did not run: what is new has yet to be received
            self._t_new = now
        self._t_read = now
        t = receive.getTimestamp()
        if last is not None and t == last.t_device:
            if now - self._t_new > _SILENCE or not receive.isConnected():
                self._lost, self.engaged = True, False
                link.lose()
                raise ConnectionLost.of(self.spec.name, SILENT)
            return last
        self._lost = False
        self._t_new = now
        target = receive.getTargetQ()
        fault = self._judge(now, receive.getSafetyMode(), receive.getRuntimeState() == PLAYING, target)
        fx, fy, fz, tx, ty, tz = receive.getActualTCPForce()  # in the controller's base: half a turn from the model's
        # A target lags by the lookahead time, so while set-points are sent the last one that was sent is reported.
        taken = link.sent if self.engaged and link.sent is not None else target
        self._last = Reading(
            now,
            t,
            round(t * self.spec.rate_hz),
            receive.getActualQ(),
            receive.getActualQd(),
            q_commanded=taken,
            wrench_ext=(-fx, -fy, fz, -tx, -ty, tz),
            fault=fault,
        )
        return self._last

    def engage(self) -> None:
        """Start the control program, or continue to: the arm holds."""
        link = self._link
        fault = self._fault or (self._last.fault if self._last is not None else None) or link.refused
        if fault is not None:
            link.refused = None
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)
        if link.ready:
            self.engaged = True
        elif not link.starting:
            link.start()

    def _find_receiver(self) -> Any:
        if self._link.receive is None:
            raise ConnectionLost(f"{self.spec.name} is not open")
        return self._link.receive

    def write(self, setpoint: Setpoint) -> bool:
        self._find_receiver()
        if self._lost:
            raise ConnectionLost.of(self.spec.name, SILENT)
        if not self._link.ready or self._fault is not None:
            return False
        self._link.send(list(setpoint.q))
        return True

    def halt(self) -> None:
        """Leave the arm at its last set-point: the control program keeps it."""

    def statistics(self) -> dict[str, Any]:
        return {"longest_gap_s": self._link.longest_gap}

    # Faults.

    def _judge(self, now: float, safety: int, playing: bool, target: list[float]) -> Fault | None:
        """Return the fault of this state; one of a session stays until recover()."""
        link = self._link
        fault = self._find_fault(safety, playing) or (
            self._judge_program(now, playing, target) if self.engaged else None
        )
        if not playing:
            link.note_stopped()
        if self.engaged and fault is not None:
            self._fault, self.engaged = fault, False
            link.end()
        return fault or self._fault

    def _find_fault(self, safety: int, playing: bool) -> Fault | None:
        """Return what keeps the arm from moving now."""
        receive = self._link.receive
        stop = safety_fault(safety)
        if stop is not None:
            return stop
        mode, slider = receive.getRobotMode(), receive.getTargetSpeedFraction()
        if mode != RUNNING:
            return mode_fault(mode)
        if not slider >= _FULL:  # also NaN
            return scaling_fault(slider, slider=True)
        scaling = receive.getSpeedScaling()
        return scaling_fault(scaling, slider=False) if self.engaged and playing and not scaling >= _FULL else None

    def _judge_program(self, now: float, playing: bool, target: list[float]) -> Fault | None:
        """Return why the control program ended, or does not follow.

        None if all is well, and for the moment that it takes to find out.
        """
        link, sent = self._link, self._link.sent
        if playing and link.ready:
            off = 0.0 if sent is None else max(abs(a - b) for a, b in zip(sent, target, strict=True))
            return None if isfinite(sum(target)) and off <= self._farthest else NOT_FOLLOWING
        if self._t_ended == inf:
            self._t_ended, link.local = now, False
            link.ask_remote()
        if not link.local and now - self._t_ended < _EXPLAIN:
            return None
        self._t_ended = inf
        if link.local:
            return LOCAL
        return WATCHDOG if now - link.t_late < _RECENT else PROGRAM_STOPPED

    def recover(self) -> None:
        """Clear a fault; unlock a protective stop. Blocks for at most 4 s.

        Raises:
            RobotFault: Where the controller is not ready; ``code`` is the fault's.
            ConnectionLost: If it does not answer.
        """
        receive = self._find_receiver()
        if self._lost:
            raise ConnectionLost.of(self.spec.name, SILENT)
        if receive.getSafetyMode() == PROTECTIVE_STOP:
            self._unlock()
        self._fault, self._t_ended = None, inf
        fault = self._find_fault(receive.getSafetyMode(), playing=False)
        if fault is not None:
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)

    def _unlock(self) -> None:
        """Unlock a protective stop. Raises RobotFault."""
        stop, receive = SAFETY[PROTECTIVE_STOP], self._link.receive
        refused = self._link.unlock()
        end = time.monotonic() + 1.0
        while not refused and receive.getSafetyMode() == PROTECTIVE_STOP and time.monotonic() < end:
            time.sleep(0.01)
        if receive.getSafetyMode() == PROTECTIVE_STOP:
            cause = f"{stop.cause}; not unlocked{refused and f': {refused}'}"
            raise RobotFault(cause, stop.remedy, code=stop.code)


def find_tcp(spec: RobotSpec) -> list[float] | None:
    """Return the model's tcp in the flange's frame, m and a rotation vector (rad); None if it is on another link."""
    k = spec.kinematics
    if k.tcp_link != FLANGE:
        return None
    return difference((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (*k.tcp_position, *k.tcp_orientation))
