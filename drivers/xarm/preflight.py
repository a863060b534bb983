"""Pre-flight check of a UFACTORY arm: reachable, the arm of the model, ready, its tcp and payload, and late reports.

Nothing moves, and no motor is switched on. Checks run in the order in which they can succeed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from hal.errors import Fault
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.preflight import CheckResult, compare_payload, compare_tcp, measure_gaps
from hal.specs import RobotSpec

from .faults import NO_CONTROLLER, describe_warning, error_fault, find_occupant
from .link import PERIOD, Report, ReportLine, connect, lock_arm, probe
from .sdk import XCONF
from .settings import XArmSettings

_NARROWER = 1e-3
"""By how much a limit of the model may be beyond the controller's, rad."""
_FIRST = 1.0
"""Longest time until the first of the reports with errors and payload comes, s."""


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check one arm; measure its reports for ``duration`` s."""
    settings = XArmSettings.of(spec)
    host, line, api, lock = settings.host, ReportLine(spec.name, settings.host), None, None
    try:
        lock = lock_arm(host)
        why = probe(host)
        if why:
            raise OSError(why)
        api, report = connect(host, report_type="rich"), line.open()[-1]
        version = ".".join(map(str, api.version_number))
        found = f"{host} answers; firmware {version}, {api.axis} joints, type {api.device_type}"
        if api.axis != len(spec.joints):
            yield CheckResult("controller", "fail", f"{found}; the model has {len(spec.joints)}", "choose its model")
            return
        yield CheckResult("controller", "ok", found)
        yield from _check_state(api, report)
        yield check_limits(spec, api.axis, api.device_type, api.sn)
        yield _check_tcp(spec, report)
        wanted = (settings.load.mass, settings.load.com) if settings.load is not None else None
        yield compare_payload(wanted, api.tcp_load[0], [1e-3 * x for x in api.tcp_load[1]], "the controller")
        yield measure_gaps("reports", lambda: len(line.receive()), PERIOD, duration)
    except OSError as error:
        remedy = f"start it in another terminal: hal emulate xarm --host {host}"
        yield CheckResult("controller", "fail", str(error), remedy if spec.emulated else NO_CONTROLLER.remedy)
    finally:
        line.close()
        if api is not None:
            api.disconnect()
        if lock is not None:
            lock.release()


def _check_state(api: Any, report: Report) -> Iterator[CheckResult]:
    end = time.monotonic() + _FIRST
    while api.motor_enable_states[0] < 0 and time.monotonic() < end:
        time.sleep(0.01)
    found = [error_fault(api.error_code)] if api.error_code else []
    occupant = find_occupant(report.mode, report.state, moving=False)
    found += [occupant] if occupant is not None else []
    found += [Fault("", describe_warning(api.warn_code), "recover() clears it")] if api.warn_code else []
    for fault in found:
        yield CheckResult("state", "warn", fault.cause, fault.remedy)
    if not found:
        on = all(state == 1 for state in api.motor_enable_states[: api.axis])
        yield CheckResult("state", "ok", f"no error; motors {'on' if on else 'off, until a session opens'}")


def check_limits(spec: RobotSpec, axis: int, kind: int, serial: str | None) -> CheckResult:
    """Compare the model's joint limits with those that the SDK has for this arm, by its type and serial number."""
    digits = (serial or "")[2:6]
    newer = digits.isdigit() and 1305 <= int(digits) < 8500  # as the SDK decides it
    known = XCONF.Robot.JOINT_LIMITS.get(axis, {}).get(int(f"{axis}1305") if newer else kind)
    if known is None:
        return CheckResult("limits", "unknown", f"the SDK has none for type {kind}", "compare them with the manual")
    wider = [
        f"{joint} {least:.3f} to {most:.3f} rad"
        for joint, low, high, (least, most) in zip(
            spec.joints, spec.limits.lower, spec.limits.upper, known, strict=False
        )
        if low < least - _NARROWER or high > most + _NARROWER
    ]
    if not wider:
        return CheckResult("limits", "ok", "those of the model are within the controller's")
    remedy = "set them under limits: of the arm in the rig; beyond them the controller stops with C23"
    return CheckResult("limits", "warn", f"narrower than the model's are: {', '.join(wider)}", remedy)


def _check_tcp(spec: RobotSpec, report: Report) -> CheckResult:
    """Compare the controller's tcp with the model's: they differ by the tcp set there, and by the calibration."""
    position, (roll, pitch, yaw) = [1e-3 * x for x in report.pose[:3]], report.pose[3:]
    theirs = Pose.from_rpy(position, (roll, pitch, yaw))
    distance, turn = theirs.distance(Kinematics(spec.kinematics).pose(report.q[: len(spec.joints)]))
    remedy = "set the model's in UFACTORY Studio: the controller's own limits of speed and space are for its tcp"
    return compare_tcp(distance, turn, remedy)
