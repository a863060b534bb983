"""Pre-flight check of a UFACTORY arm: reachable, the arm of the model, ready, its tcp and payload, and late reports.

Nothing moves, and no motor is switched on. Checks run in the order in which they can succeed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from hal.errors import ControlTaken, Fault
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.preflight import CheckResult
from hal.specs import RobotSpec

from .faults import NO_CONTROLLER, describe_warning, error_fault, find_occupant
from .link import PERIOD, Report, ReportLine, connect, lock_arm, probe
from .sdk import XCONF
from .settings import XArmSettings

_FAR, _TURNED = 0.001, 0.005
"""Difference of two tcps that is named, m and rad."""
_NARROWER = 1e-3
"""By how much a limit of the model may be beyond the controller's, rad."""
_LATE = 2.5
"""Periods without a report from which one is late."""
_FIRST = 1.0
"""Longest time until the first of the reports with errors and payload comes, s."""


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check one arm.

    Args:
        spec: The arm in the rig.
        duration: Time for measuring its reports, s.

    Yields:
        One result per check.
    """
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
        yield _check_payload(settings, api)
        yield _check_reports(line, duration)
    except ControlTaken as error:
        yield CheckResult("in use", "fail", str(error), "end that program first; nothing else was checked")
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
    found = f"{1e3 * distance:.1f} mm and {turn:.3f} rad between the controller's and the model's"
    if distance <= _FAR and turn <= _TURNED:
        return CheckResult("tcp", "ok", found)
    remedy = "set the model's in UFACTORY Studio: the controller's own limits of speed and space are for its tcp"
    return CheckResult("tcp", "warn", found, remedy)


def _check_payload(settings: XArmSettings, api: Any) -> CheckResult:
    mass, com = api.tcp_load[0], [1e-3 * x for x in api.tcp_load[1]]
    found = f"{mass:.2f} kg at [{', '.join(f'{value:.3f}' for value in com)}] m in the controller"
    load = settings.load
    if load is None:
        return CheckResult("payload", "ok", f"{found}; real.load is not set, so it stays")
    if abs(load.mass - mass) < 0.01 and max(abs(a - b) for a, b in zip(load.com, com, strict=True)) < 0.002:
        return CheckResult("payload", "ok", f"{found}, as the rig has it")
    wanted = f"the rig has {load.mass:g} kg at {list(load.com)} m"
    return CheckResult("payload", "warn", f"{found}; {wanted}", "the rig's is set when a session opens")


def _check_reports(line: ReportLine, duration: float) -> CheckResult:
    """Measure when reports come."""
    end = time.monotonic() + max(duration, 0.2)
    times: list[float] = []
    line.receive()
    while time.monotonic() < end:
        time.sleep(2e-4)
        times += [time.monotonic()] * len(line.receive())
    gaps = np.diff(times) if len(times) > 1 else np.array([np.inf])
    late = int((gaps > _LATE * PERIOD).sum())
    found = f"{len(times)} reports, longest gap {1e3 * gaps.max():.1f} ms, {late} late"
    if late <= len(times) // 100:
        return CheckResult("reports", "ok", found)
    return CheckResult("reports", "warn", found, "connect the cable directly, end busy programs")
