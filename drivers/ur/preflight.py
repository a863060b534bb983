"""Pre-flight check of a UR arm: reachable, ready for a program, calibration, tcp and payload, and late states.

Nothing moves, and no program is started. Checks run in the order in which they can succeed.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import ConnectionLost
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.preflight import CheckResult, compare_payload, compare_tcp, measure_gaps
from hal.specs import RobotSpec

from .arm import find_tcp
from .faults import (
    LOCAL,
    NO_CONTROLLER,
    NO_DASHBOARD,
    OTHER_PROGRAM,
    PLAYING,
    RUNNING,
    mode_fault,
    safety_fault,
    scaling_fault,
)
from .link import UrLink, probe
from .settings import UrSettings

_NOMINAL, _OTHER_ARM = 5e-5, 0.015
"""Largest difference of two tcps without a calibration, and with one, m: users report up to 10 mm."""
_PRIMARY = 30001
"""Port of the primary interface."""


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check one arm; measure its states for ``duration`` s."""
    settings = UrSettings.of(spec)
    why = probe(settings.host)
    if why:
        remedy = f"start it in another terminal: hal emulate ur --host {settings.host}"
        yield CheckResult("controller", "fail", why, remedy if spec.emulated else NO_CONTROLLER.remedy)
        return
    link = UrLink(spec.name, settings, spec.rate_hz, None)
    try:
        link.open()
        yield CheckResult("controller", "ok", f"{settings.host} answers; PolyScope {link.version}, {link.rate:g} Hz")
        yield from _check_state(link)
        if find_tcp(spec) is not None:
            yield _check_calibration(spec, settings.host)
        yield _check_tcp(spec, settings, link.receive)
        yield _check_payload(settings, link)
        yield _check_states(spec, link, duration)
    except ConnectionLost as error:
        fault = error.fault or NO_CONTROLLER
        yield CheckResult("controller", "fail", str(error), fault.remedy)
    finally:
        link.close()


def _check_state(link: UrLink) -> Iterator[CheckResult]:
    receive = link.receive
    safety, mode, slider = receive.getSafetyMode(), receive.getRobotMode(), receive.getTargetSpeedFraction()
    stop, local = safety_fault(safety), link.ask_local()
    found = [stop] if stop is not None else [mode_fault(mode)] if mode != RUNNING else []
    found += [LOCAL] if local else [NO_DASHBOARD] if local is None else []
    found += [OTHER_PROGRAM] if receive.getRuntimeState() == PLAYING else []
    found += [scaling_fault(slider, slider=True)] if not slider >= 1.0 else []
    for fault in found:
        yield CheckResult("state", "warn", fault.cause, fault.remedy)
    if not found:
        yield CheckResult("state", "ok", "ready to move")


def _check_calibration(spec: RobotSpec, host: str) -> CheckResult:
    """Compare the tcp of the controller's lengths and angles with the model's, at home and at random positions."""
    try:
        parameters = _read_kinematics(host)
    except (OSError, struct.error) as error:
        remedy = "allow the primary interface (Settings, Security, Services)"
        return CheckResult("calibration", "unknown", f"port {_PRIMARY} of {host}: {error}", remedy)
    kinematics, tcp = Kinematics(spec.kinematics), Pose(spec.kinematics.tcp_position, spec.kinematics.tcp_orientation)
    apart = [
        float(np.linalg.norm((_find_flange(parameters, q) @ tcp).position - kinematics.pose(q).position))
        for q in [np.array(spec.home), *np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 6))]
    ]
    found = f"the model's tcp is off by up to {1e3 * max(apart):.1f} mm, by {1e3 * apart[0]:.1f} mm at home"
    if max(apart) > _OTHER_ARM:
        return CheckResult("calibration", "fail", found, f"this is no {spec.model}: name its model in the rig")
    if max(apart) < _NOMINAL:
        return CheckResult("calibration", "ok", "none: the controller has the nominal lengths, as the model has")
    return CheckResult("calibration", "ok", f"a factory calibration, not used here: {found}")


def _read_kinematics(host: str) -> NDArray[np.float64]:
    """Return the controller's DH parameters (4, 6): theta, rad, added to the joint positions; a and d, m; alpha, rad.

    From the first message of the primary interface, as UniversalRobots/Universal_Robots_Client_Library reads it.
    """
    with socket.create_connection((host, _PRIMARY), 2.0) as line, line.makefile("rb") as stream:
        for _ in range(20):
            size, kind = struct.unpack(">iB", stream.read(5))
            parts = stream.read(min(max(size - 5, 0), 1 << 16))
            while kind == 16 and parts:  # a state of the robot
                length, part = struct.unpack(">iB", parts[:5])
                if part == 5:  # after six checksums
                    return np.array(struct.unpack(">24d", parts[29:221])).reshape(4, 6)
                parts = parts[max(length, 5) :]
    raise OSError("it sends no kinematics")


def _find_flange(parameters: NDArray[np.float64], q: NDArray[np.float64]) -> Pose:
    """Return the pose of the flange that DH parameters give, in the base of UR's models."""
    pose = np.diag([-1.0, -1.0, 1.0, 1.0])
    for angle, (theta, a, d, alpha) in zip(q, parameters.T, strict=True):
        c, s, ca, sa = np.cos(angle + theta), np.sin(angle + theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return Pose.from_matrix(pose)


def _check_tcp(spec: RobotSpec, settings: UrSettings, receive: Any) -> CheckResult:
    """Compare the controller's tcp with the model's: they differ by the installation's tcp, and by the calibration."""
    x, y, z, *turn = receive.getActualTCPPose()
    angle = float(np.linalg.norm(turn))
    axis = np.array(turn) * 0.5 * np.sinc(0.5 * angle / np.pi)
    theirs = Pose((x, y, z), (*axis, np.cos(angle / 2.0)))
    half_turn = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))  # from the controller's base to that of UR's models
    distance, rotation = (half_turn @ theirs).distance(Kinematics(spec.kinematics).pose(receive.getActualQ()))
    sets = settings.set_tcp and find_tcp(spec) is not None
    remedy = "the model's is set when a session opens" if sets else "set the model's in the installation"
    return compare_tcp(distance, rotation, f"{remedy}; what stays then is the factory calibration")


def _check_payload(settings: UrSettings, link: UrLink) -> CheckResult:
    if not link.has_payload:
        return CheckResult("payload", "unknown", "this PolyScope does not report it", "check it in the installation")
    receive, load = link.receive, settings.load
    wanted = (load.mass, load.com) if load is not None else None
    return compare_payload(wanted, receive.getPayload(), receive.getPayloadCog(), "the installation")


def _check_states(spec: RobotSpec, link: UrLink, duration: float) -> CheckResult:
    """Measure when states come."""
    if abs(link.rate - spec.rate_hz) > 1.0:
        found = f"the controller runs at {link.rate:g} Hz, the model at {spec.rate_hz:g} Hz"
        return CheckResult("states", "fail", found, f"set rate_hz: {link.rate:g} in the arm's model")
    seen: list[float] = [0.0]

    def receive() -> int:
        seen.append(link.receive.getTimestamp())
        return int(seen.pop(0) != seen[0])

    return measure_gaps("states", receive, 1.0 / spec.rate_hz, duration)
