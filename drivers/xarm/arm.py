"""Driver of a UFACTORY arm: the servo's set-points go to ``set_servo_angle_j``, states come from port 30003.

* ``engage`` switches the motors on and sets servo mode (mode 1); ``halt`` leaves the arm at its last set-point.
  ``open`` does neither: it works while another program moves the arm.
* In servo mode the controller executes each set-point at once, and keeps the last one. So silence stops the arm.
* What stops the arm, or takes it over, is a fault until ``recover``, which clears the controller's error.
"""

from __future__ import annotations

import time
from math import inf, isfinite
from typing import Any

from hal.driver import Floats, Reading, RobotDriver, Setpoint
from hal.errors import ConnectionLost, Fault, RobotFault
from hal.specs import RobotSpec

from . import faults
from .link import PERIOD, Report, ReportLine, XArmLink
from .settings import XArmSettings

_SILENCE = 0.12
"""Time without a report, or without an answer, after which the connection counts as lost, s. A packet that the network
lost is sent again after about 0.2 s."""
_PAUSED = 0.06
"""Time between two calls of read() from which a silence is this process's own, s."""
_RETRY = 0.5
"""Time between attempts to connect again, s."""
_EXPLAIN = 0.08
"""Longest time to find out why the arm stopped, s."""
_LAG, _APART = 0.1, 0.06
"""Time by which the arm may follow its set-points later, s, and a distance, rad: chosen."""
_SETTLING = 0.3
"""Time that an arm which was stopped takes to come to rest, s."""
_STARTED = 0.3
"""Time after the motors were switched on within which the reports must say so, s."""
_AT_REST = 0.02
"""Speed of a joint below which an arm that is not ours counts as being at rest, rad/s."""


class XArm(RobotDriver):
    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = XArmSettings.of(spec)
        self.engaged = False
        self._n = len(spec.joints)
        self._link = XArmLink(spec.name, self.settings, self._n)
        self._reports = ReportLine(spec.name, self.settings.host)
        self._farthest = max(spec.limits.velocity) * _LAG + _APART
        self._clear()

    def _clear(self) -> None:
        self._open = self._lost = False
        self._fault: Fault | None = None
        """Fault of a session, until recover()."""
        self._last: Reading | None = None
        self._report: Report | None = None
        self._seq = 0
        self._t_new = self._t_read = self._t_tried = self._t_ours = -inf
        self._t_trouble = inf
        """Since when the arm is not ready for set-points, s."""
        self._held_back = -1
        """Number of the report after which set-points wait for a new one."""

    def open(self) -> None:
        """Connect. Nothing moves, and no motor is switched on."""
        self.close()
        self._clear()
        try:
            self._link.open()
            first = self._reports.open()
            self._take(time.monotonic(), first)
        except BaseException:
            self.close()
            raise
        self._open = True

    def close(self) -> None:
        """Stop the arm, if it was ours: it holds. Idempotent."""
        self.engaged = self._open = False
        self._reports.close()
        self._link.close()

    # Every cycle.

    def read(self, now: float) -> Reading:
        self._check_open()
        link = self._link
        if now - self._t_read > _PAUSED:  # this process did not run: what is new has yet to be received
            self._t_new = now
            link.forgive(now)
        self._t_read = now
        try:
            reports = self._reports.receive()
            hung_up = False
        except OSError:
            reports, hung_up = [], True
        if reports:
            self._take(now, reports)
        silent = hung_up or now - self._t_new > _SILENCE
        if silent and now - self._t_tried > _RETRY:
            self._t_tried = now
            self._reports.retry()
        if silent or now - link.silent_since > _SILENCE or not link.connected or self._last is None:
            raise self._lose()
        if self.engaged or self._lost:  # the first reports after a loss may be late, and show the end of our own motion
            self._t_ours = now
        self._lost = False
        fault = self._judge(now)
        # Reports are of 100 Hz and have no set-point: while they are sent, the last one that was sent is reported.
        taken = link.sent if self.engaged else None
        self._last = self._last._replace(q_commanded=taken, fault=fault)
        return self._last

    def _check_open(self) -> None:
        if not self._open:
            raise ConnectionLost(f"{self.spec.name} is not open")

    def _lose(self) -> ConnectionLost:
        self._lost, self.engaged = True, False
        self._link.lose()
        return ConnectionLost.of(self.spec.name, faults.SILENT)

    def _take(self, now: float, reports: list[Report]) -> None:
        """Take the newest of the reports that have just come; speeds are differences of what they report."""
        n, last = self._n, self._last
        self._seq += len(reports)
        self._report = report = reports[-1]
        before: Floats = reports[0].q
        periods = len(reports) - 1
        if last is not None:  # several reports may come at once, and some may be left out
            before, periods = last.q, max(len(reports), round((now - last.t) / PERIOD))
        dq = [(b - a) / (PERIOD * periods) for a, b in zip(before, report.q, strict=False)][:n]
        self._t_new = now
        self._last = Reading(now, self._seq * PERIOD, self._seq, report.q[:n], dq, report.tau[:n])

    def engage(self) -> None:
        """Switch the motors on and set servo mode, or continue to: the arm holds."""
        self._check_open()
        link, report, last = self._link, self._report, self._last
        if report is None or last is None or self._lost:
            raise ConnectionLost.of(self.spec.name, faults.SILENT)
        fault = self._fault or last.fault or link.refused
        if fault is None and not link.starting and time.monotonic() - link.t_ready > _STARTED:
            fault = self._start(report, last)
        if fault is not None:
            link.refused = None
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)
        if link.ready and report.takes_setpoints and isfinite(sum(last.q)):
            link.sent = link.sent or list(last.q)  # the controller holds where the arm is: set-points begin there
            self.engaged, self._t_trouble = True, inf

    def _start(self, report: Report, last: Reading) -> Fault | None:
        """Begin to switch the motors on; return why the arm must be left alone."""
        fault = faults.find_occupant(report.mode, report.state, max(map(abs, last.dq)) > _AT_REST)
        if fault is None:
            self._link.start()
        elif fault is faults.BUSY and self._t_read - self._t_ours < _SETTLING:
            return None  # what moves is the end of our own motion: wait
        return fault

    def write(self, setpoint: Setpoint) -> bool:
        self._check_open()
        if self._lost or self._last is None:
            raise ConnectionLost.of(self.spec.name, faults.SILENT)
        if self._fault is not None or self._held_back == self._seq:
            return False
        if self._link.send(list(setpoint.q)):
            return True
        self._held_back = self._seq  # the servo starts again from the next report
        return False

    def halt(self) -> None:
        """Leave the arm at its last set-point, which the controller keeps."""

    def statistics(self) -> dict[str, Any]:
        return {"longest_answer_s": self._link.longest_answer, "warning": self._link.warning}

    # Faults.

    def _judge(self, now: float) -> Fault | None:
        """Return the present fault; one of a session stays until recover()."""
        link = self._link
        fault = faults.error_fault(link.error) if link.error else None
        if self.engaged:
            fault = fault or self._judge_session(now)
            if fault is not None:
                self._fault, self.engaged = fault, False
                (link.stop if fault in (faults.NOT_FOLLOWING, faults.PAUSE) else link.end)()
        return fault or self._fault

    def _judge_session(self, now: float) -> Fault | None:
        """Return why the arm does not follow set-points.

        None if it does, and for the moment that it takes to find out.
        """
        link, report, last = self._link, self._report, self._last
        assert report is not None
        assert last is not None
        if report.takes_setpoints and not link.refused_setpoint:
            self._t_trouble = inf
            off = max(abs(a - b) for a, b in zip(link.sent or last.q, last.q, strict=True))
            return faults.NOT_FOLLOWING if off > self._farthest else None
        if self._t_trouble == inf:
            self._t_trouble = now
            link.ask()
        known = min(link.t_errors, self._t_new) > self._t_trouble  # a refused set-point is known before its reason
        if not known and now - self._t_trouble < _EXPLAIN:
            return None
        if report.mode != faults.SERVO:
            return faults.OTHER_MODE
        return faults.PAUSE if report.state == faults.PAUSED else faults.STOP

    def recover(self) -> None:
        """Clear the controller's error and warning. The next session switches the motors on. Blocks for at most 2 s.

        Raises:
            RobotFault: The error came back at once: its cause is still there; ``code`` is the fault's.
            ConnectionLost: The controller does not answer.
        """
        self._check_open()
        if self._lost or not self._link.clean():
            raise ConnectionLost.of(self.spec.name, faults.SILENT)
        self._fault, self._t_trouble = None, inf
        if self._link.error:
            fault = faults.error_fault(self._link.error)
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)
