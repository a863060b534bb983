"""Before a Franka moves: is it there, is it the arm that the rig names, may it move, and is the network fast enough?

The questions are asked in the order in which they can be answered; what an answer makes idle is not asked.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from hal import registry
from hal.errors import ConnectionLost, ControlTaken
from hal.host.process import Child
from hal.preflight import CheckResult
from hal.specs import RobotSpec
from hal.types import Fault

from .claim import claim_arm
from .faults import ARM_PORT, HAND_PORT, fault_of
from .preflight_network import Answer, knock, resolve, route_to
from .preflight_ping import ALLOW, NotMeasured, judge, measure
from .settings import ArmSettings, HandSettings
from .troubles import NO_HAND, NO_WAY, REFUSED, UNKNOWN_HOST, UNREACHABLE

__all__ = ["check"]

PATIENCE = 5.0
"""s for the robot to say who it is, the start of the process that asks included; it needs a fraction of that."""
_TROUBLES = {Answer.REFUSED: REFUSED, Answer.SILENT: UNREACHABLE, Answer.NO_WAY: NO_WAY}
_HAND_LIBRARY = "panda_py"
_EMULATOR = "start it in another terminal: python -m hal.drivers.franka.emulator --host {host} (--help says more)"
_FREE = "end the program that uses this arm, also on other computers; if there is none, restart the robot in Desk"


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Look at one arm; the network is measured for ``duration`` s. Nothing moves, and nothing stays connected."""
    settings = ArmSettings.of(spec)
    try:
        claim = claim_arm(settings.host)
    except ControlTaken as error:
        yield CheckResult("in use", "fail", str(error), "end that program first; nothing else was looked at")
        return
    try:
        yield from _check(spec, settings, duration)
    finally:
        claim.release()


def _check(spec: RobotSpec, settings: ArmSettings, duration: float) -> Iterator[CheckResult]:
    host = settings.host
    address = resolve(host)
    if address is None:
        yield _failed("address", UNKNOWN_HOST.fault(host))
        return
    yield _route(host, address)
    answer = knock(address, ARM_PORT)
    if answer is not Answer.OPEN:
        verdict = _failed("robot", _TROUBLES[answer].fault(f"{host}:{ARM_PORT}"))
        yield replace(verdict, remedy=_EMULATOR.format(host=host)) if spec.emulated else verdict
        return
    yield from _robot(spec, settings)
    yield from _hand(spec)
    yield _network(address, duration)


def _route(host: str, address: str) -> CheckResult:
    route = route_to(address)
    named = address if host == address else f"{host} is {address}"
    if route is None:
        return CheckResult("route", "unknown", f"{named}; Linux does not say how packets go there")
    straight = "give a network port of this computer an address beside the robot's, and connect the two directly"
    if route.interface == "lo":
        return CheckResult("route", "ok", f"{named}, this computer: an emulator")
    if route.gateway is not None:
        return CheckResult(
            "route", "warn", f"{named}, through the router {route.gateway} ({route.interface})", straight
        )
    if route.wireless:
        return CheckResult("route", "warn", f"{named}, by radio ({route.interface})", "use a cable")
    return CheckResult("route", "ok", f"{named}, on the network of {route.interface}")


def _robot(spec: RobotSpec, settings: ArmSettings) -> Iterator[CheckResult]:
    """What the robot says of itself."""
    host = settings.host
    said = _ask(host, settings.arm)
    if said is None:
        found = f"{host}:{ARM_PORT} is open, but nobody answers there: another program may hold the arm"
        yield CheckResult("robot", "fail", found, _FREE)
        return
    if "missing" in said:
        yield _missing(said["missing"])
    elif "fault" in said:
        fault = Fault(*said["fault"])
        if fault.code == "closed":
            yield CheckResult("robot", "fail", f"{host}:{ARM_PORT} hangs up: another program may hold the arm", _FREE)
        else:
            yield _failed("robot", fault)
    else:
        yield CheckResult(
            "robot", "ok", f"answers; speaks protocol {said['protocol']}, as the model {spec.model!r} needs"
        )
        yield _mode(said["mode"], said["flags"])
        yield _reports(said["noise"])


def _failed(name: str, fault: Fault) -> CheckResult:
    return CheckResult(name, "fail", fault.cause, fault.remedy)


def _missing(library: str) -> CheckResult:
    command = registry.missing("franka").get(library, "pip install 'robot-hal[franka]'")
    return CheckResult("library", "fail", f"{library} does not import", command)


def _mode(mode: str, flags: list[str]) -> CheckResult:
    """A robot that is stopped is told, and is no reason not to start: the app can clear it."""
    fault = fault_of(flags, mode)
    if fault is None:
        return CheckResult("state", "ok", "ready to move" if mode == "idle" else f"mode {mode!r}")
    return CheckResult("state", "warn", fault.cause, fault.remedy)


def _reports(noise: float) -> CheckResult:
    """How exactly an arm at rest reports its set-points. How late it does shows only in motion."""
    from hal.servo.anchoring import NOISIEST

    found = f"reported within {noise:.1g} rad at rest; how late, the first motion shows (rig.statistics())"
    if noise <= NOISIEST:
        return CheckResult("set-points", "ok", found)
    return CheckResult(
        "set-points", "fail", found, f"the servo needs {NOISIEST:g} rad; end what moves the arm, then look again"
    )


def _hand(spec: RobotSpec) -> Iterator[CheckResult]:
    """Is the hand there, where the rig has it, and what its driver needs?"""
    gripper = spec.gripper
    if gripper is None or gripper.driver != spec.driver:
        return
    if _HAND_LIBRARY in registry.missing("franka"):
        yield _missing(_HAND_LIBRARY)
    host = HandSettings.of(gripper).host
    address = resolve(host)
    if address is not None and knock(address, HAND_PORT) is Answer.OPEN:
        yield CheckResult("hand", "ok", f"answers at port {HAND_PORT}")
        return
    yield _failed("hand", NO_HAND.fault(f"{host}:{HAND_PORT}"))


def _ask(host: str, arm: str) -> dict[str, Any] | None:
    """What :mod:`.preflight_child` found out; None where it got no answer in time."""
    child = Child("check", "hal.drivers.franka.preflight_child:main", {"host": host, "arm": arm})
    try:
        return dict(child.wait_ready(PATIENCE))
    except ConnectionLost:
        if child.process.poll() is not None:
            raise  # it did not hang, it broke
        return None
    finally:
        child.close(0.2)


def _network(address: str, duration: float) -> CheckResult:
    try:
        return judge(measure(address, duration))
    except NotMeasured as error:
        return CheckResult("network", "unknown", f"not measured: {error}", ALLOW)
